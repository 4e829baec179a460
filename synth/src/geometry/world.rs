//! Bodies in the world, and the question every ray asks: what do I meet first?

use nalgebra::{Matrix3, Point3, Vector3};

use super::bvh::Bvh;
use super::{Bounds, Ray, Shape, Span};

/// Where a shape stands: `x_world = rotation x_local + centre`.
#[derive(Clone, Copy, Debug)]
pub struct Placement {
    /// Local to world.
    pub rotation: Matrix3<f64>,
    /// The local origin in the world.
    pub centre: Point3<f64>,
}

impl Placement {
    /// Into the local frame; `t` stays what it was.
    #[inline]
    fn to_local(self, ray: &Ray) -> Ray {
        Ray { origin: self.point_to_local(&ray.origin), direction: self.rotation.tr_mul(&ray.direction) }
    }

    #[inline]
    fn point_to_local(&self, point: &Point3<f64>) -> Point3<f64> {
        Point3::from(self.rotation.tr_mul(&(point - self.centre)))
    }
}

/// A shape at its place.
#[derive(Clone, Debug)]
pub struct Body {
    /// Its form.
    pub shape: Shape,
    /// Its place.
    pub placement: Placement,
}

impl Body {
    fn bounds(&self) -> Bounds {
        let Bounds { min, max } = self.shape.bounds();
        let middle = self.placement.rotation * nalgebra::center(&min, &max).coords;
        let half = self.placement.rotation.abs() * ((max - min) / 2.0);
        let centre = self.placement.centre + middle;
        Bounds { min: centre - half, max: centre + half }
    }
}

/// What a ray met.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// The index of the body.
    pub body: usize,
    /// The ray's `t`.
    pub t: f64,
    /// Where in the world.
    pub point: Point3<f64>,
    /// The outward normal in the world, of length 1.
    pub normal: Vector3<f64>,
    /// Where in the body's frame.
    pub local: Point3<f64>,
    /// Coordinates along the surface, see [`Shape::surface_coordinates`].
    pub along: [f64; 2],
}

/// All bodies of a scene.
#[derive(Clone, Debug)]
pub struct World {
    bodies: Vec<Body>,
    bvh: Bvh,
}

impl World {
    /// Takes the bodies; their order gives their indices.
    pub fn new(bodies: Vec<Body>) -> Self {
        let bounds: Vec<_> = bodies.iter().map(Body::bounds).collect();
        Self { bvh: Bvh::new(&bounds, 1), bodies }
    }

    /// The first `t` above 0 at which the ray meets a body, and which.
    #[inline]
    pub fn nearest(&self, ray: &Ray) -> Option<(f64, usize)> {
        let mut nearest = None;
        let span = Span { min: 0.0, max: f64::INFINITY };
        self.bvh.visit(&ray.origin, &ray.direction, span, |index, max| {
            let body = &self.bodies[index];
            let local = body.placement.to_local(ray);
            let hit = body.shape.intersect(&local, Span { min: 0.0, max });
            nearest = hit.map(|t| (t, index)).or(nearest);
            Some(hit.unwrap_or(max))
        });
        nearest
    }

    /// The first hit above 0 with all that shading needs.
    pub fn trace(&self, ray: &Ray) -> Option<Hit> {
        let (t, index) = self.nearest(ray)?;
        let body = &self.bodies[index];
        let point = ray.at(t);
        let local = body.placement.point_to_local(&point);
        let (normal, along) = match &body.shape {
            Shape::Mesh(part) => part.surface(&body.placement.to_local(ray), &local),
            shape => {
                let normal = shape.normal(&local);
                (normal, shape.surface_coordinates(&local, &normal))
            }
        };
        Some(Hit { body: index, t, point, normal: body.placement.rotation * normal, local, along })
    }

    /// Whether anything lies on the ray between 0 and `max`.
    #[inline]
    pub fn occluded(&self, ray: &Ray, max: f64) -> bool {
        let mut occluded = false;
        self.bvh.visit(&ray.origin, &ray.direction, Span { min: 0.0, max }, |index, max| {
            let body = &self.bodies[index];
            let local = body.placement.to_local(ray);
            occluded = body.shape.intersect(&local, Span { min: 0.0, max }).is_some();
            (!occluded).then_some(max)
        });
        occluded
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    use super::*;

    fn crowd() -> Vec<Body> {
        (0..23)
            .map(|i| {
                let a = f64::from(i);
                let size = 0.2 + 0.15 * (a * 0.7).sin().abs();
                Body {
                    shape: match i % 3 {
                        0 => Shape::Cuboid { half: Vector3::new(size, 0.3, 0.2) },
                        1 => Shape::Ellipsoid { radii: Vector3::new(0.2, size, 0.4) },
                        _ => Shape::Cylinder { radius: size, half_height: 0.4 },
                    },
                    placement: Placement {
                        rotation: Rotation3::from_euler_angles(a, 0.3 * a, 0.0).into_inner(),
                        centre: Point3::new((1.3 * a).sin(), (2.1 * a).cos(), (0.8 * a).sin()) * 2.0,
                    },
                }
            })
            .collect()
    }

    proptest! {
        #[test]
        fn the_tree_finds_what_a_plain_search_finds(
            origin in prop::array::uniform3(-5.0_f64..5.0),
            target in prop::array::uniform3(-2.0_f64..2.0),
        ) {
            let bodies = crowd();
            let ray = Ray { origin: Point3::from(origin), direction: Point3::from(target) - Point3::from(origin) };
            let plain = bodies
                .iter()
                .enumerate()
                .filter_map(|(i, body)| {
                    let local = body.placement.to_local(&ray);
                    let t = body.shape.intersect(&local, Span { min: 0.0, max: f64::INFINITY })?;
                    Some((t, i))
                })
                .min_by(|a, b| a.0.total_cmp(&b.0));
            let world = World::new(bodies);
            prop_assert_eq!(world.nearest(&ray), plain);
            prop_assert_eq!(world.occluded(&ray, 1.0), plain.is_some_and(|(t, _)| t < 1.0));
        }
    }

    #[test]
    fn an_empty_world_hides_nothing() {
        let ray = Ray { origin: Point3::origin(), direction: Vector3::x() };
        assert!(World::new(Vec::new()).trace(&ray).is_none());
    }
}
