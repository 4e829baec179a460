//! Batch normalisation and ReLU, forward and backward.

use std::ops::Range;

use rayon::prelude::*;

use super::stack::{Stack, Tools};
use crate::WeightTensor;
use crate::kernels::normalize::{self, Affine};
use crate::kernels::slab::Shape;

/// What PyTorch adds to the variance by default.
const EPSILON: f64 = 1e-5;
/// Columns that are summed in single precision.
const COLUMNS: usize = 8;

/// The normalisation of one layer in one step.
#[derive(Clone, Debug)]
pub(super) struct Normalization {
    /// Per channel.
    affine: Vec<Affine>,
    /// `(z - mean) * inverse`, per channel, is normalised.
    mean: Vec<f64>,
    inverse: Vec<f64>,
    gamma: Vec<f64>,
    /// Mean and variance of the batch (of a sample), when they were used.
    pub(super) measured: Option<[Vec<f32>; 2]>,
}

/// The parameters of a normalisation.
pub(super) struct NormalizationWeights<'a> {
    pub(super) gamma: &'a WeightTensor,
    pub(super) beta: &'a WeightTensor,
    /// Mean and variance to use instead of those of the batch.
    pub(super) running: Option<[&'a WeightTensor; 2]>,
}

impl Normalization {
    pub(super) fn new(tools: &Tools, weights: &NormalizationWeights<'_>, z: &Stack) -> Self {
        let to_f64 = |tensor: &WeightTensor| tensor.values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
        let (gamma, beta) = (to_f64(weights.gamma), to_f64(weights.beta));
        let (mean, variance, measured) = if let Some([mean, variance]) = weights.running {
            (to_f64(mean), to_f64(variance), None)
        } else {
            let count = z.values_per_channel() as f64;
            let (mean, variance) = moments(tools, z, gamma.len());
            let of_sample = variance.iter().map(|v| (v * count / (count - 1.0).max(1.0)) as f32).collect();
            let measured = [mean.iter().map(|m| *m as f32).collect(), of_sample];
            (mean, variance, Some(measured))
        };
        let inverse: Vec<f64> = variance.iter().map(|v| 1.0 / (v + EPSILON).sqrt()).collect();
        let affine = |channel: usize| {
            let scale = gamma[channel] * inverse[channel];
            [scale as f32, (beta[channel] - mean[channel] * scale) as f32]
        };
        let affine = (0..gamma.len()).map(affine).collect();
        Self { affine, mean, inverse, gamma, measured }
    }

    /// ReLU of the normalised values, with `more` added.
    pub(super) fn apply(&self, tools: &Tools, z: &Stack, more: Option<&Stack>) -> Stack {
        Stack::compute_columns(tools, z.slabs.len(), z.shape, |i, x, column| {
            let more = more.map(|more| more.slabs[i].columns(x..x + 1));
            normalize::apply(tools.level, z.slabs[i].columns(x..x + 1), more, &self.affine, column);
        })
    }

    /// The gradient of `z` from that of the output, and those of scale and shift.
    pub(super) fn gradient(&self, tools: &Tools, z: &Stack, output: &Stack) -> (Stack, [WeightTensor; 2]) {
        let channels = self.gamma.len();
        // Sums of the gradient where ReLU lets it through, and of its product with z.
        let sums = summed(z, channels, |slab, columns| {
            let output = output.slabs[slab].columns(columns.clone());
            normalize::gradient_sums(tools.level, z.slabs[slab].columns(columns), output, &self.affine)
        });
        let count = z.values_per_channel() as f64;
        let mut slopes = Vec::with_capacity(channels);
        let (mut gamma_gradient, mut beta_gradient) = (vec![0.0; channels], vec![0.0; channels]);
        for (channel, [sum, product]) in sums.into_iter().enumerate() {
            let along = (product - self.mean[channel] * sum) * self.inverse[channel];
            gamma_gradient[channel] = along as f32;
            beta_gradient[channel] = sum as f32;
            // dz = scale * (g - sum / n - normalised z * along / n), or scale * g with given statistics.
            let scale = self.gamma[channel] * self.inverse[channel];
            slopes.push(if self.measured.is_some() {
                let slope = -scale * along * self.inverse[channel] / count;
                [scale as f32, slope as f32, (-scale * sum / count - slope * self.mean[channel]) as f32]
            } else {
                [scale as f32, 0.0, 0.0]
            });
        }
        let shape = Shape { channels, ..z.shape };
        let gradient = Stack::compute_columns(tools, z.slabs.len(), shape, |i, x, column| {
            let (z, output) = (z.slabs[i].columns(x..x + 1), output.slabs[i].columns(x..x + 1));
            normalize::gradient(tools.level, z, output, &self.affine, &slopes, column);
        });
        let tensor = |values| WeightTensor { shape: vec![channels], values };
        (gradient, [tensor(gamma_gradient), tensor(beta_gradient)])
    }
}

/// Mean and (population) variance of each channel.
fn moments(tools: &Tools, z: &Stack, channels: usize) -> (Vec<f64>, Vec<f64>) {
    let count = z.values_per_channel() as f64;
    let sums = summed(z, channels, |slab, columns| {
        normalize::moments(tools.level, z.slabs[slab].columns(columns), channels)
    });
    let mean = sums.iter().map(|[sum, _]| sum / count).collect();
    let variance = sums.iter().map(|[sum, square]| (square / count - (sum / count).powi(2)).max(0.0));
    (mean, variance.collect())
}

/// Two sums for each channel over all slabs, of sums over a few of their columns.
fn summed(
    z: &Stack,
    channels: usize,
    sums: impl Fn(usize, Range<usize>) -> Vec<[f64; 2]> + Sync,
) -> Vec<[f64; 2]> {
    let columns = z.shape.columns;
    let parts = columns.div_ceil(COLUMNS);
    let part = |at: usize| {
        let begin = at % parts * COLUMNS;
        sums(at / parts, begin..(begin + COLUMNS).min(columns))
    };
    let all: Vec<_> = (0..z.slabs.len() * parts).into_par_iter().with_min_len(2).map(part).collect();
    let total = |channel: usize| [0, 1].map(|which| all.iter().map(|sums| sums[channel][which]).sum());
    (0..channels).map(total).collect()
}
