//! What computes gradients, and what it gives.

use thiserror::Error;

use super::parameters::Tensors;
use super::{Example, LossConfig, NetworkConfig};

/// Why there is no gradient.
#[derive(Debug, Error)]
pub enum EngineError {
    /// The name means no device, or there is no such device.
    #[error("no gradients on \"{device}\": {why}")]
    Device {
        /// The name.
        device: String,
        /// Why.
        why: String,
    },
    /// The tensor library failed.
    #[error("{doing} failed on {device}: {message}")]
    Library {
        /// The step of the network.
        doing: &'static str,
        /// The device.
        device: String,
        /// What the library said.
        message: String,
    },
}

/// What batch normalisation normalises with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum BatchStatistics {
    /// The statistics of the example itself.
    Own,
    /// The running statistics, as inference does.
    Running,
}

/// How a gradient is computed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GradientOptions {
    /// The network.
    pub network: NetworkConfig,
    /// The loss.
    pub loss: LossConfig,
    /// The statistics.
    pub statistics: BatchStatistics,
}

/// Errors of a depth map, in intervals of its hypotheses.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct IntervalErrors {
    /// Pixels with a true depth.
    pub pixels: u64,
    /// The sum of absolute errors.
    pub sum: f64,
    /// How many are below 1.
    pub below_1: u64,
    /// How many are below 3.
    pub below_3: u64,
}

impl IntervalErrors {
    /// Errors of fractional indices, where the truth is finite.
    pub fn of(indices: impl IntoIterator<Item = f32>, truth: &[f32]) -> Self {
        let pairs = indices.into_iter().zip(truth).filter(|(_, truth)| truth.is_finite());
        pairs.fold(Self::default(), |mut errors, (index, truth)| {
            let error = f64::from((index - truth).abs());
            errors.pixels += 1;
            errors.sum += error;
            errors.below_1 += u64::from(error < 1.0);
            errors.below_3 += u64::from(error < 3.0);
            errors
        })
    }

    /// The errors of both.
    #[must_use]
    pub fn plus(self, other: Self) -> Self {
        Self {
            pixels: self.pixels + other.pixels,
            sum: self.sum + other.sum,
            below_1: self.below_1 + other.below_1,
            below_3: self.below_3 + other.below_3,
        }
    }

    /// Mean absolute error.
    pub fn mean(&self) -> f64 {
        self.sum / self.pixels.max(1) as f64
    }

    /// Shares of errors below 1 and below 3.
    pub fn shares(&self) -> [f64; 2] {
        [self.below_1, self.below_3].map(|count| count as f64 / self.pixels.max(1) as f64)
    }
}

/// What an example teaches.
#[derive(Clone, Debug, PartialEq)]
pub struct Gradient {
    /// The loss.
    pub loss: f64,
    /// Errors of the initial depth.
    pub initial: IntervalErrors,
    /// Errors of the refined depth, where there is a refinement.
    pub refined: Option<IntervalErrors>,
    /// The gradient of the loss by every weight.
    pub(crate) weights: Tensors,
    /// Mean and variance (of a sample, not of a population) of every batch normalisation, by the names of the
    /// running ones; none when the running ones were used.
    pub(crate) statistics: Tensors,
}

/// Computes the loss of an example and its gradient.
pub trait GradientEngine {
    /// The gradient at these weights.
    fn gradient(
        &mut self,
        weights: &Tensors,
        example: &Example,
        options: &GradientOptions,
    ) -> Result<Gradient, EngineError>;
}
