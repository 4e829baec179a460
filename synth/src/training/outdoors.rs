//! Settings in the open: streets with near and far things, ground from the air, walls with relief.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Point3, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{along, log_uniform, pick, yaw};
use super::library::Library;
use super::light::Light;
use super::paint::Paint;
use super::settings::{Frame, distance_for, field_of_view};
use super::stage::{Builder, Motion, Shot, Stage};
use super::things::STREET_THINGS;
use crate::geometry::{Heightfield, Shape};
use crate::noise::octaves;

/// Terrain, houses, trees and near clutter from eye height; the far end is tens of times the near.
pub fn street(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = field_of_view(rng);
    let eye = rng.random_range(1.2..2.2);
    let texel = frame.texel(9.0, field);
    let mut builder = Builder::new(rng, library, texel);
    let hills = builder.size(0.2, 9.0);
    let ground = terrain(&mut builder, [110.0, 110.0], hills, 0.02);
    let height = |x: f64, y: f64| ground.height(x, y);
    let paint = builder.paint();
    builder.add(Shape::Heightfield(ground.clone()), Point3::origin(), Matrix3::identity(), &paint);
    let camera = Point3::new(0.0, -20.0, height(0.0, -20.0) + eye);
    for _ in 0..builder.rng.random_range(0..14) {
        let (angle, way) = (builder.between(-0.9, 0.9), builder.size(10.0, 80.0));
        let at = camera + Vector3::new(angle.sin(), angle.cos(), 0.0) * way;
        builder.texel = frame.texel(way, field);
        add_house(&mut builder, Point3::new(at.x, at.y, height(at.x, at.y)));
    }
    for _ in 0..builder.rng.random_range(5..22) {
        let (angle, way) = (builder.between(-0.75, 0.75), builder.size(2.5, 45.0));
        let at = camera + Vector3::new(angle.sin(), angle.cos(), 0.0) * way;
        builder.texel = frame.texel(way, field);
        let thing = pick(builder.rng, &STREET_THINGS);
        // What is near is small, or it would hide all else.
        let size = builder.between(0.5, 3.5).min(0.35 * way);
        builder.add_thing(thing, Point3::new(at.x, at.y, height(at.x, at.y) - 0.05), size);
    }
    let light = Light::outdoors(builder.rng, 100.0);
    let aim = builder.between(-0.3, 0.3);
    let fall = builder.between(-0.22, 0.08);
    let target = camera + Vector3::new(aim.sin(), aim.cos(), fall) * 12.0;
    let motion =
        pick(builder.rng, &[Motion::Arc, Motion::Track, Motion::Track, Motion::Handheld, Motion::Forward]);
    (builder.stage(light), Shot { centre: camera, target, motion, field_of_view_degrees: field })
}

/// Roofs, trees and fields from above, straight down or slanted.
pub fn aerial(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = rng.random_range(35.0..70.0);
    let altitude = rng.random_range(40.0..120.0);
    let mut builder = Builder::new(rng, library, frame.texel(altitude, field));
    let hills = builder.size(0.5, 25.0);
    let ground = terrain(&mut builder, [260.0, 260.0], hills, 0.006);
    let paint = builder.paint();
    let height = |x: f64, y: f64| ground.height(x, y);
    builder.add(Shape::Heightfield(ground.clone()), Point3::origin(), Matrix3::identity(), &paint);
    let reach = altitude * (field / 2.0).to_radians().tan() * 1.8;
    let grid = yaw(builder.between(0.0, TAU));
    let rows = builder.rng.random_range(2..7);
    for i in 0..rows * rows {
        let cell = |k: i32| 2.0 * (f64::from(k) + 0.5) / f64::from(rows) - 1.0;
        let jitter =
            Vector3::new(builder.between(-0.3, 0.3), builder.between(-0.3, 0.3), 0.0) / f64::from(rows);
        let at = grid * (Vector3::new(cell(i % rows), cell(i / rows), 0.0) + jitter) * reach;
        if builder.chance(0.75) {
            add_house(&mut builder, Point3::new(at.x, at.y, height(at.x, at.y)));
        }
    }
    for _ in 0..builder.rng.random_range(5..40) {
        let (x, y) = (builder.between(-reach, reach), builder.between(-reach, reach));
        let thing = pick(
            builder.rng,
            &[super::things::Thing::Tree, super::things::Thing::Bush, super::things::Thing::Crates],
        );
        let size = builder.between(3.0, 12.0);
        builder.add_thing(thing, Point3::new(x, y, height(x, y) - 0.1), size);
    }
    let light = Light::outdoors(builder.rng, 300.0);
    let tilt: f64 = if builder.chance(0.5) { builder.between(0.02, 0.12) } else { builder.between(0.2, 0.9) };
    let target = Point3::new(builder.between(-8.0, 8.0), builder.between(-8.0, 8.0), 0.0);
    let centre = target + Vector3::new(0.0, -tilt.sin(), tilt.cos()) * altitude;
    let motion = pick(builder.rng, &[Motion::Track, Motion::Track, Motion::Arc, Motion::Handheld]);
    (builder.stage(light), Shot { centre, target, motion, field_of_view_degrees: field })
}

