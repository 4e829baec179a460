//! The metric of the ETH3D benchmark (Schöps et al. 2017): accuracy, completeness and F1 score of a cloud
//! against laser scans, at several tolerances.
//!
//! A point of the cloud is accurate when a scan has a point near it, inaccurate when it stands where a
//! laser beam went through (`observe`), and unobserved otherwise; unobserved points count nowhere. Both
//! figures are means over the cells of two grids (`cell_means`), so that dense places weigh no more.

mod cells;
mod observe;
mod project;

use nalgebra::{Matrix4, Point3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use project::{PlacedScan, parse_project};

use crate::nearest::NearestPoints;
use crate::similarity::transformed;
use crate::statistics::harmonic_mean;
use cells::cell_means;
use observe::{Observed, ScannedDirections};

/// Why scans could not be used.
#[derive(Debug, Error)]
pub enum Eth3dError {
    /// The MeshLab project is no XML.
    #[error("cannot understand the MeshLab project")]
    Project(#[from] roxmltree::Error),
    /// The project names no scan.
    #[error("the MeshLab project has no MLMesh")]
    NoScan,
    /// A scan has no file name or no matrix.
    #[error("scan {place} of the MeshLab project has no {what}")]
    Incomplete {
        /// Counted from 1.
        place: usize,
        /// What is missing.
        what: &'static str,
    },
    /// A scan's matrix is not one of a rigid motion.
    #[error(
        "the matrix of scan {place} of the MeshLab project is not 16 numbers of a rotation and a translation"
    )]
    Matrix {
        /// Counted from 1.
        place: usize,
    },
}

/// A laser scan: points in the frame of the scanner, which stands at the origin.
#[derive(Clone, Debug)]
pub struct LaserScan {
    /// In the frame of the scanner.
    pub points: Vec<Point3<f64>>,
    /// From the frame of the scanner to the world; a rotation and a translation.
    pub to_world: Matrix4<f64>,
}

/// How a cloud is judged. Lengths are metres.
#[derive(Clone, Debug, PartialEq)]
pub struct Eth3dOptions {
    /// Distances within which a point counts, rising.
    pub tolerances: Vec<f64>,
    /// Side of the cells that weigh the same.
    pub cell: f64,
    /// Radius of a laser beam at the scanner.
    pub beam_radius: f64,
    /// By this angle, in radians, a beam widens on either side.
    pub beam_half_angle: f64,
}

impl Default for Eth3dOptions {
    /// The benchmark's.
    fn default() -> Self {
        Self {
            tolerances: vec![0.01, 0.02, 0.05, 0.1, 0.2, 0.5],
            cell: 0.01,
            beam_radius: 0.5 * 0.00225,
            beam_half_angle: 0.011_f64.to_radians(),
        }
    }
}

/// The figures at one tolerance; shares from 0 to 1.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Eth3dScores {
    /// In metres.
    pub tolerance: f64,
    /// Share of the cloud's observed points that are near a scan, as a mean over cells.
    pub accuracy: f64,
    /// Share of the scans' points that are near the cloud, as a mean over cells.
    pub completeness: f64,
    /// Their harmonic mean; 0 when both are 0.
    pub f1: f64,
}

/// How good a cloud is, and the points that say so.
#[derive(Clone, Debug)]
pub struct Eth3dEvaluation {
    /// The figures, one for each tolerance.
    pub scores: Vec<Eth3dScores>,
    /// Points of the cloud that are unobserved at the least tolerance.
    pub unobserved: usize,
    /// Points of the scans in the world, each with its distance to the cloud; none where the cloud is empty.
    pub scan: Vec<(Point3<f64>, f64)>,
}

/// Compares a cloud in the world with the scans of the scene.
pub fn compare(cloud: &[Point3<f64>], scans: &[LaserScan], options: &Eth3dOptions) -> Eth3dEvaluation {
    let tolerances = &options.tolerances;
    let is_finite = |point: &Point3<f64>| point.iter().all(|v| v.is_finite());
    let cloud: Vec<Point3<f64>> = cloud.iter().copied().filter(is_finite).collect();
    let observed = observe_all(&cloud, scans, options);
    let accurate = |observed: &Observed, tolerance: usize| {
        (observed.first_accurate <= tolerance)
            .then_some(true)
            .or_else(|| observed.is_in_free_space.then_some(false))
    };
    let accuracy = cell_means(&cloud, options.cell, tolerances.len(), |point, tolerance| {
        accurate(&observed[point], tolerance)
    });
    let points: Vec<Point3<f64>> =
        scans.iter().flat_map(|scan| transformed(&scan.points, &scan.to_world)).filter(is_finite).collect();
    let distances = NearestPoints::new(&cloud).map(|tree| tree.distances(&points));
    let completeness = match &distances {
        Some(distances) => cell_means(&points, options.cell, tolerances.len(), |point, tolerance| {
            Some(distances[point] <= tolerances[tolerance])
        }),
        None => vec![0.0; tolerances.len()],
    };
    let scores = tolerances.iter().zip(accuracy).zip(completeness);
    Eth3dEvaluation {
        scores: scores
            .map(|((tolerance, accuracy), completeness)| Eth3dScores {
                tolerance: *tolerance,
                accuracy,
                completeness,
                f1: harmonic_mean(accuracy, completeness),
            })
            .collect(),
        unobserved: observed.iter().filter(|point| accurate(point, 0).is_none()).count(),
        scan: distances.map(|distances| points.into_iter().zip(distances).collect()).unwrap_or_default(),
    }
}

