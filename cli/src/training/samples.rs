//! Samples of generated scenes.

use planesweep_mvsnet::train::{SampleError, SampleShape, SampleSource};
use planesweep_scene::TrainingSample;
use planesweep_synth::{TrainingOptions, training_sample};

/// An endless supply: each seed is a scene.
pub struct SynthSamples;

impl SampleSource for SynthSamples {
    fn sample(&self, seed: u64, shape: &SampleShape) -> Result<TrainingSample, SampleError> {
        let SampleShape { width, height, views } = *shape;
        let (width, height) = (width as u32, height as u32);
        Ok(training_sample(seed, &TrainingOptions { width, height, views, setting: None }))
    }
}
