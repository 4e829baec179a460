//! Training from scratch (paper section 3.4 and 5.1): examples, gradients, updates, checkpoints, validation.
//!
//! A [`Trainer`] takes examples in the order of their numbers from a [`SampleSource`], which threads run ahead of
//! the steps. All that is random follows from the seed and the number of a sample, so a run that was killed goes
//! on from its checkpoint to the same weights as an undisturbed one.

mod checkpoint;
mod config;
mod engine;
mod example;
mod feeder;
mod network;
mod optimizer;
mod parameters;
#[cfg(all(test, feature = "torch"))]
mod tests;
#[cfg(feature = "torch")]
mod torch_engine;
mod trainer;
mod validation;

pub use checkpoint::TrainCheckpointError;
pub use config::{
    AboutConfig, ConfigError, DataConfig, LossConfig, NetworkConfig, OptimizerConfig, ProgressConfig,
    SampleConfig, Schedule, TrainConfig,
};
pub use engine::{BatchStatistics, EngineError, Gradient, GradientEngine, GradientOptions, IntervalErrors};
pub use example::{Example, ExampleError, Recipe, SampleShape};
pub use feeder::{FeedError, SampleError, SampleSource};
pub use network::KernelEngine;
pub use optimizer::{GradientNorm, TrainState};
pub use parameters::{Tensors, initial as initial_weights};
#[cfg(feature = "torch")]
pub use torch_engine::TorchEngine;
pub use trainer::{StepReport, TrainError, TrainEvent, Trainer, Wish};
pub use validation::{GroupErrors, Validation, ValidationError, ValidationSet};
