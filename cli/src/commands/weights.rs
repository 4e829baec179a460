//! `planesweep weights import` and `planesweep weights inspect`.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use clap::{Args, Subcommand, ValueEnum};
use planesweep_mvsnet::{CostMetric, ImportOptions, Normalization, Weights};
use planesweep_plan::BlobKey;
use planesweep_scene::write_atomically;
use serde_json::json;

use crate::console::Outcome;
use crate::network::read_weights;

/// The weights commands.
#[derive(Debug, Subcommand)]
pub enum WeightsCommand {
    /// Turn a checkpoint of the public PyTorch MVSNet into safetensors; no code in it is ever run.
    Import(ImportArgs),
    /// Say what a weights file holds.
    #[command(after_help = "Example: planesweep weights inspect mvsnet.safetensors")]
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

/// Imports or inspects.
pub fn run(command: &WeightsCommand) -> Result<Outcome> {
    match command {
        WeightsCommand::Import(args) => import(args),
        WeightsCommand::Inspect { file } => {
            let (bytes, weights) = read_weights(file)?;
            Ok(describe(file, &bytes, &weights))
        }
    }
}

fn import(args: &ImportArgs) -> Result<Outcome> {
    let name = args.checkpoint.file_name().map(|name| name.to_string_lossy().into_owned());
    let options = ImportOptions {
        normalization: match args.normalization {
            NormalizationArg::Unit => Normalization::UnitRange,
            NormalizationArg::PerImage => Normalization::PerImage,
        },
        metric: CostMetric::Variance,
        spacing_px: None,
        source: args.source.clone().or(name).unwrap_or_default(),
        licence: args.licence.clone(),
    };
    let weights = Weights::import(&args.checkpoint, options)?;
    let bytes = weights.to_bytes();
    write_atomically(&args.out, &bytes)
        .with_context(|| format!("cannot write weights {}", args.out.display()))?;
    Ok(describe(&args.out, &bytes, &weights))
}

fn describe(file: &Path, bytes: &[u8], weights: &Weights) -> Outcome {
    let metadata = weights.metadata();
    let values: usize = weights.tensors().values().map(|tensor| tensor.values.len()).sum();
    let hash = BlobKey::of(bytes);
    let known = json!(metadata);
    let named = |field: &str| known[field].as_str().unwrap_or_default();
    let text = format!(
        "{}: {} tensors, {values} values\nblake3         {hash}\nnormalisation  {}\nrefinement     {}\n\
         cost metric    {}\nsource         {}\nlicence        {}\n",
        file.display(),
        weights.tensors().len(),
        named("normalization"),
        named("refinement"),
        named("metric"),
        metadata.source,
        metadata.licence,
    );
    let value = json!({
        "file": file,
        "blake3": hash.to_string(),
        "tensors": weights.tensors().len(),
        "values": values,
        "metadata": known,
    });
    Outcome { text, value, skipped_views: false }
}
