//! Meshes made up on the spot: turned vessels, dented lumps, twisted blocks.

use std::f64::consts::TAU;
use std::sync::Arc;

use nalgebra::Point3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{log_uniform, pick};
use crate::geometry::TriangleMesh;
use crate::noise::{lerp, octaves};

/// Rings and sectors of a surface around the z axis.
const RINGS: u32 = 26;
const SECTORS: u32 = 30;

/// A closed surface around z, about within the unit sphere.
pub fn mould(rng: &mut ChaCha8Rng) -> Arc<TriangleMesh> {
    Arc::new(match rng.random_range(0..3) {
        0 => turned(rng),
        1 => dented(rng),
        _ => twisted(rng),
    })
}

/// A profile of random radii, turned: vases, bottles, chessmen, lamps.
fn turned(rng: &mut ChaCha8Rng) -> TriangleMesh {
    let radii: Vec<f32> = (0..8).map(|_| log_uniform(rng, 0.12, 0.75) as f32).collect();
    let flutes = if rng.random_bool(0.3) { f64::from(rng.random_range(5..14)) } else { 0.0 };
    let depth = rng.random_range(0.02..0.12);
    around(|t, angle| {
        let at = t * (radii.len() - 1) as f64;
        let i = (at as usize).min(radii.len() - 2);
        let share = (at - i as f64) as f32;
        let smooth = share * share * (3.0 - 2.0 * share);
        let radius = f64::from(lerp(radii[i], radii[i + 1], smooth)) * (1.0 + depth * (flutes * angle).cos());
        (radius, 2.0 * t - 1.0)
    })
}

/// A ball with dents and bulges: stones, fruit, heads.
fn dented(rng: &mut ChaCha8Rng) -> TriangleMesh {
    let seed = rng.random();
    let (rate, height) = (rng.random_range(0.8..2.2_f32), rng.random_range(0.1..0.5));
    let flat = rng.random_range(0.5..1.2);
    let rough: f32 = pick(rng, &[0.3, 0.45, 0.6]);
    around(|t, angle| {
        let polar = std::f64::consts::PI * t;
        let (sin, cos) = polar.sin_cos();
        let point = [sin * angle.cos(), sin * angle.sin(), cos].map(|v| v as f32 * rate);
        let radius = 0.75 * (1.0 + height * f64::from(octaves(point, 3, rough, seed))).max(0.2);
        (radius * sin, -radius * cos * flat)
    })
}

/// A polygon that turns and tapers on its way up: blocks, screws, towers.
fn twisted(rng: &mut ChaCha8Rng) -> TriangleMesh {
    let sides = f64::from(rng.random_range(3..8));
    let twist = if rng.random_bool(0.5) { 0.0 } else { rng.random_range(-2.0..2.0) };
    let taper = rng.random_range(0.0..0.8);
    let width = rng.random_range(0.25..0.7);
    around(|t, angle| {
        let within = (angle + twist * t).rem_euclid(TAU / sides) - TAU / sides / 2.0;
        let side = width * (TAU / sides / 2.0).cos() / within.cos();
        (side * (1.0 - taper * t), 2.0 * t - 1.0)
    })
}

/// The surface of `profile(t, angle)`, radius and height, for `t` from the foot (0) to the top (1), with
/// both ends closed.
fn around(profile: impl Fn(f64, f64) -> (f64, f64)) -> TriangleMesh {
    let mut positions = Vec::new();
    for ring in 0..=RINGS {
        let t = f64::from(ring) / f64::from(RINGS);
        for sector in 0..SECTORS {
            let angle = TAU * f64::from(sector) / f64::from(SECTORS);
            let (radius, height) = profile(t, angle);
            positions.push(Point3::new(radius * angle.cos(), radius * angle.sin(), height));
        }
    }
    let (foot, top) = (positions.len() as u32, positions.len() as u32 + 1);
    for t in [0.0, 1.0] {
        positions.push(Point3::new(0.0, 0.0, profile(t, 0.0).1));
    }
    let at = |ring: u32, sector: u32| ring * SECTORS + sector % SECTORS;
    let mut triangles = Vec::new();
    for s in 0..SECTORS {
        triangles.push([foot, at(0, s + 1), at(0, s)]);
        triangles.push([top, at(RINGS, s), at(RINGS, s + 1)]);
        for r in 0..RINGS {
            triangles.push([at(r, s), at(r, s + 1), at(r + 1, s + 1)]);
            triangles.push([at(r, s), at(r + 1, s + 1), at(r + 1, s)]);
        }
    }
    TriangleMesh::new(positions, &triangles, &[])
}
