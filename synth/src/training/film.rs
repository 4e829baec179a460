//! From light to the bytes of a photograph: exposure, colour balance, vignetting, blur, sensor noise,
//! tone curve, JPEG. Each view of a scene gets its own, as with a camera on automatic.

use image::codecs::jpeg::{JpegDecoder, JpegEncoder};
use image::{DynamicImage, ExtendedColorType};
use planesweep_scene::Raster;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::draw::{log_uniform, normal};
use crate::noise::{hash, mix, unit};
use crate::texture::Rgb;

/// What all views of a scene share: one camera, one light.
#[derive(Clone, Copy, Debug)]
pub struct Camera {
    exposure: f32,
    balance: Rgb,
    gamma: f32,
    contrast: f32,
    saturation: f32,
    vignetting: f32,
    /// Deviation of the noise of a middle grey, in steps of 255.
    noise: f32,
    blur: f64,
    /// JPEG quality, if it stores JPEG.
    quality: Option<u8>,
    /// How much views differ: 0 not at all, 1 much.
    drift: f64,
}

/// The development of one view.
#[derive(Clone, Copy, Debug)]
pub struct Development {
    camera: Camera,
    blur: f64,
    seed: u32,
}

impl Camera {
    /// A camera whose exposure makes a middle grey of the mean light of `reference`.
    pub fn random(rng: &mut ChaCha8Rng, reference: &Raster<Rgb>) -> Self {
        let sum: f64 = reference.values().iter().map(|c| f64::from(luminance(*c) + 1e-3).ln()).sum();
        let level = (sum / reference.values().len().max(1) as f64).exp();
        let drift = match rng.random_range(0..10) {
            0..3 => 0.0,
            3..8 => rng.random_range(0.1..0.4),
            _ => rng.random_range(0.4..1.0),
        };
        Self {
            exposure: (log_uniform(rng, 0.11, 0.34) / level) as f32,
            balance: [log_uniform(rng, 0.85, 1.18) as f32, 1.0, log_uniform(rng, 0.85, 1.18) as f32],
            gamma: log_uniform(rng, 0.85, 1.2) as f32,
            contrast: rng.random_range(0.0..0.8),
            saturation: rng.random_range(0.6..1.3),
            vignetting: if rng.random_bool(0.5) { rng.random_range(0.0..0.5) } else { 0.0 },
            noise: log_uniform(rng, 0.2, 6.0) as f32,
            blur: if rng.random_bool(0.5) { rng.random_range(0.3..0.8) } else { 0.0 },
            quality: rng.random_bool(0.7).then(|| rng.random_range(55..=97)),
            drift,
        }
    }

    /// The settings for one view.
    pub fn development(&self, rng: &mut ChaCha8Rng) -> Development {
        let mut vary = |width: f64| (self.drift * width * normal(rng)).clamp(-1.5, 1.5).exp() as f32;
        let mut camera = Self { exposure: self.exposure * vary(0.35), ..*self };
        camera.balance = [self.balance[0] * vary(0.1), 1.0, self.balance[2] * vary(0.1)];
        camera.gamma *= vary(0.12);
        // A hand shakes and focus misses now and then.
        let blur = if rng.random_bool(0.08) { rng.random_range(0.5..1.4) } else { 0.0 };
        Development { camera, blur: self.blur.hypot(blur), seed: rng.random() }
    }
}

