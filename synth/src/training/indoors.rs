//! Settings under a roof or on a table: objects, heaps, rooms, corridors.

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Point3, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{direction, log_uniform, pick, rotation, yaw};
use super::library::Library;
use super::light::Light;
use super::settings::{Frame, distance_for, field_of_view};
use super::stage::{Builder, Motion, Shot, Stage};
use super::things::{FURNITURE, SMALL_THINGS};
use crate::geometry::{Heightfield, Shape};
use crate::noise::octaves;

/// Things on a table or the ground, from around: scans of objects.
pub fn objects(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = field_of_view(rng);
    let distance = distance_for(2.4, field) * log_uniform(rng, 0.6, 1.5);
    let mut builder = Builder::new(rng, library, frame.texel(distance, field));
    add_ground(&mut builder, 1.0);
    add_backdrop(&mut builder, 1.6);
    let count = builder.rng.random_range(1..=14);
    for _ in 0..count {
        let (angle, way) = (builder.between(0.0, TAU), builder.between(0.0, 1.0).sqrt());
        let foot = Point3::new(way * angle.cos(), way * angle.sin(), -0.01);
        let thing = pick(builder.rng, &SMALL_THINGS);
        let size = builder.size(0.15, if count < 4 { 1.3 } else { 0.8 });
        builder.add_thing(thing, foot, size);
    }
    around(builder, distance, field, [0.12, 1.2], 0.3)
}

/// Many bodies thrown on a heap, sticks among them.
pub fn heap(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = field_of_view(rng);
    let distance = distance_for(2.0, field) * log_uniform(rng, 0.5, 1.4);
    let mut builder = Builder::new(rng, library, frame.texel(distance, field));
    add_ground(&mut builder, 1.0);
    add_backdrop(&mut builder, 1.8);
    let paints: Vec<_> = (0..builder.rng.random_range(3..25)).map(|_| builder.paint()).collect();
    for _ in 0..builder.rng.random_range(25..130) {
        let (angle, way) = (builder.between(0.0, TAU), builder.between(0.0, 1.1));
        let top = 0.7 * (1.0 - 0.75 * way);
        let centre = Point3::new(way * angle.cos(), way * angle.sin(), builder.between(0.0, top));
        if builder.chance(0.12) {
            let length = builder.between(0.3, 1.2);
            builder.add_stick(centre, length);
        } else {
            let turn = rotation(builder.rng);
            let radius = builder.size(0.06, 0.3);
            let paint = &paints[builder.rng.random_range(0..paints.len())];
            builder.add_lump(centre, radius, turn, paint);
        }
    }
    around(builder, distance, field, [0.2, 1.4], 0.35)
}

/// A furnished room, from one side across.
pub fn room(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = rng.random_range(45.0..78.0);
    let half = [rng.random_range(1.6..4.5), rng.random_range(1.6..4.5)];
    let height = rng.random_range(2.3..3.4);
    let mut builder = Builder::new(rng, library, frame.texel(1.2 * half[1], field));
    add_shell(&mut builder, half, height);
    for _ in 0..builder.rng.random_range(4..14) {
        // Furniture stands along the walls rather than in the way.
        let angle = builder.between(0.0, TAU);
        let reach = builder.between(0.35, 0.92);
        let foot = Point3::new(half[0] * reach * angle.cos(), half[1] * reach * angle.sin(), 0.0);
        let thing = pick(builder.rng, &FURNITURE);
        let size = builder.between(0.5, 1.5);
        builder.add_thing(thing, foot, size);
    }
    for _ in 0..builder.rng.random_range(2..9) {
        add_wall_thing(&mut builder, half, height);
    }
    let mut place = |z: [f64; 2]| {
        let [x, y] = half.map(|h| builder.between(-0.8 * h, 0.8 * h));
        Point3::new(x, y, builder.between(z[0], z[1]))
    };
    let lamps: Vec<_> = (0..2).map(|_| place([0.75 * height, 0.97 * height])).collect();
    let lamps = if builder.chance(0.6) { &lamps[..] } else { &lamps[..1] };
    let light = Light::lamps(builder.rng, lamps, half[0] + half[1]);
    let centre = Point3::new(
        builder.between(-0.6, 0.6) * half[0],
        -half[1] * builder.between(0.55, 0.93),
        builder.between(0.9, 1.9),
    );
    let target = Point3::new(
        builder.between(-0.7, 0.7) * half[0],
        half[1] * builder.between(0.2, 1.0),
        builder.between(0.3, 1.6),
    );
    let motion =
        pick(builder.rng, &[Motion::Arc, Motion::Track, Motion::Handheld, Motion::Handheld, Motion::Forward]);
    (builder.stage(light), Shot { centre, target, motion, field_of_view_degrees: field })
}

