//! MVSNet in the order of the paper: features, warping, cost volume, regularisation, depth, refinement.

mod backend;

pub use backend::{BackendInfo, DepthBackend, InferError, InferInput};
