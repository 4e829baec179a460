//! The cameras of a sample: a reference view and sources that see what it sees from elsewhere.

use nalgebra::{Point2, Point3, Rotation3, Unit, Vector3};
use planesweep_scene::{Camera, Intrinsics, Pose};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{direction, log_uniform};
use super::stage::{Motion, Shot};
use crate::geometry::{Ray, World};
use crate::render::Eye;

/// Rays along each side of the grid that probes what a view sees.
const PROBES: [u32; 2] = [16, 12];
/// Tries per source view before a place is taken that is not free or sees little.
const TRIES: usize = 12;
/// A source should see this share of the reference's surface.
const WANTED_OVERLAP: f64 = 0.4;
/// The angle between two rays that serves matching best, and how fast others get worse (paper,
/// section 4.1), in degrees.
const BEST_ANGLE_DEG: f64 = 5.0;

/// The reference camera and its sources, best first.
pub struct Rig {
    pub cameras: Vec<Camera>,
    /// The share of the probed surface that at least one source sees.
    pub overlap: f64,
}

/// Places `count` cameras for a shot. `None` when the reference camera sees next to nothing.
pub fn place(
    world: &World,
    shot: &Shot,
    width: u32,
    height: u32,
    count: usize,
    rng: &mut ChaCha8Rng,
) -> Option<Rig> {
    let intrinsics = intrinsics(shot.field_of_view_degrees, width, height, rng);
    let roll = match rng.random_range(0..12) {
        0 => rng.random_range(-1.6..1.6),
        1..4 => rng.random_range(-0.35..0.35),
        _ => rng.random_range(-0.06..0.06),
    };
    let reference = Camera { intrinsics, pose: aimed(&shot.centre, &shot.target, roll) };
    let probes = probe(world, &reference);
    let mut depths: Vec<f64> = probes.iter().map(|p| reference.pose.to_camera(p).z).collect();
    if depths.len() < (PROBES[0] * PROBES[1]) as usize / 4 {
        return None;
    }
    depths.sort_by(f64::total_cmp);
    // People turn about what is near the middle of the range, rather nearer than farther.
    let pivot_depth = depths[depths.len() * rng.random_range(30..60) / 100];
    if depths[depths.len() / 50] < 1e-3 * pivot_depth {
        return None;
    }
    let pilot = Pilot {
        world,
        reference,
        centre: shot.centre,
        roll,
        pivot: reference.unproject(&Point2::new(intrinsics.cx, intrinsics.cy), pivot_depth),
        pivot_depth,
        motion: shot.motion,
        step: log_uniform(rng, 2.5, 12.0).to_radians(),
        way: across(&reference, rng),
    };
    let zoom = rng.random_bool(0.15);
    let mut sources: Vec<(f64, Camera, Vec<bool>)> = (1..count)
        .map(|i| {
            let steps = (i as f64 / 2.0).ceil() * if i % 2 == 0 { -1.0 } else { 1.0 };
            let camera = pilot.source(steps, zoom, &probes, rng);
            let seen = visible(world, &camera, &probes);
            (score(&shot.centre, &camera, &probes, &seen), camera, seen)
        })
        .collect();
    sources.sort_by(|a, b| b.0.total_cmp(&a.0));
    let seen = (0..probes.len()).filter(|i| sources.iter().any(|(_, _, seen)| seen[*i])).count();
    let overlap = seen as f64 / probes.len() as f64;
    let cameras = [reference].into_iter().chain(sources.into_iter().map(|(_, camera, _)| camera)).collect();
    Some(Rig { cameras, overlap })
}

struct Pilot<'a> {
    world: &'a World,
    reference: Camera,
    centre: Point3<f64>,
    roll: f64,
    /// What the cameras turn about.
    pivot: Point3<f64>,
    pivot_depth: f64,
    motion: Motion,
    /// The angle at the pivot between neighbours.
    step: f64,
    /// The direction in which the camera mostly goes, across its line of sight.
    way: Vector3<f64>,
}

