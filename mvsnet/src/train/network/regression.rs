//! Softmax, expectation and loss (paper sections 3.3 and 3.4), and the gradient of the logits.

use std::sync::Arc;

use planesweep_scene::Raster;
use rayon::prelude::*;

use super::stack::{Stack, Tools};
use crate::kernels::regress::{RegressionLayer, RegressionScratch};
use crate::kernels::slab::Shape;
use crate::train::LossConfig;

/// The probabilities over depth with their expectation.
pub(super) struct Regression {
    /// One channel; columns are x, slabs y.
    probability: Stack,
    /// The expected index of the hypothesis at each pixel, row by row.
    pub(super) index: Vec<f64>,
}

impl Regression {
    /// From the input of the last layer.
    pub(super) fn new(tools: &Tools, layer: &RegressionLayer, input: &Stack) -> Self {
        let shape = Shape { channels: 1, ..input.shape };
        let row = |y: usize| {
            let mut scratch = RegressionScratch::new(shape.padded());
            let mut probability = tools.pool.take(shape);
            let mut index = Vec::with_capacity(shape.columns);
            for x in (0..shape.columns).step_by(2) {
                let rows = (0..3).filter_map(|tap| {
                    let slab = input.slabs.get((y + tap).checked_sub(1)?)?;
                    Some((slab.four_columns(x), tap))
                });
                let pixels = layer.apply(&rows.collect::<Vec<_>>(), 1, &mut scratch);
                for (pixel, regressed) in pixels.iter().enumerate().take(shape.columns - x) {
                    index.push(regressed.index);
                    let exponentials = &scratch.exponentials(pixel)[..shape.length];
                    let share =
                        (1.0 / exponentials.iter().map(|value| f64::from(*value)).sum::<f64>()) as f32;
                    let values = probability.channel_mut(x + pixel, 0).iter_mut().zip(exponentials);
                    values.for_each(|(value, exponential)| *value = exponential * share);
                }
            }
            (Arc::new(probability), index)
        };
        let (slabs, index): (Vec<_>, Vec<_>) = (0..input.slabs.len()).into_par_iter().map(row).unzip();
        Self { probability: Stack::new(slabs), index: index.concat() }
    }

    /// The divergence of the probabilities from equal ones at pixels whose truth is at no hypothesis, over all pixels.
    pub(super) fn absent_loss(&self, truth: &Raster<f32>) -> f64 {
        let Shape { columns, length, .. } = self.probability.shape;
        let pixel = |x: usize, y: usize| {
            let probability = self.probability.slabs[y].channel(x, 0);
            let logarithms = probability.iter().map(|p| f64::from(p.max(f32::MIN_POSITIVE)).ln());
            -logarithms.sum::<f64>() / length as f64 - (length as f64).ln()
        };
        let row =
            |y: usize| (0..columns).filter(|x| truth.at(*x, y).is_infinite()).map(|x| pixel(x, y)).sum();
        let rows: Vec<f64> = (0..self.probability.slabs.len()).into_par_iter().map(row).collect();
        rows.iter().sum::<f64>() / self.index.len() as f64
    }

    /// The gradient of the logits from that of the expected indices, and by the loss of pixels at no hypothesis.
    pub(super) fn gradient(&self, tools: &Tools, index: &[f64], truth: &Raster<f32>, absent: f64) -> Stack {
        let Shape { columns, length, .. } = self.probability.shape;
        let (share, equal) = ((absent / index.len() as f64) as f32, 1.0 / length as f32);
        Stack::compute(tools, self.probability.slabs.len(), self.probability.shape, |y, slab| {
            for x in 0..columns {
                let (expected, g) = (self.index[y * columns + x], index[y * columns + x] as f32);
                let probability = self.probability.slabs[y].channel(x, 0);
                for ((to, p), k) in slab.channel_mut(x, 0).iter_mut().zip(probability).zip(0_u32..) {
                    *to = g * p * (f64::from(k) - expected) as f32;
                }
                if share > 0.0 && truth.at(x, y).is_infinite() {
                    let values = slab.channel_mut(x, 0).iter_mut().zip(probability);
                    values.for_each(|(to, p)| *to += share * (p - equal));
                }
            }
        })
    }
}

/// Mean absolute error over pixels with a truth, and its gradient, both times `weight`.
pub(super) fn loss(index: &[f64], truth: &Raster<f32>, config: LossConfig, weight: f64) -> (f64, Vec<f64>) {
    let valid = truth.values().iter().filter(|truth| truth.is_finite()).count().max(1) as f64;
    let mut total = 0.0;
    let pixel = |(index, truth): (&f64, &f32)| {
        if !truth.is_finite() {
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