/// What all scans together say of each point: the best of them decides.
fn observe_all(cloud: &[Point3<f64>], scans: &[LaserScan], options: &Eth3dOptions) -> Vec<Observed> {
    let mut all = vec![Observed::nothing(options.tolerances.len()); cloud.len()];
    for scan in scans {
        let Some(directions) = ScannedDirections::new(&scan.points) else { continue };
        let Some(to_scanner) = scan.to_world.try_inverse() else { continue };
        all.par_iter_mut().zip(cloud).for_each(|(all, point)| {
            if all.first_accurate > 0 {
                all.merge(directions.observe(&to_scanner.transform_point(point), options));
            }
        });
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A wall at x = 5, a point every 2 mm, seen from a scanner that stands at (1, 2, 0) of the world.
    fn wall() -> LaserScan {
        let side = -50..=50;
        let points = side.clone().flat_map(|y| side.clone().map(move |z| (f64::from(y), f64::from(z))));
        let points = points.map(|(y, z)| Point3::new(5.0, 0.002 * y, 0.002 * z)).collect();
        LaserScan { points, to_world: Matrix4::new_translation(&nalgebra::Vector3::new(1.0, 2.0, 0.0)) }
    }

    #[test]
    fn hand_numbers() {
        // One point for each case: on the wall; 3 cm before it, where the beams went through; 3 cm behind
        // it; beside all beams. They lie in cells of their own.
        let at = |x, y| Point3::new(1.0 + x, 2.0 + y, 0.0);
        let cloud = [at(5.0, 0.0), at(4.97, 0.03), at(5.03, -0.03), at(4.0, 1.0)];
        let options = Eth3dOptions { tolerances: vec![0.01, 0.05], ..Eth3dOptions::default() };
        let evaluation = compare(&cloud, &[wall()], &options);
        let accuracies: Vec<f64> = evaluation.scores.iter().map(|s| s.accuracy).collect();
        assert_eq!(accuracies, [0.5, 1.0]);
        assert_eq!(evaluation.unobserved, 2);
        // Within 5 cm of the point on the wall lie about a fifth of the wall's 20 by 20 cm.
        let complete = evaluation.scan.iter().filter(|(_, distance)| *distance <= 0.05).count();
        let share = complete as f64 / evaluation.scan.len() as f64;
        assert!((evaluation.scores[1].completeness - share).abs() < 0.03, "{:?} {share}", evaluation.scores);
        assert!(evaluation.scores[1].f1 > evaluation.scores[0].f1);
    }

    #[test]
    fn dense_places_weigh_no_more() {
        // One good point in one cell, a hundred in the air in another cell.
        let mut cloud = vec![Point3::new(6.0, 2.0, 0.0)];
        cloud.extend((0..100).map(|k| Point3::new(5.0 + 1e-5 * f64::from(k), 2.0, 0.0)));
        let evaluation = compare(&cloud, &[wall()], &Eth3dOptions::default());
        assert!((evaluation.scores[0].accuracy - 0.5).abs() < 1e-12, "{:?}", evaluation.scores);
    }

    #[test]
    fn another_scan_can_clear_a_point() {
        // In front of the wall for one scanner, on a wall of another's.
        let near = LaserScan {
            points: vec![Point3::new(4.0, 0.0, 0.0)],
            to_world: Matrix4::new_translation(&nalgebra::Vector3::new(1.0, 2.0, 0.0)),
        };
        let cloud = [Point3::new(5.0, 2.0, 0.0)];
        let accuracy =
            |scans: &[LaserScan]| compare(&cloud, scans, &Eth3dOptions::default()).scores[0].accuracy;
        assert_eq!((accuracy(&[wall()]), accuracy(&[wall(), near])), (0.0, 1.0));
    }

    #[test]
    fn nothing_scores_nothing() {
        for (cloud, scans) in [(vec![], vec![wall()]), (vec![Point3::origin()], vec![])] {
            let evaluation = compare(&cloud, &scans, &Eth3dOptions::default());
            assert!(evaluation.scores.iter().all(|s| (s.accuracy, s.f1) == (0.0, 0.0)));
        }
    }
}
