//! The depth planes that the reference camera's frustum is swept with.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// How depth hypotheses are spaced.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Sampling {
    /// Equal steps of depth.
    Uniform,
    /// Equal steps of inverse depth.
    Inverse,
}

/// Fronto-parallel planes of the reference camera, nearest first.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthHypotheses {
    sampling: Sampling,
    min: f64,
    max: f64,
    count: u32,
}

/// Why hypotheses are refused.
#[derive(Debug, Error, PartialEq)]
pub enum HypothesesError {
    /// The range is empty, negative or not finite.
    #[error("depth range {min} to {max} is not positive and increasing")]
    Range {
        /// Nearest depth.
        min: f64,
        /// Farthest depth.
        max: f64,
    },
    /// Fewer than two planes.
    #[error("{count} depth hypotheses are not enough, at least 2 are needed")]
    Count {
        /// Planes asked for.
        count: u32,
    },
}

impl DepthHypotheses {
    /// `count` planes from `min` to `max` (both included), in scene units.
    pub fn new(sampling: Sampling, min: f64, max: f64, count: u32) -> Result<Self, HypothesesError> {
        if !(min > 0.0 && max > min && max.is_finite()) {
            return Err(HypothesesError::Range { min, max });
        }
        if count < 2 {
            return Err(HypothesesError::Count { count });
        }
        Ok(Self { sampling, min, max, count })
    }

    /// How the planes are spaced.
    pub fn sampling(&self) -> Sampling {
        self.sampling
    }

    /// Depth of the nearest plane.
    pub fn min(&self) -> f64 {
        self.min
    }

    /// Depth of the farthest plane.
    pub fn max(&self) -> f64 {
        self.max
    }

    /// Number of planes.
    pub fn count(&self) -> u32 {
        self.count
    }

    /// The depth at a (fractional) index, linear in depth or in inverse depth.
    pub fn depth_at(&self, index: f64) -> f64 {
        let t = index / (self.count - 1) as f64;
        match self.sampling {
            Sampling::Uniform => self.min + t * (self.max - self.min),
            Sampling::Inverse => 1.0 / (1.0 / self.min + t * (1.0 / self.max - 1.0 / self.min)),
        }
    }

    /// The (fractional) index of a depth; the inverse of [`Self::depth_at`].
    pub fn index_of(&self, depth: f64) -> f64 {
        let t = match self.sampling {
            Sampling::Uniform => (depth - self.min) / (self.max - self.min),
            Sampling::Inverse => (1.0 / depth - 1.0 / self.min) / (1.0 / self.max - 1.0 / self.min),
        };
        t * (self.count - 1) as f64
    }

    /// All depths, nearest first.
    pub fn depths(&self) -> Vec<f64> {
        (0..self.count).map(|k| self.depth_at(k as f64)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn both_samplings_hit_their_ends_and_invert() {
        for sampling in [Sampling::Uniform, Sampling::Inverse] {
            let h = DepthHypotheses::new(sampling, 2.0, 10.0, 5).expect("a valid range");
            let depths = h.depths();
            assert!((depths[0] - 2.0).abs() < 1e-12 && (depths[4] - 10.0).abs() < 1e-12);
            for (k, d) in depths.iter().enumerate() {
                assert!((h.index_of(*d) - k as f64).abs() < 1e-9);
            }
        }
        let inverse = DepthHypotheses::new(Sampling::Inverse, 2.0, 10.0, 5).expect("a valid range");
        assert!((1.0 / inverse.depth_at(1.0) - 0.4).abs() < 1e-12);
    }

    #[test]
    fn empty_ranges_are_refused() {
        assert!(DepthHypotheses::new(Sampling::Uniform, 0.0, 1.0, 8).is_err());
        assert!(DepthHypotheses::new(Sampling::Uniform, 2.0, 2.0, 8).is_err());
        assert!(DepthHypotheses::new(Sampling::Uniform, 1.0, f64::INFINITY, 8).is_err());
        assert_eq!(
            DepthHypotheses::new(Sampling::Uniform, 1.0, 2.0, 1),
            Err(HypothesesError::Count { count: 1 })
        );
    }
}
