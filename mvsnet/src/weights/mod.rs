//! Weights of the network: named tensors, and what must be known to use them rightly.

mod checkpoint;
mod embedded;
mod file;
mod folded;
pub(crate) mod layout;
mod pickle;
mod seeded;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use checkpoint::CheckpointError;
pub(crate) use folded::{FoldedConvolution, KernelOrder};
pub use pickle::PickleError;
pub(crate) use seeded::fan_in;
#[cfg(test)]
pub(crate) use seeded::uniform;

/// A hundred times the largest checkpoint of this network.
const MAX_CHECKPOINT_BYTES: u64 = 1 << 29;

/// How an image becomes the network's input.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Normalization {
    /// Zero mean and unit variance per image and channel.
    PerImage,
    /// RGB from 0 to 1.
    UnitRange,
}

/// The network that refines the depth map with the reference image (paper section 3.3).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Refinement {
    /// There is none; the initial depth map is the result.
    None,
    /// The last layer is a plain convolution with a bias, as in the paper.
    Paper,
    /// The last layer has batch normalisation and ReLU, as in the public PyTorch port, so that the
    /// residual is never negative.
    WithBnRelu,
}

/// The network of image features (paper section 3.1 and its ablation).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FeatureNetwork {
    /// Eight layers.
    #[default]
    Paper,
    /// One layer of 7x7 with stride 4.
    SingleLayer,
}

impl FeatureNetwork {
    /// Whether it is the paper's, which is what files mean that say nothing of it.
    #[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes it so")]
    pub(crate) fn is_paper(&self) -> bool {
        *self == Self::Paper
    }
}

/// How the features of the views become one cost (paper equation 2 and its ablation).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CostMetric {
    /// Element-wise population variance over all views.
    Variance,
    /// Element-wise mean over all views.
    Mean,
}

/// What must be known of weights besides their values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WeightsMetadata {
    /// How images become input.
    pub normalization: Normalization,
    /// Which refinement network there is.
    pub refinement: Refinement,
    /// How features become cost.
    pub metric: CostMetric,
    /// Which feature network there is.
    #[serde(default, skip_serializing_if = "FeatureNetwork::is_paper")]
    pub features: FeatureNetwork,
    /// Spacing of the depth hypotheses in training, in pixels of the best source view, when known. It
    /// gives the confidence its meaning.
    pub spacing_px: Option<f64>,
    /// Where the weights come from, for people.
    pub source: String,
    /// Licence of the weights, for people.
    pub licence: String,
    /// BLAKE3 hash of the file they were imported from, as 64 hexadecimal digits.
    pub original_blake3: Option<String>,
}

/// One tensor.
#[derive(Clone, Debug, PartialEq)]
pub struct WeightTensor {
    /// Sizes, outermost first.
    pub shape: Vec<usize>,
    /// Values, row-major.
    pub values: Vec<f32>,
}

/// The weights of one network, complete: every tensor is there, with its shape and finite values.
#[derive(Clone, Debug, PartialEq)]
pub struct Weights {
    metadata: WeightsMetadata,
    tensors: BTreeMap<String, WeightTensor>,
}

