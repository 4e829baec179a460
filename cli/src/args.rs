//! The command line.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand, ValueEnum};
use planesweep_fusion::{DepthSampling, FilterOptions};
use planesweep_plan::{PlanOptions, SamplingChoice};
use planesweep_scene::{DepthLine, PixelCentre, ReadOptions};

/// Dense multi-view stereo: photographs with known cameras in, one dense, coloured point cloud out.
#[derive(Debug, Parser)]
#[command(
    name = "planesweep",
    version,
    after_help = "Exit codes: 0 done, 1 failed, 2 usage, 3 done with skipped views.\n\
                  Example: planesweep reconstruct my-colmap-project -o out --max-size 1152"
)]
pub struct Cli {
    /// Print one JSON object on stdout instead of text.
    #[arg(long, global = true)]
    pub json: bool,
    /// Log more on stderr; twice for even more.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Turn a scene into depth maps and a point cloud, on this host; resumes by itself.
    Reconstruct(ReconstructArgs),
    /// Say what would be done with a scene, and what is odd about it.
    Inspect(InspectArgs),
    /// Infer the depth map of one view in this process.
    Depth(DepthArgs),
    /// Make a scene with exact ground truth.
    Synth(SynthArgs),
    /// Import or inspect weights of the network.
    #[command(subcommand)]
    Weights(WeightsCommand),
    /// Measure how good a result is.
    #[command(subcommand)]
    Evaluate(EvaluateCommand),
    /// Work for a coordinator until it says stop.
    Worker(WorkerArgs),
}

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

fn share(text: &str) -> Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| format!("{text} is not a number"))?;
    if (0.0..=1.0).contains(&value) { Ok(value) } else { Err(format!("{text} is not from 0 to 1")) }
}

fn positive(text: &str) -> Result<f32, String> {
    let value: f32 = text.parse().map_err(|_| format!("{text} is not a number"))?;
    if value > 0.0 && value.is_finite() { Ok(value) } else { Err(format!("{text} is not positive")) }
}

/// Two depths, `NEAR,FAR`.
fn depth_range(text: &str) -> Result<(f64, f64), String> {
    let number = |text: &str| text.trim().parse::<f64>().map_err(|_| format!("{text} is not a number"));
    let (near, far) = text.split_once(',').ok_or("two depths are needed: NEAR,FAR")?;
    let (near, far) = (number(near)?, number(far)?);
    if near > 0.0 && far > near && far.is_finite() {
        Ok((near, far))
    } else {
        Err(format!("{near} to {far} is not positive and increasing"))
    }
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
            filter: filter.map_or(defaults.filter, |f| FilterOptions {
                min_confidence: f.min_confidence,
                min_views: f.min_views,
                max_reprojection_px: f.max_reprojection,
                max_relative_depth: f.max_depth_difference,
                sampling: if f.continuous { DepthSampling::Continuous } else { DepthSampling::Bilinear },
            }),
        }
    }
}

/// The network.
#[derive(Clone, Debug, Args)]
#[command(next_help_heading = "Network")]
pub struct NetworkArgs {
    /// The weights, as `weights import` writes them.
    #[arg(long, env = "PLANESWEEP_WEIGHTS", value_name = "FILE")]
    pub weights: PathBuf,
    /// Where to infer: cpu, torch (the plain network of libtorch on the processor), cuda or cuda:N.
    #[arg(long, default_value = "cpu")]
    pub device: String,
    /// Memory for inference, such as 800M or 2G, shared by all workers; less than the least that is
    /// possible is taken for that. Changes no bit of the result.
    #[arg(long, value_name = "SIZE", value_parser = bytes)]
    pub memory: Option<u64>,
}

/// A size in bytes: a number with K, M, G or T (powers of 1024) behind it or without.
fn bytes(text: &str) -> Result<u64, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let shift = match text[digits.len()..].trim_end_matches(['B', 'b', 'i']).to_ascii_uppercase().as_str() {
        "" => 0,
        "K" => 10,
        "M" => 20,
        "G" => 30,
        "T" => 40,
        _ => return Err(format!("{text} is no size; write it like 800M or 2G")),
    };
    let number: f64 = digits.parse().map_err(|_| format!("{text} is no size; write it like 800M or 2G"))?;
    let size = number * (1_u64 << shift) as f64;
    if (1.0..1e18).contains(&size) { Ok(size as u64) } else { Err(format!("{text} is no size")) }
}

