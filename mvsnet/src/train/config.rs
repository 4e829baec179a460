//! What a training run is made of: the content of a configuration file.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{CostMetric, FeatureNetwork, Normalization, Refinement};

/// A training run. Everything that shapes the weights stands here; the rest follows from the seed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TrainConfig {
    /// Another seed gives other initial weights and other samples.
    pub seed: u64,
    /// Updates of the weights in all.
    pub steps: u64,
    /// Threads of a step; they change no bit of the result of our own kernels.
    pub threads: usize,
    /// Threads that make samples ahead of the steps; they change no bit.
    pub sample_threads: usize,
    /// What computes gradients: "cpu" (kernels of our own), "torch" (libtorch on the processor), "cuda" or "cuda:N".
    pub device: String,
    /// Where samples come from.
    #[serde(skip_serializing_if = "DataConfig::is_default")]
    pub data: DataConfig,
    /// The network.
    pub network: NetworkConfig,
    /// How samples are drawn.
    pub samples: SampleConfig,
    /// What is minimised.
    pub loss: LossConfig,
    /// How.
    pub optimizer: OptimizerConfig,
    /// How often the state is saved and measured.
    pub progress: ProgressConfig,
    /// What the weights file says of the weights, for people.
    pub about: AboutConfig,
}

/// The network that is trained.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NetworkConfig {
    /// How images become input.
    pub normalization: Normalization,
    /// Which refinement network there is.
    pub refinement: Refinement,
    /// How features become cost.
    pub metric: CostMetric,
    /// Which feature network there is.
    #[serde(skip_serializing_if = "FeatureNetwork::is_paper")]
    pub features: FeatureNetwork,
}

/// Where samples come from: the generator, data sets on disk, or both.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DataConfig {
    /// The share of samples that are generated; the others come from the data sets, if there are any.
    pub generated_share: f64,
    /// Folders of meshes and photographs that the generator puts among what it makes up.
    pub library: Vec<String>,
    /// MVSNet or BlendedMVS folders, or folders of such.
    pub folders: Vec<String>,
    /// Folders of DTU as it is laid out for training: its 79 training scans, and its 18 validation scans to
    /// validate on.
    pub dtu: Vec<String>,
    /// MVSNet or BlendedMVS folders that are validated on and not trained on.
    pub validation_folders: Vec<String>,
}

/// How samples are drawn. Each is drawn from its own number, so a resumed run sees the same ones.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SampleConfig {
    /// Columns and rows of the images, multiples of 32; each sample takes one of these.
    pub sizes: Vec<[usize; 2]>,
    /// Images of a sample, the reference included; each sample takes one of these.
    pub views: Vec<usize>,
    /// Fewest and most depth hypotheses, multiples of 8.
    pub depths: [u32; 2],
    /// Least and greatest spacing of the hypotheses, in pixels of the best source view, as far as `depths` allows.
    pub spacing_px: [f64; 2],
    /// The share of samples with hypotheses at equal steps of inverse depth.
    pub inverse_share: f64,
    /// By how much of its width the depth range may grow or shrink at either end.
    pub range_jitter: f64,
    /// Strength of brightness, contrast and colour changes of each view; 0 for generators that do it themselves.
    pub photometric: f64,
}

/// The loss (paper section 3.4): mean absolute error over valid pixels, in intervals of the hypotheses.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LossConfig {
    /// The weight of the refined depth against the initial one (the paper's lambda).
    pub refined_weight: f64,
    /// Errors beyond this many intervals count as this many and teach nothing.
    pub clamp: Option<f64>,
    /// The weight of pixels whose surface surely lies at no hypothesis, such as the sky's: there the probabilities are
    /// drawn towards equal ones, by their divergence, so that confidence is low. The mean is over all pixels.
    pub absent_weight: f64,
}

/// Adam (Kingma and Ba 2015) with gradient clipping and a schedule.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OptimizerConfig {
    /// The highest learning rate.
    pub learning_rate: f64,
    /// The learning rate at the last step, as a share of the highest.
    pub final_share: f64,
    /// Steps in which the learning rate rises from zero.
    pub warmup: u64,
    /// How the learning rate falls afterwards.
    pub schedule: Schedule,
    /// Decay of the mean of gradients.
    pub beta1: f64,
    /// Decay of the mean of their squares.
    pub beta2: f64,
    /// Weight decay, decoupled from the gradient (Loshchilov and Hutter 2019), on kernels only.
    pub weight_decay: f64,
    /// Gradients of a larger norm are scaled to it.
    pub clip_norm: Option<f64>,
    /// Samples whose gradients make one step.
    pub samples_per_step: usize,
    /// The share of a sample's statistics in the running statistics of batch normalisation.
    pub statistics_momentum: f64,
    /// From this step on, batch normalisation uses its running statistics, as inference does, and leaves them alone.
    pub freeze_statistics_at: Option<u64>,
    /// Decay of the average of the weights over steps, which is what is exported; 0 exports the last weights.
    pub average_decay: f64,
}