/// A long way between walls with pillars and things, seen along it.
pub fn corridor(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = rng.random_range(50.0..80.0);
    let half = [rng.random_range(1.0..2.5), rng.random_range(5.0..14.0)];
    let height = rng.random_range(2.2..3.6);
    let mut builder = Builder::new(rng, library, frame.texel(0.35 * half[1], field));
    add_shell(&mut builder, half, height);
    let pillar = builder.paint();
    let spacing = builder.between(1.5, 3.5);
    let round = builder.chance(0.5);
    let columns = (2.0 * half[1] / spacing) as usize;
    for i in 0..columns {
        for side in [-1.0, 1.0] {
            let at = Point3::new(side * half[0], (i as f64 + 0.5) * spacing - half[1], height / 2.0);
            if round {
                let shape = Shape::Cylinder { radius: 0.18, half_height: height / 2.0 };
                builder.add(shape, at, Matrix3::identity(), &pillar);
            } else {
                builder.add_box([0.15, 0.2, height / 2.0], at, Matrix3::identity(), &pillar);
            }
        }
    }
    for _ in 0..builder.rng.random_range(4..16) {
        let side = if builder.chance(0.5) { 1.0 } else { -1.0 };
        let x = side * half[0] * builder.between(0.45, 0.95);
        let foot = Point3::new(x, half[1] * builder.between(-0.8, 1.0), 0.0);
        let thing = pick(builder.rng, &FURNITURE);
        let size = builder.between(0.4, 1.2);
        builder.add_thing(thing, foot, size);
        add_wall_thing(&mut builder, half, height);
    }
    let lamps = [-0.5, 0.1, 0.7].map(|y| Point3::new(0.0, y * half[1], 0.95 * height));
    let light = Light::lamps(builder.rng, &lamps, half[0] + half[1]);
    let centre =
        Point3::new(builder.between(-0.5, 0.5) * half[0], -0.85 * half[1], builder.between(1.0, 1.9));
    let target = Point3::new(
        builder.between(-0.8, 0.8) * half[0],
        half[1] * builder.between(-0.2, 0.6),
        builder.between(0.5, 1.7),
    );
    let motion = pick(builder.rng, &[Motion::Forward, Motion::Forward, Motion::Track, Motion::Handheld]);
    (builder.stage(light), Shot { centre, target, motion, field_of_view_degrees: field })
}

/// Shapes afloat before a wall: nothing here is real but the geometry.
pub fn floating(rng: &mut ChaCha8Rng, library: &Library, frame: Frame) -> (Stage, Shot) {
    let field = field_of_view(rng);
    let distance = distance_for(2.2, field) * log_uniform(rng, 0.7, 1.3);
    let mut builder = Builder::new(rng, library, frame.texel(distance, field));
    let wall = builder.paint();
    let tilt = yaw(builder.between(-0.6, 0.6));
    let depth = builder.between(1.0, 3.0);
    builder.add_box([12.0, 0.1, 12.0], Point3::new(0.0, depth, 0.0), tilt, &wall);
    for _ in 0..builder.rng.random_range(4..50) {
        let centre = Point3::from(direction(builder.rng) * builder.between(0.1, 1.3));
        let turn = rotation(builder.rng);
        let paint = builder.paint();
        let radius = builder.size(0.06, 0.5);
        builder.add_lump(centre, radius, turn, &paint);
    }
    around(builder, distance, field, [-0.2, 0.4], 0.2)
}

/// A shot from the open side (-y) at an elevation in `elevation`, lit by sun or lamps.
fn around(
    mut builder: Builder,
    distance: f64,
    field: f64,
    elevation: [f64; 2],
    height: f64,
) -> (Stage, Shot) {
    let light = if builder.chance(0.5) {
        Light::outdoors(builder.rng, 4.0)
    } else {
        let lamps: Vec<_> = (0..builder.rng.random_range(1..=2))
            .map(|_| {
                Point3::new(builder.between(-3.0, 3.0), builder.between(-3.0, 1.0), builder.between(1.8, 4.0))
            })
            .collect();
        Light::lamps(builder.rng, &lamps, 3.5)
    };
    let (sin, cos) = builder.between(elevation[0], elevation[1]).sin_cos();
    let (side, front) = builder.between(-0.5, 0.5).sin_cos();
    let target = Point3::new(
        builder.between(-0.3, 0.3),
        builder.between(-0.3, 0.3),
        height * builder.between(0.0, 1.0),
    );
    let centre = target + Vector3::new(side * cos, -front * cos, sin) * distance;
    let centre = Point3::new(centre.x, centre.y, centre.z.max(0.08));
    let motion = pick(builder.rng, &[Motion::Arc, Motion::Arc, Motion::Arc, Motion::Handheld, Motion::Track]);
    (builder.stage(light), Shot { centre, target, motion, field_of_view_degrees: field })
}