/// Arguments of `reconstruct`.
#[derive(Debug, Args)]
#[command(
    after_help = "SCENE is a COLMAP project (images/ and sparse/ or sparse/0/) or an MVSNet folder (images/ \
    and cams/).\nExample: planesweep reconstruct my-colmap-project -o out --max-size 1152"
)]
pub struct ReconstructArgs {
    /// The scene.
    pub scene: PathBuf,
    /// Where the result goes; an interrupted run in the same folder is resumed.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Worker processes; by default as many as make the machine busy and fit into its memory.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=256))]
    pub workers: Option<u32>,
    /// Threads of each worker's inference; by default the processors are shared evenly.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Forget what an earlier run in the same folder has done.
    #[arg(long)]
    pub fresh: bool,
    #[command(flatten)]
    pub network: NetworkArgs,
    #[command(flatten)]
    pub plan: PlanArgs,
    #[command(flatten)]
    pub filter: FilterArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// Arguments of `inspect`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep inspect my-colmap-project --max-size 1152")]
pub struct InspectArgs {
    /// The scene.
    pub scene: PathBuf,
    #[command(flatten)]
    pub plan: PlanArgs,
    #[command(flatten)]
    pub filter: FilterArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// Arguments of `depth`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep depth my-colmap-project --view DSC_0001.JPG -o one-view")]
pub struct DepthArgs {
    /// The scene.
    pub scene: PathBuf,
    /// The view, by name or id.
    #[arg(long)]
    pub view: String,
    /// The folder that depth, confidence and preview go to.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Write the probability over depth at this pixel of the depth map too, as CSV and as a plot.
    #[arg(long, value_name = "X,Y", value_parser = parse_pixel)]
    pub probe: Option<(usize, usize)>,
    #[command(flatten)]
    pub network: NetworkArgs,
    #[command(flatten)]
    pub plan: PlanArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// A pixel, column and row, as "X,Y".
fn parse_pixel(text: &str) -> Result<(usize, usize), String> {
    let number = |text: &str| text.trim().parse().ok();
    let pixel = text.split_once(',').and_then(|(x, y)| Some((number(x)?, number(y)?)));
    pixel.ok_or_else(|| "a pixel is two numbers with a comma between, such as 12,34".to_owned())
}

/// Arguments of `synth`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep synth demo/scene --views 10 --width 640 --height 480")]
pub struct SynthArgs {
    /// The folder that the scene goes to: a COLMAP project with exact depth in depth_gt/.
    pub out: PathBuf,
    /// Another seed makes another scene.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Photographs.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u32).range(2..=1000))]
    pub views: u32,
    /// Columns of a photograph.
    #[arg(long, default_value_t = 640, value_parser = clap::value_parser!(u32).range(32..=8192))]
    pub width: u32,
    /// Rows of a photograph.
    #[arg(long, default_value_t = 480, value_parser = clap::value_parser!(u32).range(32..=8192))]
    pub height: u32,
}

/// The weights commands.
#[derive(Debug, Subcommand)]
pub enum WeightsCommand {
    /// Turn a checkpoint of the public PyTorch MVSNet into safetensors; no code in it is ever run.
    Import(ImportArgs),
    /// Say what a weights file holds.
    Inspect {
        /// The file.
        file: PathBuf,
    },
}

/// Arguments of `weights import`.
#[derive(Debug, Args)]
#[command(
    after_help = "Example: planesweep weights import model_000014.ckpt -o mvsnet.safetensors --licence unknown"
)]
pub struct ImportArgs {
    /// The checkpoint.
    pub checkpoint: PathBuf,
    /// The file to write.
    #[arg(short, long)]
    pub out: PathBuf,
    /// How images were normalised in training: unit (0..1 RGB, as the public port does) or
    /// per-image (zero mean, unit variance).
    #[arg(long, value_enum, default_value = "unit")]
    pub normalization: NormalizationArg,
    /// Where the weights come from; by default the checkpoint's file name.
    #[arg(long)]
    pub source: Option<String>,
    /// Their licence.
    #[arg(long, default_value = "unknown")]
    pub licence: String,
}

/// How images become input, on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum NormalizationArg {
    /// RGB from 0 to 1.
    Unit,
    /// Zero mean and unit variance of each channel of each image.
    PerImage,
}