impl Pilot<'_> {
    /// The first of some tries that stands free and sees enough, else the one that sees most. Each
    /// try stays nearer to the reference view.
    fn source(&self, steps: f64, zoom: bool, probes: &[Point3<f64>], rng: &mut ChaCha8Rng) -> Camera {
        let mut best: Option<(f64, Camera)> = None;
        let mut angle = steps * self.step * rng.random_range(0.8..1.25);
        for _ in 0..TRIES {
            let camera = self.candidate(angle, zoom, rng);
            let seen = visible(self.world, &camera, probes);
            let overlap = seen.iter().filter(|s| **s).count() as f64 / probes.len() as f64;
            let free = self.is_free(&camera.pose.centre());
            let overlap = if free { overlap } else { 0.1 * overlap };
            if overlap >= WANTED_OVERLAP {
                return camera;
            }
            if best.as_ref().is_none_or(|(most, _)| overlap > *most) {
                best = Some((overlap, camera));
            }
            angle *= if rng.random_bool(0.3) { -0.8 } else { 0.8 };
        }
        best.map_or(self.reference, |(_, camera)| camera)
    }

    fn candidate(&self, angle: f64, zoom: bool, rng: &mut ChaCha8Rng) -> Camera {
        let d = self.pivot_depth;
        let forward = (self.pivot - self.centre).normalize();
        let mut shake = |size: f64| direction(rng) * size;
        let chord = 2.0 * d * (angle / 2.0).tan();
        let (centre, aim) = match self.motion {
            Motion::Arc => {
                let axis = Unit::new_normalize(forward.cross(&self.way));
                let turned = Rotation3::from_axis_angle(&axis, -angle) * (self.centre - self.pivot);
                (self.pivot + turned + shake(0.15 * chord.abs()), 1.0)
            }
            Motion::Track => (self.centre + self.way * chord + shake(0.1 * chord.abs()), 0.0),
            Motion::Handheld => {
                let off = shake(1.0);
                let across = off - forward * (0.6 * off.dot(&forward));
                (self.centre + across.normalize() * chord, 0.6)
            }
            Motion::Forward => {
                let along = forward * (2.5 * chord.clamp(-0.1 * d, 0.16 * d));
                (self.centre + along + shake(0.3 * chord.abs()), 0.1)
            }
        };
        // Between keeping the direction (0) and turning to the pivot (1).
        let aim = (aim + rng.random_range(-0.25..0.25_f64)).clamp(-0.1, 1.1);
        let parallel = centre + (self.pivot - self.centre);
        let wobble = direction(rng) * (d * log_uniform(rng, 0.005, 0.08));
        let target = parallel + (self.pivot - parallel) * aim + wobble;
        let roll = self.roll + rng.random_range(-0.05..0.05);
        let mut intrinsics = self.reference.intrinsics;
        if zoom {
            let factor = log_uniform(rng, 0.85, 1.18);
            intrinsics.fx *= factor;
            intrinsics.fy *= factor;
        }
        Camera { intrinsics, pose: aimed(&centre, &target, roll) }
    }

    /// Whether the way there from the reference camera, and a little beyond, is free.
    fn is_free(&self, centre: &Point3<f64>) -> bool {
        let way = centre - self.centre;
        way.norm() < 1e-9 || !self.world.occluded(&Ray { origin: self.centre, direction: way }, 1.3)
    }
}

/// A camera that looks at `target`, rolled about its line of sight; near the poles any way is up.
fn aimed(centre: &Point3<f64>, target: &Point3<f64>, roll: f64) -> Pose {
    let forward = (target - centre).normalize();
    let up = if forward.z.abs() > 0.999 { Vector3::y() } else { Vector3::z() };
    let level = Pose::look_at(centre, target, &up);
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), roll);
    Pose { rotation: turn * level.rotation, translation: turn * level.translation }
}

