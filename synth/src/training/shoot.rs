//! The light that reaches each pixel of a camera in a stage.

use nalgebra::Point2;
use planesweep_scene::{Camera, Raster};
use rayon::prelude::*;

use super::light::radiance;
use super::stage::Stage;
use crate::noise::{hash, mix, unit};
use crate::render::Eye;
use crate::texture::Rgb;

/// Which body a pixel shows; the sky is none.
const SKY: u32 = u32::MAX;
/// Pixels whose light differs from a neighbour's by more than this share are sampled again.
const CONTRAST: f32 = 0.45;
/// Further rays for such pixels, spread over the pixel.
const REFINED: [[f64; 2]; 2] = [[-0.3, -0.2], [0.3, 0.2]];

/// One ray per pixel, more where bodies meet or light changes much.
pub fn light(stage: &Stage, camera: &Camera) -> Raster<Rgb> {
    let first = Pass::new(stage, camera);
    let width = first.pixels.width();
    let mut image = first.light();
    image.values_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            if first.needs_more(x, y) {
                for (i, offset) in REFINED.into_iter().enumerate() {
                    let (more, _) = first.sample(x, y, offset, i as i32 + 1);
                    for c in 0..3 {
                        pixel[c] += more[c];
                    }
                }
                *pixel = pixel.map(|c| c / (1 + REFINED.len()) as f32);
            }
        }
    });
    image
}

/// One ray per pixel.
pub fn rough_light(stage: &Stage, camera: &Camera) -> Raster<Rgb> {
    Pass::new(stage, camera).light()
}

/// The middle of each pixel: its light and the body it shows.
struct Pass<'a> {
    stage: &'a Stage,
    eye: Eye,
    focal: f64,
    pixels: Raster<(Rgb, u32)>,
}

impl<'a> Pass<'a> {
    fn new(stage: &'a Stage, camera: &Camera) -> Self {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let focal = camera.intrinsics.fx.min(camera.intrinsics.fy);
        let pixels = Raster::filled(width, height, ([0.0; 3], SKY));
        let mut pass = Self { stage, eye: Eye::new(camera), focal, pixels };
        let mut pixels = pass.pixels.clone();
        pixels.values_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.iter_mut().enumerate() {
                *pixel = pass.sample(x, y, [0.0; 2], 0);
            }
        });
        pass.pixels = pixels;
        pass
    }

    fn light(&self) -> Raster<Rgb> {
        self.pixels.map(|(light, _)| *light)
    }

    /// The light of one ray, `offset` from the middle of a pixel, and the body it meets.
    fn sample(&self, x: usize, y: usize, offset: [f64; 2], salt: i32) -> (Rgb, u32) {
        let ray = self.eye.ray(&Point2::new(x as f64 + offset[0], y as f64 + offset[1]));
        let Some(hit) = self.stage.world.trace(&ray) else {
            return (self.stage.light.sky(&ray.direction.normalize()), SKY);
        };
        let random = hash(x as i32, y as i32, salt, 0);
        let draws = [random, mix(random ^ 1)].map(|r| f64::from(unit(r)));
        (radiance(self.stage, &hit, &ray, hit.t / self.focal, draws), hit.body as u32)
    }

    fn needs_more(&self, x: usize, y: usize) -> bool {
        let (color, body) = self.pixels.at(x, y);
        let neighbours = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
        neighbours.into_iter().filter_map(|(x, y)| self.pixels.get(x, y)).any(|(other, its_body)| {
            its_body != body || (color[1] - other[1]).abs() > CONTRAST * color[1].max(other[1])
        })
    }
}
