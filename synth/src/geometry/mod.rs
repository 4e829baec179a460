//! Where a ray meets the scene, in double precision.

mod bvh;
mod heightfield;
mod mesh;
mod shape;
mod torus;
mod world;

pub use heightfield::Heightfield;
pub use mesh::{MeshHit, MeshShape, TriangleMesh};
pub use shape::Shape;
pub use world::{Body, Hit, Placement, World};

use nalgebra::{Point3, Vector3};

/// The points `origin + t direction`. The direction need not have length 1: `t` counts in it, so a
/// camera ray whose direction has z = 1 in the camera frame yields depth as `t`.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Where `t` is 0.
    pub origin: Point3<f64>,
    /// What one unit of `t` adds.
    pub direction: Vector3<f64>,
}

impl Ray {
    /// The point at `t`.
    #[inline]
    pub fn at(&self, t: f64) -> Point3<f64> {
        self.origin + self.direction * t
    }
}

/// A stretch of a ray, open at both ends.
#[derive(Clone, Copy, Debug)]
pub struct Span {
    /// Where it begins.
    pub min: f64,
    /// Where it ends.
    pub max: f64,
}

impl Span {
    #[inline]
    pub(crate) fn contains(&self, t: f64) -> bool {
        t > self.min && t < self.max
    }

    /// The first of two parameters in rising order that lies inside.
    #[inline]
    pub(crate) fn first_of(&self, near: f64, far: f64) -> Option<f64> {
        if self.contains(near) { Some(near) } else { self.contains(far).then_some(far) }
    }
}

/// A box along the axes.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    /// Smallest coordinates.
    pub min: Point3<f64>,
    /// Largest coordinates.
    pub max: Point3<f64>,
}

impl Bounds {
    /// The smallest box that holds both.
    #[must_use]
    pub fn union(&self, other: &Self) -> Self {
        Self { min: self.min.inf(&other.min), max: self.max.sup(&other.max) }
    }

    /// Where the line of a ray is inside: `None` when it misses. `inverse` is one over its direction.
    #[inline]
    pub fn crossing(&self, origin: &Point3<f64>, inverse: &Vector3<f64>, span: Span) -> Option<Span> {
        let Span { mut min, mut max } = span;
        for axis in 0..3 {
            let (first, last) = if inverse[axis] < 0.0 { (self.max, self.min) } else { (self.min, self.max) };
            let near = (first[axis] - origin[axis]) * inverse[axis];
            // Three roundings in each: without room for them a ray through a corner misses all boxes that
            // share it (Ize, Robust BVH Ray Traversal, 2013).
            let far = (last[axis] - origin[axis]) * inverse[axis] * (1.0 + 4.0 * f64::EPSILON);
            // Zero times infinity gives NaN, which both comparisons skip: the ray lies in that face.
            min = if near > min { near } else { min };
            max = if far < max { far } else { max };
        }
        (min <= max).then_some(Span { min, max })
    }
}
