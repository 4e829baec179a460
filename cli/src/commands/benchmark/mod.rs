//! `planesweep benchmark`: reconstruct and evaluate the scenes of a benchmark, beside the paper's figures.

mod config;
mod published;

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::{Args, CommandFactory, FromArgMatches};
use planesweep_evaluate::dtu::DtuMeans;
use planesweep_evaluate::tnt::TntScores;
use planesweep_scene::write_atomically;
use serde_json::{Value, json};

use self::config::{BenchmarkConfig, INTERMEDIATE, Preset};
use super::evaluate::{self, DtuArgs, EvaluateCommand, TntArgs};
use super::{reconstruct, submit};
use crate::args::{Cli, Command, CredentialArgs};
use crate::console::{Outcome, table};

/// Arguments of `benchmark`.
#[derive(Debug, Args)]
#[command(
    after_help = "CONFIG is a TOML file: preset (tanks-and-temples-intermediate, tanks-and-temples-training or \
    dtu), scenes, truth, out, weights, names, options, thresholds, aligned; docs/evaluation.md has them all. \
    Running it again resumes.\n\
    Example: planesweep benchmark dtu.toml"
)]
pub struct BenchmarkArgs {
    /// The benchmark.
    pub config: PathBuf,
    /// Submit the scenes to this coordinator, as `submit` does, instead of starting workers here.
    #[arg(long, value_name = "URL")]
    pub coordinator: Option<String>,
    #[command(flatten)]
    pub credentials: CredentialArgs,
}

/// A scene that was tried.
struct Tried {
    name: String,
    /// What `reconstruct` said, or why it failed.
    reconstructed: Result<Outcome, String>,
}

/// Reconstructs, evaluates, and writes the tables.
pub fn run(args: &BenchmarkArgs, verbose: u8) -> Result<Outcome> {
    let config = BenchmarkConfig::read(&args.config)?;
    fs::create_dir_all(&config.out).with_context(|| format!("cannot make {}", config.out.display()))?;
    let mut tried = Vec::new();
    for name in config.names() {
        eprintln!("{name}");
        // One scene that fails does not end a run of hours; it is named at the end.
        let reconstructed = reconstruct_scene(args, &config, &name, verbose).map_err(|error| {
            eprintln!("{name}: {error:#}");
            format!("{error:#}")
        });
        tried.push(Tried { name, reconstructed });
    }
    let (rows, measured) = match config.preset {
        Preset::Dtu => dtu_table(&config, &tried)?,
        Preset::TanksAndTemplesIntermediate | Preset::TanksAndTemplesTraining => tnt_table(&config, &tried)?,
    };
    let markdown = markdown(&rows);
    let path = config.out.join("benchmark.md");
    write_atomically(&path, markdown.as_bytes())
        .with_context(|| format!("cannot write {}", path.display()))?;
    let scene = |tried: &Tried| match &tried.reconstructed {
        Ok(outcome) => json!({ "scene": tried.name, "points": outcome.value["points"] }),
        Err(error) => json!({ "scene": tried.name, "error": error }),
    };
    let scenes: Vec<Value> = tried.iter().map(scene).collect();
    let value = json!({ "scenes": scenes, "measured": measured, "table": path });
    let is_partial =
        |tried: &Tried| tried.reconstructed.as_ref().map_or(true, |outcome| outcome.skipped_views);
    Ok(Outcome { text: table(&rows), value, skipped_views: tried.iter().any(is_partial) })
}

fn reconstruct_scene(
    args: &BenchmarkArgs,
    config: &BenchmarkConfig,
    name: &str,
    verbose: u8,
) -> Result<Outcome> {
    let arguments = match &args.coordinator {
        None => config.arguments(name, "reconstruct", &[]),
        Some(url) => config.arguments(name, "submit", &args.credentials.passed_on(url)),
    };
    // An option that comes twice counts as it comes last, so that the file overrides the preset.
    let command = Cli::command().args_override_self(true);
    let cli = command
        .try_get_matches_from(arguments)
        .and_then(|matches| Cli::from_arg_matches(&matches))
        .context("cannot use the options of the benchmark")?;
    match cli.command {
        Command::Reconstruct(args) => reconstruct::run(&args, true, verbose),
        Command::Submit(args) => submit::run(&args, true),
        _ => bail!("the options of the benchmark are those of another command"),
    }
}

