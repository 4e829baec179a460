//! Sparse points with tracks, as structure from motion would leave them, but exact.

use nalgebra::{Point2, Point3, Vector3};
use planesweep_scene::{Camera, SparsePoints, ViewId};
use rayon::prelude::*;

use crate::geometry::World;
use crate::noise::{hash, unit};
use crate::render::Eye;

/// Surfaces seen under a smaller cosine are too foreshortened for a feature to be found again.
const MIN_COSINE: f64 = 0.15;
/// A point is visible where the ray's own depth is the point's, up to this relative difference.
const SAME_DEPTH: f64 = 1e-6;

/// See [`crate::SynthScene::sparse_points`].
pub fn sample(world: &World, cameras: &[Camera], per_view: usize) -> SparsePoints {
    let eyes: Vec<Eye> = cameras.iter().map(Eye::new).collect();
    let views: Vec<usize> = (0..cameras.len()).collect();
    let found: Vec<_> =
        views.par_iter().map(|view| sample_view(world, cameras, &eyes, *view, per_view)).collect();
    let mut points = SparsePoints::default();
    for (position, track) in found.into_iter().flatten() {
        points.push(position, track);
    }
    points
}

fn sample_view(
    world: &World,
    cameras: &[Camera],
    eyes: &[Eye],
    view: usize,
    per_view: usize,
) -> Vec<(Point3<f64>, Vec<ViewId>)> {
    let intrinsics = &cameras[view].intrinsics;
    let (width, height) = (f64::from(intrinsics.width), f64::from(intrinsics.height));
    // One point in each square of a grid over the image, so that no part stays empty.
    let side = (width * height / per_view.max(1) as f64).sqrt();
    let (columns, rows) = ((width / side).ceil() as i32, (height / side).ceil() as i32);
    let grid = (0..rows).flat_map(|row| (0..columns).map(move |column| (column, row)));
    grid.filter_map(|(column, row)| {
        let jitter = |axis| f64::from(unit(hash(column, row, axis, view as u32)));
        let x = (f64::from(column) + jitter(0)) * side - 0.5;
        let y = (f64::from(row) + jitter(1)) * side - 0.5;
        if x > width - 1.0 || y > height - 1.0 || x < 0.0 || y < 0.0 {
            return None;
        }
        let hit = world.trace(&eyes[view].ray(&Point2::new(x, y)))?;
        let track: Vec<_> = (0..cameras.len())
            .filter(|i| sees(world, &cameras[*i], &eyes[*i], &hit.point, &hit.normal))
            .map(|i| ViewId(i as u32 + 1))
            .collect();
        (track.len() >= 2).then_some((hit.point, track))
    })
    .collect()
}

fn sees(world: &World, camera: &Camera, eye: &Eye, point: &Point3<f64>, normal: &Vector3<f64>) -> bool {
    let Some((pixel, depth)) = camera.project(point) else { return false };
    let (right, bottom) = (camera.intrinsics.width as f64 - 1.0, camera.intrinsics.height as f64 - 1.0);
    if !(0.0..=right).contains(&pixel.x) || !(0.0..=bottom).contains(&pixel.y) {
        return false;
    }
    let ray = eye.ray(&pixel);
    normal.dot(&ray.direction).abs() >= MIN_COSINE * ray.direction.norm()
        && world.nearest(&ray).is_some_and(|(t, _)| (t - depth).abs() <= SAME_DEPTH * depth)
}
