//! Examples in the order of their numbers, made ahead by threads of their own.

use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use planesweep_scene::TrainingSample;
use thiserror::Error;

use super::{Example, ExampleError, Recipe, SampleShape, TrainConfig};

/// Examples that wait to be used, at most.
const AHEAD: u64 = 8;
/// How often a sample that teaches nothing is drawn anew.
const ATTEMPTS: u64 = 16;

/// Makes samples. The same seed and shape must always give the same sample.
pub trait SampleSource: Sync {
    /// Makes the sample of a seed.
    fn sample(&self, seed: u64, shape: &SampleShape) -> Result<TrainingSample, SampleError>;
}

/// Why a source made no sample.
#[derive(Debug, Error)]
#[error("cannot make the sample of seed {seed}: {why}")]
pub struct SampleError {
    /// The seed.
    pub seed: u64,
    /// Why.
    pub why: String,
}

/// Why there is no example.
#[derive(Debug, Error)]
pub enum FeedError {
    /// The source failed.
    #[error("cannot make sample {number}")]
    Source {
        /// The number.
        number: u64,
        /// Why.
        #[source]
        source: SampleError,
    },
    /// None of several samples taught anything.
    #[error("sample {number} teaches nothing, however often it is drawn")]
    Useless {
        /// The number.
        number: u64,
        /// What is wrong with the last.
        #[source]
        source: ExampleError,
    },
    /// The source panicked.
    #[error("making sample {number} panicked")]
    Panicked {
        /// The number.
        number: u64,
    },
}

/// A sample with what was drawn for it.
pub(crate) fn draw(
    source: &dyn SampleSource,
    config: &TrainConfig,
    run_seed: u64,
    number: u64,
) -> Result<(TrainingSample, Example), FeedError> {
    let mut attempt = 0;
    loop {
        let recipe = Recipe::draw(&config.samples, run_seed, number * ATTEMPTS + attempt);
        let sample = source
            .sample(recipe.seed, &recipe.shape)
            .map_err(|source| FeedError::Source { number, source })?;
        attempt += 1;
        match recipe.example(sample.clone(), &config.samples, config.network) {
            Ok(example) => return Ok((sample, example)),
            Err(source) if attempt == ATTEMPTS => return Err(FeedError::Useless { number, source }),
            Err(_) => {}
        }
    }
}

/// Hands out examples in order, whichever thread finishes first.
pub(crate) struct Feeder<'a> {
    source: &'a dyn SampleSource,
    config: &'a TrainConfig,
    state: Mutex<FeedState>,
    changed: Condvar,
}

struct FeedState {
    /// The next number that nobody makes yet.
    begun: u64,
    /// The next number that is handed out.
    wanted: u64,
    ready: BTreeMap<u64, Result<Example, FeedError>>,
    closed: bool,
}

/// Closes a feeder when it is dropped.
pub(crate) struct Closing<'f, 'a>(&'f Feeder<'a>);

impl Drop for Closing<'_, '_> {
    fn drop(&mut self) {
        self.0.lock().closed = true;
        self.0.changed.notify_all();
    }
}

impl<'a> Feeder<'a> {
    /// Begins with the example of number `first`.
    pub(crate) fn new(source: &'a dyn SampleSource, config: &'a TrainConfig, first: u64) -> Self {
        let state = FeedState { begun: first, wanted: first, ready: BTreeMap::new(), closed: false };
        Self { source, config, state: Mutex::new(state), changed: Condvar::new() }
    }

    /// Makes examples until the feeder is closed: the body of a thread.
    pub(crate) fn work(&self) {
        loop {
            let mut state = self.lock();
            while !state.closed && state.begun >= state.wanted + AHEAD {
                state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
            }
            if state.closed {
                return;
            }
            let number = state.begun;
            state.begun += 1;
            drop(state);
            let made =
                catch_unwind(AssertUnwindSafe(|| draw(self.source, self.config, self.config.seed, number)));
            let made = made.unwrap_or(Err(FeedError::Panicked { number })).map(|(_, example)| example);
            self.lock().ready.insert(number, made);
            self.changed.notify_all();
        }
    }

    /// Waits for the next example.
    pub(crate) fn next(&self) -> Result<Example, FeedError> {
        let mut state = self.lock();
        let number = state.wanted;
        loop {
            if let Some(example) = state.ready.remove(&number) {
                state.wanted += 1;
                self.changed.notify_all();
                return example;
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Examples that are ready.
    pub(crate) fn ready(&self) -> usize {
        self.lock().ready.len()
    }

    /// Lets the threads end when it is dropped.
    pub(crate) fn closing(&self) -> Closing<'_, 'a> {
        Closing(self)
    }

    fn lock(&self) -> MutexGuard<'_, FeedState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Broken;

    impl SampleSource for Broken {
        fn sample(&self, seed: u64, shape: &SampleShape) -> Result<TrainingSample, SampleError> {
            assert!(shape.views < 3, "no scene has three views");
            Err(SampleError { seed, why: "there are none".to_owned() })
        }
    }

    #[test]
    fn sources_that_fail_or_panic_give_an_error_and_threads_end() {
        let mut config = TrainConfig::default();
        for (views, panics) in [(2, false), (3, true)] {
            config.samples.views = vec![views];
            let feeder = Feeder::new(&Broken, &config, 7);
            let error = std::thread::scope(|scope| {
                scope.spawn(|| feeder.work());
                let _closing = feeder.closing();
                feeder.next().expect_err("nothing can be made")
            });
            assert_eq!(matches!(error, FeedError::Panicked { number: 7 }), panics, "{error}");
            assert_eq!(matches!(error, FeedError::Source { number: 7, .. }), !panics, "{error}");
        }
    }
}
