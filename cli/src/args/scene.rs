//! How a scene is read.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use planesweep_scene::{DepthLine, PixelCentre, ReadOptions, SceneFormat};

/// What cannot be known from a scene's files.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Reading the scene")]
pub struct ReadArgs {
    /// The format of the scene; by default its files tell.
    #[arg(long, value_enum)]
    pub format: Option<FormatArg>,
    /// The folder that image names count from; by default where the format has it.
    #[arg(long, value_name = "FOLDER")]
    pub images: Option<PathBuf>,
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

/// [`SceneFormat`] on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum FormatArg {
    /// A COLMAP model in sparse/ with its photographs, or a dense workspace.
    Colmap,
    /// A folder of MVSNet or BlendedMVS.
    Mvsnet,
    /// sfm_data.json of OpenMVG.
    Openmvg,
    /// transforms.json of nerfstudio or instant-ngp.
    Nerfstudio,
    /// bundle.out of Bundler with its list of images.
    Bundler,
    /// scene.mvs of OpenMVS.
    Openmvs,
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
            format: self.format.map(|format| match format {
                FormatArg::Colmap => SceneFormat::Colmap,
                FormatArg::Mvsnet => SceneFormat::Mvsnet,
                FormatArg::Openmvg => SceneFormat::OpenMvg,
                FormatArg::Nerfstudio => SceneFormat::Nerfstudio,
                FormatArg::Bundler => SceneFormat::Bundler,
                FormatArg::Openmvs => SceneFormat::OpenMvs,
            }),
            // Workers, and runs that resume, may have another working folder.
            images: self.images.as_ref().map(|path| path.canonicalize().unwrap_or_else(|_| path.clone())),
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
