//! What a coordinator costs: a plan of any size, done by simulated workers that compute nothing.
//!
//! ```text
//! cargo run -p planesweep-coordinator --example bench_coordinator -- VIEWS WORKERS [LEDGER]
//! ```
//!
//! Each view has three jobs (5 images, 10 neighbours), and there is the cloud. Coordinator and workers
//! share this process and talk over loopback sockets; the ledger is an SQLite file in the folder for
//! temporary files unless another is named.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use planesweep_coordinator::{Config, Coordinator, LedgerPlace};
use planesweep_fusion::FilterOptions;
use planesweep_plan::{
    AssembleSpec, BlobKey, EmitSpec, FilterSpec, ImageSpec, InferSpec, Job, JobId, JobSpec, NUMERICS_VERSION,
    WorkerId,
};
use planesweep_proto::{
    CODE_VERSION, Client, Endpoint, FinishedJob, Order, Outcome, PROTOCOL_VERSION, Report, Role, Slots,
    SubmitHeader, Success, WorkerState,
};
use planesweep_scene::{Camera, DepthHypotheses, Distortion, Intrinsics, Pose, Sampling, ViewId};

const SOURCES: u32 = 4;
const NEIGHBOURS: u32 = 10;
/// Jobs of each class that a worker holds.
const SLOTS: u32 = 2;

#[tokio::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [views, workers, ..] = &*arguments else { return Err("VIEWS WORKERS [LEDGER] are needed".into()) };
    let (views, workers): (u32, u32) = (views.parse()?, workers.parse()?);
    let folder = tempfile::tempdir()?;
    let ledger = match arguments.get(2) {
        Some(ledger) => LedgerPlace::from(&**ledger),
        None => folder.path().join("ledger.sqlite").into(),
    };
    let jobs = plan(views);
    let count = jobs.len();
    let before = memory_mib("VmRSS")?;
    let coordinator = Coordinator::start(Config::new(ledger, "file:///nowhere")).await?;
    let begun = Instant::now();
    let header = SubmitHeader { name: "bench".to_owned(), ..SubmitHeader::default() };
    let run = coordinator.submit(header, jobs).await?.run;
    let submitting = begun.elapsed().as_secs_f64();
    println!("submitted {count} jobs in {submitting:.1} s, {:.0} us each", 1e6 * submitting / count as f64);

    let begun = Instant::now();
    let reports = Arc::new(AtomicU64::new(0));
    let url = coordinator.url();
    let tasks: Vec<_> = (0..workers).map(|k| tokio::spawn(work(url.clone(), k, reports.clone()))).collect();
    let status = coordinator.wait_finished(&run).await?;
    let seconds = begun.elapsed().as_secs_f64();
    let reports = reports.load(Ordering::Relaxed);
    println!(
        "{workers} workers: {seconds:.1} s, {:.0} grants per second, {:.0} us per job, {:.0} reports per second",
        count as f64 / seconds,
        1e6 * seconds / count as f64,
        reports as f64 / seconds
    );
    println!(
        "memory: {} MiB at most, {before} MiB of them the plan before it was submitted",
        memory_mib("VmHWM")?
    );
    assert!(status.finished && status.late_results == 0);
    coordinator.shutdown().await;
    for task in tasks {
        task.await??;
    }
    Ok(())
}

