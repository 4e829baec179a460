//! What the network learns from.

use crate::{DepthRange, Raster, WorkingImage};

/// Photographs of one surface and the depth that one of them sees: what generators and data sets give
/// and training takes.
#[derive(Clone, Debug, PartialEq)]
pub struct TrainingSample {
    /// The reference view, then its sources, best first.
    pub views: Vec<WorkingImage>,
    /// True depth of the reference, z in scene units, at the pixels of its depth map (a quarter of the
    /// image, [`crate::Intrinsics::quartered`]); 0 where it is unknown or where no source sees the surface,
    /// infinite where there surely is none.
    pub depth: Raster<f32>,
    /// The depth range that a plan would have searched.
    pub range: DepthRange,
}
