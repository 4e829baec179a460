//! The command line: what several commands share; the arguments of one command stand with it.

mod cluster;
mod fusion;
mod inference;
mod scene;
pub mod values;

use clap::{Parser, Subcommand};

pub use self::cluster::{ConnectArgs, CredentialArgs, ServerTlsArgs, TokenArgs, store_url};
pub use self::fusion::FilterArgs;
pub use self::inference::{NetworkArgs, PlanArgs};
pub use self::scene::ReadArgs;
use crate::commands::bench::BenchArgs;
use crate::commands::bench::side::SideArgs;
use crate::commands::benchmark::BenchmarkArgs;
use crate::commands::convert::ConvertArgs;
use crate::commands::coordinator::CoordinatorArgs;
use crate::commands::depth::DepthArgs;
use crate::commands::evaluate::EvaluateCommand;
use crate::commands::fuse::FuseArgs;
use crate::commands::inspect::InspectArgs;
use crate::commands::reconstruct::ReconstructArgs;
use crate::commands::render_depth::RenderDepthArgs;
use crate::commands::status::{CancelArgs, StatusArgs};
use crate::commands::submit::SubmitArgs;
use crate::commands::synth::SynthArgs;
use crate::commands::train::TrainArgs;
use crate::commands::weights::WeightsCommand;
use crate::commands::worker::WorkerArgs;

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
    /// Write a scene in another format, and say what that cannot hold.
    Convert(ConvertArgs),
    /// Infer the depth map of one view in this process.
    Depth(DepthArgs),
    /// Fuse depth maps, of this program or any MVS network, into a point cloud.
    Fuse(FuseArgs),
    /// Make a scene with exact ground truth, or training samples.
    Synth(SynthArgs),
    /// Train weights from scratch on generated scenes; the same command again resumes.
    Train(TrainArgs),
    /// Render depth maps of a triangle mesh, as training data.
    RenderDepth(RenderDepthArgs),
    /// Import or inspect weights of the network.
    #[command(
        subcommand,
        after_help = "Example: planesweep weights import model_000014.ckpt -o mvsnet.safetensors"
    )]
    Weights(WeightsCommand),
    /// Measure how good a result is.
    #[command(
        subcommand,
        after_help = "Example: planesweep evaluate depth demo/out demo/scene/depth_gt -o demo/evaluation"
    )]
    Evaluate(EvaluateCommand),
    /// Measure how fast the network is on this machine, ours against libtorch.
    Bench(BenchArgs),
    /// One side of a bench; answers requests on standard input.
    #[command(hide = true)]
    BenchSide(SideArgs),
    /// Reconstruct and evaluate the scenes of a benchmark, beside the published figures.
    Benchmark(BenchmarkArgs),
    /// Hand out the jobs of submitted scenes to workers on any hosts.
    Coordinator(CoordinatorArgs),
    /// Work for a coordinator until it says stop.
    Worker(WorkerArgs),
    /// Have a scene reconstructed by the workers of a coordinator.
    Submit(SubmitArgs),
    /// Say how far the runs of a coordinator are.
    Status(StatusArgs),
    /// Stop a run.
    Cancel(CancelArgs),
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
    fn every_command_has_an_example() {
        fn check(command: &clap::Command) {
            for command in command.get_subcommands().filter(|c| !c.is_hide_set() && c.get_name() != "help") {
                let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
                assert!(help.contains("Example") && help.contains("planesweep "), "{}", command.get_name());
                check(command);
            }
        }
        check(&Cli::command());
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
    fn what_a_script_gives_a_worker_can_be_given_anew() {
        let parsed = |more: &[&str]| {
            let script = "planesweep worker --coordinator http://head:7070 --listen 0.0.0.0:0 --threads 4";
            match Cli::try_parse_from(script.split(' ').chain(more.iter().copied())).expect("valid").command {
                Command::Worker(args) => (args.listen.to_string(), args.threads),
                other => panic!("parsed as {other:?}"),
            }
        };
        assert_eq!(parsed(&[]), ("0.0.0.0:0".to_owned(), Some(4)));
        let anew = ["--listen", "127.0.0.1:0", "--threads", "2"];
        assert_eq!(parsed(&anew), ("127.0.0.1:0".to_owned(), Some(2)));
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
        assert!(refused("--memory", "2X"));
    }
}