/// A wall with ledges, columns, windows and ornament, head-on or slanted.
pub fn facade(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = field_of_view(rng);
    let distance = distance_for(5.0, field) * log_uniform(rng, 0.5, 1.6);
    let mut builder = Builder::new(rng, library, frame.texel(distance, field));
    let level = Matrix3::identity();
    let wall = builder.paint();
    if builder.chance(0.4) {
        // Rough stone: a heightfield stood on its edge, its heights towards -y.
        let (seed, deep, rate) =
            (builder.rng.random(), builder.size(0.03, 0.5), builder.size(0.3, 2.0) as f32);
        let field = Heightfield::new(161, 161, [12.0, 12.0], |x, y| {
            deep * f64::from(octaves([x as f32 * rate, y as f32 * rate, 0.0], 4, 0.5, seed))
        });
        builder.add(Shape::Heightfield(field), Point3::origin(), along(&-Vector3::y()), &wall);
    } else {
        builder.add_box([14.0, 0.3, 9.0], Point3::new(0.0, 0.3, 0.0), level, &wall);
    }
    let ornament = [builder.paint(), builder.paint(), builder.plain_paint()];
    let (columns, rows) = (builder.rng.random_range(1..7), builder.rng.random_range(1..5));
    let (dx, dz) = (builder.between(0.8, 2.0), builder.between(0.9, 2.2));
    let deep = builder.between(0.02, 0.25);
    let round = builder.chance(0.3);
    for i in 0..columns * rows {
        let x = (f64::from(i % columns) - f64::from(columns - 1) / 2.0) * dx;
        let z = (f64::from(i / columns) - f64::from(rows - 1) / 2.0) * dz;
        let at = Point3::new(x, 0.0, z);
        if round {
            let shape = Shape::Torus { major: 0.28 * dx, minor: 0.06 * dx };
            builder.add(shape, at, along(&Vector3::y()), &ornament[0]);
        } else {
            builder.add_box([0.3 * dx, deep, 0.3 * dz], at, level, &ornament[0]);
            builder.add_box([0.24 * dx, deep + 0.02, 0.25 * dz], at, level, &ornament[2]);
        }
        builder.add_box([0.36 * dx, 1.7 * deep, 0.03], at - Vector3::z() * (0.33 * dz), level, &ornament[1]);
    }
    for _ in 0..builder.rng.random_range(0..6) {
        let x = builder.between(-4.0, 4.0);
        let off = builder.between(0.1, 0.9);
        let radius = builder.between(0.05, 0.3);
        builder.add_rod(Point3::new(x, -off, -9.0), Point3::new(x, -off, 9.0), radius, &ornament[1]);
    }
    for _ in 0..builder.rng.random_range(0..40) {
        let at =
            Point3::new(builder.between(-4.0, 4.0), builder.between(-0.1, 0.05), builder.between(-3.0, 3.0));
        let turn = super::draw::rotation(builder.rng);
        let radius = builder.size(0.08, 0.6);
        let paint = &ornament[builder.rng.random_range(0..2)];
        builder.add_lump(at, radius, turn, paint);
    }
    if builder.chance(0.5) {
        let ground = builder.paint();
        let z = -builder.between(1.2, 2.5);
        builder.add_box([30.0, 30.0, 0.2], Point3::new(0.0, -15.0, z), level, &ground);
    }
    let light = Light::outdoors(builder.rng, 10.0);
    let slant: f64 = builder.between(-0.85, 0.85);
    let target = Point3::new(builder.between(-1.0, 1.0), 0.0, builder.between(-0.8, 0.8));
    let centre = target + Vector3::new(slant.sin(), -slant.cos(), builder.between(-0.1, 0.3)) * distance;
    let motion = pick(builder.rng, &[Motion::Arc, Motion::Track, Motion::Handheld]);
    (builder.stage(light), Shot { centre, target, motion, field_of_view_degrees: field })
}

