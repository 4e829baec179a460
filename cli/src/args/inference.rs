//! What shapes the plan, and what infers.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use planesweep_plan::{PlanOptions, SamplingChoice};

use super::FilterArgs;
use super::values::{bytes, depth_range, device};

/// A set of choices under one name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Quality {
    /// 640 pixels, 3 views: a look at the scene.
    Preview,
    /// 1600 pixels, 5 views.
    Normal,
    /// 1920 pixels, 5 views, 256 depths: the paper's Tanks and Temples setting.
    Paper,
}

/// Pixels of the working image to one of the network's depth map.
const NETWORK_PIXEL: f32 = 4.0;

/// What shapes the plan.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Inference")]
pub struct PlanArgs {
    /// A set of choices; each can be overridden.
    #[arg(long, value_enum, default_value = "normal")]
    pub quality: Quality,
    /// Images per depth map, the reference included.
    #[arg(long, value_parser = clap::value_parser!(u32).range(2..=32))]
    pub views: Option<u32>,
    /// Longest side of the images that the network sees, in pixels.
    #[arg(long, value_parser = clap::value_parser!(u32).range(32..=16384))]
    pub max_size: Option<u32>,
    /// Number of depth hypotheses; by default the resolution decides.
    #[arg(long, value_parser = clap::value_parser!(u32).range(8..=4096))]
    pub depths: Option<u32>,
    /// Spacing of the depth hypotheses.
    #[arg(long, value_enum, default_value = "auto")]
    pub sampling: SamplingArg,
    /// Infer each view in bands of at least this many rows of the image, for several workers at once.
    /// Changes no bit of the result.
    #[arg(long, value_name = "ROWS", value_parser = clap::value_parser!(u32).range(512..=16384))]
    pub band_rows: Option<u32>,
    /// Nearest and farthest depth of every view, in scene units; by default the sparse points decide.
    #[arg(long, value_name = "NEAR,FAR", value_parser = depth_range)]
    pub depth_range: Option<(f64, f64)>,
}

/// [`SamplingChoice`] on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum SamplingArg {
    /// Inverse where the range is wide.
    Auto,
    /// Equal steps of depth.
    Uniform,
    /// Equal steps of inverse depth.
    Inverse,
}

impl PlanArgs {
    /// As the plan wants it.
    pub fn options(&self, filter: Option<&FilterArgs>) -> PlanOptions {
        let (size, views, depths) = match self.quality {
            Quality::Preview => (640, 3, None),
            Quality::Normal => (1600, 5, None),
            Quality::Paper => (1920, 5, Some(256)),
        };
        let defaults = PlanOptions::default();
        let full_resolution = filter.is_some_and(|filter| filter.full_resolution);
        let mut criteria = filter.map_or(defaults.filter, FilterArgs::options);
        if full_resolution {
            criteria.network_pixel = NETWORK_PIXEL;
        }
        PlanOptions {
            views: self.views.unwrap_or(views),
            fusion_views: filter.map_or(defaults.fusion_views, |f| f.fusion_views),
            max_size: Some(self.max_size.unwrap_or(size)),
            depths: self.depths.or(depths),
            sampling: match self.sampling {
                SamplingArg::Auto => SamplingChoice::Auto,
                SamplingArg::Uniform => SamplingChoice::Uniform,
                SamplingArg::Inverse => SamplingChoice::Inverse,
            },
            depth_range: self.depth_range,
            band_rows: self.band_rows,
            filter: criteria,
            full_resolution,
            once_per_surface: filter.map_or(defaults.once_per_surface, |f| !f.every_view),
        }
    }
}

/// The network.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Network")]
pub struct NetworkArgs {
    /// The weights, as `weights import` and `train` write them; by default those that come with the program.
    #[arg(long, env = "PLANESWEEP_WEIGHTS", value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Where to infer: cpu, torch (the plain network of libtorch on the processor), cuda or cuda:N.
    #[arg(long, default_value = "cpu", value_parser = device)]
    pub device: String,
    /// Memory for inference, such as 800M or 2G, shared by all workers; less than the least that is
    /// possible is taken for that. Changes no bit of the result.
    #[arg(long, value_name = "SIZE", value_parser = bytes)]
    pub memory: Option<u64>,
}
