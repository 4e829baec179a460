//! A bounding volume hierarchy: median splits, built once over the bodies of a scene or the triangles of
//! a mesh.

use nalgebra::{Point3, Vector3};

use super::{Bounds, Span};

/// Deep enough for any count: halves are even, so the depth is the logarithm of the count.
const MAX_DEPTH: usize = 40;

/// A binary tree of boxes, stored depth first: the left child follows its parent.
#[derive(Clone, Debug)]
pub struct Bvh {
    nodes: Vec<Node>,
    /// The items of all leaves; those of one stand together.
    order: Vec<u32>,
}

#[derive(Clone, Copy, Debug)]
struct Node {
    bounds: Bounds,
    kind: Kind,
}

#[derive(Clone, Copy, Debug)]
enum Kind {
    /// Its items are `order[first..last]`.
    Leaf {
        first: u32,
        last: u32,
    },
    Split {
        right: u32,
    },
}

impl Bvh {
    /// Builds the tree with up to `leaf_size` items per leaf; the index of a box is the item's.
    pub fn new(bounds: &[Bounds], leaf_size: usize) -> Self {
        let mut nodes = Vec::with_capacity(2 * bounds.len().div_ceil(leaf_size));
        let mut order: Vec<u32> = (0..bounds.len() as u32).collect();
        if !order.is_empty() {
            build(bounds, &mut order, 0, leaf_size, &mut nodes);
        }
        Self { nodes, order }
    }

    /// A box that holds all items; `None` when there are none.
    pub fn bounds(&self) -> Option<Bounds> {
        self.nodes.first().map(|node| node.bounds)
    }

    /// Calls `visit(item, max)` for every item in a leaf whose box the ray crosses before `max`, near
    /// boxes first; it returns the `max` from there on, or `None` to stop.
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
                    Kind::Leaf { first, last } => {
                        for item in &self.order[first as usize..last as usize] {
                            match visit(*item as usize, span.max) {
                                Some(max) => span.max = max,
                                None => return,
                            }
                        }
                    }
                    Kind::Split { right } => {
                        let (left, right) = (current + 1, right as usize);
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

/// Builds the node of the items in `order`, which stand from `start` on in the whole.
fn build(bounds: &[Bounds], order: &mut [u32], start: usize, leaf_size: usize, nodes: &mut Vec<Node>) {
    let of = |item: &u32| &bounds[*item as usize];
    let all = order[1..].iter().fold(*of(&order[0]), |all, item| all.union(of(item)));
    if order.len() <= leaf_size {
        let kind = Kind::Leaf { first: start as u32, last: (start + order.len()) as u32 };
        nodes.push(Node { bounds: all, kind });
        return;
    }
    let axis = (all.max - all.min).iamax();
    let middle = |item: &u32| of(item).min[axis] + of(item).max[axis];
    let half = order.len() / 2;
    order.select_nth_unstable_by(half, |a, b| middle(a).total_cmp(&middle(b)).then(a.cmp(b)));
    let (left, right) = order.split_at_mut(half);
    let at = nodes.len();
    nodes.push(Node { bounds: all, kind: Kind::Split { right: 0 } });
    build(bounds, left, start, leaf_size, nodes);
    nodes[at].kind = Kind::Split { right: nodes.len() as u32 };
    build(bounds, right, start + half, leaf_size, nodes);
}