/// Noise of several wavelengths, each of the same slope.
fn terrain(builder: &mut Builder, half: [f64; 2], height: f64, rate: f64) -> Heightfield {
    let seed = builder.rng.random();
    let persistence = builder.between(0.25, 0.5) as f32;
    Heightfield::new(129, 129, half, |x, y| {
        let at = [x * rate, y * rate, 0.7].map(|v| v as f32);
        height * f64::from(octaves(at, 4, persistence, seed))
    })
}

/// A block with windows, ledges and a roof, some storeys high.
fn add_house(builder: &mut Builder, foot: Point3<f64>) {
    let turn = yaw(builder.between(-0.6, 0.6));
    let (wall, trim, glass) = (builder.paint(), builder.paint(), builder.plain_paint());
    let half = [builder.between(2.5, 8.0), builder.between(2.5, 8.0), builder.between(1.5, 8.0)];
    let centre = foot + Vector3::z() * (half[2] - 0.5);
    builder.add_box(half, centre, turn, &wall);
    let at = |x: f64, y: f64, z: f64| centre + turn * Vector3::new(x, y, z);
    let storeys = (half[2] / 1.4) as i32;
    let windows = builder.rng.random_range(1..5);
    let frame = builder.between(0.5, 0.9);
    for i in 0..storeys * windows {
        let x = half[0] * (2.0 * (f64::from(i % windows) + 0.5) / f64::from(windows) - 1.0);
        let z = (f64::from(i / windows) + 0.5) * 2.8 - half[2];
        let w = (0.5 * half[0] / f64::from(windows)).min(0.7);
        builder.add_box([w, 0.06, frame], at(x, -half[1], z), turn, &glass);
        builder.add_box([w + 0.12, 0.2, 0.08], at(x, -half[1], z - frame), turn, &trim);
    }
    add_roof(builder, half, centre, turn, &trim);
}

fn add_roof(builder: &mut Builder, half: [f64; 3], centre: Point3<f64>, turn: Matrix3<f64>, paint: &Paint) {
    if builder.chance(0.4) {
        let eaves = [half[0] + 0.3, half[1] + 0.3, 0.15];
        builder.add_box(eaves, centre + Vector3::z() * half[2], turn, paint);
        return;
    }
    // Two slabs that lean on each other.
    let pitch: f64 = builder.between(0.3, 0.8);
    let (sin, cos) = pitch.sin_cos();
    for side in [-1.0, 1.0] {
        let lean = Matrix3::new(1.0, 0.0, 0.0, 0.0, cos, side * sin, 0.0, -side * sin, cos);
        let slope = half[1] / cos / 2.0 + 0.2;
        let at = Vector3::new(0.0, side * half[1] / 2.0, half[2] + half[1] * pitch.tan() / 2.0);
        builder.add_box([half[0] + 0.3, slope, 0.1], centre + turn * at, turn * lean, paint);
    }
}
