//! How good a result is: depth error, DTU distances, Tanks and Temples F-score.

#![warn(missing_docs)]

mod depth;

pub use depth::{
    CurvePoint, DepthError, DepthErrorOptions, DepthErrors, ErrorStatistics, ErrorSummary, depth_error,
    truth_at_estimate,
};
