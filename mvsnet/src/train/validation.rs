//! How good weights are on samples that they never saw, by the very inference that users run.

use planesweep_scene::{DepthHypotheses, Raster, TrainingSample, WorkingImage};
use thiserror::Error;

use super::feeder::{FeedError, SampleSource, draw};
use super::{IntervalErrors, TrainConfig};
use crate::cpu_backend::CpuBackendError;
use crate::{CpuBackend, DepthBackend, InferError, InferInput, Weights};

/// What is added to the seed of a run for its validation, so that no sample is ever trained on.
const HELD_OUT: u64 = 0x5eed_0000_0000_0000;

/// Why weights cannot be measured.
#[derive(Debug, Error)]
pub enum ValidationError {
    /// There is no backend.
    #[error("cannot use the weights")]
    Backend(#[from] CpuBackendError),
    /// An inference failed.
    #[error("cannot infer depth")]
    Infer(#[from] InferError),
    /// A sample is missing.
    #[error(transparent)]
    Feed(#[from] FeedError),
}

/// One thing to infer, with its truth.
#[derive(Clone, Debug)]
struct Case {
    views: Vec<WorkingImage>,
    hypotheses: DepthHypotheses,
    /// Fractional indices of the true depths; NaN where unknown, infinite at no hypothesis.
    truth: Raster<f32>,
}

/// Cases with a name.
#[derive(Clone, Debug)]
struct Group {
    name: String,
    cases: Vec<Case>,
}

/// What weights are measured on.
#[derive(Clone, Debug, Default)]
pub struct ValidationSet {
    groups: Vec<Group>,
    spacing_px: Option<f64>,
}

/// The errors of weights on one group of cases.
#[derive(Clone, Debug, PartialEq)]
pub struct GroupErrors {
    /// Its name.
    pub name: String,
    /// The errors of all pixels.
    pub all: IntervalErrors,
    /// The errors of pixels whose confidence is above 0.8.
    pub confident: IntervalErrors,
    /// Pixels whose surface is at no hypothesis.
    pub absent: u64,
    /// How many of these have a confidence above 0.8 all the same.
    pub absent_confident: u64,
}

impl GroupErrors {
    /// The share of pixels without a surface at any hypothesis that have a confidence above 0.8.
    pub fn absent_share(&self) -> f64 {
        self.absent_confident as f64 / self.absent.max(1) as f64
    }
}

/// The errors of weights, group by group.
#[derive(Clone, Debug, PartialEq)]
pub struct Validation {
    /// Held-out samples first, then scenes.
    pub groups: Vec<GroupErrors>,
}

impl ValidationSet {
    /// Draws held-out samples of the source.
    pub fn held_out(source: &dyn SampleSource, config: &TrainConfig) -> Result<Self, ValidationError> {
        let mut cases = Vec::new();
        let mut spacings = Vec::new();
        for number in 0..config.progress.validation_samples {
            let (sample, example) = draw(source, config, config.seed ^ HELD_OUT, number)?;
            spacings.push(example.spacing_px);
            cases.push(Case { views: sample.views, hypotheses: example.hypotheses, truth: example.truth });
        }
        spacings.sort_by(f64::total_cmp);
        let spacing_px = spacings.get(spacings.len() / 2).copied().filter(|px| *px > 0.0);
        let groups =
            if cases.is_empty() { vec![] } else { vec![Group { name: "held out".to_owned(), cases }] };
        Ok(Self { groups, spacing_px })
    }

    /// Adds the views of a scene, each with the hypotheses that its plan has.
    pub fn add_scene(
        &mut self,
        name: &str,
        views: impl IntoIterator<Item = (TrainingSample, DepthHypotheses)>,
    ) {
        let case = |(sample, hypotheses): (TrainingSample, DepthHypotheses)| {
            let last = f64::from(hypotheses.count() - 1);
            let truth = sample.depth.map(|depth| {
                let index = if *depth > 0.0 { hypotheses.index_of(f64::from(*depth)) } else { f64::NAN };
                if (0.0..=last).contains(&index) { index as f32 } else { f32::NAN }
            });
            Case { views: sample.views, hypotheses, truth }
        };
        self.groups.push(Group { name: name.to_owned(), cases: views.into_iter().map(case).collect() });
    }

    /// The median spacing of the hypotheses of held-out samples, in pixels of the best source view: what the
    /// weights are trained with.
    pub fn spacing_px(&self) -> Option<f64> {
        self.spacing_px
    }

    /// Measures weights.
    pub fn measure(&self, weights: &Weights, threads: usize) -> Result<Validation, ValidationError> {
        let mut backend = CpuBackend::new(weights, threads, None)?;
        let group = |group: &Group| {
            let mut errors = GroupErrors {
                name: group.name.clone(),
                all: IntervalErrors::default(),
                confident: IntervalErrors::default(),
                absent: 0,
                absent_confident: 0,
            };
            for Case { views, hypotheses, truth } in &group.cases {
                let sources: Vec<&WorkingImage> = views[1..].iter().collect();
                let map =
                    backend.infer(InferInput { reference: &views[0], sources: &sources, hypotheses })?;
                let truth = truth.cropped(map.width(), map.height());
                let index = |depth: &f32| hypotheses.index_of(f64::from(*depth)) as f32;
                errors.all =
                    errors.all.plus(IntervalErrors::of(map.depth.values().iter().map(index), truth.values()));
                let pairs = || truth.values().iter().zip(map.confidence.values());
                let trusted: Vec<f32> =
                    pairs().map(|(truth, sure)| if *sure > 0.8 { *truth } else { f32::NAN }).collect();
                let trusted = IntervalErrors::of(map.depth.values().iter().map(index), &trusted);
                errors.confident = errors.confident.plus(trusted);
                errors.absent += pairs().filter(|(truth, _)| truth.is_infinite()).count() as u64;
                errors.absent_confident +=
                    pairs().filter(|(truth, sure)| truth.is_infinite() && **sure > 0.8).count() as u64;
            }
            Ok(errors)
        };
        let groups = self.groups.iter().map(group).collect::<Result<_, ValidationError>>()?;
        Ok(Validation { groups })
    }
}
