//! Where samples come from: the generator, data sets on disk, or both.

use std::path::Path;

use anyhow::{Context, Result};
use planesweep_mvsnet::train::{DataConfig, SampleError, SampleShape, SampleSource};
use planesweep_scene::TrainingSample;
use planesweep_synth::{
    DataSet, DataSetError, DtuSplit, Library, SampleShape as StoredShape, TrainingOptions,
    training_sample_with,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// How often another stored sample is taken for one without any depth.
const ATTEMPTS: u32 = 16;

/// An endless supply: each seed is a sample.
pub struct Samples {
    generated_share: f64,
    library: Library,
    data_sets: Vec<DataSet>,
}

impl Samples {
    /// Those to train on.
    pub fn to_train(data: &DataConfig) -> Result<Self> {
        Self::open(data, &data.folders, DtuSplit::Train)
    }

    /// Those to validate on: of the data sets, only what is kept from training.
    pub fn held_out(data: &DataConfig) -> Result<Self> {
        Self::open(data, &data.validation_folders, DtuSplit::Validation)
    }

    fn open(data: &DataConfig, folders: &[String], split: DtuSplit) -> Result<Self> {
        let mut library = Library::default();
        for folder in &data.library {
            library.add_folder(Path::new(folder))?;
        }
        let folders = folders.iter().map(|folder| DataSet::open(Path::new(folder)));
        let dtu = data.dtu.iter().map(|folder| DataSet::open_dtu(Path::new(folder), split));
        let data_sets: Vec<_> =
            folders.chain(dtu).collect::<Result<_, _>>().context("cannot open a data set")?;
        let generated_share = if data_sets.is_empty() { 1.0 } else { data.generated_share };
        Ok(Self { generated_share, library, data_sets })
    }

    /// A stored sample; each reference view under each light is as likely as any other.
    fn stored(&self, rng: &mut ChaCha8Rng, shape: &SampleShape) -> Result<TrainingSample, DataSetError> {
        let SampleShape { width, height, views } = *shape;
        let shape = StoredShape { width: width as u32, height: height as u32, views };
        let all: usize = self.data_sets.iter().map(DataSet::len).sum();
        let mut attempt = 1;
        loop {
            let mut index = rng.random_range(0..all);
            let mut set = self.data_sets.iter();
            let mut at = set.next().expect("something is stored");
            while index >= at.len() {
                index -= at.len();
                at = set.next().expect("the index is below the sum of the lengths");
            }
            match at.sample(index, &shape, rng.random()) {
                Err(DataSetError::NoDepth { .. }) if attempt < ATTEMPTS => attempt += 1,
                result => return result,
            }
        }
    }
}

impl SampleSource for Samples {
    fn sample(&self, seed: u64, shape: &SampleShape) -> Result<TrainingSample, SampleError> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        // The generator draws from the seed's lower streams.
        rng.set_stream(u64::MAX);
        if rng.random_bool(self.generated_share) {
            let SampleShape { width, height, views } = *shape;
            let options =
                TrainingOptions { width: width as u32, height: height as u32, views, setting: None };
            return Ok(training_sample_with(seed, &options, &self.library));
        }
        self.stored(&mut rng, shape).map_err(|error| SampleError { seed, why: chain(&error) })
    }
}

/// An error with all that caused it.
fn chain(error: &DataSetError) -> String {
    let mut text = error.to_string();
    let mut cause = std::error::Error::source(error);
    while let Some(error) = cause {
        text.push_str(&format!(": {error}"));
        cause = error.source();
    }
    text
}
