//! Light: one sun with soft shadows, a sky that reaches where nothing near is in the way, and a
//! highlight on glossy surfaces.

use std::f64::consts::TAU;

use nalgebra::Vector3;

use crate::geometry::{Hit, Ray, World};
use crate::texture::{Material, Rgb, Spot};

/// What lights a scene.
#[derive(Clone, Debug)]
pub struct Light {
    /// Towards the sun, of length 1, world.
    pub sun: Vector3<f64>,
    /// The tangent of the sun's radius as seen from the ground; sets how soft shadows are.
    pub sun_radius: f64,
    /// Radiance of the sun.
    pub sun_color: Rgb,
    /// Radiance of the sky.
    pub sky_color: Rgb,
}

/// Rays that start on a surface start this far above it, in scene units.
const LIFT: f64 = 1e-3;
/// Bodies darken what lies within this distance of them, in scene units.
const SKY_REACH: f64 = 1.2;
/// Exponent of the highlight.
const SHARPNESS: i32 = 40;

/// Two random numbers in `[0, 1)` for the sun's disc and two for the sky's half sphere.
pub type Draws = [f64; 4];

/// The light that leaves `hit` towards where the ray came from.
pub fn radiance(
    world: &World,
    light: &Light,
    material: &Material,
    hit: &Hit,
    direction: &Vector3<f64>,
    draws: Draws,
) -> Rgb {
    let normal = if hit.normal.dot(direction) > 0.0 { -hit.normal } else { hit.normal };
    let origin = hit.point + normal * LIFT;
    let lit = |direction: Vector3<f64>, reach: f64| {
        if world.occluded(&Ray { origin, direction }, reach) { 0.0 } else { 1.0 }
    };

    let sun = light.sun + disc(&light.sun, draws[0], draws[1]) * light.sun_radius;
    let incidence = normal.dot(&light.sun);
    let sunlight = if incidence > 0.0 { incidence as f32 * lit(sun, f64::INFINITY) } else { 0.0 };
    // Directions by the cosine of their angle to the normal: each weighs the same.
    let towards = normal + sphere(draws[2], draws[3]) * (1.0 - 1e-6);
    let openness = 0.35 + 0.65 * lit(towards.normalize(), SKY_REACH);
    let skylight = openness * (0.6 + 0.4 * normal.z as f32);

    let highlight = if material.gloss > 0.0 && sunlight > 0.0 {
        let half = (light.sun - direction.normalize()).normalize();
        material.gloss * normal.dot(&half).max(0.0).powi(SHARPNESS) as f32 * sunlight
    } else {
        0.0
    };

    let spot = Spot {
        local: [hit.local.x as f32, hit.local.y as f32, hit.local.z as f32],
        along: hit.along.map(|c| c as f32),
    };
    let albedo = material.albedo(&spot);
    std::array::from_fn(|c| {
        albedo[c] * (light.sun_color[c] * sunlight + light.sky_color[c] * skylight)
            + light.sun_color[c] * highlight
    })
}

/// From linear light to an sRGB byte, with a shoulder so that highlights keep their drawing.
pub fn encode(linear: f32) -> u8 {
    let toned = linear * (1.0 + linear / 9.0) / (1.0 + linear);
    let toned = toned.clamp(0.0, 1.0);
    let srgb = if toned <= 0.003_130_8 { 12.92 * toned } else { 1.055 * toned.powf(1.0 / 2.4) - 0.055 };
    (srgb * 255.0 + 0.5) as u8
}

/// A point of the unit disc across `axis`.
pub fn disc(axis: &Vector3<f64>, u: f64, v: f64) -> Vector3<f64> {
    let side = if axis.x.abs() < 0.8 { Vector3::x() } else { Vector3::y() };
    let a = axis.cross(&side).normalize();
    let b = axis.cross(&a);
    let (sin, cos) = (TAU * v).sin_cos();
    (a * cos + b * sin) * u.sqrt()
}

/// A point of the unit sphere.
fn sphere(u: f64, v: f64) -> Vector3<f64> {
    let z = 2.0 * u - 1.0;
    let (sin, cos) = (TAU * v).sin_cos();
    let r = (1.0 - z * z).max(0.0).sqrt();
    Vector3::new(r * cos, r * sin, z)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Point3};

    use super::*;
    use crate::geometry::{Body, Placement, Shape};
    use crate::texture::Pattern;

    #[test]
    fn what_the_sun_does_not_reach_is_darker() {
        let slab = |z: f64, half: f64| Body {
            shape: Shape::Cuboid { half: Vector3::new(half, half, 0.1) },
            placement: Placement { rotation: Matrix3::identity(), centre: Point3::new(0.0, 0.0, z) },
        };
        let world = World::new(vec![slab(-0.1, 10.0), slab(2.1, 1.0)]);
        let light = Light { sun: Vector3::z(), sun_radius: 0.01, sun_color: [3.0; 3], sky_color: [0.5; 3] };
        let material = Material {
            pattern: Pattern::Rock,
            scale: 1.0,
            palette: [[0.5; 3]; 3],
            grain: 0.0,
            gloss: 0.0,
            seed: 0,
        };
        let seen = |x: f64| {
            let ray = Ray { origin: Point3::new(x, -8.0, 1.0), direction: Vector3::new(0.0, 8.0, -1.0) };
            let hit = world.trace(&ray).expect("the ground is below");
            radiance(&world, &light, &material, &hit, &ray.direction, [0.5; 4])[0]
        };
        assert!(seen(5.0) > 3.0 * seen(0.0), "{} in the sun, {} in the shade", seen(5.0), seen(0.0));
    }

    #[test]
    fn encoding_rises_from_black_to_white() {
        let bytes: Vec<u8> = (0..1000).map(|i| encode(i as f32 * 0.02)).collect();
        assert!(bytes.windows(2).all(|w| w[0] <= w[1]));
        assert_eq!((bytes[0], bytes[999]), (0, 255));
    }
}
