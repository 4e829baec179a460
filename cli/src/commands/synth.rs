//! `planesweep synth`.

use std::path::PathBuf;

use anyhow::{Context, Result};
use clap::Args;
use planesweep_synth::{
    DemoOptions, Library, Style, TrainingOptions, training_sample_with, write_demo, write_training_sample,
};
use serde_json::json;

use crate::console::Outcome;
use crate::out_folder::check_empty;

/// Arguments of `synth`.
#[derive(Debug, Args)]
#[command(
    after_help = "Examples: planesweep synth demo/scene --views 10 --width 640 --height 480\n          \
                  planesweep synth samples --training 100 --seed 7"
)]
pub struct SynthArgs {
    /// The folder that the scene goes to: a COLMAP project with exact depth in depth_gt/. A new or empty one; beside
    /// training samples there may be others.
    pub out: PathBuf,
    /// Another seed makes another scene.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Photographs; 10 of a scene, 3 of a training sample when not given.
    #[arg(long, value_parser = clap::value_parser!(u32).range(2..=1000))]
    pub views: Option<u32>,
    /// Columns of a photograph; 640 of a scene, 320 of a training sample when not given.
    #[arg(long, value_parser = clap::value_parser!(u32).range(32..=8192))]
    pub width: Option<u32>,
    /// Rows of a photograph; 480 of a scene, 256 of a training sample when not given.
    #[arg(long, value_parser = clap::value_parser!(u32).range(32..=8192))]
    pub height: Option<u32>,
    /// Write this many training samples instead, each a scene of its own as an MVSNet folder; their
    /// seeds count from SEED.
    #[arg(long, value_name = "COUNT")]
    pub training: Option<u32>,
    /// A folder of meshes (PLY, OBJ, NPZ, textured by the image of the same name) and photographs that
    /// training samples use beside what they make up; may be given several times.
    #[arg(long, value_name = "FOLDER", requires = "training")]
    pub library: Vec<PathBuf>,
}

/// Writes a scene or training samples.
pub fn run(args: &SynthArgs) -> Result<Outcome> {
    match args.training {
        Some(count) => write_samples(args, count),
        None => write_scene(args),
    }
}

fn write_scene(args: &SynthArgs) -> Result<Outcome> {
    check_empty(&args.out)?;
    let style = Style::default();
    let style = Style {
        views: args.views.map_or(style.views, |views| views as usize),
        width: args.width.unwrap_or(style.width),
        height: args.height.unwrap_or(style.height),
        ..style
    };
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

fn write_samples(args: &SynthArgs, count: u32) -> Result<Outcome> {
    let options = TrainingOptions::default();
    let options = TrainingOptions {
        views: args.views.map_or(options.views, |views| views as usize),
        width: args.width.unwrap_or(options.width),
        height: args.height.unwrap_or(options.height),
        ..options
    };
    let mut library = Library::default();
    for folder in &args.library {
        library.add_folder(folder)?;
    }
    let samples: Vec<(u64, PathBuf)> =
        (args.seed..).take(count as usize).map(|seed| (seed, args.out.join(format!("{seed:08}")))).collect();
    samples.iter().try_for_each(|(_, folder)| check_empty(folder))?;
    for (seed, folder) in samples {
        write_training_sample(&folder, &training_sample_with(seed, &options, &library))
            .with_context(|| format!("cannot write the training sample {}", folder.display()))?;
    }
    let text = format!("{count} training samples are in {}\n", args.out.display());
    Ok(Outcome { text, value: json!({ "out": args.out, "samples": count }), skipped_views: false })
}
