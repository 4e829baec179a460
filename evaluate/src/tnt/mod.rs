//! The metric of the Tanks and Temples benchmark (Knapitsch et al. 2017): precision, recall and F-score
//! of a cloud against a laser scan.
//!
//! In the order of the evaluation: the trajectory of the reconstruction is brought onto the reference's
//! ([`align_trajectories`]), the cloud is refined onto the scan in three rounds ([`align_cloud`]), both
//! are cut to the scene's volume ([`CropVolume`]), thinned to half the threshold and compared ([`score`]).

mod crop;
mod files;
mod icp;
mod ransac;

use nalgebra::{Matrix4, Point3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use crop::CropVolume;
pub use files::{parse_mapping, parse_trajectory, parse_transform};
pub use ransac::align_trajectories;

use crate::down_sample::{uniform_down_sample, voxel_down_sample};
use crate::nearest::NearestPoints;
pub use crate::similarity::Correspondence;
use crate::similarity::transformed;
use crate::statistics::{harmonic_mean, share_below};

/// Why a cloud could not be judged.
#[derive(Debug, Error)]
pub enum TntError {
    /// The crop file is not what Open3D writes.
    #[error("cannot understand the crop volume")]
    Crop(#[source] serde_json::Error),
    /// The crop volume has no inside.
    #[error("the crop volume's polygon has {corners} corners")]
    Polygon {
        /// Corners it has.
        corners: usize,
    },
    /// A word is not the number that belongs there.
    #[error("cannot understand {file}: number {place} is \"{got}\"")]
    Number {
        /// What the file holds.
        file: &'static str,
        /// Counted from 1.
        place: usize,
        /// What stands there.
        got: String,
    },
    /// A file goes on after its end.
    #[error("cannot understand {file}: \"{word}\" follows its last number")]
    Rest {
        /// What the file holds.
        file: &'static str,
        /// The first word too many.
        word: String,
    },
    /// The mapping points outside the video.
    #[error("the mapping names frame {frame} of {frames}")]
    Frame {
        /// Counted from 1.
        frame: usize,
        /// Frames of the video.
        frames: usize,
    },
    /// The cameras cannot be matched by their order.
    #[error(
        "the trajectory has {cameras} cameras, the reference {reference}; all images must be in it, in order"
    )]
    CameraCount {
        /// Cameras of the reconstruction.
        cameras: usize,
        /// Cameras of the reference.
        reference: usize,
    },
    /// No similarity brings the trajectories together.
    #[error("cannot align the trajectories of {cameras} cameras: too few of them agree")]
    Alignment {
        /// Correspondences.
        cameras: usize,
    },
}

/// More cameras than this are frames of a video, of which the reference has some.
const VIDEO_FRAMES: usize = 1600;
/// Points above which the last round of the refinement takes a part of the cloud.
const MAX_ICP_POINTS: usize = 4_000_000;
/// The curves end at this multiple of the threshold.
const CURVE_THRESHOLDS: usize = 5;
/// Points of a curve per threshold.
const CURVE_STEPS: usize = 100;

/// The threshold that the benchmark sets for a training scene, in metres; the name in any case.
pub fn threshold(scene: &str) -> Option<f64> {
    Some(match scene.to_ascii_lowercase().as_str() {
        "barn" | "meetingroom" => 0.01,
        "caterpillar" | "truck" => 0.005,
        "church" | "courthouse" => 0.025,
        "ignatius" => 0.003,
        _ => return None,
    })
}

/// Camera centres of a reconstruction, each with the same camera's in the frame of the scan.
///
/// `to_scan` brings the `reference` centres there. A trajectory of a whole video is cut down by the
/// `mapping`, if there is one; then both must be equally long.
pub fn matched_cameras(
    trajectory: &[Point3<f64>],
    reference: &[Point3<f64>],
    to_scan: &Matrix4<f64>,
    mapping: Option<&[usize]>,
) -> Result<Vec<Correspondence>, TntError> {
    let sampled: Vec<Point3<f64>> = match mapping {
        Some(mapping) if trajectory.len() > VIDEO_FRAMES => {
            mapping.iter().filter_map(|frame| trajectory.get(*frame)).copied().collect()
        }
        _ => trajectory.to_vec(),
    };
    if sampled.len() != reference.len() {
        return Err(TntError::CameraCount { cameras: sampled.len(), reference: reference.len() });
    }
    let pairs = sampled.into_iter().zip(transformed(reference, to_scan));
    Ok(pairs.map(|(from, to)| Correspondence { from, to }).collect())
}

