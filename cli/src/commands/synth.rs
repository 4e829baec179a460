//! `planesweep synth`.

use anyhow::{Context, Result};
use planesweep_synth::{DemoOptions, Style, write_demo};
use serde_json::json;

use crate::args::SynthArgs;
use crate::console::Outcome;

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
