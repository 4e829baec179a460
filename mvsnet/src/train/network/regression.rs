//! Softmax, expectation and loss (paper sections 3.3 and 3.4), and the gradient of the logits.

use planesweep_scene::Raster;
use rayon::prelude::*;

use super::stack::{Stack, Tools};
use crate::kernels::slab::Shape;
use crate::train::LossConfig;

/// The probabilities over depth with their expectation.
pub(super) struct Regression {
    /// One channel of probabilities; columns are x, slabs y.
    probability: Stack,
    /// The expected index of the hypothesis at each pixel, row by row.
    pub(super) index: Vec<f64>,
}

impl Regression {
    /// From logits, which are the first channel.
    pub(super) fn new(tools: &Tools, logits: &Stack) -> Self {
        let shape = Shape { channels: 1, ..logits.shape };
        let probability = Stack::compute(tools, logits.slabs.len(), shape, |y, slab| {
            for x in 0..shape.columns {
                let logits = logits.slabs[y].channel(x, 0);
                let greatest = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
                let values = slab.channel_mut(x, 0);
                let mut total = 0.0_f64;
                for (value, logit) in values.iter_mut().zip(logits) {
                    *value = (logit - greatest).exp();
                    total += f64::from(*value);
                }
                let share = (1.0 / total) as f32;
                for value in values {
                    *value *= share;
                }
            }
        });
        let index = (0..logits.slabs.len()).into_par_iter().flat_map_iter(|y| {
            let slab = &probability.slabs[y];
            (0..shape.columns).map(move |x| {
                let terms = slab.channel(x, 0).iter().zip(0_u32..);
                terms.map(|(p, k)| f64::from(*p) * f64::from(k)).sum::<f64>()
            })
        });
        let index = index.collect();
        Self { probability, index }
    }

    /// The gradient of the logits from that of the expected indices.
    pub(super) fn gradient(&self, tools: &Tools, index: &[f64]) -> Stack {
        let Shape { columns, .. } = self.probability.shape;
        Stack::compute(tools, self.probability.slabs.len(), self.probability.shape, |y, slab| {
            for x in 0..columns {
                let (expected, g) = (self.index[y * columns + x], index[y * columns + x] as f32);
                let probability = self.probability.slabs[y].channel(x, 0);
                for ((to, p), k) in slab.channel_mut(x, 0).iter_mut().zip(probability).zip(0_u32..) {
                    *to = g * p * (f64::from(k) - expected) as f32;
                }
            }
        })
    }
}

/// Mean absolute error over pixels with a truth, and its gradient, both times `weight`.
pub(super) fn loss(index: &[f64], truth: &Raster<f32>, config: LossConfig, weight: f64) -> (f64, Vec<f64>) {
    let valid = truth.values().iter().filter(|truth| !truth.is_nan()).count().max(1) as f64;
    let mut total = 0.0;
    let pixel = |(index, truth): (&f64, &f32)| {
        if truth.is_nan() {
            return 0.0;
        }
        let error = index - f64::from(*truth);
        let limit = config.clamp.unwrap_or(f64::INFINITY);
        total += error.abs().min(limit);
        if error == 0.0 || error.abs() > limit { 0.0 } else { error.signum() * weight / valid }
    };
    let gradient = index.iter().zip(truth.values()).map(pixel).collect();
    (total * weight / valid, gradient)
}
