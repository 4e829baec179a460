//! `planesweep submit`: a scene for a coordinator elsewhere.

use std::fs;
use std::path::PathBuf;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use clap::Args;
use planesweep_store::Store;
use serde_json::json;

use super::export::{self, Finished};
use crate::args::{ConnectArgs, FilterArgs, PlanArgs, ReadArgs};
use crate::computation::Computation;
use crate::console::{Outcome, UsageError};
use crate::interrupts::Interrupts;
use crate::out_folder::check_out;
use crate::prepare::{Network, Prepared, Stages};
use crate::upload::{Uploaded, upload};

/// Arguments of `submit`.
#[derive(Debug, Args)]
#[command(
    after_help = "The same command again shares all that is done or under way; with -o it fetches the result of a \
    run that has ended.\n\
    Example: planesweep submit my-colmap-project -o out --coordinator http://10.0.0.1:7070"
)]
pub struct SubmitArgs {
    /// The scene.
    pub scene: PathBuf,
    /// Wait for the end, then write the result here.
    #[arg(short, long)]
    pub out: Option<PathBuf>,
    /// Print the run's id and wait for nothing.
    #[arg(long, conflicts_with = "out")]
    pub detach: bool,
    #[command(flatten)]
    pub connect: ConnectArgs,
    /// The weights, as `weights import` and `train` write them; by default those that come with the program.
    #[arg(long, env = "PLANESWEEP_WEIGHTS", value_name = "FILE")]
    pub weights: Option<PathBuf>,
    /// Where the workers infer; only `analytic`, the test double, makes a difference.
    #[arg(long, hide = true, default_value = "cpu")]
    pub device: String,
    /// Folder with a mask per view, NAME.png or STEM.png: what is black there gets no depth. By default
    /// STEM.mask.png beside the photographs.
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    /// Copy photographs and masks to the store, those that it does not have, for workers that do not find them
    /// under their paths; done in any case when this host does not reach the store but through the coordinator.
    #[arg(long)]
    pub upload: bool,
    #[command(flatten)]
    pub plan: PlanArgs,
    #[command(flatten)]
    pub filter: FilterArgs,
    #[command(flatten)]
    pub read: ReadArgs,
}

/// Submits a scene; waits and fetches the result unless told not to.
pub fn run(args: &SubmitArgs, json: bool) -> Result<Outcome> {
    let begun = Instant::now();
    match &args.out {
        Some(out) => check_out(out, &args.scene)?,
        None if args.detach => {}
        None => {
            bail!(UsageError("either -o OUT is needed or --detach, which waits for no result".to_owned()))
        }
    }
    let mut stages = Stages::new();
    let runtime = tokio::runtime::Runtime::new().context("cannot start the runtime")?;
    let interrupts = Interrupts::default();
    // Before anything that takes long.
    let (client, store) = runtime.block_on(async {
        let mut client = args.connect.client()?;
        let place = client.store().await;
        let place = place.with_context(|| format!("cannot submit to {}", args.connect.coordinator))?;
        let store = Store::of(&client, &place).await?.patient(interrupts.drain.clone());
        Ok::<_, anyhow::Error>((client, store))
    })?;
    let network = Network::read(args.weights.as_deref(), &args.device)?;
    let options = args.plan.options(Some(&args.filter));
    let prepared = Prepared::new(
        &args.scene,
        network,
        &options,
        &args.read.options(),
        args.masks.as_deref(),
        &mut stages,
    )?;
    if let Some(out) = &args.out {
        // Not at the end of a long run is it told that this cannot be.
        fs::create_dir_all(out).with_context(|| format!("cannot make the folder {}", out.display()))?;
    }
    if !json {
        eprintln!("{} views to infer, {} left out", prepared.plan.views.len(), prepared.left_out());
    }
    let put = store.put(prepared.network.bytes.clone().into());
    runtime.block_on(put).context("cannot store the weights")?;
    if args.upload || !store.is_reached_from_here() {
        let Uploaded { sent, files } = runtime.block_on(upload(&prepared.jobs, &store))?;
        eprintln!("{sent} of {files} photographs and masks uploaded, the store has the others");
    }
    let computation = Computation { client, store: &store, prepared: &prepared, exclusive: false };
    let Some(out) = &args.out else {
        let submitted = runtime.block_on(computation.submit(Vec::new()))?;
        let value = json!({ "run": submitted.run.0, "jobs": submitted.jobs, "reused": submitted.reused });
        let skipped_views = prepared.left_out() > 0;
        return Ok(Outcome { text: format!("{}\n", submitted.run.0), value, skipped_views });
    };
    let computing = Instant::now();
    let computed = runtime.block_on(async {
        interrupts.clone().listen("no longer waiting", None);
        let say_run = |run: &_| {
            eprintln!("run {run}");
            Ok(())
        };
        let computed = computation.run(&interrupts.drain, say_run).await?;
        interrupts.computed.cancel();
        computed.context(
            "stopped waiting; the run goes on: the same command again waits for it, `planesweep cancel` stops it",
        )
    })?;
    stages.push(("compute".to_owned(), computing.elapsed().as_secs_f64()));
    export::run(&Finished::new(out, &prepared, &store, &runtime, &computed), stages, begun)
}
