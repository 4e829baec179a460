//! True depth at the pixels of the network's map, masked to what sources see, and the range that a
//! plan would search.

use nalgebra::Point2;
use planesweep_scene::{Camera, DepthRange, Raster};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::rig::sees;
use crate::geometry::World;
use crate::render::Eye;

/// As many sparse points as structure from motion finds in an image of this size, about.
const SPARSE_POINTS: usize = 300;

/// The reference view's depth (z) at a quarter of the size; 0 where no source sees the surface, infinite where the sky
/// is.
pub fn depth(world: &World, cameras: &[Camera]) -> Raster<f32> {
    let [reference, sources @ ..] = cameras else { return Raster::filled(0, 0, 0.0) };
    let map = Camera { intrinsics: reference.intrinsics.quartered(), pose: reference.pose };
    let eye = Eye::new(&map);
    let sources: Vec<(&Camera, Eye)> = sources.iter().map(|camera| (camera, Eye::new(camera))).collect();
    let (width, height) = (map.intrinsics.width as usize, map.intrinsics.height as usize);
    let mut depth = Raster::filled(width, height, 0.0);
    depth.values_mut().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, value) in row.iter_mut().enumerate() {
            let ray = eye.ray(&Point2::new(x as f64, y as f64));
            let Some((t, _)) = world.nearest(&ray) else {
                *value = f32::INFINITY;
                continue;
            };
            let point = ray.at(t);
            if sources.iter().any(|(camera, eye)| sees(world, camera, eye, &point)) {
                *value = t as f32;
            }
        }
    });
    depth
}

/// The depths that are known, row by row.
pub fn known(depth: &Raster<f32>) -> impl Iterator<Item = f64> {
    depth.values().iter().filter(|d| **d > 0.0 && d.is_finite()).map(|d| f64::from(*d))
}

/// Percentiles of depths at random pixels with a margin, as a plan takes them from sparse points, but
/// wider by chance: real points include wrong ones. `None` when too few pixels have depth.
pub fn range(depth: &Raster<f32>, rng: &mut ChaCha8Rng) -> Option<DepthRange> {
    let known: Vec<f64> = known(depth).collect();
    if known.len() * 10 < depth.values().len() {
        return None;
    }
    let mut sparse: Vec<f64> = (0..SPARSE_POINTS).map(|_| known[rng.random_range(0..known.len())]).collect();
    sparse.sort_by(f64::total_cmp);
    let (near, far) = (sparse[SPARSE_POINTS / 100], sparse[SPARSE_POINTS - 1 - SPARSE_POINTS / 100]);
    let extent = (far - near).max(1e-3 * far);
    let widen = if rng.random_bool(0.5) { rng.random_range(0.05..0.1) } else { rng.random_range(0.05..0.6) };
    // A range as wide as it is deep would reach behind the camera.
    let min = near - (rng.random_range(0.5..1.0) * widen * extent).min(0.3 * near);
    let max = far + rng.random_range(0.5..1.0) * widen * extent;
    Some(DepthRange { min, max, count: None })
}