/// How the learning rate falls after the warm-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Schedule {
    /// It does not.
    Constant,
    /// Half a cosine.
    Cosine,
    /// By the same factor in each step.
    Exponential,
}

/// How often things happen, in steps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ProgressConfig {
    /// A line of progress and a point of the curves.
    pub log_every: u64,
    /// A checkpoint.
    pub checkpoint_every: u64,
    /// A validation.
    pub validate_every: u64,
    /// Samples of a validation, from seeds that are never trained on.
    pub validation_samples: u64,
    /// Scenes with ground truth that are validated on, too.
    pub validation_scenes: Vec<String>,
    /// The run ends after this step, before the schedule does, as if it were interrupted there.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stop_after: Option<u64>,
}

/// What the weights file says, for people.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AboutConfig {
    /// Where the weights come from.
    pub source: String,
    /// Their licence.
    pub licence: String,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            seed: 1,
            steps: 20_000,
            threads: 2,
            sample_threads: 1,
            device: "cpu".to_owned(),
            data: DataConfig::default(),
            network: NetworkConfig::default(),
            samples: SampleConfig::default(),
            loss: LossConfig::default(),
            optimizer: OptimizerConfig::default(),
            progress: ProgressConfig::default(),
            about: AboutConfig::default(),
        }
    }
}

impl Default for DataConfig {
    fn default() -> Self {
        Self {
            generated_share: 1.0,
            library: Vec::new(),
            folders: Vec::new(),
            dtu: Vec::new(),
            validation_folders: Vec::new(),
        }
    }
}

impl DataConfig {
    fn is_default(&self) -> bool {
        *self == Self::default()
    }

    /// Whether anything is stored to train on.
    fn has_data_sets(&self) -> bool {
        !self.folders.is_empty() || !self.dtu.is_empty()
    }
}

impl Default for NetworkConfig {
    fn default() -> Self {
        Self {
            normalization: Normalization::PerImage,
            refinement: Refinement::None,
            metric: CostMetric::Variance,
            features: FeatureNetwork::Paper,
        }
    }
}

impl Default for SampleConfig {
    fn default() -> Self {
        Self {
            sizes: vec![[320, 256]],
            views: vec![3],
            depths: [32, 96],
            spacing_px: [0.7, 2.0],
            inverse_share: 0.5,
            range_jitter: 0.15,
            photometric: 0.0,
        }
    }
}

impl Default for LossConfig {
    fn default() -> Self {
        Self { refined_weight: 1.0, clamp: Some(30.0), absent_weight: 0.0 }
    }
}

impl Default for OptimizerConfig {
    fn default() -> Self {
        Self {
            learning_rate: 1e-3,
            final_share: 0.02,
            warmup: 100,
            schedule: Schedule::Cosine,
            beta1: 0.9,
            beta2: 0.999,
            weight_decay: 0.0,
            clip_norm: Some(10.0),
            samples_per_step: 1,
            statistics_momentum: 0.1,
            freeze_statistics_at: None,
            average_decay: 0.0,
        }
    }
}

impl Default for ProgressConfig {
    fn default() -> Self {
        Self {
            log_every: 20,
            checkpoint_every: 200,
            validate_every: 1000,
            validation_samples: 16,
            validation_scenes: Vec::new(),
            stop_after: None,
        }
    }
}

impl Default for AboutConfig {
    fn default() -> Self {
        Self { source: "planesweep train".to_owned(), licence: "MIT OR Apache-2.0".to_owned() }
    }
}

/// A number of the configuration that makes no sense.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{field} must be {expected}")]
pub struct ConfigError {
    /// The field, with its section.
    pub field: &'static str,
    /// What it should be.
    pub expected: &'static str,
}