/// The evaluate commands.
#[derive(Debug, Subcommand)]
pub enum EvaluateCommand {
    /// Compare the depth maps of a result with true ones.
    Depth(EvaluateDepthArgs),
}

/// Arguments of `evaluate depth`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep evaluate depth demo/out demo/scene/depth_gt")]
pub struct EvaluateDepthArgs {
    /// A folder that `reconstruct` made.
    pub out: PathBuf,
    /// The folder with the true depth of each view: NAME.pfm.
    pub truth: PathBuf,
}

/// Arguments of `worker`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep worker --coordinator http://10.0.0.1:7070 --role both")]
pub struct WorkerArgs {
    /// The coordinator's address.
    #[arg(long, env = "PLANESWEEP_COORDINATOR")]
    pub coordinator: String,
    /// The token that the coordinator wants.
    #[arg(long, env = "PLANESWEEP_TOKEN", hide_env_values = true)]
    pub token: Option<String>,
    /// Which jobs it takes.
    #[arg(long, value_enum, default_value = "both")]
    pub role: RoleArg,
    /// Where to infer: cpu, torch, cuda or cuda:N; `analytic` is a test double that knows a plane.
    #[arg(long, default_value = "cpu")]
    pub device: String,
    /// Threads of an inference; by default all processors.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Memory for inference, such as 800M or 2G.
    #[arg(long, value_name = "SIZE", value_parser = bytes)]
    pub memory: Option<u64>,
    /// Stop when standard input ends, that is, when the process that started this one is gone.
    #[arg(long, hide = true)]
    pub stop_with_stdin: bool,
}

/// Which jobs a worker takes, on the command line.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub enum RoleArg {
    /// Inference only.
    Infer,
    /// Everything but inference.
    Fuse,
    /// Every job.
    Both,
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn a_quality_is_a_set_of_defaults() {
        let plan = |args: &[&str]| {
            let command = ["planesweep", "inspect", "scene"].iter().chain(args);
            match Cli::try_parse_from(command).expect("valid").command {
                Command::Inspect(args) => args.plan.options(None),
                other => panic!("parsed as {other:?}"),
            }
        };
        let paper = plan(&["--quality", "paper", "--depths", "64"]);
        assert_eq!((paper.max_size, paper.views, paper.depths), (Some(1920), 5, Some(64)));
        assert_eq!(plan(&["--depth-range", "1,9.5"]).depth_range, Some((1.0, 9.5)));
        assert_eq!(plan(&[]).max_size, Some(1600));
    }

    #[test]
    fn senseless_numbers_are_usage_errors() {
        let refused = |option: &str, value: &str| {
            let option = format!("{option}={value}");
            let args = ["planesweep", "reconstruct", "s", "-o", "o", "--weights", "w", &option];
            Cli::try_parse_from(args).is_err()
        };
        assert!(refused("--depth-range", "9,1") && refused("--depth-range", "0,1"));
        assert!(refused("--min-views", "0") && refused("--min-confidence", "nan"));
        assert!(refused("--max-reprojection", "-1") && refused("--max-depth-difference", "inf"));
        assert!(!refused("--min-confidence", "0.5"));
        assert!(refused("--memory", "2X") && refused("--memory", "-1G"));
        assert_eq!(bytes("1.5G"), Ok(3 << 29));
        assert_eq!(bytes("800MiB"), Ok(800 << 20));
    }

    #[test]
    fn a_pixel_is_two_numbers() {
        assert_eq!(parse_pixel("12,34"), Ok((12, 34)));
        for wrong in ["12", "12,", "1,2,3", "-1,2"] {
            assert!(parse_pixel(wrong).is_err(), "{wrong}");
        }
    }
}
