//! How good a result is: depth error, DTU distances, Tanks and Temples F-score, ETH3D accuracy and completeness.

#![warn(missing_docs)]

mod depth;
mod depth_means;
mod down_sample;
pub mod dtu;
pub mod eth3d;
mod nearest;
mod photometric;
mod similarity;
mod statistics;
pub mod tnt;

pub use depth::{
    CurvePoint, DepthError, DepthErrorOptions, DepthErrors, ErrorStatistics, ErrorSummary, depth_error,
    truth_at_estimate,
};
pub use depth_means::{DepthMeans, SummaryMeans};
pub use down_sample::voxel_down_sample;
pub use photometric::{PhotometricErrors, PhotometricPoint, photometric_error};