impl Development {
    /// The photograph.
    pub fn develop(&self, light: &Raster<Rgb>) -> Raster<[u8; 3]> {
        let (width, height) = (light.width(), light.height());
        let blurred;
        let light = if self.blur > 0.25 {
            blurred = blur(light, self.blur as f32);
            &blurred
        } else {
            light
        };
        let mut pixels = vec![[0; 3]; width * height];
        pixels.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, (pixel, color)) in row.iter_mut().zip(light.row(y)).enumerate() {
                *pixel = self.pixel(*color, x, y, width, height);
            }
        });
        if let Some(quality) = self.camera.quality {
            compress(&mut pixels, width as u32, height as u32, quality);
        }
        Raster::new(width, height, pixels).expect("the pixels were made for this size")
    }

    fn pixel(&self, color: Rgb, x: usize, y: usize, width: usize, height: usize) -> [u8; 3] {
        let Camera { exposure, balance, gamma, contrast, saturation, vignetting, noise, .. } = self.camera;
        let (u, v) = (x as f32 / width as f32 - 0.5, y as f32 / height as f32 - 0.5);
        let shade = exposure * (1.0 - vignetting * 2.0 * (u * u + v * v));
        let mut exposed: Rgb = std::array::from_fn(|c| color[c] * balance[c] * shade);
        let grey = luminance(exposed);
        exposed = exposed.map(|c| (grey + (c - grey) * saturation).max(0.0));
        let random = hash(x as i32, y as i32, 0, self.seed);
        std::array::from_fn(|c| {
            // Photons count by their number: noise grows with the root of the light.
            let noisy =
                exposed[c] + bell(mix(random ^ (c as u32 + 1))) * noise * 0.004 * (0.02 + exposed[c]).sqrt();
            tone(noisy.max(0.0), gamma, contrast)
        })
    }
}

/// sRGB with a shoulder, then a curve through the middle.
fn tone(linear: f32, gamma: f32, contrast: f32) -> u8 {
    let toned = (linear * (1.0 + linear / 6.0) / (1.0 + linear)).clamp(0.0, 1.0);
    let srgb = if toned <= 0.003_130_8 { 12.92 * toned } else { 1.055 * toned.powf(1.0 / 2.4) - 0.055 };
    let t = if (gamma - 1.0).abs() > 1e-3 { srgb.powf(gamma) } else { srgb };
    let steep = t * t * (3.0 - 2.0 * t);
    ((t + contrast * (steep - t)) * 255.0 + 0.5) as u8
}

fn luminance([r, g, b]: Rgb) -> f32 {
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

/// About a bell curve of deviation 1: the sum of four uniform numbers.
fn bell(random: u32) -> f32 {
    let byte = |shift: u32| ((random >> shift) & 255) as f32 / 255.0;
    // The deviation of the sum of four is the root of a third; the low bits smooth its steps.
    (byte(0) + byte(8) + byte(16) + byte(24) - 2.0) * 1.732 + 0.01 * (unit(mix(random)) - 0.5)
}

/// A Gaussian of `sigma` pixels, rows then columns.
fn blur(image: &Raster<Rgb>, sigma: f32) -> Raster<Rgb> {
    let radius = (2.5 * sigma).ceil() as usize;
    let weights: Vec<f32> = (0..=radius).map(|i| (-0.5 * (i as f32 / sigma).powi(2)).exp()).collect();
    let total = weights[0] + 2.0 * weights[1..].iter().sum::<f32>();
    let (width, height) = (image.width(), image.height());
    let pass = |source: &[Rgb], at: &(dyn Fn(usize, usize, isize) -> usize + Sync)| {
        let mut out = vec![[0.0; 3]; width * height];
        out.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                let mut sum = [0.0; 3];
                for offset in -(radius as isize)..=radius as isize {
                    let weight = weights[offset.unsigned_abs()] / total;
                    let color = source[at(x, y, offset)];
                    for c in 0..3 {
                        sum[c] += weight * color[c];
                    }
                }
                *pixel = sum;
            }
        });
        out
    };
    let rows = pass(image.values(), &|x, y, d| y * width + x.saturating_add_signed(d).min(width - 1));
    let both = pass(&rows, &|x, y, d| y.saturating_add_signed(d).min(height - 1) * width + x);
    Raster::new(width, height, both).expect("the pixels were made for this size")
}

/// Writes and reads a JPEG; what the codec refuses stays as it is.
fn compress(pixels: &mut [[u8; 3]], width: u32, height: u32, quality: u8) {
    let mut bytes = Vec::new();
    let encoded = JpegEncoder::new_with_quality(&mut bytes, quality).encode(
        pixels.as_flattened(),
        width,
        height,
        ExtendedColorType::Rgb8,
    );
    let decoded = encoded
        .and_then(|()| JpegDecoder::new(std::io::Cursor::new(bytes)))
        .and_then(DynamicImage::from_decoder);
    if let Ok(image) = decoded {
        pixels.as_flattened_mut().copy_from_slice(image.to_rgb8().as_raw());
    }
}