/// A worker whose jobs are done as soon as it has them.
async fn work(
    url: String,
    number: u32,
    reports: Arc<AtomicU64>,
) -> Result<(), planesweep_proto::ServiceError> {
    let mut client = Client::connect(&url, None)?;
    let mut finished = Vec::new();
    for sequence in 1.. {
        let report = Report {
            protocol_version: PROTOCOL_VERSION,
            code_version: CODE_VERSION.to_owned(),
            numerics_version: NUMERICS_VERSION,
            worker: WorkerId(format!("w{number}")),
            sequence,
            host: "bench".to_owned(),
            boot_id: String::new(),
            role: Role::Both,
            device: "none".to_owned(),
            state: WorkerState::Ready,
            free: Slots { infer: SLOTS, fuse: SLOTS },
            offset_ms: sequence,
            held: Vec::new(),
            finished: std::mem::take(&mut finished),
            max_wait: std::time::Duration::from_secs(2),
            endpoint: Endpoint::default(),
        };
        let reply = client.report(&report).await?;
        reports.fetch_add(1, Ordering::Relaxed);
        if reply.order == Order::Stop {
            break;
        }
        finished = reply
            .grants
            .into_iter()
            .map(|grant| {
                let outcome = Outcome::Success(Success {
                    blob: BlobKey(grant.job.0),
                    length: 1,
                    measurements: BTreeMap::new(),
                    seconds: 0.0,
                });
                FinishedJob { job: grant.job, attempt: grant.attempt, outcome }
            })
            .collect();
    }
    Ok(())
}

/// Infer, filter and emit for each view, against the views before and after it, and the cloud.
fn plan(views: u32) -> Vec<Job> {
    let id = |kind: &str, view: u32| JobId(BlobKey::of(format!("{kind} {view}").as_bytes()).0);
    let near =
        |view: u32, count: u32| (1..=count).map(move |k| (view + k) % views).filter(move |v| *v != view);
    let neighbours = |view: u32| near(view, NEIGHBOURS).map(ViewId).collect::<Vec<_>>();
    let with_near = |kind: &'static str, view: u32| {
        std::iter::once(view).chain(near(view, NEIGHBOURS)).map(|view| id(kind, view)).collect::<Vec<_>>()
    };
    let hypotheses = DepthHypotheses::new(Sampling::Uniform, 1.0, 9.0, 192).expect("a valid range");
    let mut jobs = Vec::new();
    for view in 0..views {
        let spec = JobSpec::Infer(InferSpec {
            reference: image(view),
            sources: near(view, SOURCES).map(image).collect(),
            hypotheses,
            rows: None,
            weights: BlobKey::of(b"weights"),
        });
        jobs.push(Job { id: id("infer", view), spec, needs: Vec::new() });
    }
    for view in 0..views {
        let options = FilterOptions::default();
        let spec = JobSpec::Filter(FilterSpec { view: ViewId(view), neighbours: neighbours(view), options });
        jobs.push(Job { id: id("filter", view), spec, needs: with_near("infer", view) });
    }
    for view in 0..views {
        let spec = JobSpec::Emit(EmitSpec {
            view: ViewId(view),
            neighbours: neighbours(view),
            max_relative_depth: 0.01,
            double: false,
        });
        jobs.push(Job { id: id("emit", view), spec, needs: with_near("filter", view) });
    }
    let spec = JobSpec::Assemble(AssembleSpec { views: (0..views).map(ViewId).collect() });
    let needs = (0..views).map(|view| id("emit", view)).collect();
    jobs.push(Job { id: id("assemble", 0), spec, needs });
    jobs
}

fn image(view: u32) -> ImageSpec {
    let intrinsics = Intrinsics { width: 64, height: 48, fx: 50.0, fy: 50.0, skew: 0.0, cx: 31.5, cy: 23.5 };
    let centre = [f64::from(view), 0.0, -5.0].into();
    let pose = Pose::look_at(&centre, &[f64::from(view), 0.0, 0.0].into(), &[0.0, 1.0, 0.0].into());
    ImageSpec {
        view: ViewId(view),
        name: format!("{view:08}.jpg"),
        path: format!("/scenes/flight/images/{view:08}.jpg").into(),
        hash: BlobKey::of(&view.to_be_bytes()),
        camera: Camera { intrinsics, pose },
        distortion: Distortion::None,
        working_width: 64,
        working_height: 48,
    }
}

/// A line of what the kernel says of this process's memory.
fn memory_mib(name: &str) -> Result<u64, Box<dyn std::error::Error>> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix(name)).ok_or("the kernel does not say")?;
    let kib: u64 = line.trim_matches(|c: char| !c.is_ascii_digit()).parse()?;
    Ok(kib >> 10)
}
