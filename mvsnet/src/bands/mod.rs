//! The network in bounded memory (paper section 3, streamed over rows).
//!
//! Rows of the cost volume go in at the top; every layer keeps only what later rows still need; finished
//! rows of the depth map come out. No row is computed twice, and how many are taken at a time changes no
//! bit of them.

mod halo;
mod images;
mod layers;
mod predict;
mod stages;
mod volume;

pub(crate) use halo::{rows_for_depth, rows_for_refinement};
pub(crate) use images::{features, refined};
pub(crate) use layers::{FeatureLayers, RegularizationLayers, refinement_layers};
pub use predict::{InferCost, InferSize, Operations};
pub(crate) use predict::{STEP_ROWS, cache_bytes, predict, step_rows};
pub(crate) use stages::{Row, taps};
pub(crate) use volume::{Regularization, VolumeTimes};
