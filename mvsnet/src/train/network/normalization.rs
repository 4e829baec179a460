//! Batch normalisation and ReLU, forward and backward.

use rayon::prelude::*;

use super::stack::{Stack, Tools};
use crate::WeightTensor;
use crate::kernels::slab::Slab;

/// What PyTorch adds to the variance by default.
const EPSILON: f64 = 1e-5;

/// The normalisation of one layer in one step.
#[derive(Clone, Debug)]
pub(super) struct Normalization {
    /// `y = scale * z + shift`, per channel.
    scale: Vec<f32>,
    shift: Vec<f32>,
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
    pub(super) fn new(weights: &NormalizationWeights<'_>, z: &Stack) -> Self {
        let to_f64 = |tensor: &WeightTensor| tensor.values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>();
        let (gamma, beta) = (to_f64(weights.gamma), to_f64(weights.beta));
        let (mean, variance, measured) = if let Some([mean, variance]) = weights.running {
            (to_f64(mean), to_f64(variance), None)
        } else {
            let count = z.values_per_channel() as f64;
            let (mean, variance) = moments(z, gamma.len(), count);
            let of_sample = variance.iter().map(|v| (v * count / (count - 1.0).max(1.0)) as f32).collect();
            let measured = [mean.iter().map(|m| *m as f32).collect(), of_sample];
            (mean, variance, Some(measured))
        };
        let inverse: Vec<f64> = variance.iter().map(|v| 1.0 / (v + EPSILON).sqrt()).collect();
        let scale: Vec<f64> = gamma.iter().zip(&inverse).map(|(gamma, inverse)| gamma * inverse).collect();
        let shift = (0..gamma.len()).map(|c| (beta[c] - mean[c] * scale[c]) as f32).collect();
        let scale = scale.iter().map(|scale| *scale as f32).collect();
        Self { scale, shift, mean, inverse, gamma, measured }
    }

    /// ReLU of the normalised values, with `more` added.
    pub(super) fn apply(&self, tools: &Tools, z: &Stack, more: Option<&Stack>) -> Stack {
        Stack::compute(tools, z.slabs.len(), z.shape, |i, slab| {
            for x in 0..z.shape.columns {
                for channel in 0..z.shape.channels {
                    let to = slab.channel_mut(x, channel);
                    let from = z.slabs[i].channel(x, channel);
                    // Channels that only fill a block stay zero.
                    let (scale, shift) = self.affine(channel);
                    match more {
                        None => {
                            for (to, from) in to.iter_mut().zip(from) {
                                *to = (scale * from + shift).max(0.0);
                            }
                        }
                        Some(more) => {
                            let more = more.slabs[i].channel(x, channel);
                            for ((to, from), more) in to.iter_mut().zip(from).zip(more) {
                                *to = (scale * from + shift).max(0.0) + more;
                            }
                        }
                    }
                }
            }
        })
    }

    fn affine(&self, channel: usize) -> (f32, f32) {
        self.scale.get(channel).map_or((0.0, 0.0), |scale| (*scale, self.shift[channel]))
    }

