//! How far a depth map is from the truth.

use nalgebra::Vector3;
use planesweep_scene::{DepthHypotheses, Intrinsics, Raster};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::statistics::{mean, median};

/// Why depths cannot be compared.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum DepthError {
    /// Two rasters are not of one size.
    #[error(
        "cannot compare depths: {part} is {width}x{height}, the estimate {estimate_width}x{estimate_height}"
    )]
    SizeMismatch {
        /// "truth" or "confidence".
        part: &'static str,
        /// Columns of that part.
        width: usize,
        /// Rows of that part.
        height: usize,
        /// Columns of the estimate.
        estimate_width: usize,
        /// Rows of the estimate.
        estimate_height: usize,
    },
    /// An intrinsic matrix has no inverse.
    #[error("cannot find the estimate's pixels in the truth: the estimate's camera has no inverse")]
    Camera,
}

/// What to report besides the errors of all pixels.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthErrorOptions {
    /// The errors are also given for pixels of at least these confidences.
    pub min_confidences: Vec<f32>,
    /// The hypotheses that the estimate came from; their interval is a unit of the error.
    pub hypotheses: Option<DepthHypotheses>,
    /// Points of the curve of error against kept share.
    pub curve_points: usize,
}

impl Default for DepthErrorOptions {
    fn default() -> Self {
        Self { min_confidences: vec![0.8], hypotheses: None, curve_points: 20 }
    }
}

/// The errors of a depth map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthErrors {
    /// Pixels of the estimate that have a true depth.
    pub truth_pixels: u64,
    /// The errors of all pixels that have both depths.
    pub all: ErrorSummary,
    /// The errors of the confident ones, by [`DepthErrorOptions::min_confidences`].
    pub confident: Vec<ErrorSummary>,
    /// What is kept against its error, from the most confident pixels to all; empty when no pixel has
    /// both depths.
    pub curve: Vec<CurvePoint>,
}

/// The errors of the pixels of some confidence.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorSummary {
    /// The confidence they have at least.
    pub min_confidence: f32,
    /// Their number.
    pub pixels: u64,
    /// Their share of the pixels that have a true depth; 0 when there are none.
    pub coverage: f64,
    /// Their errors; `None` when there are none.
    pub errors: Option<ErrorStatistics>,
}

/// Statistics of `|estimate - truth|` over some pixels, at least one.
///
/// The median of an even number of values is the mean of the two in the middle. "Within" includes
/// the bound. Relative errors are fractions of the truth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ErrorStatistics {
    /// Median of the absolute errors, in scene units.
    pub median_absolute: f64,
    /// Mean of the absolute errors, in scene units.
    pub mean_absolute: f64,
    /// Median of the relative errors.
    pub median_relative: f64,
    /// Mean of the relative errors.
    pub mean_relative: f64,
    /// Share with a relative error within 0.01.
    pub within_1_percent: f64,
    /// Share with a relative error within 0.02.
    pub within_2_percent: f64,
    /// Share with a relative error within 0.05.
    pub within_5_percent: f64,
    /// Share within one interval of the hypotheses, of inverse depth when they are sampled so; `None`
    /// when they were not given.
    pub within_1_interval: Option<f64>,
    /// Share within three intervals.
    pub within_3_intervals: Option<f64>,
}

/// The errors of the most confident pixels.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CurvePoint {
    /// Their share of the pixels that have both depths.
    pub kept: f64,
    /// The least confidence among them.
    pub min_confidence: f32,
    /// Their errors.
    #[serde(flatten)]
    pub errors: ErrorStatistics,
}

