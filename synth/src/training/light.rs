//! Light in training scenes: lamps with sharp or soft shadows, light from all around, the sky itself.

use nalgebra::{Point3, Vector3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{direction, log_uniform};
use super::motif::{blend, color};
use super::stage::Stage;
use crate::geometry::{Hit, Ray};
use crate::noise::{octaves, smoothstep};
use crate::shade::disc;
use crate::texture::{Rgb, Spot};

/// What lights a scene.
#[derive(Clone, Debug)]
pub struct Light {
    lamps: Vec<Lamp>,
    /// Light from all around.
    ambient: Rgb,
    /// Where more of it comes from; shorter than 1.
    ambient_tilt: Vector3<f64>,
    sky: Sky,
    /// Rays leave surfaces this far above them, in scene units.
    lift: f64,
}

#[derive(Clone, Copy, Debug)]
struct Lamp {
    place: Place,
    color: Rgb,
    /// How far a shadow's edge is smeared: the lamp's radius over its distance.
    softness: f64,
}

#[derive(Clone, Copy, Debug)]
enum Place {
    /// Infinitely far in a direction of length 1.
    Sun(Vector3<f64>),
    /// At a point, with full power at a distance.
    Bulb(Point3<f64>, f64),
}

/// What is seen where nothing stands.
#[derive(Clone, Copy, Debug)]
struct Sky {
    horizon: Rgb,
    zenith: Rgb,
    clouds: f32,
    seed: u32,
}

impl Light {
    /// Sun and sky; sometimes overcast. `size` is the extent of the scene.
    pub fn outdoors(rng: &mut ChaCha8Rng, size: f64) -> Self {
        let overcast = rng.random_bool(0.3);
        let mut sun = direction(rng);
        sun.z = sun.z.abs() + rng.random_range(0.1..0.8);
        let power = if overcast { rng.random_range(0.0..0.4) } else { rng.random_range(1.0..4.0) };
        let warm = rng.random_range(0.65..1.05);
        let lamp = Lamp {
            place: Place::Sun(sun.normalize()),
            color: [power, power * (0.5 + 0.5 * warm), power * warm],
            softness: if overcast { 0.3 } else { 0.01 },
        };
        let sky = rng.random_range(0.35..1.1_f32);
        let blue = rng.random_range(1.0..1.4_f32);
        let tint = [sky / blue.sqrt(), sky, sky * blue];
        Self {
            lamps: vec![lamp],
            ambient: tint,
            ambient_tilt: Vector3::new(0.1, 0.1, 0.35) + direction(rng) * 0.2,
            sky: Sky {
                horizon: tint.map(|c| c * 1.5),
                zenith: [tint[0] * 0.6, tint[1] * 0.8, tint[2] * 1.2],
                clouds: if rng.random_bool(0.5) { rng.random_range(0.2..1.5) } else { 0.0 },
                seed: rng.random(),
            },
            lift: 1e-6 * size,
        }
    }

    /// One to three lamps at `places`, `size` the extent of the scene.
    pub fn lamps(rng: &mut ChaCha8Rng, places: &[Point3<f64>], size: f64) -> Self {
        let lamps = places
            .iter()
            .map(|place| {
                let power = log_uniform(rng, 0.4, 2.5) as f32;
                let warm = rng.random_range(0.5..1.05);
                Lamp {
                    place: Place::Bulb(*place, size * rng.random_range(0.5..1.2)),
                    color: [power, power * (0.4 + 0.6 * warm), power * warm],
                    softness: log_uniform(rng, 0.005, 0.12),
                }
            })
            .collect();
        let ambient = rng.random_range(0.15..0.8_f32);
        let backdrop = if rng.random_bool(0.4) { [0.0; 3] } else { color(rng) };
        Self {
            lamps,
            ambient: [ambient, ambient * 0.97, ambient * rng.random_range(0.8..1.05)],
            ambient_tilt: direction(rng) * rng.random_range(0.1..0.6),
            sky: Sky { horizon: backdrop, zenith: backdrop, clouds: 0.0, seed: 0 },
            lift: 1e-6 * size,
        }
    }

    /// What is seen in a direction (length 1) where nothing stands.
    pub fn sky(&self, direction: &Vector3<f64>) -> Rgb {
        let Sky { horizon, zenith, clouds, seed } = self.sky;
        let up = direction.z.clamp(0.0, 1.0) as f32;
        let clear = blend(horizon, zenith, up.sqrt());
        if clouds <= 0.0 || direction.z <= 0.01 {
            return clear;
        }
        let scale = 1.5 / (direction.z + 0.15);
        let at = [direction.x * scale, direction.y * scale, 0.0].map(|v| v as f32);
        let cover = smoothstep(-0.1, 0.5, octaves(at, 4, 0.55, seed));
        blend(clear, horizon.map(|c| c * (0.7 + 0.5 * clouds)), cover)
    }
}

/// The light that arrives at the camera along a ray that met `hit`. `draws` in `[0, 1)` choose the
/// points of the lamps.
pub fn radiance(stage: &Stage, hit: &Hit, ray: &Ray, footprint: f64, draws: [f64; 2]) -> Rgb {
    let light = &stage.light;
    let paint = &stage.paints[hit.body];
    let outward = if hit.normal.dot(&ray.direction) > 0.0 { -hit.normal } else { hit.normal };
    let view = -ray.direction.normalize();
    // Slanted surfaces stretch the pixel; the geometric mean of its sides is what is filtered.
    let footprint = (footprint / outward.dot(&view).max(0.05).sqrt()) as f32;
    let spot = Spot {
        local: [hit.local.x as f32, hit.local.y as f32, hit.local.z as f32],
        along: hit.along.map(|c| c as f32),
    };
    let albedo = paint.albedo(&spot, footprint);
    let normal = paint.shading_normal(hit, outward, footprint);
    // A shadow ray must clear the rounding of the hit itself, which grows with the distance.
    let origin = hit.point + outward * (light.lift + 1e-9 * hit.point.coords.norm());

    let openness = (1.0 + light.ambient_tilt.dot(&normal)) as f32;
    let mut diffuse = light.ambient.map(|c| c * openness);
    let mut shine = [0.0_f32; 3];
    for lamp in &light.lamps {
        let (towards, reach, power) = match lamp.place {
            Place::Sun(direction) => (direction, f64::INFINITY, 1.0),
            Place::Bulb(place, full) => {
                let way = place - hit.point;
                let distance = way.norm().max(1e-9);
                (way / distance, distance, (full / distance.max(0.3 * full)).powi(2))
            }
        };
        let incidence = towards.dot(&normal);
        if incidence <= 0.0 || towards.dot(&outward) <= 0.0 {
            continue;
        }
        let direction = (towards + disc(&towards, draws[0], draws[1]) * lamp.softness).normalize();
        if stage.world.occluded(&Ray { origin, direction }, reach) {
            continue;
        }
        let received = (incidence * power) as f32;
        let highlight = if paint.gloss > 0.0 {
            let half = (towards + view).normalize();
            paint.gloss * (normal.dot(&half).max(0.0) as f32).powf(paint.sharpness) * received * 3.0
        } else {
            0.0
        };
        for c in 0..3 {
            diffuse[c] += lamp.color[c] * received;
            shine[c] += lamp.color[c] * highlight;
        }
    }
    if paint.mirror > 0.0 {
        let mirrored = normal * (2.0 * normal.dot(&view)) - view;
        let grazing = 1.0 - normal.dot(&view).clamp(0.0, 1.0) as f32;
        let share = paint.mirror * (1.0 + 4.0 * grazing.powi(5));
        let around = light.sky(&mirrored);
        for c in 0..3 {
            shine[c] += share * (around[c] + light.ambient[c] * (0.5 + 0.5 * mirrored.z as f32));
        }
    }
    std::array::from_fn(|c| albedo[c] * diffuse[c] + shine[c])
}
