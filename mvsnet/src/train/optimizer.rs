//! One update of the weights: clipping, Adam, running statistics, the average over steps.

use super::OptimizerConfig;
use super::parameters::{Tensors, is_kernel, is_statistic, zeros_like};

/// Everything that a step changes, and all that a resumed run needs beside its configuration.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainState {
    /// Steps done.
    pub step: u64,
    /// The weights, with the running statistics of batch normalisation.
    pub(crate) weights: Tensors,
    /// Their average over steps; empty when none is kept.
    pub(crate) average: Tensors,
    /// Adam's mean of gradients.
    pub(crate) mean: Tensors,
    /// Adam's mean of squared gradients.
    pub(crate) square: Tensors,
}

/// What a step learned of a weight's gradient as a whole.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GradientNorm {
    /// Its norm before clipping.
    pub norm: f64,
    /// False when a value was no number, so that the step was left out.
    pub finite: bool,
}

impl TrainState {
    /// The state before the first step.
    pub(crate) fn new(weights: Tensors, average: bool) -> Self {
        let mut trained = zeros_like(&weights);
        trained.retain(|name, _| !is_statistic(name));
        Self {
            step: 0,
            average: if average { weights.clone() } else { Tensors::new() },
            mean: trained.clone(),
            square: trained,
            weights,
        }
    }

    /// The weights that are exported: their average, where one is kept.
    pub(crate) fn exported(&self) -> &Tensors {
        if self.average.is_empty() { &self.weights } else { &self.average }
    }

    /// Does a step with the mean gradient of its samples and the statistics of their batch normalisations, in the
    /// order of the samples. A gradient that is not finite leaves the weights alone.
    pub(crate) fn update(
        &mut self,
        config: &OptimizerConfig,
        steps: u64,
        gradient: &Tensors,
        statistics: &[Tensors],
    ) -> GradientNorm {
        let values = gradient.values().flat_map(|tensor| &tensor.values);
        let norm = values.map(|value| f64::from(*value).powi(2)).sum::<f64>().sqrt();
        let finite = norm.is_finite();
        let rate = config.learning_rate_at(self.step, steps);
        self.step += 1;
        if finite {
            let scale = config.clip_norm.map_or(1.0, |limit| (limit / norm.max(limit)).min(1.0));
            self.adam(config, rate, scale as f32, gradient);
            for sample in statistics {
                let momentum = config.statistics_momentum as f32;
                blend(&mut self.weights, sample, momentum);
            }
        }
        if !self.average.is_empty() {
            // Early averages are short, so that the initial weights are soon forgotten.
            let decay = config.average_decay.min((self.step as f64 + 1.0) / (self.step as f64 + 10.0));
            blend(&mut self.average, &self.weights, (1.0 - decay) as f32);
        }
        GradientNorm { norm, finite }
    }

    fn adam(&mut self, config: &OptimizerConfig, rate: f64, scale: f32, gradient: &Tensors) {
        let (beta1, beta2) = (config.beta1 as f32, config.beta2 as f32);
        let t = self.step.min(i32::MAX as u64) as i32;
        let step = (rate / (1.0 - config.beta1.powi(t))) as f32;
        let unbias = (1.0 / (1.0 - config.beta2.powi(t))) as f32;
        for (name, gradient) in gradient {
            let known = "gradients have the names of the weights";
            let mean = self.mean.get_mut(name).expect(known);
            let square = self.square.get_mut(name).expect(known);
            let weight = self.weights.get_mut(name).expect(known);
            let keep = if is_kernel(weight) { 1.0 - (rate * config.weight_decay) as f32 } else { 1.0 };
            let moments = mean.values.iter_mut().zip(&mut square.values);
            for ((weight, (mean, square)), gradient) in
                weight.values.iter_mut().zip(moments).zip(&gradient.values)
            {
                let gradient = gradient * scale;
                *mean += (1.0 - beta1) * (gradient - *mean);
                *square += (1.0 - beta2) * (gradient * gradient - *square);
                *weight = *weight * keep - step * *mean / ((*square * unbias).sqrt() + EPSILON);
            }
        }
    }
}

/// What Adam adds to the root of the mean square.
const EPSILON: f32 = 1e-8;

/// Moves tensors towards those of the same names by a share of the difference.
fn blend(to: &mut Tensors, from: &Tensors, share: f32) {
    for (name, from) in from {
        let to = to.get_mut(name).expect("tensors that are blended have the same names");
        for (to, from) in to.values.iter_mut().zip(&from.values) {
            *to += share * (from - *to);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::WeightTensor;

    fn one(name: &str, value: f32) -> Tensors {
        Tensors::from([(name.to_owned(), WeightTensor { shape: vec![1], values: vec![value] })])
    }

    fn config() -> OptimizerConfig {
        OptimizerConfig { learning_rate: 0.1, warmup: 0, final_share: 1.0, ..OptimizerConfig::default() }
    }

    #[test]
    fn adam_takes_the_steps_of_its_paper() {
        let mut state = TrainState::new(one("w", 1.0), false);
        // The first step is the learning rate, whatever the gradient.
        state.update(&config(), 10, &one("w", 3.0), &[]);
        assert!((state.weights["w"].values[0] - 0.9).abs() < 1e-6);
        state.update(&config(), 10, &one("w", -1.0), &[]);
        let (mean, square) =
            ((0.9 * 0.1 * 3.0 - 0.1) / (1.0 - 0.81), (0.999 * 0.009 + 0.001) / (1.0 - 0.998001));
        let expected = 0.9 - 0.1 * mean / f64::sqrt(square);
        assert!((f64::from(state.weights["w"].values[0]) - expected).abs() < 1e-5);
    }

    #[test]
    fn long_gradients_are_cut_and_broken_ones_left_out() {
        let clip = |clip_norm| {
            let mut state = TrainState::new(one("w", 1.0), false);
            let norm = state.update(&OptimizerConfig { clip_norm, ..config() }, 10, &one("w", 4.0), &[]);
            (norm.norm, state.mean["w"].values[0])
        };
        let (norm, mean) = clip(None);
        assert!(norm == 4.0 && (mean - 0.4).abs() < 1e-6);
        let (norm, mean) = clip(Some(2.0));
        assert!(norm == 4.0 && (mean - 0.2).abs() < 1e-6);
        let mut state = TrainState::new(one("w", 1.0), true);
        let norm = state.update(&config(), 10, &one("w", f32::NAN), &[one("w", 7.0)]);
        assert!(!norm.finite && state.step == 1);
        assert_eq!(state.weights["w"].values, [1.0]);
    }

    #[test]
    fn statistics_and_averages_move_by_their_share() {
        let mut weights = one("bn.running_mean", 2.0);
        weights.extend(one("w", 1.0));
        let mut state = TrainState::new(weights, true);
        assert_eq!(state.mean.len(), 1);
        let config = OptimizerConfig { statistics_momentum: 0.25, average_decay: 0.999, ..config() };
        state.update(&config, 10, &one("w", 1.0), &[one("bn.running_mean", 6.0)]);
        assert_eq!(state.weights["bn.running_mean"].values, [3.0]);
        // A short average at first: two elevenths of it stay.
        assert!(
            (state.exported()["bn.running_mean"].values[0] - (2.0 * 2.0 / 11.0 + 3.0 * 9.0 / 11.0)).abs()
                < 1e-6
        );
    }
}