/// The similarity that brings `cloud` onto `scan`, refined from `initial` in three rounds of ever finer
/// clouds and ever shorter reach; `threshold` in the units of the scan.
pub fn align_cloud(
    cloud: &[Point3<f64>],
    scan: &[Point3<f64>],
    initial: &Matrix4<f64>,
    volume: &CropVolume,
    threshold: f64,
) -> Matrix4<f64> {
    let scan = volume.crop(scan);
    let thinned = |points: Vec<Point3<f64>>, cell: Option<f64>| match cell {
        Some(cell) => voxel_down_sample(&points, cell),
        None => uniform_down_sample(points, MAX_ICP_POINTS),
    };
    let rounds = [(Some(threshold), 80.0), (Some(threshold / 2.0), 20.0), (None, 2.0)];
    rounds.into_iter().fold(*initial, |transform, (cell, reach)| {
        let source = thinned(volume.crop(&transformed(cloud, &transform)), cell);
        let target = thinned(scan.clone(), cell);
        icp::refine(&source, &target, reach * threshold) * transform
    })
}

/// How good a cloud is, and the points and distances that say so.
#[derive(Clone, Debug)]
pub struct TntEvaluation {
    /// The figures.
    pub scores: TntScores,
    /// Points of the cloud that were judged, in the frame of the scan, each with its distance to the scan.
    pub cloud: Vec<(Point3<f64>, f64)>,
    /// Points of the scan that were looked for, each with its distance to the cloud.
    pub scan: Vec<(Point3<f64>, f64)>,
}

/// The figures of a cloud; shares from 0 to 1.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TntScores {
    /// Distance within which a point counts, in the units of the scan.
    pub threshold: f64,
    /// Share of the cloud's points that are nearer to the scan.
    pub precision: f64,
    /// Share of the scan's points that are nearer to the cloud.
    pub recall: f64,
    /// Their harmonic mean; 0 when both are 0 or either has no points.
    pub f_score: f64,
    /// Points of the cloud after cutting and thinning.
    pub cloud_points: usize,
    /// Points of the scan after cutting and thinning.
    pub scan_points: usize,
    /// Precision and recall at other thresholds, rising.
    pub curve: Vec<TntCurvePoint>,
}

/// Precision and recall at one threshold.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TntCurvePoint {
    /// In the units of the scan.
    pub threshold: f64,
    /// As [`TntScores::precision`].
    pub precision: f64,
    /// As [`TntScores::recall`].
    pub recall: f64,
}

/// Compares a cloud, brought into the frame of the scan by `transform`, with it.
pub fn score(
    cloud: &[Point3<f64>],
    scan: &[Point3<f64>],
    transform: &Matrix4<f64>,
    volume: &CropVolume,
    threshold: f64,
) -> TntEvaluation {
    let cloud = voxel_down_sample(&volume.crop(&transformed(cloud, transform)), threshold / 2.0);
    let scan = voxel_down_sample(&volume.crop(scan), threshold / 2.0);
    let (Some(cloud_tree), Some(scan_tree)) = (NearestPoints::new(&cloud), NearestPoints::new(&scan)) else {
        let scores = TntScores {
            threshold,
            precision: 0.0,
            recall: 0.0,
            f_score: 0.0,
            cloud_points: cloud.len(),
            scan_points: scan.len(),
            curve: Vec::new(),
        };
        return TntEvaluation { scores, cloud: Vec::new(), scan: Vec::new() };
    };
    let (to_scan, to_cloud) = (scan_tree.distances(&cloud), cloud_tree.distances(&scan));
    let (precision, recall) = (share_below(&to_scan, threshold), share_below(&to_cloud, threshold));
    let step = threshold / CURVE_STEPS as f64;
    let precisions = cumulative(&to_scan, step);
    let recalls = cumulative(&to_cloud, step);
    let curve = precisions.into_iter().zip(recalls).enumerate().map(|(k, (precision, recall))| {
        TntCurvePoint { threshold: (k + 1) as f64 * step, precision, recall }
    });
    let scores = TntScores {
        threshold,
        precision,
        recall,
        f_score: harmonic_mean(precision, recall),
        cloud_points: cloud.len(),
        scan_points: scan.len(),
        curve: curve.collect(),
    };
    let (cloud, scan) = (cloud.into_iter().zip(to_scan).collect(), scan.into_iter().zip(to_cloud).collect());
    TntEvaluation { scores, cloud, scan }
}

