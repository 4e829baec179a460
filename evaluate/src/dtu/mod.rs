//! The distances of the DTU data set (Aanæs et al. 2016): accuracy and completeness in mm, and the
//! percentages of MVSNet's table 1.
//!
//! The cloud is thinned ([`thin`]), both clouds are compared, what the scanner could not see
//! ([`ObservabilityMask`]) and what is not above the table ([`TablePlane`]) is left out ([`compare`]).

mod mat;
mod thin;

use std::io;
use std::path::PathBuf;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use mat::{ObservabilityMask, TablePlane};
pub use thin::thin;

use crate::nearest::NearestPoints;
use crate::statistics::{harmonic_mean, mean, median, share_below};

/// Why the ground truth could not be used.
#[derive(Debug, Error)]
pub enum DtuError {
    /// A file cannot be opened.
    #[error("cannot open {}", path.display())]
    Open {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// A file is no MATLAB file of version 5.
    #[error("cannot read {} as a MATLAB file", path.display())]
    Mat {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: matfile::Error,
    },
    /// A variable is missing or not what it should be.
    #[error("cannot use {}: variable {variable} is missing or has another form", path.display())]
    Variable {
        /// The file.
        path: PathBuf,
        /// The variable.
        variable: &'static str,
    },
}

/// Spacing of the ground truth, and of the cloud after thinning, in mm.
pub const SPACING_MM: f64 = 0.2;
/// Distances from here on are taken for outliers, in mm.
const OUTLIER_MM: f64 = 20.0;
/// Side of the blocks in which the data set's own program compares, in mm; what lies in none is left out.
const BLOCK_MM: f64 = 60.0;
/// Thresholds of the percentages, in mm.
const PERCENTAGES_MM: [f64; 2] = [1.0, 2.0];

/// The figures of a scan.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DtuScores {
    /// From the cloud to the ground truth.
    pub accuracy: DistanceStatistics,
    /// From the ground truth to the cloud.
    pub completeness: DistanceStatistics,
    /// The mean of both means, in mm.
    pub overall: f64,
    /// The shares nearer than 1 mm and 2 mm.
    pub percentages: Vec<Percentage>,
}

/// Distances of the points of one cloud to the other, in mm; 0 where no point counts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DistanceStatistics {
    /// Points that count: observable, or above the table.
    pub points: usize,
    /// Those of them that are no outliers, from which the other figures are.
    pub kept: usize,
    /// Mean.
    pub mean: f64,
    /// Median.
    pub median: f64,
    /// Variance (of the population).
    pub variance: f64,
}

/// The percentage metric at one threshold; shares from 0 to 1 of the points that count, outliers included.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Percentage {
    /// In mm.
    pub threshold: f64,
    /// Share of the cloud's points that are nearer to the ground truth.
    pub accuracy: f64,
    /// Share of the ground truth's points that are nearer to the cloud.
    pub completeness: f64,
    /// Their harmonic mean; 0 when both are 0.
    pub f_score: f64,
}

/// How good a cloud is, and the points and distances that say so.
#[derive(Clone, Debug)]
pub struct DtuEvaluation {
    /// The figures.
    pub scores: DtuScores,
    /// The points of the cloud that count, each with its distance in mm.
    pub cloud: Vec<(Point3<f64>, f64)>,
    /// The points of the ground truth that count, each with its distance in mm.
    pub truth: Vec<(Point3<f64>, f64)>,
}

/// Compares a thinned cloud with the ground truth, both in mm.
///
/// All of the cloud may complete the ground truth, also what the mask leaves out. Points that are not
/// finite count nowhere. Where either cloud is empty, every distance is that of an outlier.
pub fn compare(
    cloud: &[Point3<f64>],
    truth: &[Point3<f64>],
    mask: &ObservabilityMask,
    table: &TablePlane,
) -> DtuEvaluation {
    let finite = |points: &[Point3<f64>]| -> Vec<Point3<f64>> {
        points.iter().filter(|p| p.iter().all(|v| v.is_finite())).copied().collect()
    };
    let (cloud, truth) = (finite(cloud), finite(truth));
    let counts = |points: &[Point3<f64>], does_count: &dyn Fn(&Point3<f64>) -> bool| -> Vec<Point3<f64>> {
        points.iter().filter(|p| mask.is_in_blocks(p, BLOCK_MM) && does_count(p)).copied().collect()
    };
    let judged = counts(&cloud, &|point| mask.contains(point));
    let wanted = counts(&truth, &|point| table.is_above(point));
    let distances = |from: &[Point3<f64>], to: &[Point3<f64>]| match NearestPoints::new(to) {
        Some(tree) => tree.distances(from),
        None => vec![f64::INFINITY; from.len()],
    };
    let (to_truth, to_cloud) = (distances(&judged, &truth), distances(&wanted, &cloud));
    let (accuracy, completeness) = (DistanceStatistics::of(&to_truth), DistanceStatistics::of(&to_cloud));
    let percentages = PERCENTAGES_MM.map(|threshold| {
        let (accuracy, completeness) = (share_below(&to_truth, threshold), share_below(&to_cloud, threshold));
        Percentage { threshold, accuracy, completeness, f_score: harmonic_mean(accuracy, completeness) }
    });
    let overall = f64::midpoint(accuracy.mean, completeness.mean);
    let scores = DtuScores { accuracy, completeness, overall, percentages: percentages.to_vec() };
    let (cloud, truth) =
        (judged.into_iter().zip(to_truth).collect(), wanted.into_iter().zip(to_cloud).collect());
    DtuEvaluation { scores, cloud, truth }
}

