//! The shapes scenes are made of, each in its own frame, centred at the origin.

use std::f64::consts::TAU;

use nalgebra::{Point3, Vector3};

use super::{Bounds, Heightfield, MeshShape, Ray, Span, torus};

/// A surface in its local frame; lengths in scene units.
#[derive(Clone, Debug)]
pub enum Shape {
    /// A box along the axes.
    Cuboid {
        /// Half its extent along each axis.
        half: Vector3<f64>,
    },
    /// An ellipsoid along the axes.
    Ellipsoid {
        /// Its radii.
        radii: Vector3<f64>,
    },
    /// A cylinder along z, closed at both ends.
    Cylinder {
        /// Its radius.
        radius: f64,
        /// Half its length.
        half_height: f64,
    },
    /// A ring around z.
    Torus {
        /// From the centre to the middle of the tube.
        major: f64,
        /// Radius of the tube.
        minor: f64,
    },
    /// A surface over the xy plane.
    Heightfield(Heightfield),
    /// Triangles, shared by all bodies of one form.
    Mesh(MeshShape),
}

impl Shape {
    /// The first `t` within `span` at which the ray meets the surface, from outside or inside.
    #[inline]
    pub fn intersect(&self, ray: &Ray, span: Span) -> Option<f64> {
        match self {
            Self::Cuboid { half } => intersect_cuboid(half, ray, span),
            Self::Ellipsoid { radii } => {
                let origin = ray.origin.coords.component_div(radii);
                let direction = ray.direction.component_div(radii);
                let (near, far) =
                    quadratic(direction.norm_squared(), origin.dot(&direction), origin.norm_squared() - 1.0)?;
                span.first_of(near, far)
            }
            Self::Cylinder { radius, half_height } => intersect_cylinder(*radius, *half_height, ray, span),
            Self::Torus { major, minor } => torus::intersect(*major, *minor, ray, span),
            Self::Heightfield(field) => field.intersect(ray, span),
            Self::Mesh(part) => part.intersect(ray, span),
        }
    }

    /// The outward normal, of length 1, at a point of the surface. That of a mesh follows from the
    /// ray instead, see [`MeshShape::surface`]; here it is from the middle outwards.
    pub fn normal(&self, point: &Point3<f64>) -> Vector3<f64> {
        match self {
            Self::Cuboid { half } => {
                let axis = point.coords.component_div(half).iamax();
                let mut normal = Vector3::zeros();
                normal[axis] = point[axis].signum();
                normal
            }
            Self::Ellipsoid { radii } => point.coords.component_div(radii).component_div(radii).normalize(),
            Self::Cylinder { radius, half_height } => {
                if point.z.abs() / half_height > point.x.hypot(point.y) / radius {
                    Vector3::new(0.0, 0.0, point.z.signum())
                } else {
                    Vector3::new(point.x, point.y, 0.0).normalize()
                }
            }
            Self::Torus { major, .. } => torus::normal(*major, point),
            Self::Heightfield(field) => field.normal(point.x, point.y),
            Self::Mesh(_) => point.coords.try_normalize(0.0).unwrap_or_else(Vector3::z),
        }
    }

    /// Two coordinates along the surface, in scene units, for patterns that are laid on it: brick
    /// courses run along the first, and the second rises with local z where the surface does.
    pub fn surface_coordinates(&self, point: &Point3<f64>, normal: &Vector3<f64>) -> [f64; 2] {
        match self {
            Self::Cuboid { .. } | Self::Mesh(_) => match normal.iamax() {
                0 => [point.y, point.z],
                1 => [point.x, point.z],
                _ => [point.x, point.y],
            },
            Self::Heightfield(_) => [point.x, point.y],
            Self::Cylinder { .. } if normal.z.abs() > 0.5 => [point.x, point.y],
            Self::Cylinder { radius, .. } => [around(point, *radius), point.z],
            Self::Ellipsoid { radii } => [around(point, radii.x.max(radii.y)), point.z],
            Self::Torus { major, minor } => {
                let tube = point.z.atan2(point.x.hypot(point.y) - major);
                [around(point, *major), tube * minor]
            }
        }
    }

    /// A box that holds the surface.
    pub fn bounds(&self) -> Bounds {
        let half = match self {
            Self::Heightfield(field) => return field.bounds(),
            Self::Mesh(part) => return part.bounds(),
            Self::Cuboid { half } => *half,
            Self::Ellipsoid { radii } => *radii,
            Self::Cylinder { radius, half_height } => Vector3::new(*radius, *radius, *half_height),
            Self::Torus { major, minor } => Vector3::new(major + minor, major + minor, *minor),
        };
        Bounds { min: Point3::from(-half), max: Point3::from(half) }
    }
}

/// The way around z, in turns times the circumference rounded to whole units, so that patterns of
/// unit period close.
fn around(point: &Point3<f64>, radius: f64) -> f64 {
    point.y.atan2(point.x) / TAU * (TAU * radius).ceil()
}

/// The roots of `a t^2 + 2 b t + c` in rising order, for `a > 0`.
#[inline]
fn quadratic(a: f64, b: f64, c: f64) -> Option<(f64, f64)> {
    let discriminant = b * b - a * c;
    if discriminant < 0.0 {
        return None;
    }
    // Adding numbers of one sign only: the other root comes from the product of both.
    let q = -(b + discriminant.sqrt().copysign(b));
    let (first, second) = (q / a, if q == 0.0 { 0.0 } else { c / q });
    Some((first.min(second), first.max(second)))
}