/// The shares of the distances below each multiple of `step`, from the first to the last but one before
/// the curve's end.
fn cumulative(distances: &[f64], step: f64) -> Vec<f64> {
    let mut counts = vec![0_u64; CURVE_THRESHOLDS * CURVE_STEPS - 1];
    for distance in distances {
        if let Some(count) = counts.get_mut((distance / step) as usize) {
            *count += 1;
        }
    }
    let mut below = 0;
    let share = |count: u64| {
        below += count;
        below as f64 / distances.len() as f64
    };
    counts.into_iter().map(share).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit_volume() -> CropVolume {
        let json = r#"{"orthogonal_axis": "Z", "axis_min": -1, "axis_max": 1,
            "bounding_polygon": [[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]]}"#;
        CropVolume::parse(json).expect("a volume")
    }

    fn row(values: &[[f64; 3]]) -> Vec<Point3<f64>> {
        values.iter().map(|p| Point3::from(*p)).collect()
    }

    #[test]
    fn hand_numbers() {
        // The scan: four points a unit apart. The cloud: one exact, one 0.05 off, one 0.2 off, two that
        // fall into one cell, one outside the volume.
        let scan =
            row(&[[1.0, 5.0, 0.0], [2.0, 5.0, 0.0], [3.0, 5.0, 0.0], [4.0, 5.0, 0.0], [5.0, 5.0, 3.0]]);
        let cloud =
            row(&[[1.0, 5.0, 0.0], [2.0, 5.0, 0.05], [3.0, 5.2, 0.0], [3.0, 5.201, 0.0], [-1.0, 5.0, 0.0]]);
        let evaluation = score(&cloud, &scan, &Matrix4::identity(), &unit_volume(), 0.1);
        let scores = evaluation.scores;
        assert_eq!((scores.cloud_points, scores.scan_points), (3, 4));
        assert_eq!((scores.precision, scores.recall), (2.0 / 3.0, 0.5));
        assert!((scores.f_score - 4.0 / 7.0).abs() < 1e-12);
        assert_eq!(scores.curve.len(), 499);
        let at = |k: usize| scores.curve[k - 1];
        assert_eq!((at(100).precision, at(100).recall), (2.0 / 3.0, 0.5));
        assert_eq!((at(40).precision, at(210).precision, at(210).recall), (1.0 / 3.0, 1.0, 0.75));
        assert!((at(210).threshold - 0.21).abs() < 1e-12);
    }

    #[test]
    fn nothing_scores_nothing() {
        let one = row(&[[1.0, 1.0, 0.0]]);
        let far = row(&[[9.0, 9.0, 0.0]]);
        for (cloud, scan) in [(&one[..], &[][..]), (&[], &one), (&one, &far)] {
            let scores = score(cloud, scan, &Matrix4::identity(), &unit_volume(), 0.1).scores;
            assert_eq!((scores.precision, scores.recall, scores.f_score), (0.0, 0.0, 0.0));
        }
    }

    #[test]
    fn cameras_are_matched_by_their_order_or_by_the_mapping() {
        let video: Vec<Point3<f64>> = (0..1601).map(|i| Point3::new(f64::from(i), 0.0, 0.0)).collect();
        let reference = row(&[[0.0; 3], [1.0; 3]]);
        let shift = Matrix4::new_translation(&nalgebra::Vector3::new(0.0, 0.0, 2.0));
        let matched = matched_cameras(&video, &reference, &shift, Some(&[0, 1600])).expect("matched");
        assert_eq!((matched[1].from, matched[1].to), (video[1600], Point3::new(1.0, 1.0, 3.0)));
        let error = matched_cameras(&video, &reference, &shift, None).expect_err("no mapping");
        assert!(error.to_string().starts_with("the trajectory has 1601 cameras, the reference 2"), "{error}");
    }

    #[test]
    fn thresholds_are_those_of_the_training_scenes() {
        assert_eq!(threshold("Ignatius"), Some(0.003));
        assert_eq!(threshold("family"), None);
    }
}
