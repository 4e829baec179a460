//! Depth maps at the resolution of their photograph: joint, that is image-guided, upsampling.

use rayon::prelude::*;

use crate::depth_map::with_confidence;
use crate::{Camera, DepthMap, Raster, WorkingImage};

/// Two depths that differ by less, relatively, from one pixel of a map to the next are one surface: a plane seen at 80
/// degrees makes steps of 3 %.
const MAX_RELATIVE_STEP: f32 = 0.03;
/// Difference of colours (root of the sum of squares over RGB, of 255 each) that tells two surfaces apart.
const COLOR_SIGMA: f32 = 25.0;

impl DepthMap {
    /// The map at the resolution of `image`, the photograph that it is the depth of, of whatever size.
    ///
    /// Within a surface, inverse depth is interpolated, which is exact for planes. Where the four pixels around lie on
    /// several surfaces, the one whose pixels in the neighbourhood are most like the photograph's pixel in colour
    /// gets it whole, so that no depth lies between the surfaces. Where the nearest pixel has no depth, there is
    /// none. Confidence follows depth; colours are the photograph's.
    #[must_use]
    pub fn upsampled(&self, image: &WorkingImage) -> DepthMap {
        let (width, height) = (image.pixels.width(), image.pixels.height());
        let guided = Guided { map: self, inverse: self.depth.map(|d| if *d > 0.0 { 1.0 / d } else { 0.0 }) };
        let (k, of_map) = (&image.camera.intrinsics, &self.camera.intrinsics);
        let columns = (of_map.fx / k.fx, of_map.cx - k.cx * of_map.fx / k.fx);
        let rows = (of_map.fy / k.fy, of_map.cy - k.cy * of_map.fy / k.fy);
        let mut depth = Raster::filled(width, height, 0.0);
        let mut confidence = Raster::filled(width, height, 0.0);
        let both = depth.values_mut().par_chunks_mut(width.max(1));
        both.zip(confidence.values_mut().par_chunks_mut(width.max(1))).enumerate().for_each(
            |(y, (depth, confidence))| {
                let v = (rows.0 * y as f64 + rows.1) as f32;
                for (x, color) in image.pixels.row(y).iter().enumerate() {
                    let u = (columns.0 * x as f64 + columns.1) as f32;
                    (depth[x], confidence[x]) = guided.at(u, v, *color).unwrap_or_default();
                }
            },
        );
        let camera = Camera { intrinsics: *k, pose: self.camera.pose };
        let color = with_confidence(image.pixels.values().iter().copied(), &confidence);
        DepthMap { camera, depth, confidence, color }
    }
}

/// A map whose depth is wanted between its pixels.
struct Guided<'a> {
    map: &'a DepthMap,
    /// 1 / depth; 0 where there is none.
    inverse: Raster<f32>,
}

/// Whether two inverse depths are of one surface.
fn continues(a: f32, b: f32) -> bool {
    a > 0.0 && b > 0.0 && (a - b).abs() < MAX_RELATIVE_STEP * a.min(b)
}

