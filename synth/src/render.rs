//! From a world and a camera to an image and its exact depth, row by row in parallel.

use nalgebra::{Point2, Point3, Vector3};
use planesweep_scene::{Camera, Raster};
use rayon::prelude::*;

use crate::SynthScene;
use crate::geometry::{Ray, World};
use crate::noise::{hash, unit};
use crate::shade::{Draws, encode, radiance};
use crate::texture::Rgb;

/// A camera, ready to shoot rays whose `t` is depth.
pub struct Eye {
    centre: Point3<f64>,
    camera: Camera,
}

impl Eye {
    /// Prepares a camera.
    pub fn new(camera: &Camera) -> Self {
        Self { centre: camera.pose.centre(), camera: *camera }
    }

    /// The ray through a pixel position; one unit of its `t` is one unit of depth (z).
    #[inline]
    pub fn ray(&self, pixel: &Point2<f64>) -> Ray {
        let direction = self.camera.intrinsics.unproject(pixel, 1.0).coords;
        Ray { origin: self.centre, direction: self.camera.pose.rotation.tr_mul(&direction) }
    }
}

/// The exact depth at pixel centres; 0 where nothing is met.
pub fn depth(world: &World, camera: &Camera) -> Raster<f32> {
    let eye = Eye::new(camera);
    let (width, height) = size(camera);
    let mut depth = Raster::filled(width, height, 0.0);
    depth.values_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let ray = eye.ray(&Point2::new(x as f64, y as f64));
            *value = world.nearest(&ray).map_or(0.0, |(t, _)| t as f32);
        }
    });
    depth
}

/// The image, of `supersampling` squared rays per pixel.
pub fn color(scene: &SynthScene, camera: &Camera, supersampling: u32) -> Raster<[u8; 3]> {
    let eye = Eye::new(camera);
    let (width, height) = size(camera);
    let samples = Samples { side: supersampling.max(1) };
    let mut image = Raster::filled(width, height, [0; 3]);
    image.values_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.iter_mut().enumerate() {
            let mut sum = [0.0_f32; 3];
            for sample in samples.of_pixel(x, y) {
                let at = Point2::new(x as f64 + sample.offset[0], y as f64 + sample.offset[1]);
                let light = seen(scene, &eye.ray(&at), sample.draws);
                for (total, value) in sum.iter_mut().zip(light) {
                    *total += value;
                }
            }
            let share = 1.0 / (samples.side * samples.side) as f32;
            *pixel = sum.map(|total| encode(total * share));
        }
    });
    image
}

/// The light that arrives along a ray.
fn seen(scene: &SynthScene, ray: &Ray, draws: Draws) -> Rgb {
    let Some(hit) = scene.world.trace(ray) else { return sky(&ray.direction, &scene.light.sky_color) };
    radiance(&scene.world, &scene.light, &scene.materials[hit.body], &hit, &ray.direction, draws)
}

fn sky(direction: &Vector3<f64>, color: &Rgb) -> Rgb {
    let up = direction.normalize().z.clamp(0.0, 1.0) as f32;
    color.map(|c| c * (1.6 - 0.6 * up))
}

fn size(camera: &Camera) -> (usize, usize) {
    (camera.intrinsics.width as usize, camera.intrinsics.height as usize)
}

/// Jittered samples: one in each square of a `side` by `side` grid over the pixel, and likewise for
/// sun and sky, whose grids are visited in other orders so that nothing repeats across the image.
struct Samples {
    side: u32,
}

struct Sample {
    offset: [f64; 2],
    draws: Draws,
}

impl Samples {
    fn of_pixel(&self, x: usize, y: usize) -> impl Iterator<Item = Sample> {
        let side = self.side;
        let count = side * side;
        let seed = hash(x as i32, y as i32, 0, 0);
        (0..count).map(move |i| {
            // A draw in square `index` of the grid.
            let draw = |index: u32, salt: i32| {
                let random = |axis: i32| f64::from(unit(hash(i as i32, salt, axis, seed)));
                let cell = [index % side, index / side];
                [0, 1].map(|axis| (f64::from(cell[axis]) + random(axis as i32)) / f64::from(side))
            };
            let shifted = |shift: u32| (i + shift % count) % count;
            let [px, py] = draw(i, 1);
            let [a, b] = draw(shifted(seed >> 4), 2);
            let [c, d] = draw(shifted(seed >> 18), 3);
            Sample { offset: [px - 0.5, py - 0.5], draws: [a, b, c, d] }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_fill_the_pixel_evenly() {
        let samples: Vec<_> = Samples { side: 4 }.of_pixel(17, 3).collect();
        assert_eq!(samples.len(), 16);
        for quadrant in [[-1.0, -1.0], [1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]] {
            let inside = samples
                .iter()
                .filter(|s| s.offset[0] * quadrant[0] >= 0.0 && s.offset[1] * quadrant[1] >= 0.0)
                .count();
            assert_eq!(inside, 4);
        }
        for sample in &samples {
            assert!(sample.offset.iter().all(|o| (-0.5..0.5).contains(o)));
            assert!(sample.draws.iter().all(|d| (0.0..1.0).contains(d)));
        }
    }
}
