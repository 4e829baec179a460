//! The loop: examples in, updates of the weights, checkpoints, validation.

use std::path::{Path, PathBuf};

use rayon::{ThreadPool, ThreadPoolBuilder};
use thiserror::Error;

use super::checkpoint::TrainCheckpointError;
use super::engine::{BatchStatistics, EngineError, GradientEngine, GradientOptions, IntervalErrors};
use super::feeder::{FeedError, Feeder, SampleSource};
use super::parameters::{Tensors, initial, metadata, to_weights};
use super::validation::{Validation, ValidationError, ValidationSet};
use super::{TrainConfig, TrainState};
use crate::{Weights, WeightsError};

/// Why training stopped.
#[derive(Debug, Error)]
pub enum TrainError {
    /// A checkpoint cannot be read or written.
    #[error(transparent)]
    Checkpoint(#[from] TrainCheckpointError),
    /// There is no example.
    #[error(transparent)]
    Feed(#[from] FeedError),
    /// There is no gradient.
    #[error("cannot compute the gradient of step {step}")]
    Gradient {
        /// The step.
        step: u64,
        /// Why.
        #[source]
        source: EngineError,
    },
    /// The loss is no number, step after step.
    #[error(
        "gradients have not been finite for {count} steps up to step {step}; a lower learning rate may help"
    )]
    Diverged {
        /// The step.
        step: u64,
        /// How many.
        count: u64,
    },
    /// The weights cannot be exported.
    #[error("cannot export weights that broke in training")]
    Export(#[from] WeightsError),
    /// The validation failed.
    #[error("cannot validate")]
    Validation(#[from] ValidationError),
    /// The system gives no threads.
    #[error("cannot start threads")]
    Threads(#[source] rayon::ThreadPoolBuildError),
}

/// Steps without a finite gradient after which training gives up.
const MOST_BROKEN_STEPS: u64 = 20;

/// What a step did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StepReport {
    /// Steps done, this one included.
    pub step: u64,
    /// The mean loss of its samples.
    pub loss: f64,
    /// Errors of the initial depth.
    pub initial: IntervalErrors,
    /// Errors of the refined depth, where there is a refinement.
    pub refined: Option<IntervalErrors>,
    /// The norm of the gradient before clipping.
    pub gradient_norm: f64,
    /// The learning rate.
    pub learning_rate: f64,
    /// Examples that waited when the step began; none means that steps wait for samples.
    pub examples_ready: usize,
}

/// What happens in a run, as it happens.
#[derive(Clone, Debug)]
pub enum TrainEvent<'a> {
    /// A run begins, or goes on after this many steps.
    Begun {
        /// Steps done before.
        step: u64,
    },
    /// A step was done.
    Step(StepReport),
    /// The weights were measured on samples they never saw.
    Validated {
        /// Steps done.
        step: u64,
        /// The errors.
        validation: &'a Validation,
    },
    /// A checkpoint was written, and these are the weights of that moment.
    Saved {
        /// Steps done.
        step: u64,
        /// The weights to use.
        weights: &'a Weights,
    },
}

/// What the one who watches a run wants.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wish {
    /// The run goes on.
    GoOn,
    /// The run saves its state and ends.
    Stop,
}

/// A run of training.
pub struct Trainer<'a> {
    config: &'a TrainConfig,
    run: String,
    checkpoint: PathBuf,
    state: TrainState,
    engine: Box<dyn GradientEngine>,
}

impl<'a> Trainer<'a> {
    /// A run with this configuration, which has been checked. It goes on where the checkpoint in this file ends,
    /// or begins anew when there is none.
    pub fn new(
        config: &'a TrainConfig,
        checkpoint: &Path,
        engine: Box<dyn GradientEngine>,
    ) -> Result<Self, TrainError> {
        let run = identity(config);
        let fresh =
            TrainState::new(initial(config.network, config.seed), config.optimizer.average_decay > 0.0);
        let state = fresh.load(checkpoint, &run)?.unwrap_or(fresh);
        Ok(Self { config, run, checkpoint: checkpoint.to_owned(), state, engine })
    }