fn intrinsics(field_of_view_degrees: f64, width: u32, height: u32, rng: &mut ChaCha8Rng) -> Intrinsics {
    let focal = f64::from(width) / 2.0 / (field_of_view_degrees / 2.0).to_radians().tan();
    // Most images are whole photographs; some are parts of larger ones.
    let offset = if rng.random_bool(0.2) { 0.2 } else { 0.02 };
    let mut shift =
        |size: u32| (f64::from(size) - 1.0) / 2.0 + f64::from(size) * rng.random_range(-offset..offset);
    let (cx, cy) = (shift(width), shift(height));
    let aspect = if rng.random_bool(0.3) { rng.random_range(0.97..1.03) } else { 1.0 };
    Intrinsics { width, height, fx: focal, fy: focal * aspect, skew: 0.0, cx, cy }
}

/// Mostly to the right, sometimes up or slanted.
fn across(reference: &Camera, rng: &mut ChaCha8Rng) -> Vector3<f64> {
    let angle: f64 = match rng.random_range(0..10) {
        0..6 => rng.random_range(-0.3..0.3),
        6..8 => rng.random_range(1.2..1.9),
        _ => rng.random_range(0.0..std::f64::consts::PI),
    };
    let right = reference.pose.rotation.row(0).transpose();
    let down = reference.pose.rotation.row(1).transpose();
    right * angle.cos() + down * angle.sin()
}

/// Surface points (world) that a grid of rays of the camera meets.
fn probe(world: &World, camera: &Camera) -> Vec<Point3<f64>> {
    let eye = Eye::new(camera);
    let Intrinsics { width, height, .. } = camera.intrinsics;
    let at = |i: u32, of: u32, size: u32| (f64::from(i) + 0.5) / f64::from(of) * f64::from(size) - 0.5;
    (0..PROBES[1])
        .flat_map(|y| (0..PROBES[0]).map(move |x| (x, y)))
        .filter_map(|(x, y)| {
            let ray = eye.ray(&Point2::new(at(x, PROBES[0], width), at(y, PROBES[1], height)));
            world.nearest(&ray).map(|(t, _)| ray.at(t))
        })
        .collect()
}

/// Which of the points (world, on surfaces) a camera sees.
pub fn visible(world: &World, camera: &Camera, points: &[Point3<f64>]) -> Vec<bool> {
    let eye = Eye::new(camera);
    points.iter().map(|point| sees(world, camera, &eye, point)).collect()
}

/// Whether a camera sees a surface point: it falls into the image and nothing lies clearly before it.
pub fn sees(world: &World, camera: &Camera, eye: &Eye, point: &Point3<f64>) -> bool {
    /// Share of the depth that rounding and grazing rays may cost.
    const SAME_DEPTH: f64 = 1e-4;
    let Some((pixel, depth)) = camera.project(point) else { return false };
    let (right, bottom) =
        (f64::from(camera.intrinsics.width) - 1.0, f64::from(camera.intrinsics.height) - 1.0);
    (0.0..=right).contains(&pixel.x)
        && (0.0..=bottom).contains(&pixel.y)
        && !world.occluded(&eye.ray(&pixel), depth * (1.0 - SAME_DEPTH))
}

/// The sum over the points that both see of how well their angle serves.
fn score(centre: &Point3<f64>, source: &Camera, points: &[Point3<f64>], seen: &[bool]) -> f64 {
    let other = source.pose.centre();
    points
        .iter()
        .zip(seen)
        .filter(|(_, seen)| **seen)
        .map(|(point, _)| {
            let angle = (centre - point).angle(&(other - point)).to_degrees();
            let width = if angle <= BEST_ANGLE_DEG { 1.0 } else { 10.0 };
            (-0.5 * ((angle - BEST_ANGLE_DEG) / width).powi(2)).exp()
        })
        .sum()
}
