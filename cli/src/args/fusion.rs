//! What a pixel must satisfy.

use clap::Args;
use planesweep_fusion::{DepthSampling, FilterOptions};

use super::values::{positive, share};

/// What a pixel must satisfy to become a point.
#[derive(Clone, Copy, Debug, Args)]
#[command(next_help_heading = "Fusion")]
pub struct FilterArgs {
    /// Drop pixels with less confidence.
    #[arg(long, default_value_t = 0.8, value_parser = share)]
    pub min_confidence: f32,
    /// Views that must agree on a depth, the reference included. The paper says three; scripts that
    /// ask for three source views mean 4 here.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=255))]
    pub min_views: u32,
    /// Largest reprojection error, in pixels of the depth map.
    #[arg(long, default_value_t = 1.0, value_parser = positive)]
    pub max_reprojection: f32,
    /// Largest relative difference of depths.
    #[arg(long, default_value_t = 0.01, value_parser = positive)]
    pub max_depth_difference: f32,
    /// Read a neighbour's depth between its pixels only where these are valid and continuous, instead
    /// of plainly bilinear as the common scripts do.
    #[arg(long)]
    pub continuous: bool,
    /// Views that a depth map is checked against.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub fusion_views: u32,
}

impl FilterArgs {
    /// As fusion wants it.
    pub fn options(&self) -> FilterOptions {
        FilterOptions {
            min_confidence: self.min_confidence,
            min_views: self.min_views,
            max_reprojection_px: self.max_reprojection,
            max_relative_depth: self.max_depth_difference,
            sampling: if self.continuous { DepthSampling::Continuous } else { DepthSampling::Bilinear },
        }
    }
}