impl DistanceStatistics {
    fn of(distances: &[f64]) -> Self {
        let mut kept: Vec<f64> = distances.iter().copied().filter(|d| *d < OUTLIER_MM).collect();
        let average = mean(&kept).unwrap_or(0.0);
        let squared: Vec<f64> = kept.iter().map(|d| (d - average).powi(2)).collect();
        Self {
            points: distances.len(),
            kept: kept.len(),
            mean: average,
            median: median(&mut kept).unwrap_or(0.0),
            variance: mean(&squared).unwrap_or(0.0),
        }
    }
}

/// The scans that the benchmark's figures are means of.
pub const TEST_SCANS: [u32; 22] =
    [1, 4, 9, 10, 11, 12, 13, 15, 23, 24, 29, 32, 33, 34, 48, 49, 62, 75, 77, 110, 114, 118];
/// The scans that networks are chosen with.
pub const VALIDATION_SCANS: [u32; 18] =
    [3, 5, 17, 21, 28, 35, 37, 38, 40, 43, 56, 59, 66, 67, 82, 86, 106, 117];

/// The means over scans, each scan weighing the same; `None` when there are none.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DtuMeans {
    /// Scans.
    pub scans: usize,
    /// Mean of the mean distances from the clouds, in mm.
    pub accuracy: f64,
    /// Mean of the mean distances to the clouds, in mm.
    pub completeness: f64,
    /// Their mean, in mm.
    pub overall: f64,
    /// Means of the percentages.
    pub percentages: Vec<Percentage>,
}

impl DtuMeans {
    /// Over the given scans.
    pub fn of<'a>(scans: impl IntoIterator<Item = &'a DtuScores>) -> Option<Self> {
        let scans: Vec<&DtuScores> = scans.into_iter().collect();
        let mean_of = |of: &dyn Fn(&DtuScores) -> f64| mean(&scans.iter().map(|s| of(s)).collect::<Vec<_>>());
        let percentage = |at: usize| {
            Some(Percentage {
                threshold: PERCENTAGES_MM[at],
                accuracy: mean_of(&|s| s.percentages.get(at).map_or(0.0, |p| p.accuracy))?,
                completeness: mean_of(&|s| s.percentages.get(at).map_or(0.0, |p| p.completeness))?,
                f_score: mean_of(&|s| s.percentages.get(at).map_or(0.0, |p| p.f_score))?,
            })
        };
        Some(Self {
            scans: scans.len(),
            accuracy: mean_of(&|s| s.accuracy.mean)?,
            completeness: mean_of(&|s| s.completeness.mean)?,
            overall: mean_of(&|s| s.overall)?,
            percentages: (0..PERCENTAGES_MM.len()).map(percentage).collect::<Option<_>>()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outliers_are_dropped_from_distances_but_not_from_percentages() {
        let distances = [0.5, 1.5, 4.0, 19.9, 20.0, 300.0];
        let statistics = DistanceStatistics::of(&distances);
        assert_eq!((statistics.points, statistics.kept), (6, 4));
        assert!((statistics.mean - 25.9 / 4.0).abs() < 1e-12);
        assert!((statistics.median - 2.75).abs() < 1e-12);
        assert_eq!((share_below(&distances, 1.0), share_below(&distances, 2.0)), (1.0 / 6.0, 2.0 / 6.0));
        let none = DistanceStatistics::of(&[]);
        assert_eq!((none.points, none.mean, none.variance), (0, 0.0, 0.0));
    }

    #[test]
    fn scans_weigh_the_same() {
        let scores = |accuracy: f64, completeness: f64| {
            let statistics =
                |mean| DistanceStatistics { points: 9, kept: 9, mean, median: mean, variance: 0.0 };
            let percentages = PERCENTAGES_MM.map(|threshold| Percentage {
                threshold,
                accuracy: 0.5,
                completeness: 1.0,
                f_score: 2.0 / 3.0,
            });
            DtuScores {
                accuracy: statistics(accuracy),
                completeness: statistics(completeness),
                overall: f64::midpoint(accuracy, completeness),
                percentages: percentages.to_vec(),
            }
        };
        let means = DtuMeans::of(&[scores(0.25, 0.5), scores(0.75, 1.0)]).expect("two scans");
        assert_eq!((means.accuracy, means.completeness, means.overall), (0.5, 0.75, 0.625));
        assert_eq!(means.percentages[1].threshold, 2.0);
        assert_eq!(DtuMeans::of(&[]), None);
    }
}