/// A flat or uneven ground around the origin, sometimes a small table top in the void.
fn add_ground(builder: &mut Builder, roughness: f64) {
    let paint = builder.paint();
    match builder.rng.random_range(0..5) {
        0 => {
            let half = builder.between(0.9, 1.6);
            builder.add_box([half, half, 0.05], Point3::new(0.0, 0.0, -0.05), Matrix3::identity(), &paint);
        }
        1..3 => {
            let seed = builder.rng.random();
            let height = roughness * builder.size(0.005, 0.12);
            let rate = builder.size(0.6, 3.0) as f32;
            let field = Heightfield::new(97, 97, [6.0, 6.0], |x, y| {
                height * f64::from(octaves([x as f32 * rate, y as f32 * rate, 0.3], 3, 0.5, seed))
            });
            builder.add(Shape::Heightfield(field), Point3::origin(), Matrix3::identity(), &paint);
        }
        _ => builder.add_box([8.0, 8.0, 0.1], Point3::new(0.0, 0.0, -0.1), Matrix3::identity(), &paint),
    }
}

/// Walls behind the scene, or nothing.
fn add_backdrop(builder: &mut Builder, nearest: f64) {
    for side in [0.0, 0.9, -0.9] {
        if builder.chance(if side == 0.0 { 0.6 } else { 0.3 }) {
            let paint = if builder.chance(0.4) { builder.plain_paint() } else { builder.paint() };
            let angle: f64 = side + builder.between(-0.2, 0.2);
            let distance = builder.size(nearest, 3.0 * nearest);
            let at = Point3::new(-distance * angle.sin(), distance * angle.cos(), 2.0);
            builder.add_box([9.0, 0.1, 3.0], at, yaw(angle), &paint);
        }
    }
}

/// Floor, ceiling and four walls around the origin.
fn add_shell(builder: &mut Builder, half: [f64; 2], height: f64) {
    const THICK: f64 = 0.2;
    let level = Matrix3::identity();
    let [hx, hy] = half.map(|h| h + 2.0 * THICK);
    let floor = builder.paint();
    builder.add_box([hx, hy, THICK], Point3::new(0.0, 0.0, -THICK), level, &floor);
    let ceiling = builder.plain_paint();
    builder.add_box([hx, hy, THICK], Point3::new(0.0, 0.0, height + THICK), level, &ceiling);
    let common = if builder.chance(0.5) { builder.plain_paint() } else { builder.paint() };
    for (x, y) in [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)] {
        let paint = if builder.chance(0.35) { builder.paint() } else { common.clone() };
        let at = Point3::new(x * (half[0] + THICK), y * (half[1] + THICK), height / 2.0);
        let extent = if x == 0.0 { [hx, THICK, height / 2.0] } else { [THICK, hy, height / 2.0] };
        builder.add_box(extent, at, level, &paint);
    }
}

/// A picture, shelf, cupboard, pipe or window on one of the walls.
fn add_wall_thing(builder: &mut Builder, half: [f64; 2], height: f64) {
    let level = Matrix3::identity();
    let wall = builder.rng.random_range(0..3);
    // Side walls and the far one; `at(s, off, z)` is `s` along the wall and `off` in front of it.
    let at = |s: f64, off: f64, z: f64| match wall {
        0 => Point3::new(-half[0] + off, s * half[1], z),
        1 => Point3::new(half[0] - off, s * half[1], z),
        _ => Point3::new(s * half[0], half[1] - off, z),
    };
    let extent = |along: f64, off: f64, up: f64| if wall < 2 { [off, along, up] } else { [along, off, up] };
    let (s, z) = (builder.between(-0.9, 0.9), height * builder.between(0.3, 0.75));
    let paint = builder.paint();
    match builder.rng.random_range(0..5) {
        0..2 => {
            let (w, h) = (builder.size(0.15, 0.8), builder.size(0.15, 0.6));
            builder.add_box(extent(w, 0.02, h), at(s, 0.01, z), level, &paint);
        }
        2 => {
            let (w, deep) = (builder.between(0.3, 0.8), builder.between(0.1, 0.2));
            let shelves = builder.rng.random_range(1..5);
            for i in 0..shelves {
                let z = 0.4 + 0.4 * f64::from(i);
                builder.add_box(extent(w, deep, 0.015), at(s, deep, z), level, &paint);
                for _ in 0..3 {
                    let shift = builder.between(-0.6, 0.6) * w / half[usize::from(wall < 2)];
                    let thing = pick(builder.rng, &SMALL_THINGS);
                    let size = builder.between(0.12, 0.35);
                    builder.add_thing(thing, at(s + shift, deep, z + 0.015), size);
                }
            }
        }
        3 => {
            let (w, deep, h) =
                (builder.between(0.3, 0.9), builder.between(0.15, 0.35), builder.between(0.3, 1.0));
            builder.add_box(extent(w, deep, h), at(s, deep, h), level, &paint);
        }
        _ => {
            let (low, high) = (at(s, 0.06, 0.0), at(s, 0.06, height));
            builder.add_rod(low, high, 0.04, &paint);
        }
    }
}
