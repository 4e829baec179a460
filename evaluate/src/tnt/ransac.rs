//! The rough alignment of two trajectories.

use nalgebra::Matrix4;
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;

use super::TntError;
use crate::similarity::{Correspondence, fit_similarity};

/// Correspondences that a candidate is fitted to.
const SAMPLE: usize = 6;
/// Candidates that are tried.
const TRIALS: u64 = 100_000;
/// Distance within which a correspondence agrees, in the units of the truth (metres).
const INLIER_DISTANCE: f64 = 0.2;

/// The similarity that most of the correspondences agree with, among those fitted to samples of them;
/// where several are as good, the one that is nearer to those that agree.
///
/// Trial `k` draws from stream `k` of the seed, so the result depends on the seed alone.
pub fn align_trajectories(pairs: &[Correspondence], seed: u64) -> Result<Matrix4<f64>, TntError> {
    let trial = |trial: u64| {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(trial);
        let chosen: Vec<_> =
            sample(&mut random, pairs.len(), SAMPLE.min(pairs.len())).iter().map(|i| pairs[i]).collect();
        let transform = fit_similarity(&chosen)?;
        Some(Candidate { trial, transform, agreement: agreement(pairs, &transform) })
    };
    if pairs.len() < 3 {
        return Err(TntError::Alignment { cameras: pairs.len() });
    }
    let best = (0..TRIALS).into_par_iter().filter_map(trial).reduce_with(Candidate::better);
    let best = best.filter(|candidate| candidate.agreement.0 >= 3);
    best.map(|candidate| candidate.transform).ok_or(TntError::Alignment { cameras: pairs.len() })
}

struct Candidate {
    trial: u64,
    transform: Matrix4<f64>,
    /// How many correspondences agree, and the sum of their squared distances.
    agreement: (usize, f64),
}

impl Candidate {
    fn better(self, other: Self) -> Self {
        let more = other.agreement.0.cmp(&self.agreement.0);
        let order =
            more.then(self.agreement.1.total_cmp(&other.agreement.1)).then(self.trial.cmp(&other.trial));
        if order.is_le() { self } else { other }
    }
}

fn agreement(pairs: &[Correspondence], transform: &Matrix4<f64>) -> (usize, f64) {
    let squared = pairs.iter().map(|pair| (transform.transform_point(&pair.from) - pair.to).norm_squared());
    let near = squared.filter(|squared| *squared < INLIER_DISTANCE * INLIER_DISTANCE);
    near.fold((0, 0.0), |(count, sum), squared| (count + 1, sum + squared))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Point3, Similarity3, Vector3};

    use super::*;

    #[test]
    fn wrong_correspondences_do_not_matter() {
        let truth = Similarity3::new(Vector3::new(1.0, -2.0, 3.0), Vector3::new(0.3, 0.2, -0.9), 2.5);
        let pairs: Vec<_> = (0..30)
            .map(|i| {
                let t = f64::from(i);
                let from = Point3::new(4.0 * t.cos(), 4.0 * t.sin(), 0.3 * (3.1 * t).sin());
                let to = if i % 3 == 0 { Point3::new(t, -t, 0.0) } else { truth * from };
                Correspondence { from, to }
            })
            .collect();
        let found = align_trajectories(&pairs, 1).expect("aligned");
        assert!((found - truth.to_homogeneous()).abs().max() < 1e-9, "{found}");
        assert_eq!(align_trajectories(&pairs, 1).expect("aligned"), found);
    }

    #[test]
    fn too_few_cameras_are_refused() {
        let pair = Correspondence { from: Point3::origin(), to: Point3::origin() };
        let error = align_trajectories(&[pair, pair], 1).expect_err("two");
        assert_eq!(error.to_string(), "cannot align the trajectories of 2 cameras: too few of them agree");
        // Cameras in one place fit no similarity.
        assert!(align_trajectories(&[pair; 9], 1).is_err());
    }
}