/// Compares a depth map with the truth at each of its pixels; all three rasters are of one size (see
/// [`truth_at_estimate`] otherwise).
///
/// A depth counts where it is finite and positive; pixels without a true depth play no part. A
/// confidence that is NaN counts as 0. Along the curve, equal confidences are taken in pixel order.
pub fn depth_error(
    estimate: &Raster<f32>,
    confidence: &Raster<f32>,
    truth: &Raster<f32>,
    options: &DepthErrorOptions,
) -> Result<DepthErrors, DepthError> {
    check_size("confidence", confidence, estimate)?;
    check_size("truth", truth, estimate)?;
    let truth_pixels = truth.values().iter().filter(|d| is_depth(**d)).count() as u64;
    let mut pixels: Vec<PixelError> = estimate
        .values()
        .iter()
        .zip(confidence.values())
        .zip(truth.values())
        .filter(|((estimate, _), truth)| is_depth(**estimate) && is_depth(**truth))
        .map(|((estimate, confidence), truth)| {
            PixelError::new(*estimate, *confidence, *truth, options.hypotheses.as_ref())
        })
        .collect();
    pixels.par_sort_by(|a, b| b.confidence.total_cmp(&a.confidence)); // stable: ties in pixel order
    let summary = |min_confidence: f32| {
        let kept = &pixels[..pixels.partition_point(|p| p.confidence >= min_confidence)];
        let coverage = if truth_pixels > 0 { kept.len() as f64 / truth_pixels as f64 } else { 0.0 };
        ErrorSummary {
            min_confidence,
            pixels: kept.len() as u64,
            coverage,
            errors: ErrorStatistics::of(kept, options.hypotheses.is_some()),
        }
    };
    Ok(DepthErrors {
        truth_pixels,
        all: ErrorSummary { min_confidence: 0.0, ..summary(f32::NEG_INFINITY) },
        confident: options.min_confidences.iter().map(|c| summary(*c)).collect(),
        curve: curve(&pixels, options.curve_points, options.hypotheses.is_some()),
    })
}

/// The true depths at the pixels of an estimate whose map has another size: pixel `x` of the estimate
/// is pixel `K_truth K_estimate^-1 x` of the truth, rounded to the nearest; 0 where that is outside.
///
/// Both cameras stand at the same place. With the camera of a network's map, a quarter of its image,
/// pixel `u` falls on pixel `4u` of a truth of the image's size.
pub fn truth_at_estimate(
    truth: &Raster<f32>,
    truth_camera: &Intrinsics,
    estimate_camera: &Intrinsics,
) -> Result<Raster<f32>, DepthError> {
    let inverse = estimate_camera.matrix().try_inverse().ok_or(DepthError::Camera)?;
    let map = truth_camera.matrix() * inverse;
    let (width, height) = (estimate_camera.width as usize, estimate_camera.height as usize);
    Ok(Raster::from_fn(width, height, |x, y| {
        let pixel = map * Vector3::new(x as f64, y as f64, 1.0);
        let (column, row) = (pixel.x.round(), pixel.y.round());
        if column >= 0.0 && row >= 0.0 {
            truth.get(column as usize, row as usize).unwrap_or(0.0)
        } else {
            0.0
        }
    }))
}

fn is_depth(depth: f32) -> bool {
    depth.is_finite() && depth > 0.0
}

fn check_size(part: &'static str, raster: &Raster<f32>, estimate: &Raster<f32>) -> Result<(), DepthError> {
    let (width, height) = (raster.width(), raster.height());
    let (estimate_width, estimate_height) = (estimate.width(), estimate.height());
    if (width, height) == (estimate_width, estimate_height) {
        Ok(())
    } else {
        Err(DepthError::SizeMismatch { part, width, height, estimate_width, estimate_height })
    }
}

/// The error of one pixel that has both depths.
struct PixelError {
    confidence: f32,
    absolute: f64,
    relative: f64,
    /// In intervals of the hypotheses; 0 when they are unknown.
    intervals: f64,
}

impl PixelError {
    fn new(estimate: f32, confidence: f32, truth: f32, hypotheses: Option<&DepthHypotheses>) -> Self {
        let (estimate, truth) = (estimate as f64, truth as f64);
        let absolute = (estimate - truth).abs();
        Self {
            confidence: if confidence.is_nan() { 0.0 } else { confidence },
            absolute,
            relative: absolute / truth,
            intervals: hypotheses.map_or(0.0, |h| (h.index_of(estimate) - h.index_of(truth)).abs()),
        }
    }
}

