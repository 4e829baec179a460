//! What surfaces of training scenes look like: a motif, perhaps a second one in places, and grain;
//! shine on top. Whatever is finer than a pixel fades to its mean, so one ray per pixel does not alias.

use std::sync::Arc;

use nalgebra::Vector3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::draw::{log_uniform, pick};
use super::motif::{Layer, blend};
use super::photo::Photo;
use crate::geometry::Hit;
use crate::noise::{gradient_noise, smoothstep};
use crate::texture::{Rgb, Spot};

/// The look of a surface.
#[derive(Clone, Debug)]
pub struct Paint {
    base: Layer,
    /// The texture of a scanned thing, which covers all layers.
    skin: Option<Skin>,
    overlay: Option<Overlay>,
    grain: Grain,
    /// Height of the bumps over their wavelength; 0 is smooth.
    bump: f32,
    /// Wavelength of the bumps, in scene units.
    bump_wavelength: f32,
    /// The weight of highlights, 0 for matt.
    pub gloss: f32,
    /// The exponent of highlights.
    pub sharpness: f32,
    /// The share of light that is mirrored from the surroundings.
    pub mirror: f32,
}

/// A texture that the surface's own coordinates address.
#[derive(Clone, Debug)]
struct Skin {
    photo: Arc<Photo>,
    /// How far its coordinates run per unit of length.
    per_length: f32,
}

/// A second layer where noise passes a threshold.
#[derive(Clone, Debug)]
struct Overlay {
    layer: Layer,
    wavelength: f32,
    threshold: f32,
    seed: u32,
}

/// Noise that scales the colour.
#[derive(Clone, Copy, Debug)]
struct Grain {
    height: f32,
    wavelength: f32,
    octaves: u32,
    persistence: f32,
    seed: u32,
}

/// How busy surfaces are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Busyness {
    /// Anything.
    Any,
    /// At most faint: painted walls, sky-lit ceilings, plastic.
    Plain,
}

impl Paint {
    /// Any look. `texel` is the size of a pixel on the surface at the distance it is made for, in
    /// scene units; structures are a few to a few hundred of these.
    pub fn random(rng: &mut ChaCha8Rng, texel: f64, busyness: Busyness, photos: &[Arc<Photo>]) -> Self {
        let plain = busyness == Busyness::Plain || rng.random_bool(0.08);
        let base = if plain { Layer::plain(rng, texel) } else { Layer::random(rng, texel, photos) };
        let overlay = (!plain && rng.random_bool(0.3)).then(|| Overlay {
            layer: Layer::random(rng, texel, photos),
            wavelength: log_uniform(rng, 20.0 * texel, 200.0 * texel) as f32,
            threshold: rng.random_range(-0.2..0.4),
            seed: rng.random(),
        });
        let height = match (plain, rng.random_range(0..10)) {
            (true, 0..3) | (false, 0) => 0.0,
            (true, _) => log_uniform(rng, 0.005, 0.06),
            (false, _) => log_uniform(rng, 0.06, 0.6),
        };
        let grain = Grain {
            height: height as f32,
            wavelength: log_uniform(rng, 5.0 * texel, 80.0 * texel) as f32,
            octaves: rng.random_range(2..=5),
            persistence: rng.random_range(0.4..0.95),
            seed: rng.random(),
        };
        let shiny = rng.random_bool(0.3);
        Self {
            base,
            skin: None,
            overlay,
            grain,
            bump: if rng.random_bool(0.25) { rng.random_range(0.05..0.35) } else { 0.0 },
            bump_wavelength: log_uniform(rng, 6.0 * texel, 60.0 * texel) as f32,
            gloss: if shiny { rng.random_range(0.05..0.6) } else { pick(rng, &[0.0, 0.0, 0.03]) },
            sharpness: log_uniform(rng, 6.0, 200.0) as f32,
            mirror: if shiny && rng.random_bool(0.5) { rng.random_range(0.02..0.2) } else { 0.0 },
        }
    }

    /// This paint under the texture of a scanned thing, whose coordinates run `per_length` per unit.
    #[must_use]
    pub fn with_skin(self, photo: Arc<Photo>, per_length: f32) -> Self {
        Self { skin: Some(Skin { photo, per_length }), bump: 0.0, ..self }
    }

    /// The share of light the surface throws back at a spot, where a pixel is `footprint` wide.
    pub fn albedo(&self, spot: &Spot, footprint: f32) -> Rgb {
        if let Some(Skin { photo, per_length }) = &self.skin {
            let [u, v] = spot.along;
            return photo.color(u, v, footprint * per_length, false).map(|c| c.clamp(0.01, 0.95));
        }
        let mut color = self.base.color(spot, footprint);
        if let Some(Overlay { layer, wavelength, threshold, seed }) = &self.overlay {
            let noise = gradient_noise(spot.local.map(|v| v / wavelength), *seed);
            let edge = (footprint / wavelength).max(0.02);
            let share = smoothstep(threshold - edge, threshold + edge, noise);
            if share > 0.0 {
                color = blend(color, layer.color(spot, footprint), share);
            }
        }
        let factor = (1.0 + self.grain.at(spot.local, footprint)).clamp(0.25, 1.9);
        color.map(|c| (c * factor).clamp(0.01, 0.95))
    }

    /// The normal that light sees, bumps included.
    pub fn shading_normal(&self, hit: &Hit, normal: Vector3<f64>, footprint: f32) -> Vector3<f64> {
        let visible = self.bump * resolved(self.bump_wavelength, footprint);
        if visible <= 0.0 {
            return normal;
        }
        let at = |shift: f32| {
            let point =
                [hit.local.x, hit.local.y, hit.local.z].map(|v| v as f32 / self.bump_wavelength + shift);
            f64::from(gradient_noise(point, self.grain.seed ^ 0xb0b))
        };
        // Three independent noises tilt the normal; that they are no gradient of one height shows
        // nowhere.
        (normal + Vector3::new(at(0.0), at(31.7), at(77.3)) * f64::from(visible)).normalize()
    }
}

impl Grain {
    fn at(&self, point: [f32; 3], footprint: f32) -> f32 {
        let (mut sum, mut wavelength, mut height) = (0.0, self.wavelength, self.height);
        if height <= 0.0 {
            return 0.0;
        }
        for octave in 0..self.octaves {
            let visible = resolved(wavelength, footprint);
            if visible <= 0.0 {
                break;
            }
            let noise = gradient_noise(point.map(|v| v / wavelength), self.seed.wrapping_add(octave));
            sum += height * visible * noise;
            wavelength *= 0.5;
            height *= self.persistence;
        }
        sum
    }
}

/// How much of a structure is left at a pixel of width `footprint`: all from four pixels per period
/// on, nothing at one and a half.
pub fn resolved(period: f32, footprint: f32) -> f32 {
    smoothstep(1.5, 4.0, period / footprint)
}