impl TrainConfig {
    /// Checks every number against what it means.
    pub fn checked(self) -> Result<Self, ConfigError> {
        let SampleConfig { sizes, views, depths, spacing_px, inverse_share, range_jitter, photometric } =
            &self.samples;
        let LossConfig { refined_weight, clamp, absent_weight } = self.loss;
        let o = &self.optimizer;
        let share = |value: f64| (0.0..=1.0).contains(&value);
        let positive = |value: f64| value > 0.0 && value.is_finite();
        let size = |size: &[usize; 2]| size.iter().all(|s| (32..=8192).contains(s) && s.is_multiple_of(32));
        let [fewest, most] = *depths;
        let [finest, widest] = *spacing_px;
        let checks = [
            (self.steps > 0, "steps", "at least 1"),
            ((1..=1024).contains(&self.threads), "threads", "from 1 to 1024"),
            ((1..=1024).contains(&self.sample_threads), "sample_threads", "from 1 to 1024"),
            (
                share(self.data.generated_share)
                    && (self.data.generated_share < 1.0) == self.data.has_data_sets(),
                "data.generated_share",
                "below 1 with data.folders or data.dtu, and 1 without",
            ),
            (!sizes.is_empty() && sizes.iter().all(size), "samples.sizes", "multiples of 32 up to 8192"),
            (
                !views.is_empty() && views.iter().all(|n| (2..=32).contains(n)),
                "samples.views",
                "numbers from 2 to 32",
            ),
            (
                fewest >= 8 && fewest <= most && most <= 1024 && depths.iter().all(|d| d.is_multiple_of(8)),
                "samples.depths",
                "two multiples of 8 up to 1024, the smaller first",
            ),
            (
                positive(finest) && positive(widest) && finest <= widest,
                "samples.spacing_px",
                "two positive numbers, the smaller first",
            ),
            (share(*inverse_share), "samples.inverse_share", "from 0 to 1"),
            ((0.0..0.45).contains(range_jitter), "samples.range_jitter", "from 0 to 0.45"),
            (share(*photometric), "samples.photometric", "from 0 to 1"),
            (
                refined_weight >= 0.0 && refined_weight.is_finite(),
                "loss.refined_weight",
                "0 or a positive number",
            ),
            (clamp.is_none_or(positive), "loss.clamp", "a positive number"),
            (
                absent_weight >= 0.0 && absent_weight.is_finite(),
                "loss.absent_weight",
                "0 or a positive number",
            ),
            (positive(o.learning_rate), "optimizer.learning_rate", "a positive number"),
            (o.final_share > 0.0 && share(o.final_share), "optimizer.final_share", "above 0 and at most 1"),
            (share(o.beta1) && o.beta1 < 1.0, "optimizer.beta1", "at least 0 and below 1"),
            (share(o.beta2) && o.beta2 < 1.0, "optimizer.beta2", "at least 0 and below 1"),
            (share(o.weight_decay), "optimizer.weight_decay", "from 0 to 1"),
            (o.clip_norm.is_none_or(positive), "optimizer.clip_norm", "a positive number"),
            ((1..=4096).contains(&o.samples_per_step), "optimizer.samples_per_step", "from 1 to 4096"),
            (
                o.statistics_momentum > 0.0 && share(o.statistics_momentum),
                "optimizer.statistics_momentum",
                "above 0 and at most 1",
            ),
            (
                share(o.average_decay) && o.average_decay < 1.0,
                "optimizer.average_decay",
                "at least 0 and below 1",
            ),
            (self.progress.log_every > 0, "progress.log_every", "at least 1"),
            (self.progress.checkpoint_every > 0, "progress.checkpoint_every", "at least 1"),
            (self.progress.validate_every > 0, "progress.validate_every", "at least 1"),
        ];
        match checks.into_iter().find(|(fine, ..)| !fine) {
            Some((_, field, expected)) => Err(ConfigError { field, expected }),
            None => Ok(self),
        }
    }
}

impl OptimizerConfig {
    /// The learning rate of a step, counted from 0, in a run of `steps`.
    pub(crate) fn learning_rate_at(&self, step: u64, steps: u64) -> f64 {
        if step < self.warmup {
            return self.learning_rate * (step + 1) as f64 / self.warmup as f64;
        }
        let last = steps.saturating_sub(1).max(self.warmup + 1);
        let done = ((step - self.warmup) as f64 / (last - self.warmup) as f64).min(1.0);
        let share = match self.schedule {
            Schedule::Constant => 1.0,
            Schedule::Cosine => {
                let fall = 0.5 * (1.0 + (std::f64::consts::PI * done).cos());
                self.final_share + (1.0 - self.final_share) * fall
            }
            Schedule::Exponential => self.final_share.powf(done),
        };
        self.learning_rate * share
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn learning_rate_rises_then_falls_to_its_share() {
        for schedule in [Schedule::Cosine, Schedule::Exponential] {
            let optimizer = OptimizerConfig {
                learning_rate: 1.0,
                final_share: 0.1,
                warmup: 10,
                schedule,
                ..OptimizerConfig::default()
            };
            let rates: Vec<f64> = (0..100).map(|step| optimizer.learning_rate_at(step, 100)).collect();
            assert!(rates[..10].windows(2).all(|pair| pair[0] < pair[1]) && rates[9] == 1.0);
            assert!(rates[10..].windows(2).all(|pair| pair[0] > pair[1]), "{rates:?}");
            assert!((rates[99] - 0.1).abs() < 1e-12 && rates[10] == 1.0);
        }
        let optimizer = OptimizerConfig { schedule: Schedule::Constant, ..OptimizerConfig::default() };
        assert_eq!(optimizer.learning_rate_at(19_999, 20_000), 1e-3);
    }

    #[test]
    fn defaults_are_sensible_and_nonsense_is_named() {
        assert!(TrainConfig::default().checked().is_ok());
        let mut config = TrainConfig::default();
        config.samples.sizes.push([320, 250]);
        let error = config.checked().expect_err("250 is no multiple of 32");
        assert_eq!(error.to_string(), "samples.sizes must be multiples of 32 up to 8192");
        let mut config = TrainConfig::default();
        config.optimizer.learning_rate = f64::NAN;
        assert_eq!(config.checked().expect_err("no number").field, "optimizer.learning_rate");
    }
}
