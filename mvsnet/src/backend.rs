//! What every implementation of the network offers.

use planesweep_scene::{DepthHypotheses, DepthMap, WorkingImage};
use thiserror::Error;

/// One inference: a reference image, its sources, and the planes to sweep.
#[derive(Clone, Copy, Debug)]
pub struct InferInput<'a> {
    /// The reference image, not padded.
    pub reference: &'a WorkingImage,
    /// The source images, best first; at least one; sizes may differ.
    pub sources: &'a [&'a WorkingImage],
    /// Depth planes of the reference camera.
    pub hypotheses: &'a DepthHypotheses,
}

/// What a backend says of itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BackendInfo {
    /// For example "torch" or "analytic".
    pub name: String,
    /// For example "cpu" or "cuda:0".
    pub device: String,
}

/// Why an inference gave no depth map.
#[derive(Debug, Error)]
pub enum InferError {
    /// There is no source image.
    #[error("cannot infer depth without a source image")]
    NoSources,
    /// Memory did not suffice; a smaller setting may.
    #[error("out of memory on {device} while {doing}")]
    OutOfMemory {
        /// The device.
        device: String,
        /// The step of the network.
        doing: &'static str,
    },
    /// The tensor library failed.
    #[error("{doing} failed on {device}: {message}")]
    Library {
        /// The step of the network.
        doing: &'static str,
        /// The device.
        device: String,
        /// What the library said.
        message: String,
    },
}

/// An implementation of the network. One OS thread owns it for as long as it lives.
pub trait DepthBackend {
    /// Name and device.
    fn info(&self) -> BackendInfo;

    /// Infers depth and confidence at a quarter of the reference image's size (rounded up), with the
    /// colours of the reference image sampled there.
    fn infer(&mut self, input: InferInput<'_>) -> Result<DepthMap, InferError>;
}