impl ErrorStatistics {
    fn of(pixels: &[PixelError], with_intervals: bool) -> Option<Self> {
        let share = |holds: &dyn Fn(&PixelError) -> bool| {
            pixels.iter().filter(|p| holds(p)).count() as f64 / pixels.len() as f64
        };
        let mut absolute: Vec<f64> = pixels.iter().map(|p| p.absolute).collect();
        let mut relative: Vec<f64> = pixels.iter().map(|p| p.relative).collect();
        Some(Self {
            mean_absolute: mean(&absolute)?,
            median_absolute: median(&mut absolute)?,
            mean_relative: mean(&relative)?,
            median_relative: median(&mut relative)?,
            within_1_percent: share(&|p| p.relative <= 0.01),
            within_2_percent: share(&|p| p.relative <= 0.02),
            within_5_percent: share(&|p| p.relative <= 0.05),
            within_1_interval: with_intervals.then(|| share(&|p| p.intervals <= 1.0)),
            within_3_intervals: with_intervals.then(|| share(&|p| p.intervals <= 3.0)),
        })
    }
}

/// `points` shares in equal steps up to 1 of `pixels`, which are sorted by falling confidence.
fn curve(pixels: &[PixelError], points: usize, with_intervals: bool) -> Vec<CurvePoint> {
    (1..=points)
        .into_par_iter()
        .filter_map(|point| {
            let kept = &pixels[..(pixels.len() * point).div_ceil(points)];
            Some(CurvePoint {
                kept: kept.len() as f64 / pixels.len() as f64,
                min_confidence: kept.last()?.confidence,
                errors: ErrorStatistics::of(kept, with_intervals)?,
            })
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use planesweep_scene::Sampling;
    use proptest::prelude::*;

    use super::*;

    fn row(values: &[f32]) -> Raster<f32> {
        Raster::new(values.len(), 1, values.to_vec()).expect("one row")
    }

    #[test]
    fn hand_numbers() {
        let truth = row(&[2.0, 2.0, 4.0, 4.0, 0.0, 10.0, f32::NAN]);
        let estimate = row(&[2.0, 2.5, 4.125, 4.0625, 7.0, 0.0, 3.0]);
        let confidence = row(&[0.9, 0.1, 0.8, 0.95, 1.0, 1.0, 1.0]);
        // Planes 0.25 apart.
        let hypotheses = DepthHypotheses::new(Sampling::Uniform, 1.0, 5.0, 17).expect("a valid range");
        let options = DepthErrorOptions {
            min_confidences: vec![0.8, 0.99],
            hypotheses: Some(hypotheses),
            curve_points: 2,
        };
        let errors = depth_error(&estimate, &confidence, &truth, &options).expect("sizes agree");
        assert_eq!(errors.truth_pixels, 5);
        // Absolute 0, 0.5, 0.125, 0.0625; relative 0, 0.25, 0.03125, 0.015625; intervals 0, 2, .5, .25.
        let all = ErrorStatistics {
            median_absolute: 0.09375,
            mean_absolute: 0.171875,
            median_relative: 0.0234375,
            mean_relative: 0.07421875,
            within_1_percent: 0.25,
            within_2_percent: 0.5,
            within_5_percent: 0.75,
            within_1_interval: Some(0.75),
            within_3_intervals: Some(1.0),
        };
        let summary = ErrorSummary { min_confidence: 0.0, pixels: 4, coverage: 0.8, errors: Some(all) };
        assert_eq!(errors.all, summary);
        let confident = errors.confident[0];
        assert_eq!((confident.min_confidence, confident.pixels, confident.coverage), (0.8, 3, 0.6));
        assert_eq!(confident.errors.expect("three pixels").median_relative, 0.015625);
        let none = ErrorSummary { min_confidence: 0.99, pixels: 0, coverage: 0.0, errors: None };
        assert_eq!(errors.confident[1], none);
        let [half, whole] = errors.curve[..] else { panic!("two points, not {:?}", errors.curve) };
        assert_eq!((half.kept, half.min_confidence), (0.5, 0.9));
        assert_eq!((half.errors.median_relative, half.errors.within_1_percent), (0.0078125, 0.5));
        assert_eq!((whole.kept, whole.min_confidence, whole.errors), (1.0, 0.1, all));
    }

    #[test]
    fn intervals_of_inverse_sampling_are_of_inverse_depth() {
        // Planes at 1/depth = 1, 0.75, 0.5, 0.25.
        let hypotheses = DepthHypotheses::new(Sampling::Inverse, 1.0, 4.0, 4).expect("a valid range");
        let options = DepthErrorOptions { hypotheses: Some(hypotheses), ..DepthErrorOptions::default() };
        let estimate = row(&[1.3, 3.9]);
        let errors = depth_error(&estimate, &row(&[1.0; 2]), &row(&[1.0, 2.1]), &options);
        // 1/1 - 1/1.3 = 0.23, within; 1/2.1 - 1/3.9 = 0.22, within, though 1.8 in depth.
        let statistics = errors.expect("sizes agree").all.errors.expect("two pixels");
        assert_eq!(statistics.within_1_interval, Some(1.0));
    }

    #[test]
    fn no_truth_and_other_sizes() {
        let options = DepthErrorOptions::default();
        let errors = depth_error(&row(&[1.0]), &row(&[1.0]), &row(&[0.0]), &options).expect("one size");
        let none = ErrorSummary { min_confidence: 0.0, pixels: 0, coverage: 0.0, errors: None };
        assert_eq!((errors.truth_pixels, errors.all, errors.curve), (0, none, vec![]));
        let error = depth_error(&row(&[1.0]), &row(&[1.0]), &row(&[1.0; 2]), &options);
        assert_eq!(
            error.expect_err("truth is wider").to_string(),
            "cannot compare depths: truth is 2x1, the estimate 1x1"
        );
    }

    #[test]
    fn a_quarter_size_map_reads_every_fourth_true_pixel() {
        let image = Intrinsics { width: 18, height: 13, fx: 20.0, fy: 21.0, skew: 0.5, cx: 8.3, cy: 6.1 };
        let truth = Raster::from_fn(18, 13, |x, y| (100 * y + x) as f32);
        let sampled = truth_at_estimate(&truth, &image, &image.quartered()).expect("invertible");
        assert_eq!((sampled.width(), sampled.height()), (5, 4));
        for y in 0..4 {
            for x in 0..5 {
                assert_eq!(sampled.at(x, y), truth.at(4 * x, 4 * y));
            }
        }
        let same = truth_at_estimate(&truth, &image, &image).expect("invertible");
        assert_eq!(same, truth);
        let shifted = Intrinsics { cx: image.cx + 2.0, ..image };
        let outside = truth_at_estimate(&truth, &image, &shifted).expect("invertible");
        assert_eq!((outside.at(1, 0), outside.at(2, 0)), (0.0, truth.at(0, 0)));
        let flat = Intrinsics { fx: 0.0, ..image };
        assert_eq!(truth_at_estimate(&truth, &image, &flat), Err(DepthError::Camera));
    }

    proptest! {
        #[test]
        fn reports_hold_together(
            pixels in prop::collection::vec((-0.5..9.0_f32, -0.5..9.0_f32, 0.0..1.0_f32), 1..200),
            scale in 0.1..10.0_f32,
        ) {
            let column = |f: &dyn Fn(&(f32, f32, f32)) -> f32| row(&pixels.iter().map(f).collect::<Vec<_>>());
            let (estimate, truth, confidence) = (column(&|p| p.0), column(&|p| p.1), column(&|p| p.2));
            let options = DepthErrorOptions { min_confidences: vec![0.0, 0.5, 0.8], ..DepthErrorOptions::default() };
            let report = depth_error(&estimate, &confidence, &truth, &options).expect("one size");
            prop_assert_eq!(report.confident[0], report.all);
            prop_assert!(report.confident.windows(2).all(|w| w[0].pixels >= w[1].pixels));
            prop_assert!(report.all.coverage <= 1.0);
            if let Some(errors) = report.all.errors {
                prop_assert!(errors.within_1_percent <= errors.within_2_percent);
                prop_assert!(errors.within_2_percent <= errors.within_5_percent);
                let last = report.curve.last().expect("a curve");
                prop_assert_eq!((last.kept, last.errors), (1.0, errors));
                prop_assert!(report.curve.windows(2).all(|w| w[0].kept <= w[1].kept));
                prop_assert!(report.curve.windows(2).all(|w| w[0].min_confidence >= w[1].min_confidence));
                // Relative errors do not depend on the unit of the scene.
                let scaled = depth_error(&estimate.map(|d| d * scale), &confidence, &truth.map(|d| d * scale), &options)
                    .expect("one size").all.errors.expect("as many pixels");
                prop_assert!((scaled.median_relative - errors.median_relative).abs() <= 1e-5 * (1.0 + errors.median_relative));
            } else {
                prop_assert!(report.curve.is_empty());
            }
        }
    }
}
