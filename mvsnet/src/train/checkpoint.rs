//! The state of a run in one file, which is whole or not there, so that a run may be killed at any moment.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

use planesweep_scene::write_atomically;
use safetensors::tensor::{Dtype, SafeTensors, TensorView, serialize};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::TrainState;
use super::parameters::Tensors;
use crate::WeightTensor;

/// Key of the header's metadata; its value is JSON.
const METADATA_KEY: &str = "planesweep-train";

/// What a checkpoint says besides its tensors. The numbers of the samples follow from the step, so nothing else
/// of the random numbers need be kept.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Header {
    step: u64,
    /// What must be the same for a run to go on.
    run: String,
}

/// Why a checkpoint cannot be used.
#[derive(Debug, Error)]
pub enum TrainCheckpointError {
    /// The file cannot be read.
    #[error("cannot read the checkpoint {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The file cannot be written.
    #[error("cannot write the checkpoint {}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// It is no checkpoint, or damaged.
    #[error("{} is no checkpoint of training, or damaged: {what}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
    /// It belongs to another run.
    #[error(
        "the checkpoint {} is of a run with another configuration; begin anew in another folder, or with the old one",
        path.display()
    )]
    OtherRun {
        /// The file.
        path: PathBuf,
    },
}

impl TrainState {
    /// Writes the state of the run that `run` describes.
    pub(crate) fn save(&self, path: &Path, run: &str) -> Result<(), TrainCheckpointError> {
        let header = Header { step: self.step, run: run.to_owned() };
        let header = serde_json::to_string(&header).expect("a number and a string");
        let mut bytes = BTreeMap::new();
        for (part, tensors) in self.parts() {
            for (name, tensor) in tensors {
                let values: Vec<u8> = tensor.values.iter().flat_map(|value| value.to_le_bytes()).collect();
                bytes.insert(format!("{part}/{name}"), (tensor.shape.clone(), values));
            }
        }
        let views = bytes.iter().map(|(name, (shape, values))| {
            let view = TensorView::new(Dtype::F32, shape.clone(), values);
            (name.as_str(), view.expect("tensors have as many values as their shape"))
        });
        let bytes = serialize(views, Some(HashMap::from([(METADATA_KEY.to_owned(), header)])))
            .expect("names and sizes of the network fit a header");
        write_atomically(path, &bytes)
            .map_err(|source| TrainCheckpointError::Write { path: path.to_owned(), source })
    }

    /// Reads the state of the run that `run` describes into one of the same shape; `None` when there is no file.
    pub(crate) fn load(&self, path: &Path, run: &str) -> Result<Option<Self>, TrainCheckpointError> {
        let bytes = match std::fs::read(path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            read => read.map_err(|source| TrainCheckpointError::Read { path: path.to_owned(), source })?,
        };
        let damaged = |what: String| TrainCheckpointError::Damaged { path: path.to_owned(), what };
        let (_, metadata) = SafeTensors::read_metadata(&bytes).map_err(|error| damaged(error.to_string()))?;
        let header = metadata.metadata().as_ref().and_then(|entries| entries.get(METADATA_KEY));
        let header = header.ok_or_else(|| damaged("it has no header".to_owned()))?;
        let header: Header = serde_json::from_str(header).map_err(|error| damaged(error.to_string()))?;
        if header.run != run {
            return Err(TrainCheckpointError::OtherRun { path: path.to_owned() });
        }
        let file = SafeTensors::deserialize(&bytes).map_err(|error| damaged(error.to_string()))?;
        let read = |part: &str, like: &Tensors| -> Result<Tensors, TrainCheckpointError> {
            let tensor = |(name, like): (&String, &WeightTensor)| {
                let name_in_file = format!("{part}/{name}");
                let view = file.tensor(&name_in_file).map_err(|error| damaged(error.to_string()))?;
                if view.dtype() != Dtype::F32 || view.shape() != like.shape {
                    return Err(damaged(format!("tensor \"{name_in_file}\" has another shape")));
                }
                let values = view.data().chunks_exact(4);
                let values = values.map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
                Ok((name.clone(), WeightTensor { shape: like.shape.clone(), values }))
            };
            like.iter().map(tensor).collect()
        };
        let [weights, average, mean, square] = self.parts().map(|(part, like)| read(part, like));
        Ok(Some(Self {
            step: header.step,
            weights: weights?,
            average: average?,
            mean: mean?,
            square: square?,
        }))
    }

    fn parts(&self) -> [(&'static str, &Tensors); 4] {
        [
            ("weights", &self.weights),
            ("average", &self.average),
            ("mean", &self.mean),
            ("square", &self.square),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::super::{NetworkConfig, parameters};
    use super::*;

    #[test]
    fn states_survive_their_file_and_damage_is_an_error() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("state");
        let fresh = TrainState::new(parameters::initial(NetworkConfig::default(), 3), true);
        assert!(fresh.load(&path, "run").expect("no file is no error").is_none());
        let mut state = fresh.clone();
        state.step = 17;
        for tensors in [&mut state.mean, &mut state.square, &mut state.weights, &mut state.average] {
            for tensor in tensors.values_mut() {
                tensor.values[0] += 0.25;
            }
        }
        state.save(&path, "run").expect("saved");
        assert_eq!(fresh.load(&path, "run").expect("read").expect("there"), state);
        let error = fresh.load(&path, "other").expect_err("another run");
        assert!(matches!(error, TrainCheckpointError::OtherRun { .. }));
        let bytes = std::fs::read(&path).expect("read");
        for len in [0, 5, 200, bytes.len() - 1] {
            std::fs::write(&path, &bytes[..len]).expect("written");
            let error = fresh.load(&path, "run").expect_err("cut off");
            assert!(matches!(error, TrainCheckpointError::Damaged { .. }));
        }
    }
}
