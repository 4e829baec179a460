//! `planesweep synth`.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use planesweep_synth::{DemoOptions, Style, write_demo};
use serde_json::json;

use crate::console::Outcome;

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

/// Writes a scene.
pub fn run(args: &SynthArgs) -> Result<Outcome> {
    let style =
        Style { views: args.views as usize, width: args.width, height: args.height, ..Style::default() };
    let options = DemoOptions { seed: args.seed, style, ..DemoOptions::default() };
    let scene = write_demo(&args.out, &options)
        .with_context(|| format!("cannot make a scene in {}", args.out.display()))?;
    let (views, points) = (scene.views.len(), scene.points.len());
    let text = format!(
        "{views} photographs, {points} sparse points and exact depth are in {}\n",
        args.out.display()
    );
    Ok(Outcome {
        text,
        value: json!({ "out": args.out, "views": views, "points": points }),
        skipped_views: false,
    })
}