impl Guided<'_> {
    /// Depth and confidence at a place, given the colour there.
    fn at(&self, u: f32, v: f32, color: [u8; 3]) -> Option<(f32, f32)> {
        let (width, height) = (self.map.width(), self.map.height());
        // Half a pixel beyond the border repeats it.
        let place = |position: f32, size: usize| {
            let position = position.clamp(0.0, size.saturating_sub(1) as f32);
            let first = (position as usize).min(size.saturating_sub(2));
            (first, position - first as f32)
        };
        let ((x, fx), (y, fy)) = (place(u, width), place(v, height));
        let (right, below) = ((x + 1).min(width.checked_sub(1)?), (y + 1).min(height.checked_sub(1)?));
        let corners = [(x, y), (right, y), (x, below), (right, below)];
        let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
        let inverse = corners.map(|(x, y)| self.inverse.at(x, y));
        let nearest = usize::from(fx >= 0.5) + 2 * usize::from(fy >= 0.5);
        if inverse[nearest] == 0.0 {
            return None;
        }
        let surface = if inverse.iter().all(|other| continues(*other, inverse[nearest])) {
            inverse[nearest]
        } else {
            self.surface(&inverse, nearest, (u, v), (x, y), color)
        };
        let (mut sum, mut confidence, mut total) = (0.0, 0.0, 0.0);
        for ((corner, weight), (x, y)) in inverse.into_iter().zip(weights).zip(corners) {
            if continues(corner, surface) {
                // What is far may be all that there is of the surface.
                let weight = weight.max(1e-3);
                sum += weight * corner;
                confidence += weight * self.map.confidence.at(x, y);
                total += weight;
            }
        }
        (sum > 0.0).then(|| (total / sum, confidence / total))
    }

    /// Of the surfaces that the corners lie on, the one whose pixels among the 4 x 4 about the place are most like
    /// `color`: the inverse depth of one of its corners. The first corner is `(x, y)`.
    fn surface(
        &self,
        corners: &[f32; 4],
        nearest: usize,
        (u, v): (f32, f32),
        (x, y): (usize, usize),
        color: [u8; 3],
    ) -> f32 {
        let mut support = [0.0_f32; 4];
        for row in y.saturating_sub(1)..(y + 3).min(self.map.height()) {
            for column in x.saturating_sub(1)..(x + 3).min(self.map.width()) {
                let seen = self.inverse.at(column, row);
                if seen == 0.0 {
                    continue;
                }
                let there = self.map.rgb(column, row);
                let square = |a: u8, b: u8| (f32::from(a) - f32::from(b)).powi(2);
                let difference: f32 = color.iter().zip(there).map(|(a, b)| square(*a, b)).sum();
                let distance = (column as f32 - u).powi(2) + (row as f32 - v).powi(2);
                let weight = (-difference / (2.0 * COLOR_SIGMA * COLOR_SIGMA) - 0.5 * distance).exp();
                for (support, corner) in support.iter_mut().zip(corners) {
                    *support += if continues(seen, *corner) { weight } else { 0.0 };
                }
            }
        }
        let mut best = nearest;
        for (corner, value) in support.iter().enumerate() {
            if *value > support[best] {
                best = corner;
            }
        }
        corners[best]
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::{Intrinsics, Pose};

    const SIZE: usize = 64;

    fn camera() -> Camera {
        let side = SIZE as u32;
        let intrinsics =
            Intrinsics { width: side, height: side, fx: 70.0, fy: 70.0, skew: 0.0, cx: 31.0, cy: 33.0 };
        Camera { intrinsics, pose: Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() } }
    }

    /// Inverse depth of a slanted plane, and a nearer disc of another colour before it.
    fn truth(x: f64, y: f64) -> (f64, bool) {
        let on_disc = (x - 30.0).powi(2) + (y - 28.0).powi(2) < 15.0_f64.powi(2);
        (if on_disc { 0.5 } else { 0.25 + 0.0005 * x - 0.0003 * y }, on_disc)
    }

    /// The photograph, and its exact map at a quarter of its size.
    fn scene(contrast: u8) -> (WorkingImage, DepthMap) {
        let color = |x: usize, y: usize| {
            let noise = (x * 7 + y * 13) as u8 % 10;
            let disc = if truth(x as f64, y as f64).1 { contrast } else { 0 };
            [90 + noise + disc, 120 + noise - disc / 2, 100 + noise]
        };
        let image = WorkingImage { camera: camera(), pixels: Raster::from_fn(SIZE, SIZE, color) };
        let k = image.camera.intrinsics.quartered();
        let (width, height) = (k.width as usize, k.height as usize);
        let depth =
            Raster::from_fn(width, height, |x, y| (1.0 / truth(4.0 * x as f64, 4.0 * y as f64).0) as f32);
        let colors = image.map_colors(width, height);
        let camera = Camera { intrinsics: k, ..image.camera };
        let map =
            DepthMap::new(camera, depth, Raster::filled(width, height, 0.9), colors).expect("sizes agree");
        (image, map)
    }

    #[test]
    fn surfaces_are_exact_and_edges_follow_the_photograph() {
        let (image, map) = scene(80);
        let full = map.upsampled(&image);
        assert_eq!((full.camera, full.width()), (image.camera, SIZE));
        let (mut flying, mut wrong) = (0, 0);
        for y in 0..58 {
            for x in 0..58 {
                let (inverse, on_disc) = truth(x as f64, y as f64);
                let error = (f64::from(full.depth.at(x, y)) * inverse - 1.0).abs();
                wrong += usize::from(error > 0.02);
                let depth = f64::from(full.depth.at(x, y));
                let other = if on_disc { 1.0 / (0.25 + 0.0005 * x as f64 - 0.0003 * y as f64) } else { 2.0 };
                flying += usize::from(error > 0.02 && (depth / other - 1.0).abs() > 0.02);
                let edge = ((x as f64 - 30.0).hypot(y as f64 - 28.0) - 15.0).abs();
                assert!(edge < 8.0 || error < 1e-4, "{error} at {x}, {y}");
            }
        }
        assert_eq!(flying, 0, "no depth lies between the surfaces");
        // The edge has 94 pixels; a quarter of the resolution is off by two on average.
        assert!(wrong < 30, "{wrong}");
    }

    #[test]
    fn without_contrast_edges_stay_sharp_and_holes_stay() {
        let (image, mut map) = scene(0);
        map.depth.values_mut()[16 * 7 + 3] = 0.0;
        let full = map.upsampled(&image);
        assert_eq!((full.depth.at(12, 28), full.confidence.at(12, 28)), (0.0, 0.0));
        for y in 0..58 {
            for x in 0..58 {
                let depth = f64::from(full.depth.at(x, y));
                let plane = 1.0 / (0.25 + 0.0005 * x as f64 - 0.0003 * y as f64);
                let on_one = (depth - 2.0).abs() < 0.01 || (depth / plane - 1.0).abs() < 0.02;
                assert!(depth == 0.0 || on_one, "{depth} at {x}, {y}");
            }
        }
        assert!((full.confidence.at(50, 50) - 0.9).abs() < 1e-6);
    }
}