    /// Trains to the end, or until `watch` wishes to stop. Gives the weights.
    pub fn run(
        &mut self,
        source: &dyn SampleSource,
        validation: &ValidationSet,
        watch: &mut dyn FnMut(TrainEvent<'_>) -> Wish,
    ) -> Result<Weights, TrainError> {
        let config = self.config;
        let samples = config.optimizer.samples_per_step as u64;
        let feeder = Feeder::new(source, config, self.state.step * samples);
        let pools: Vec<ThreadPool> = (0..config.sample_threads)
            .map(|_| ThreadPoolBuilder::new().num_threads(1).build())
            .collect::<Result<_, _>>()
            .map_err(TrainError::Threads)?;
        std::thread::scope(|scope| {
            for pool in &pools {
                let feeder = &feeder;
                scope.spawn(move || pool.install(|| feeder.work()));
            }
            // Its threads end however the steps do, a panic included.
            let _closing = feeder.closing();
            self.steps(&feeder, validation, watch)
        })?;
        self.weights(validation)
    }

    fn steps(
        &mut self,
        feeder: &Feeder<'_>,
        validation: &ValidationSet,
        watch: &mut dyn FnMut(TrainEvent<'_>) -> Wish,
    ) -> Result<(), TrainError> {
        let config = self.config;
        let progress = &config.progress;
        let mut broken = 0;
        let mut wish = watch(TrainEvent::Begun { step: self.state.step });
        let end = progress.stop_after.unwrap_or(config.steps).min(config.steps);
        while self.state.step < end && wish == Wish::GoOn {
            let (report, finite) = self.step(feeder)?;
            broken = if finite { 0 } else { broken + 1 };
            if broken == MOST_BROKEN_STEPS {
                return Err(TrainError::Diverged { step: report.step, count: broken });
            }
            wish = watch(TrainEvent::Step(report));
            let (step, last) = (report.step, report.step == end || wish == Wish::Stop);
            if (step.is_multiple_of(progress.validate_every) && wish == Wish::GoOn) || step == end {
                let weights = self.weights(validation)?;
                let measured = validation.measure(&weights, config.threads)?;
                watch(TrainEvent::Validated { step, validation: &measured });
            }
            if step.is_multiple_of(progress.checkpoint_every) || last {
                self.state.save(&self.checkpoint, &self.run)?;
                let weights = self.weights(validation)?;
                watch(TrainEvent::Saved { step, weights: &weights });
            }
        }
        Ok(())
    }

    fn step(&mut self, feeder: &Feeder<'_>) -> Result<(StepReport, bool), TrainError> {
        let config = self.config;
        let step = self.state.step;
        let frozen = config.optimizer.freeze_statistics_at.is_some_and(|from| step >= from);
        let options = GradientOptions {
            network: config.network,
            loss: config.loss,
            statistics: if frozen { BatchStatistics::Running } else { BatchStatistics::Own },
        };
        let count = config.optimizer.samples_per_step;
        let examples_ready = feeder.ready();
        let (mut loss, mut initial, mut refined) = (0.0, IntervalErrors::default(), None);
        let mut sum: Option<Tensors> = None;
        let mut statistics = Vec::with_capacity(count);
        for _ in 0..count {
            let example = feeder.next()?;
            let gradient = self
                .engine
                .gradient(&self.state.weights, &example, &options)
                .map_err(|source| TrainError::Gradient { step, source })?;
            loss += gradient.loss / count as f64;
            initial = initial.plus(gradient.initial);
            refined = gradient.refined.map(|errors| errors.plus(refined.unwrap_or_default()));
            sum = Some(match sum {
                None => gradient.weights,
                Some(sum) => added(sum, &gradient.weights),
            });
            statistics.push(gradient.statistics);
        }
        let mut mean = sum.unwrap_or_default();
        for value in mean.values_mut().flat_map(|tensor| &mut tensor.values) {
            *value /= count as f32;
        }
        let learning_rate = config.optimizer.learning_rate_at(step, config.steps);
        let norm = self.state.update(&config.optimizer, config.steps, &mean, &statistics);
        let report = StepReport {
            step: self.state.step,
            loss,
            initial,
            refined,
            gradient_norm: norm.norm,
            learning_rate,
            examples_ready,
        };
        Ok((report, norm.finite))
    }

    /// The weights as they are, for use.
    fn weights(&self, validation: &ValidationSet) -> Result<Weights, TrainError> {
        let metadata = metadata(self.config.network, &self.config.about, validation.spacing_px());
        Ok(to_weights(metadata, self.state.exported())?)
    }
}

fn added(mut sum: Tensors, more: &Tensors) -> Tensors {
    for (sum, more) in sum.values_mut().zip(more.values()) {
        for (sum, more) in sum.values.iter_mut().zip(&more.values) {
            *sum += more;
        }
    }
    sum
}

/// All of a configuration that shapes the weights, in a form that can be compared. The number of steps belongs to
/// it, for the learning rate follows from it.
fn identity(config: &TrainConfig) -> String {
    let defaults = TrainConfig::default();
    let shaping = TrainConfig {
        threads: defaults.threads,
        sample_threads: defaults.sample_threads,
        progress: defaults.progress,
        about: defaults.about,
        ..config.clone()
    };
    serde_json::to_string(&shaping).expect("a configuration has only numbers, strings and lists")
}