/// Why weights are refused.
#[derive(Debug, Error)]
pub enum WeightsError {
    /// The file cannot be read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The file is too large to be weights of this network.
    #[error("{} has {bytes} bytes, which is more than {limit} and no checkpoint of MVSNet", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// A PyTorch checkpoint is refused.
    #[error("cannot import the checkpoint {}", path.display())]
    Checkpoint {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: CheckpointError,
    },
    /// The bytes are no safetensors file, or end within its header.
    #[error(
        "not a safetensors file, or cut off within its header; PyTorch checkpoints need `weights import`"
    )]
    NotSafetensors,
    /// The bytes are a PyTorch checkpoint.
    #[error(
        "this is a PyTorch checkpoint: `planesweep weights import FILE -o FILE.safetensors` turns it into weights"
    )]
    PyTorchCheckpoint,
    /// The header is too long to be true.
    #[error("the safetensors header claims {bytes} bytes, more than {limit}")]
    HugeHeader {
        /// Its size.
        bytes: u64,
        /// The limit.
        limit: u64,
    },
    /// The header is no valid description of tensors.
    #[error("the safetensors header is damaged")]
    Header {
        /// Why.
        #[source]
        source: serde_json::Error,
    },
    /// The header does not say how to use the weights.
    #[error("the safetensors file has no planesweep metadata; make it with `weights import`")]
    NoMetadata,
    /// What it says cannot be understood.
    #[error("the planesweep metadata of the safetensors file is damaged")]
    Metadata {
        /// Why.
        #[source]
        source: serde_json::Error,
    },
    /// The file ends within a tensor.
    #[error("tensor \"{name}\" is truncated: its data should end at byte {expected}, the file has {got}")]
    Truncated {
        /// The tensor.
        name: String,
        /// Where its data should end, from the end of the header.
        expected: usize,
        /// Bytes after the header.
        got: usize,
    },
    /// The file goes on after the last tensor.
    #[error("{count} bytes follow the last tensor")]
    TrailingBytes {
        /// How many.
        count: usize,
    },
    /// A tensor of the network is not there.
    #[error("tensor \"{name}\" is missing")]
    MissingTensor {
        /// The tensor.
        name: String,
    },
    /// A tensor belongs to no layer of the network.
    #[error("tensor \"{name}\" belongs to no layer of MVSNet")]
    UnknownTensor {
        /// The tensor.
        name: String,
    },
    /// A tensor does not fit its layer.
    #[error("tensor \"{name}\" has shape {got:?}, the network needs {expected:?}")]
    WrongShape {
        /// The tensor.
        name: String,
        /// The network's shape.
        expected: Vec<usize>,
        /// The tensor's shape.
        got: Vec<usize>,
    },
    /// A tensor's elements are no f32.
    #[error("tensor \"{name}\" has elements of type {dtype}, only F32 is read")]
    WrongType {
        /// The tensor.
        name: String,
        /// Their type.
        dtype: String,
    },
    /// A value is not finite, or is a negative variance.
    #[error("tensor \"{name}\" holds the value {value}")]
    BadValue {
        /// The tensor.
        name: String,
        /// The value.
        value: f32,
    },
}

/// What a PyTorch checkpoint does not say of itself.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportOptions {
    /// How images become input.
    pub normalization: Normalization,
    /// How features become cost.
    pub metric: CostMetric,
    /// Spacing of the depth hypotheses in training, in pixels of the best source view, when known.
    pub spacing_px: Option<f64>,
    /// Where the weights come from.
    pub source: String,
    /// Their licence.
    pub licence: String,
}

impl Weights {
    /// Checks the tensors against the network that `metadata` describes.
    pub fn new(
        metadata: WeightsMetadata,
        tensors: BTreeMap<String, WeightTensor>,
    ) -> Result<Self, WeightsError> {
        layout::check(&metadata, &tensors)?;
        Ok(Self { metadata, tensors })
    }

    /// Imports a checkpoint of the public PyTorch MVSNet, of the zip format or the one before it, without
    /// ever running code from it. The refinement network is recognised by its names.
    pub fn import(path: &Path, options: ImportOptions) -> Result<Self, WeightsError> {
        let read = |source| WeightsError::Read { path: path.to_owned(), source };
        let bytes = std::fs::metadata(path).map_err(read)?.len();
        if bytes > MAX_CHECKPOINT_BYTES {
            return Err(WeightsError::TooLarge { path: path.to_owned(), bytes, limit: MAX_CHECKPOINT_BYTES });
        }
        let bytes = std::fs::read(path).map_err(read)?;
        let tensors = checkpoint::read(&bytes)
            .map_err(|source| WeightsError::Checkpoint { path: path.to_owned(), source })?;
        let ImportOptions { normalization, metric, spacing_px, source, licence } = options;
        let metadata = WeightsMetadata {
            normalization,
            refinement: layout::refinement_of(&tensors),
            metric,
            features: FeatureNetwork::Paper,
            spacing_px,
            source,
            licence,
            original_blake3: Some(blake3::hash(&bytes).to_hex().to_string()),
        };
        Self::new(metadata, tensors)
    }

    /// What must be known to use them.
    pub fn metadata(&self) -> &WeightsMetadata {
        &self.metadata
    }

    /// All tensors by name.
    pub fn tensors(&self) -> &BTreeMap<String, WeightTensor> {
        &self.tensors
    }
}
