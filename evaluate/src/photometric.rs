//! How well a depth map explains a photograph that it was not made from.

use nalgebra::Point2;
use planesweep_scene::{Camera, DepthMap, Raster};
use rayon::prelude::*;
use serde::Serialize;

use crate::statistics::{mean, median};

/// Differences of colour between a view and the held-out one, at the pixels whose points the latter shows.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct PhotometricErrors {
    /// Pixels with a depth whose point lies in the held-out image.
    pub pixels: u64,
    /// The errors of the most confident of them, from few to all; empty when there are none.
    pub curve: Vec<PhotometricPoint>,
}

/// The errors of the most confident pixels, in grey levels of 255.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct PhotometricPoint {
    /// Their share of the pixels.
    pub kept: f64,
    /// Median over pixels of the mean absolute difference of the three channels.
    pub median: f64,
    /// Mean of the same.
    pub mean: f64,
}

/// Compares the colours of a depth map with those of a photograph that was no source of it, read
/// bilinearly where the depths say.
///
/// Both sets of colours are of about the same resolution. What hides a point from the held-out camera
/// is not known, so a part of the error is no fault of the depths: compare it between depth maps of the
/// same view. Equal confidences are taken in pixel order.
pub fn photometric_error(
    map: &DepthMap,
    held_out: &Camera,
    held_out_colors: &Raster<[u8; 3]>,
    curve_points: usize,
) -> PhotometricErrors {
    let rows: Vec<Vec<(f32, f64)>> = (0..map.height())
        .into_par_iter()
        .map(|y| {
            (0..map.width())
                .filter_map(|x| {
                    let depth = map.depth.at(x, y);
                    if depth <= 0.0 {
                        return None;
                    }
                    let point = map.camera.unproject(&Point2::new(x as f64, y as f64), f64::from(depth));
                    let (pixel, _) = held_out.project(&point)?;
                    let there = bilinear(held_out_colors, pixel)?;
                    let here = map.rgb(x, y);
                    let difference: f64 =
                        here.iter().zip(there).map(|(a, b)| (f64::from(*a) - b).abs()).sum();
                    Some((map.confidence.at(x, y), difference / 3.0))
                })
                .collect()
        })
        .collect();
    let mut errors = rows.concat();
    errors.sort_by(|a, b| b.0.total_cmp(&a.0)); // stable: ties in pixel order
    let curve = (1..=curve_points).filter_map(|point| {
        let kept = &errors[..(errors.len() * point).div_ceil(curve_points)];
        let mut values: Vec<f64> = kept.iter().map(|(_, error)| *error).collect();
        let kept = kept.len() as f64 / errors.len() as f64;
        Some(PhotometricPoint { kept, mean: mean(&values)?, median: median(&mut values)? })
    });
    PhotometricErrors { pixels: errors.len() as u64, curve: curve.collect() }
}

/// The colour at a position; `None` outside the outermost pixel centres.
fn bilinear(colors: &Raster<[u8; 3]>, pixel: Point2<f64>) -> Option<[f64; 3]> {
    let (width, height) = (colors.width() as f64, colors.height() as f64);
    let is_inside = pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= width - 1.0 && pixel.y <= height - 1.0;
    if !is_inside {
        return None;
    }
    let (x, y) = (pixel.x as usize, pixel.y as usize);
    let (right, below) = ((x + 1).min(colors.width() - 1), (y + 1).min(colors.height() - 1));
    let (fx, fy) = (pixel.x - x as f64, pixel.y - y as f64);
    let corners = [colors.at(x, y), colors.at(right, y), colors.at(x, below), colors.at(right, below)];
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    Some(std::array::from_fn(|channel| {
        corners.iter().zip(weights).map(|(corner, weight)| f64::from(corner[channel]) * weight).sum()
    }))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use planesweep_scene::{Intrinsics, Pose};

    use super::*;

    /// Colours that change by 20 grey levels a pixel along x.
    fn ramp(offset: f64) -> Raster<[u8; 3]> {
        Raster::from_fn(9, 3, |x, _| [(20.0 * (x as f64 + offset)) as u8; 3])
    }

    fn camera(x: f64) -> Camera {
        let intrinsics = Intrinsics { width: 9, height: 3, fx: 8.0, fy: 8.0, skew: 0.0, cx: 4.0, cy: 1.0 };
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::new(-x, 0.0, 0.0) };
        Camera { intrinsics, pose }
    }

    fn map(depth: impl Fn(usize) -> f32, confidence: impl Fn(usize) -> f32) -> DepthMap {
        let raster = |value: &dyn Fn(usize) -> f32| Raster::from_fn(9, 3, |x, _| value(x));
        DepthMap::new(camera(0.0), raster(&depth), raster(&confidence), ramp(0.0)).expect("one size")
    }

    #[test]
    fn true_depth_explains_the_other_photograph() {
        // At depth 4 the other camera, 1 to the right, sees everything 2 pixels further left.
        let errors = photometric_error(&map(|_| 4.0, |_| 0.9), &camera(1.0), &ramp(2.0), 4);
        assert_eq!((errors.pixels, errors.curve.len()), (21, 4));
        assert!(errors.curve[3].mean < 1e-9, "{errors:?}");
        // At half the depth it is 4 pixels: 2 too many.
        let wrong = photometric_error(&map(|_| 2.0, |_| 0.9), &camera(1.0), &ramp(2.0), 1);
        assert_eq!((wrong.pixels, wrong.curve[0].median), (15, 40.0));
    }

    #[test]
    fn the_most_confident_come_first_and_no_depth_counts_nowhere() {
        let depth = |x: usize| {
            if x == 8 {
                0.0
            } else if x > 5 {
                2.0
            } else {
                4.0
            }
        };
        let confidence = |x: usize| if x > 5 { 0.1 } else { 0.9 };
        let errors = photometric_error(&map(depth, confidence), &camera(1.0), &ramp(2.0), 3);
        assert_eq!(errors.pixels, 18);
        assert!(errors.curve[1].mean < 1e-9);
        assert!((errors.curve[2].mean - 40.0 / 3.0).abs() < 1e-9, "{errors:?}");
        let nothing = photometric_error(&map(|_| 0.0, |_| 0.0), &camera(1.0), &ramp(0.0), 3);
        assert_eq!(nothing, PhotometricErrors { pixels: 0, curve: vec![] });
    }
}