    /// The gradient of `z` from that of the output, and those of scale and shift.
    pub(super) fn gradient(&self, tools: &Tools, z: &Stack, output: &Stack) -> (Stack, [WeightTensor; 2]) {
        let channels = self.gamma.len();
        // Sums of the gradient where ReLU lets it through, and of its product with z.
        let per_slab: Vec<Vec<[f64; 2]>> =
            (0..z.slabs.len()).into_par_iter().map(|i| self.sums(&z.slabs[i], &output.slabs[i])).collect();
        let total =
            |channel: usize, which: usize| per_slab.iter().map(|sums| sums[channel][which]).sum::<f64>();
        let count = z.values_per_channel() as f64;
        let mut coefficients = Vec::with_capacity(channels);
        let (mut gamma_gradient, mut beta_gradient) = (vec![0.0; channels], vec![0.0; channels]);
        for channel in 0..channels {
            let (sum, product) = (total(channel, 0), total(channel, 1));
            let along = (product - self.mean[channel] * sum) * self.inverse[channel];
            gamma_gradient[channel] = along as f32;
            beta_gradient[channel] = sum as f32;
            // dz = scale * (g - sum / n - normalised z * along / n), or scale * g with given statistics.
            let scale = self.gamma[channel] * self.inverse[channel];
            coefficients.push(if self.measured.is_some() {
                let slope = -scale * along * self.inverse[channel] / count;
                [scale as f32, slope as f32, (-scale * sum / count - slope * self.mean[channel]) as f32]
            } else {
                [scale as f32, 0.0, 0.0]
            });
        }
        let shape = crate::kernels::slab::Shape { channels, ..z.shape };
        let gradient = Stack::compute(tools, z.slabs.len(), shape, |i, slab| {
            for x in 0..shape.columns {
                for (channel, [scale, slope, constant]) in coefficients.iter().enumerate() {
                    let to = slab.channel_mut(x, channel);
                    let z = z.slabs[i].channel(x, channel);
                    let g = output.slabs[i].channel(x, channel);
                    let (factor, shift) = self.affine(channel);
                    for ((to, z), g) in to.iter_mut().zip(z).zip(g) {
                        let g = if factor * z + shift > 0.0 { *g } else { 0.0 };
                        *to = scale * g + (slope * z + constant);
                    }
                }
            }
        });
        let tensor = |values| WeightTensor { shape: vec![channels], values };
        (gradient, [tensor(gamma_gradient), tensor(beta_gradient)])
    }

    fn sums(&self, z: &Slab, output: &Slab) -> Vec<[f64; 2]> {
        let mut sums = vec![[0.0; 2]; self.gamma.len()];
        for x in 0..z.shape().columns {
            for (channel, sums) in sums.iter_mut().enumerate() {
                let (scale, shift) = self.affine(channel);
                let pairs = (z.channel(x, channel), output.channel(x, channel));
                let [sum, product] = sixteen(pairs, |z, g| {
                    let g = if scale * z + shift > 0.0 { g } else { 0.0 };
                    [g, g * z]
                });
                sums[0] += sum;
                sums[1] += product;
            }
        }
        sums
    }
}

/// Mean and (population) variance of each channel.
fn moments(z: &Stack, channels: usize, count: f64) -> (Vec<f64>, Vec<f64>) {
    let per_slab: Vec<Vec<[f64; 2]>> = z
        .slabs
        .par_iter()
        .map(|slab| {
            let mut sums = vec![[0.0; 2]; channels];
            for x in 0..z.shape.columns {
                for (channel, sums) in sums.iter_mut().enumerate() {
                    let values = slab.channel(x, channel);
                    let [sum, square] = sixteen((values, values), |value, _| [value, value * value]);
                    sums[0] += sum;
                    sums[1] += square;
                }
            }
            sums
        })
        .collect();
    let total = |channel: usize, which: usize| per_slab.iter().map(|sums| sums[channel][which]).sum::<f64>();
    let mean: Vec<f64> = (0..channels).map(|channel| total(channel, 0) / count).collect();
    let variance = (0..channels).map(|channel| (total(channel, 1) / count - mean[channel].powi(2)).max(0.0));
    let variance = variance.collect();
    (mean, variance)
}

/// Two sums over pairs of values, sixteen at a time, in an order that does not depend on the processor.
#[inline]
fn sixteen((a, b): (&[f32], &[f32]), terms: impl Fn(f32, f32) -> [f32; 2]) -> [f64; 2] {
    let mut lanes = [[0.0_f32; 16]; 2];
    let ((a, a_rest), (b, b_rest)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    for (a, b) in a.iter().zip(b) {
        for i in 0..16 {
            let [first, second] = terms(a[i], b[i]);
            lanes[0][i] += first;
            lanes[1][i] += second;
        }
    }
    let mut sums = lanes.map(|lanes| lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>());
    for (a, b) in a_rest.iter().zip(b_rest) {
        let [first, second] = terms(*a, *b);
        sums[0] += f64::from(first);
        sums[1] += f64::from(second);
    }
    sums
}