/// The paper's table 1 with a row of ours.
fn dtu_table(config: &BenchmarkConfig, tried: &[Tried]) -> Result<(Vec<Vec<String>>, Value)> {
    let heading = [
        "",
        "acc. mm",
        "comp. mm",
        "overall mm",
        "acc. < 1 mm",
        "comp. < 1 mm",
        "f-score < 1 mm",
        "acc. < 2 mm",
        "comp. < 2 mm",
        "f-score < 2 mm",
    ];
    let row = |name: &str, figures: &[f64; 9]| {
        let digits = |place: usize| if place < 3 { 3 } else { 2 };
        let figures = figures.iter().enumerate().map(|(place, v)| format!("{v:.*}", digits(place)));
        std::iter::once(name.to_owned()).chain(figures).collect::<Vec<_>>()
    };
    let mut rows = vec![heading.map(str::to_owned).to_vec()];
    rows.extend(published::DTU.iter().map(|(name, figures)| row(name, figures)));
    let done = |tried: &Tried| {
        tried.reconstructed.as_ref().ok().and_then(|_| tried.name.strip_prefix("scan")?.parse().ok())
    };
    let scans: Vec<u32> = tried.iter().filter_map(done).collect();
    let Some(truth) = config.truth.clone().filter(|_| !scans.is_empty()) else {
        return Ok((rows, Value::Null));
    };
    let args = DtuArgs {
        results: config.out.clone(),
        truth,
        scans: Some(scans),
        seed: 0,
        out: Some(config.out.join("evaluation")),
    };
    let measured = evaluate::run(&EvaluateCommand::Dtu(args))?.value;
    let means: DtuMeans =
        serde_json::from_value(measured["mean"].clone()).context("no means of the scans")?;
    let mut figures = [means.accuracy, means.completeness, means.overall, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let shares = means.percentages.iter().flat_map(|p| [p.accuracy, p.completeness, p.f_score]);
    for (figure, share) in figures[3..].iter_mut().zip(shares) {
        *figure = 100.0 * share;
    }
    rows.push(row(&format!("planesweep, {} of {} scans", means.scans, tried.len()), &figures));
    Ok((rows, measured))
}

/// The paper's table 2, or a table of the training scenes, with a row of ours: F-scores in percent.
fn tnt_table(config: &BenchmarkConfig, tried: &[Tried]) -> Result<(Vec<Vec<String>>, Value)> {
    let mut heading = vec![String::new(), "mean".to_owned()];
    heading.extend(tried.iter().map(|tried| tried.name.clone()));
    let mut rows = vec![heading];
    let names: Vec<&str> = tried.iter().map(|tried| tried.name.as_str()).collect();
    if names == INTERMEDIATE {
        let row = |(name, figures): &(&str, [f64; 9])| {
            let figures = figures.iter().map(|figure| format!("{figure:.2}"));
            std::iter::once((*name).to_owned()).chain(figures).collect::<Vec<_>>()
        };
        rows.extend(published::INTERMEDIATE.iter().map(row));
    }
    let mut measured = Vec::new();
    for tried in tried {
        measured.push(tnt_scores(config, tried)?);
    }
    let f_scores: Vec<Option<f64>> =
        measured.iter().map(|scores| scores.as_ref().map(|scores| 100.0 * scores.f_score)).collect();
    let known: Vec<f64> = f_scores.iter().copied().flatten().collect();
    let mean = (!known.is_empty()).then(|| known.iter().sum::<f64>() / known.len() as f64);
    let shown = |value: &Option<f64>| value.map_or("-".to_owned(), |value| format!("{value:.2}"));
    let mut ours = vec![format!("planesweep, {} of {} scenes", known.len(), tried.len()), shown(&mean)];
    ours.extend(f_scores.iter().map(shown));
    rows.push(ours);
    let scenes: Vec<Value> = tried
        .iter()
        .zip(&measured)
        .map(|(tried, scores)| json!({ "scene": tried.name, "scores": scores }))
        .collect();
    Ok((rows, json!({ "mean_f_score": mean.map(|percent| percent / 100.0), "scenes": scenes })))
}

/// The scores of a scene that was reconstructed and whose ground truth is there.
fn tnt_scores(config: &BenchmarkConfig, tried: &Tried) -> Result<Option<TntScores>> {
    let name = &tried.name;
    let truth = config.truth.as_deref().map(|truth| truth.join(name)).filter(|truth| truth.is_dir());
    let (Some(truth), Ok(_)) = (truth, &tried.reconstructed) else { return Ok(None) };
    let args = TntArgs {
        result: config.out.join(name),
        truth,
        scene: Some(name.clone()),
        threshold: config.thresholds.get(name).copied(),
        trajectory: None,
        aligned: config.aligned,
        seed: 0,
        out: Some(config.out.join(Path::new("evaluation")).join(name)),
    };
    let outcome =
        evaluate::run(&EvaluateCommand::Tnt(args)).with_context(|| format!("cannot evaluate {name}"))?;
    let scores = serde_json::from_value(outcome.value["scores"].clone()).context("no scores of the scene")?;
    Ok(Some(scores))
}

/// The rows as a table in Markdown; the first is the heading.
fn markdown(rows: &[Vec<String>]) -> String {
    let line = |row: &[String]| format!("| {} |\n", row.join(" | "));
    let mut text = String::new();
    for (place, row) in rows.iter().enumerate() {
        text.push_str(&line(row));
        if place == 0 {
            text.push_str(&line(&vec!["---".to_owned(); row.len()]));
        }
    }
    text
}
