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
const CONTRAST: f32 = 0.35;
/// Further rays for such pixels, spread over the pixel.
const REFINED: [[f64; 2]; 3] = [[-0.31, -0.12], [0.29, -0.27], [0.06, 0.33]];

/// One ray per pixel, more where bodies meet or light changes much.
pub fn light(stage: &Stage, camera: &Camera) -> Raster<Rgb> {
    let eye = Eye::new(camera);
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    let focal = camera.intrinsics.fx.min(camera.intrinsics.fy);
    let sample = |x: usize, y: usize, offset: [f64; 2], salt: i32| {
        let ray = eye.ray(&Point2::new(x as f64 + offset[0], y as f64 + offset[1]));
        let Some(hit) = stage.world.trace(&ray) else {
            return (stage.light.sky(&ray.direction.normalize()), SKY);
        };
        let random = hash(x as i32, y as i32, salt, 0);
        let draws = [random, mix(random ^ 1)].map(|r| f64::from(unit(r)));
        (radiance(stage, &hit, &ray, hit.t / focal, draws), hit.body as u32)
    };
    let mut first = vec![([0.0; 3], SKY); width * height];
    first.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            *pixel = sample(x, y, [0.0; 2], 0);
        }
    });
    let needs_more = |x: usize, y: usize| {
        let (color, body) = first[y * width + x];
        let neighbours = [(x.wrapping_sub(1), y), (x + 1, y), (x, y.wrapping_sub(1)), (x, y + 1)];
        neighbours.into_iter().filter(|(x, y)| *x < width && *y < height).any(|(x, y)| {
            let (other, its_body) = first[y * width + x];
            its_body != body || (color[1] - other[1]).abs() > CONTRAST * color[1].max(other[1])
        })
    };
    let mut image = vec![[0.0; 3]; width * height];
    image.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            *pixel = first[y * width + x].0;
            if needs_more(x, y) {
                for (i, offset) in REFINED.into_iter().enumerate() {
                    let (more, _) = sample(x, y, offset, i as i32 + 1);
                    for c in 0..3 {
                        pixel[c] += more[c];
                    }
                }
                *pixel = pixel.map(|c| c / 4.0);
            }
        }
    });
    Raster::new(width, height, image).expect("the pixels were made for this size")
}
