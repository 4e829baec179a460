//! A bounding volume hierarchy over few bodies: median splits, built once per scene.

use nalgebra::{Point3, Vector3};

use super::{Bounds, Span};

/// Deep enough for any count: halves are even, so the depth is the logarithm of the count.
const MAX_DEPTH: usize = 32;

/// A binary tree of boxes, stored depth first: the left child follows its parent.
#[derive(Clone, Debug)]
pub struct Bvh {
    nodes: Vec<Node>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    bounds: Bounds,
    kind: Kind,
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    Leaf { body: usize },
    Split { right: usize },
}

impl Bvh {
    /// Builds the tree; the index of a box is the body's.
    pub fn new(bounds: &[Bounds]) -> Self {
        let mut nodes = Vec::with_capacity(2 * bounds.len());
        let mut order: Vec<usize> = (0..bounds.len()).collect();
        if !order.is_empty() {
            build(bounds, &mut order, &mut nodes);
        }
        Self { nodes }
    }

    /// Calls `visit(body, max)` for every body whose box the ray crosses before `max`, near boxes
    /// first; it returns the `max` from there on, or `None` to stop.
    #[inline]
    pub fn visit(
        &self,
        origin: &Point3<f64>,
        direction: &Vector3<f64>,
        mut span: Span,
        mut visit: impl FnMut(usize, f64) -> Option<f64>,
    ) {
        let inverse = direction.map(f64::recip);
        let enters = |node: usize, span: Span| {
            let node = self.nodes.get(node)?;
            node.bounds.crossing(origin, &inverse, span).map(|inside| inside.min)
        };
        let mut stack = [(0_usize, 0.0_f64); MAX_DEPTH];
        let mut height = 0;
        let Some(mut near) = enters(0, span) else { return };
        let mut current = 0;
        loop {
            if near < span.max {
                match self.nodes[current].kind {
                    Kind::Leaf { body } => match visit(body, span.max) {
                        Some(max) => span.max = max,
                        None => return,
                    },
                    Kind::Split { right } => {
                        let left = current + 1;
                        match (enters(left, span), enters(right, span)) {
                            (Some(l), Some(r)) => {
                                let (first, second) =
                                    if l <= r { ((left, l), (right, r)) } else { ((right, r), (left, l)) };
                                stack[height] = second;
                                height += 1;
                                (current, near) = first;
                                continue;
                            }
                            (Some(l), None) => {
                                (current, near) = (left, l);
                                continue;
                            }
                            (None, Some(r)) => {
                                (current, near) = (right, r);
                                continue;
                            }
                            (None, None) => {}
                        }
                    }
                }
            }
            if height == 0 {
                return;
            }
            height -= 1;
            (current, near) = stack[height];
        }
    }
}

fn build(bounds: &[Bounds], order: &mut [usize], nodes: &mut Vec<Node>) {
    let all = order[1..].iter().fold(bounds[order[0]], |all, i| all.union(&bounds[*i]));
    if let [body] = *order {
        nodes.push(Node { bounds: all, kind: Kind::Leaf { body } });
        return;
    }
    let axis = (all.max - all.min).iamax();
    let middle = |i: usize| bounds[i].min[axis] + bounds[i].max[axis];
    order.sort_by(|a, b| middle(*a).total_cmp(&middle(*b)).then(a.cmp(b)));
    let (left, right) = order.split_at_mut(order.len() / 2);
    let at = nodes.len();
    nodes.push(Node { bounds: all, kind: Kind::Split { right: 0 } });
    build(bounds, left, nodes);
    nodes[at].kind = Kind::Split { right: nodes.len() };
    build(bounds, right, nodes);
}
