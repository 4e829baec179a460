//! How a scene is read.

use clap::{Args, ValueEnum};
use planesweep_scene::{DepthLine, PixelCentre, ReadOptions};

/// What cannot be known from a scene's files.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Reading the scene")]
pub struct ReadArgs {
    /// Leave out views with an impossible camera, name or size instead of refusing the scene.
    #[arg(long)]
    pub skip_bad_views: bool,
    /// Meaning of the two numbers of a short depth line in a cam.txt.
    #[arg(long, value_enum, default_value = "auto")]
    pub depth_line: DepthLineArg,
    /// Where the principal point of a cam.txt counts from: integer puts the top-left pixel's centre
    /// at (0, 0), half at (0.5, 0.5).
    #[arg(long, value_enum, default_value = "integer")]
    pub pixel_centre: PixelCentreArg,
    /// Factor on the depth interval of a cam.txt.
    #[arg(long)]
    pub interval_scale: Option<f64>,
}

/// [`DepthLine`] on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum DepthLineArg {
    /// By value: a second number larger than the first is a maximum.
    Auto,
    /// Minimum and interval.
    Interval,
    /// Minimum and maximum.
    Minmax,
}

/// [`PixelCentre`] on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum PixelCentreArg {
    /// (0, 0).
    Integer,
    /// (0.5, 0.5).
    Half,
}

impl ReadArgs {
    /// As the readers want it.
    pub fn options(&self) -> ReadOptions {
        ReadOptions {
            skip_bad_views: self.skip_bad_views,
            depth_line: match self.depth_line {
                DepthLineArg::Auto => DepthLine::Auto,
                DepthLineArg::Interval => DepthLine::Interval,
                DepthLineArg::Minmax => DepthLine::MinMax,
            },
            pixel_centre: match self.pixel_centre {
                PixelCentreArg::Integer => PixelCentre::Integer,
                PixelCentreArg::Half => PixelCentre::Half,
            },
            plane_count: None,
            interval_scale: self.interval_scale,
        }
    }
}
