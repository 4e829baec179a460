//! The ring, met by stepping along the ray by its distance (sphere tracing) instead of by roots of
//! the quartic, which lose digits where the ray grazes.

use nalgebra::{Point3, Vector3};

use super::{Ray, Span};

/// Distance at which a step counts as arrived, relative to the size of the ring.
const ARRIVED: f64 = 1e-10;
/// Grazing rays need the most steps; what is still under way then passes by.
const MAX_STEPS: usize = 512;

/// The first `t` within `span`.
pub fn intersect(major: f64, minor: f64, ray: &Ray, span: Span) -> Option<f64> {
    let speed = ray.direction.norm();
    let reach = major + minor;
    let nearest = -ray.origin.coords.dot(&ray.direction) / (speed * speed);
    let miss_squared = (ray.origin + ray.direction * nearest).coords.norm_squared();
    if miss_squared > reach * reach {
        return None;
    }
    let half = (reach * reach - miss_squared).sqrt() / speed;
    let mut t = span.min.max(nearest - half);
    let end = span.max.min(nearest + half);
    let tolerance = ARRIVED * reach;
    for _ in 0..MAX_STEPS {
        if t >= end {
            return None;
        }
        let distance = distance(major, minor, &ray.at(t)).abs();
        if distance < tolerance {
            return span.contains(t).then_some(t);
        }
        t += distance / speed;
    }
    None
}

/// The outward normal at a point of the ring.
pub fn normal(major: f64, point: &Point3<f64>) -> Vector3<f64> {
    let around = point.x.hypot(point.y);
    let shrink = (around - major) / around;
    Vector3::new(point.x * shrink, point.y * shrink, point.z).normalize()
}

#[inline]
fn distance(major: f64, minor: f64, point: &Point3<f64>) -> f64 {
    let around = (point.x * point.x + point.y * point.y).sqrt() - major;
    (around * around + point.z * point.z).sqrt() - minor
}
