//! `planesweep train`.

use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_mvsnet::Weights;
use planesweep_mvsnet::train::{
    GradientEngine, KernelEngine, StepReport, TorchEngine, TrainConfig, TrainEvent, Trainer, Validation,
    ValidationSet, Wish,
};
use planesweep_scene::write_atomically;
use serde_json::json;

use crate::console::Outcome;
use crate::training::{Curves, Samples, Stop, add_scene};

/// Arguments of `train`.
#[derive(Debug, Args)]
#[command(after_help = "Example: planesweep train train.toml -o runs/first\n\
                        The same command again goes on where the run was interrupted.")]
pub struct TrainArgs {
    /// The configuration, as TOML; what it leaves out has a default.
    pub config: PathBuf,
    /// The folder that checkpoint, weights and curves go to.
    #[arg(short, long)]
    pub out: PathBuf,
    /// Begin anew, whatever the folder holds.
    #[arg(long)]
    pub fresh: bool,
}

/// Names in the folder of a run.
const CHECKPOINT: &str = "checkpoint.safetensors";
const WEIGHTS: &str = "weights.safetensors";
const CONFIG: &str = "config.toml";

/// Trains.
pub fn run(args: &TrainArgs) -> Result<Outcome> {
    let config = read_config(&args.config)?;
    let out = &args.out;
    fs::create_dir_all(out).with_context(|| format!("cannot make the folder {}", out.display()))?;
    let checkpoint = out.join(CHECKPOINT);
    if args.fresh && checkpoint.exists() {
        fs::remove_file(&checkpoint)
            .with_context(|| format!("cannot remove the checkpoint {}", checkpoint.display()))?;
    }
    let effective = toml::to_string(&config).context("cannot write the configuration")?;
    write(&out.join(CONFIG), effective.as_bytes())?;

    let source = Samples::to_train(&config.data)?;
    let held_out = Samples::held_out(&config.data)?;
    let mut validation =
        ValidationSet::held_out(&held_out, &config).context("cannot make held-out samples")?;
    for scene in &config.progress.validation_scenes {
        add_scene(&mut validation, Path::new(scene))?;
    }
    let mut trainer = Trainer::new(&config, &checkpoint, engine(&config)?)?;
    let stop = Stop::on_signals()?;
    let mut curves = None;
    let mut failed = None;
    let mut last = None;
    let weights = trainer.run(&source, &validation, &mut |event| {
        let handled = watch(&event, &config, out, &mut curves, &mut last);
        match handled {
            Err(error) if failed.is_none() => failed = Some(error),
            _ => {}
        }
        if failed.is_some() || stop.is_wished() { Wish::Stop } else { Wish::GoOn }
    });
    if let Some(error) = failed {
        return Err(error);
    }
    let weights = weights?;
    let file = out.join(WEIGHTS);
    write(&file, &weights.to_bytes())?;
    let steps = last.map_or(0, |report: StepReport| report.step);
    let text = format!("{} steps of {} are done; weights are in {}\n", steps, config.steps, file.display());
    let value = json!({ "steps": steps, "of": config.steps, "weights": file, "out": out });
    Ok(Outcome { text, value, skipped_views: false })
}

fn watch(
    event: &TrainEvent<'_>,
    config: &TrainConfig,
    out: &Path,
    curves: &mut Option<Curves>,
    last: &mut Option<StepReport>,
) -> Result<()> {
    match event {
        TrainEvent::Begun { step } => {
            if *step > 0 {
                eprintln!("going on after step {step} of {}", config.steps);
            }
            *curves = Some(Curves::open(out, *step)?);
        }
        TrainEvent::Step(report) => {
            *last = Some(*report);
            let curves = curves.as_mut().context("a run begins before its steps")?;
            if let Some(line) = curves.add(report, config)? {
                eprintln!("{line}");
            }
        }
        TrainEvent::Validated { step, validation } => {
            let curves = curves.as_mut().context("a run begins before its validations")?;
            curves.add_validation(*step, validation)?;
            for line in describe(*step, validation) {
                eprintln!("{line}");
            }
        }
        TrainEvent::Saved { weights, .. } => save(out, weights, curves.as_ref())?,
    }
    Ok(())
}

fn save(out: &Path, weights: &Weights, curves: Option<&Curves>) -> Result<()> {
    write(&out.join(WEIGHTS), &weights.to_bytes())?;
    curves.map_or(Ok(()), Curves::draw)
}

fn describe(step: u64, validation: &Validation) -> Vec<String> {
    let line = |group: &planesweep_mvsnet::train::GroupErrors| {
        let [one, three] = group.all.shares();
        let [sure_one, _] = group.confident.shares();
        let kept = group.confident.pixels as f64 / group.all.pixels.max(1) as f64;
        format!(
            "step {step}, {}: error {:.3} intervals, {:.1} % below 1, {:.1} % below 3; \
             {:.1} % confident, of these {:.1} % below 1{}",
            group.name,
            group.all.mean(),
            100.0 * one,
            100.0 * three,
            100.0 * kept,
            100.0 * sure_one,
            if group.absent > 0 {
                format!("; {:.1} % of pixels without a surface confident", 100.0 * group.absent_share())
            } else {
                String::new()
            },
        )
    };
    validation.groups.iter().map(line).collect()
}

fn read_config(path: &Path) -> Result<TrainConfig> {
    let text = fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let config: TrainConfig =
        toml::from_str(&text).with_context(|| format!("cannot understand {}", path.display()))?;
    config.checked().with_context(|| format!("cannot train with {}", path.display()))
}

fn engine(config: &TrainConfig) -> Result<Box<dyn GradientEngine>> {
    match config.device.as_str() {
        "cpu" => Ok(Box::new(KernelEngine::new(config.threads)?)),
        "torch" => Ok(Box::new(TorchEngine::new("cpu", config.threads)?)),
        name if name.starts_with("cuda") => Ok(Box::new(TorchEngine::new(name, config.threads)?)),
        name => bail!("device \"{name}\" is none of cpu, torch, cuda and cuda:N"),
    }
}

fn write(path: &Path, bytes: &[u8]) -> Result<()> {
    write_atomically(path, bytes).with_context(|| format!("cannot write {}", path.display()))
}
