//! `planesweep bench`: our network against the plain one of libtorch, in alternating runs.
//!
//! Each side is a process of its own, so that its memory can be measured, and the processes work in turn, so that both
//! meet the machine in the same state.

mod figures;
pub mod side;

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_mvsnet::{InferRates, matrix_rate};
use planesweep_scene::{Raster, read_depth_pfm};
use planesweep_synth::{DemoOptions, Style, write_demo};
use serde_json::json;

use self::figures::{Figures, SideRuns};
use self::side::{Request, Run, Side, Size};
use crate::console::{Outcome, table};
use crate::network::processors;

/// Arguments of `bench`.
#[derive(Debug, Args)]
#[command(
    after_help = "Sizes are WIDTHxHEIGHTxDEPTHSxVIEWS, or small (640x512x192x3), medium (1152x864x192x5), \
    dtu (1600x1184x256x5) and tnt (1920x1056x256x5).\n\
    Example: planesweep bench --size medium --runs 5"
)]
pub struct BenchArgs {
    /// A scene whose best-connected view is inferred, with images resized to each size; without it one is made.
    pub scene: Option<PathBuf>,
    /// The view, by name or id.
    #[arg(long, requires = "scene")]
    pub view: Option<String>,
    /// What is measured; can be given several times.
    #[arg(long = "size", default_values = ["small", "medium"])]
    pub sizes: Vec<Size>,
    /// Who is measured, in this order.
    #[arg(long, value_enum, value_delimiter = ',', default_values = ["plain", "ours", "alone"])]
    pub sides: Vec<Side>,
    /// Rounds that count; in each every side infers once. One round before them does not count.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=1000))]
    pub runs: u32,
    /// Threads of an inference; by default all processors.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..=1024))]
    pub threads: Option<u32>,
    /// Weights, as `weights import` writes them; without them untrained ones, which cost the same.
    #[arg(long, value_name = "FILE")]
    pub weights: Option<PathBuf>,
}

/// Measures every size.
pub fn run(args: &BenchArgs) -> Result<Outcome> {
    let threads = args.threads.map_or_else(processors, |threads| threads as usize);
    let rates = InferRates::measure(threads)?;
    let mut text = String::new();
    let mut sizes = Vec::new();
    for size in &args.sizes {
        let figures = measure(args, *size, threads, &rates)?;
        text.push_str(&figures.heading());
        text.push_str(&table(&figures.rows()));
        text.push_str(&figures.summary());
        text.push('\n');
        sizes.push(figures.value());
    }
    Ok(Outcome { text, value: json!({ "threads": threads, "sizes": sizes }), skipped_views: false })
}

fn measure(args: &BenchArgs, size: Size, threads: usize, rates: &InferRates) -> Result<Figures> {
    let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
    let scene = match &args.scene {
        Some(scene) => scene.clone(),
        None => made_scene(folder.path(), size)?,
    };
    let mut sides = Vec::new();
    for side in &args.sides {
        sides.push(SideProcess::start(args, &scene, size, *side, threads)?);
    }
    let mut peaks = vec![matrix_rate(threads)?];
    let mut runs: Vec<Vec<Run>> = vec![Vec::new(); sides.len()];
    for round in 0..=args.runs {
        for (side, runs) in sides.iter_mut().zip(&mut runs) {
            let run: Run =
                serde_json::from_str(&side.ask(&Request::Run)?).context("a run without figures")?;
            let label = if round == 0 { "warm-up".to_owned() } else { format!("run {round}") };
            eprintln!("{size} {:6} {label}: {:.3} s", side.name, run.seconds);
            runs.push(run);
        }
        peaks.push(matrix_rate(threads)?);
    }
    let mut maps = Vec::new();
    for side in &mut sides {
        let path = folder.path().join(format!("{}.pfm", side.name));
        side.ask(&Request::SaveDepth(path.clone()))?;
        maps.push(read_depth_pfm(&path)?);
    }
    let difference = maps.split_first().and_then(|(first, others)| {
        others.iter().map(|other| greatest_difference(first, other)).max_by(f64::total_cmp)
    });
    let runs = args.sides.iter().copied().zip(runs);
    let sides = runs.map(|(side, mut runs)| {
        let warm_up = runs.remove(0);
        SideRuns { side, warm_up, runs }
    });
    Ok(Figures { size, threads, peaks, sides: sides.collect(), difference, rates: *rates })
}

/// A synthetic scene of exactly these images.
fn made_scene(folder: &Path, size: Size) -> Result<PathBuf> {
    let scene = folder.join("scene");
    let style =
        Style { views: size.views, width: size.width as u32, height: size.height as u32, ..Style::default() };
    let options = DemoOptions { style, supersampling: 1, ..DemoOptions::default() };
    write_demo(&scene, &options).context("cannot make a scene to measure on")?;
    Ok(scene)
}

/// The greatest relative difference of two depth maps.
fn greatest_difference(a: &Raster<f32>, b: &Raster<f32>) -> f64 {
    let differences = a.values().iter().zip(b.values()).map(|(a, b)| f64::from((a - b).abs() / a.max(*b)));
    differences.fold(0.0, f64::max)
}

/// The process of one side.
struct SideProcess {
    name: &'static str,
    child: Child,
    requests: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl SideProcess {
    fn start(args: &BenchArgs, scene: &Path, size: Size, side: Side, threads: usize) -> Result<Self> {
        let program = std::env::current_exe().context("cannot find the program to measure")?;
        let mut command = Command::new(program);
        command.arg("bench-side").arg(scene).args(["--size", &size.to_string(), "--side", side.name()]);
        command.args(["--threads", &threads.to_string()]);
        if let Some(view) = &args.view {
            command.args(["--view", view]);
        }
        if let Some(weights) = &args.weights {
            command.arg("--weights").arg(weights);
        }
        command.stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().with_context(|| format!("cannot start the {} side", side.name()))?;
        let (Some(requests), Some(answers)) = (child.stdin.take(), child.stdout.take()) else {
            bail!("the {} side has no pipes", side.name());
        };
        Ok(Self { name: side.name(), child, requests, answers: BufReader::new(answers) })
    }

    fn ask(&mut self, request: &Request) -> Result<String> {
        let line = serde_json::to_string(request).context("a request that cannot be written")?;
        // A side that is gone has said why on stderr.
        let gone = || format!("the {} side ended before it answered", self.name);
        writeln!(self.requests, "{line}").with_context(gone)?;
        let mut answer = String::new();
        if self.answers.read_line(&mut answer).with_context(gone)? == 0 {
            bail!(gone());
        }
        Ok(answer)
    }
}

impl Drop for SideProcess {
    fn drop(&mut self) {
        // It has nothing to lose, and may be in the middle of a long run.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
