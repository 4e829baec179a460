//! What a pixel must satisfy.

use clap::{Args, ValueEnum};
use planesweep_fusion::{DepthSampling, FilterOptions, FusionMethod};

use super::values::{positive, share};

/// What a pixel must satisfy to become a point.
#[derive(Clone, Copy, Debug, Args)]
#[command(next_help_heading = "Fusion")]
pub struct FilterArgs {
    /// What decides whether a depth is kept.
    #[arg(long, value_enum, default_value = "consistency")]
    pub fusion: FusionArg,
    /// Drop pixels with less confidence [default: 0.8].
    #[arg(long, value_parser = share)]
    pub min_confidence: Option<f32>,
    /// Views that must agree on a depth, the reference included. The paper says three; scripts that
    /// ask for three source views mean 4 here. With dynamic consistency, the fewest that may agree [default: 3].
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=255))]
    pub min_views: Option<u32>,
    /// Largest reprojection error, in pixels of the depth map [default: 1].
    #[arg(long, value_parser = positive)]
    pub max_reprojection: Option<f32>,
    /// Largest relative difference of depths [default: 0.01].
    #[arg(long, value_parser = positive)]
    pub max_depth_difference: Option<f32>,
    /// Read a neighbour's depth between its pixels only where these are valid and continuous, instead
    /// of plainly bilinear as the common scripts do.
    #[arg(long)]
    pub continuous: bool,
    /// Views that a depth map is checked against.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub fusion_views: u32,
    /// Fuse at the resolution of the working images, four times that of the network's depth maps: these are upsampled,
    /// guided by the photographs. Thresholds stay in pixels of the network's depth maps.
    #[arg(long)]
    pub full_resolution: bool,
    /// Emit a surface from every view that keeps it, not only from the one that sees it best.
    #[arg(long)]
    pub every_view: bool,
}

/// [`FusionMethod`] on the command line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum FusionArg {
    /// The nearest depth that not more views see through than it is hidden from (stability-based,
    /// Merrell et al.).
    Visibility,
    /// The most confident depth whose supporters outweigh its opponents (confidence-based).
    VisibilityConfidence,
    /// The view's own depth, if enough views agree (the paper's filter).
    Consistency,
    /// The same with thresholds that relax as more views agree.
    Dynamic,
}

impl From<FusionArg> for FusionMethod {
    fn from(arg: FusionArg) -> Self {
        match arg {
            FusionArg::Visibility => Self::Visibility,
            FusionArg::VisibilityConfidence => Self::VisibilityConfidence,
            FusionArg::Consistency => Self::Consistency,
            FusionArg::Dynamic => Self::Dynamic,
        }
    }
}

impl FilterArgs {
    /// As fusion wants it.
    pub fn options(&self) -> FilterOptions {
        self.options_over(FilterOptions { method: self.fusion.into(), ..FilterOptions::default() })
    }

    /// What was given, over these defaults.
    pub fn options_over(&self, defaults: FilterOptions) -> FilterOptions {
        FilterOptions {
            method: defaults.method,
            min_confidence: self.min_confidence.unwrap_or(defaults.min_confidence),
            min_views: self.min_views.unwrap_or(defaults.min_views),
            max_reprojection_px: self.max_reprojection.unwrap_or(defaults.max_reprojection_px),
            max_relative_depth: self.max_depth_difference.unwrap_or(defaults.max_relative_depth),
            sampling: if self.continuous { DepthSampling::Continuous } else { defaults.sampling },
            network_pixel: defaults.network_pixel,
        }
    }
}
