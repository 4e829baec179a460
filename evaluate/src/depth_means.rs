//! The errors of several depth maps as one.

use serde::Serialize;

use crate::depth::{CurvePoint, DepthErrors, ErrorStatistics, ErrorSummary};
use crate::statistics::mean;

/// Means over depth maps, each weighing the same where it has pixels of the kind.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct DepthMeans {
    /// Depth maps.
    pub views: usize,
    /// Of all pixels.
    pub all: SummaryMeans,
    /// Of the confident ones, by threshold.
    pub confident: Vec<SummaryMeans>,
    /// Of the most confident ones, by their share.
    pub curve: Vec<CurvePoint>,
}

/// Means of [`ErrorSummary`] over depth maps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct SummaryMeans {
    /// The confidence that the pixels have at least.
    pub min_confidence: f32,
    /// Their share of the pixels that have a true depth.
    pub share: f64,
    /// Their errors; `None` when no map has such pixels.
    #[serde(flatten)]
    pub errors: Option<ErrorStatistics>,
}

impl DepthMeans {
    /// Over depth maps that were measured with the same options; `None` when there are none.
    pub fn of(maps: &[DepthErrors]) -> Option<Self> {
        let first = maps.first()?;
        let summary = |of: &dyn Fn(&DepthErrors) -> Option<ErrorSummary>| {
            let summaries: Vec<ErrorSummary> = maps.iter().filter_map(of).collect();
            let shares: Vec<f64> = summaries.iter().map(|s| s.coverage).collect();
            let errors: Vec<ErrorStatistics> = summaries.iter().filter_map(|s| s.errors).collect();
            Some(SummaryMeans {
                min_confidence: summaries.first()?.min_confidence,
                share: mean(&shares)?,
                errors: ErrorStatistics::mean_of(&errors),
            })
        };
        let at = |place: usize| {
            let points: Vec<CurvePoint> = maps.iter().filter_map(|m| m.curve.get(place).copied()).collect();
            let kept: Vec<f64> = points.iter().map(|p| p.kept).collect();
            let errors: Vec<ErrorStatistics> = points.iter().map(|p| p.errors).collect();
            Some(CurvePoint {
                kept: mean(&kept)?,
                min_confidence: points.iter().map(|p| p.min_confidence).fold(f32::INFINITY, f32::min),
                errors: ErrorStatistics::mean_of(&errors)?,
            })
        };
        let longest = maps.iter().map(|map| map.curve.len()).max().unwrap_or(0);
        Some(Self {
            views: maps.len(),
            all: summary(&|map| Some(map.all))?,
            confident: (0..first.confident.len())
                .filter_map(|place| summary(&|map| map.confident.get(place).copied()))
                .collect(),
            curve: (0..longest).filter_map(at).collect(),
        })
    }
}

impl ErrorStatistics {
    /// The mean of each figure; those in intervals only where all have them. `None` of nothing.
    fn mean_of(all: &[Self]) -> Option<Self> {
        let of = |figure: fn(&Self) -> f64| mean(&all.iter().map(figure).collect::<Vec<_>>());
        let optional =
            |figure: fn(&Self) -> Option<f64>| mean(&all.iter().map(figure).collect::<Option<Vec<_>>>()?);
        Some(Self {
            median_absolute: of(|e| e.median_absolute)?,
            mean_absolute: of(|e| e.mean_absolute)?,
            median_relative: of(|e| e.median_relative)?,
            mean_relative: of(|e| e.mean_relative)?,
            within_1_percent: of(|e| e.within_1_percent)?,
            within_2_percent: of(|e| e.within_2_percent)?,
            within_5_percent: of(|e| e.within_5_percent)?,
            within_1_interval: optional(|e| e.within_1_interval),
            within_3_intervals: optional(|e| e.within_3_intervals),
        })
    }
}

#[cfg(test)]
mod tests {
    use planesweep_scene::Raster;

    use super::*;
    use crate::depth::{DepthErrorOptions, depth_error};

    #[test]
    fn maps_weigh_the_same_whatever_their_size() {
        let measure = |estimate: &[f32], confidence: f32| {
            let row = |values: &[f32]| Raster::new(values.len(), 1, values.to_vec()).expect("one row");
            let flat = |value: f32| row(&vec![value; estimate.len()]);
            let options = DepthErrorOptions { curve_points: 2, ..DepthErrorOptions::default() };
            depth_error(&row(estimate), &flat(confidence), &flat(4.0), &options).expect("one size")
        };
        let maps = [measure(&[4.0, 4.0, 4.0, 4.0, 4.0, 4.0], 0.9), measure(&[5.0, 5.0], 0.1)];
        let means = DepthMeans::of(&maps).expect("two maps");
        assert_eq!((means.views, means.all.share), (2, 1.0));
        assert_eq!(means.all.errors.expect("pixels").median_relative, 0.125);
        // Only the first is confident: its errors count, the share is over both.
        let confident = means.confident[0];
        assert_eq!((confident.share, confident.errors.expect("pixels").median_relative), (0.5, 0.0));
        assert_eq!(means.curve.len(), 2);
        assert_eq!((means.curve[0].kept, means.curve[0].errors.mean_relative), (0.5, 0.125));
        assert_eq!(means.curve[0].errors.within_1_interval, None);
        assert_eq!(DepthMeans::of(&[]), None);
    }
}
