//! MVSNet in the order of the paper: features, warping, cost volume, regularisation, depth, refinement.
//!
//! A [`DepthBackend`] turns a reference image, its sources and depth hypotheses into a depth map.
//! `TorchBackend` (feature `torch`) is the network with [`Weights`]; [`AnalyticBackend`] knows the depth
//! of a plane exactly and stands in for it where the network is not what is tested.

#![warn(missing_docs)]

mod analytic;
mod backend;
mod bands;
mod blocks;
mod confidence;
mod cpu_backend;
mod feature_cache;
mod input;
mod kernels;
mod rates;
pub mod train;
mod weights;

#[cfg(feature = "torch")]
mod convolution;
#[cfg(feature = "torch")]
mod cost_volume;
#[cfg(feature = "torch")]
mod depth;
#[cfg(feature = "torch")]
mod features;
#[cfg(all(test, feature = "torch"))]
mod golden;
#[cfg(feature = "torch")]
mod matrix_rate;
#[cfg(feature = "torch")]
mod network;
#[cfg(feature = "torch")]
mod refine;
#[cfg(feature = "torch")]
mod regularize;
#[cfg(feature = "torch")]
mod torch_backend;
#[cfg(feature = "torch")]
mod warp;

pub use analytic::AnalyticBackend;
pub use backend::{BackendInfo, DepthBackend, InferError, InferInput};
pub use bands::{InferCost, InferSize, Operations};
pub use cpu_backend::{CpuBackend, CpuBackendError, InferTimes};
#[cfg(feature = "torch")]
pub use matrix_rate::matrix_rate;
pub use rates::InferRates;
#[cfg(feature = "torch")]
pub use torch_backend::{PlainTimes, TorchBackend, TorchBackendError};
pub use weights::{
    CheckpointError, CostMetric, FeatureNetwork, ImportOptions, Normalization, PickleError, Refinement,
    WeightTensor, Weights, WeightsError, WeightsMetadata,
};