#[inline]
fn intersect_cuboid(half: &Vector3<f64>, ray: &Ray, span: Span) -> Option<f64> {
    let bounds = Bounds { min: Point3::from(-half), max: Point3::from(*half) };
    let inverse = ray.direction.map(f64::recip);
    let everywhere = Span { min: f64::NEG_INFINITY, max: f64::INFINITY };
    let inside = bounds.crossing(&ray.origin, &inverse, everywhere)?;
    span.first_of(inside.min, inside.max)
}

#[inline]
fn intersect_cylinder(radius: f64, half_height: f64, ray: &Ray, span: Span) -> Option<f64> {
    let (o, d) = (&ray.origin, &ray.direction);
    let caps = {
        let (a, b) = ((-half_height - o.z) / d.z, (half_height - o.z) / d.z);
        (a.min(b), a.max(b))
    };
    let across = d.x * d.x + d.y * d.y;
    let (near, far) = if across > 0.0 {
        quadratic(across, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - radius * radius)?
    } else if o.x * o.x + o.y * o.y < radius * radius {
        (f64::NEG_INFINITY, f64::INFINITY)
    } else {
        return None;
    };
    // A ray across the axis has infinite or NaN caps; max and min then keep the mantle's roots,
    // so whether it passes between the caps is asked apart.
    if d.z == 0.0 && o.z.abs() > half_height {
        return None;
    }
    let (enter, leave) = (near.max(caps.0), far.min(caps.1));
    if enter > leave {
        return None;
    }
    span.first_of(enter, leave)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// Zero on the surface, with about unit slope across it.
    fn implicit(shape: &Shape, p: &Point3<f64>) -> f64 {
        match shape {
            Shape::Cuboid { half } => (p.coords.abs() - half).max(),
            Shape::Ellipsoid { radii } => (p.coords.component_div(radii).norm() - 1.0) * radii.min(),
            Shape::Cylinder { radius, half_height } => (p.x.hypot(p.y) - radius).max(p.z.abs() - half_height),
            Shape::Torus { major, minor } => (p.x.hypot(p.y) - major).hypot(p.z) - minor,
            Shape::Heightfield(field) => p.z - field.height(p.x, p.y),
            Shape::Mesh(_) => unreachable!("meshes are tested where they are"),
        }
    }

    fn shapes() -> Vec<Shape> {
        vec![
            Shape::Cuboid { half: Vector3::new(0.4, 1.0, 0.7) },
            Shape::Ellipsoid { radii: Vector3::new(0.5, 1.1, 0.8) },
            Shape::Cylinder { radius: 0.6, half_height: 0.9 },
            Shape::Torus { major: 0.8, minor: 0.25 },
            Shape::Heightfield(Heightfield::new(33, 25, [1.0, 0.9], |x, y| {
                0.3 * (4.0 * x).sin() * (3.0 * y).cos()
            })),
        ]
    }

    proptest! {
        #[test]
        fn hits_lie_on_the_surface_and_are_the_first(
            which in 0_usize..5,
            origin in prop::array::uniform3(-3.0_f64..3.0),
            target in prop::array::uniform3(-0.7_f64..0.7),
        ) {
            let shape = &shapes()[which];
            let origin = Point3::from(origin);
            let ray = Ray { origin, direction: Point3::from(target) - origin };
            let span = Span { min: 0.0, max: 10.0 };
            let domain = shape.bounds();
            let hit = shape.intersect(&ray, span);
            if let Some(t) = hit {
                let point = ray.at(t);
                prop_assert!(implicit(shape, &point).abs() < 1e-7, "off by {}", implicit(shape, &point));
                prop_assert!((shape.normal(&point).norm() - 1.0).abs() < 1e-12);
                for axis in 0..3 {
                    prop_assert!(point[axis] > domain.min[axis] - 1e-9 && point[axis] < domain.max[axis] + 1e-9);
                }
            }
            // March along the ray: it may not change sides before the hit. A heightfield has sides
            // only over its rectangle.
            let end = hit.unwrap_or(10.0);
            let mut side = 0.0;
            for step in 0..400 {
                let point = ray.at(end * f64::from(step) / 400.0);
                let beside = point.x.abs() > domain.max.x || point.y.abs() > domain.max.y;
                if !(beside && matches!(shape, Shape::Heightfield(_))) {
                    let f = implicit(shape, &point);
                    prop_assert!(f * side > -1e-7, "passed the surface at {point}");
                    side = f.signum();
                }
            }
        }
    }

    #[test]
    fn rays_along_the_axes_are_no_special_case() {
        let cylinder = Shape::Cylinder { radius: 0.5, half_height: 1.0 };
        let span = Span { min: 0.0, max: f64::INFINITY };
        let along = Ray { origin: Point3::new(0.1, 0.0, 3.0), direction: -Vector3::z() };
        assert_eq!(cylinder.intersect(&along, span), Some(2.0));
        let across = Ray { origin: Point3::new(3.0, 0.0, 0.2), direction: -Vector3::x() };
        assert_eq!(cylinder.intersect(&across, span), Some(2.5));
        let above = Ray { origin: Point3::new(3.0, 0.0, 1.2), direction: -Vector3::x() };
        assert_eq!(cylinder.intersect(&above, span), None);
        let cuboid = Shape::Cuboid { half: Vector3::new(1.0, 1.0, 1.0) };
        assert_eq!(cuboid.intersect(&across, span), Some(2.0));
    }

    #[test]
    fn a_ray_from_inside_meets_the_far_wall() {
        let span = Span { min: 0.0, max: f64::INFINITY };
        let ray = Ray { origin: Point3::origin(), direction: Vector3::x() };
        for shape in &shapes()[..3] {
            let t = shape.intersect(&ray, span).expect("the ray leaves the solid");
            assert!((t - shape.bounds().max.x).abs() < 1e-12);
        }
    }
}
