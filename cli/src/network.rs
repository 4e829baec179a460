//! From `--weights` and `--device` to a network.

use std::path::Path;

use anyhow::{Context, Result, bail};
use nalgebra::Vector3;
use planesweep_mvsnet::{
    AnalyticBackend, CpuBackend, DepthBackend, InferCost, InferSize, TorchBackend, Weights,
};
use planesweep_plan::{Plan, ViewPlan};
use planesweep_worker::BackendFactory;

/// The device of the test double.
const ANALYTIC: &str = "analytic";
/// Depth of the plane that the test double knows.
const ANALYTIC_DEPTH: f64 = 5.0;

/// What stands for the weights of the test double, so that its results are never taken for real ones.
const ANALYTIC_WEIGHTS: &[u8] = b"analytic backend";

/// Whether this names a device; whether there is one shows when it is used.
pub fn is_device(name: &str) -> bool {
    let is_numbered = name.strip_prefix("cuda:").is_some_and(|number| number.parse::<u32>().is_ok());
    is_numbered || ["cpu", "torch", "cuda", ANALYTIC].contains(&name)
}

/// The bytes that the device loads its network from.
pub fn weights_for(device: &str, weights: Vec<u8>) -> Vec<u8> {
    if device == ANALYTIC { ANALYTIC_WEIGHTS.to_vec() } else { weights }
}

/// Reads a weights file and checks that it is one.
pub fn read_weights(path: &Path) -> Result<(Vec<u8>, Weights)> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read weights {}", path.display()))?;
    let weights =
        Weights::from_bytes(&bytes).with_context(|| format!("cannot use weights {}", path.display()))?;
    Ok((bytes, weights))
}

/// The weights in this file, or those that come with the program.
pub fn weights_or_default(path: Option<&Path>) -> Result<(Vec<u8>, Weights)> {
    let Some(path) = path else {
        let bytes = Weights::default_file();
        let weights = Weights::from_bytes(bytes).context("cannot use the weights of this program")?;
        return Ok((bytes.to_vec(), weights));
    };
    read_weights(path)
}

/// How a network is run.
#[derive(Clone, Debug)]
pub struct Placement {
    /// "cpu" (kernels of our own), "torch" (the plain network of libtorch on the processor), "cuda" or
    /// "cuda:N".
    pub device: String,
    /// Threads of one inference; they change no bit of the result.
    pub threads: usize,
    /// What one inference may hold in memory, where the device can choose.
    pub memory_bytes: Option<u64>,
}

/// Makes networks.
pub fn backend_factory(placement: &Placement) -> Result<BackendFactory> {
    let Placement { device, threads, memory_bytes } = placement.clone();
    match device.as_str() {
        ANALYTIC => Ok(Box::new(|_| Ok(Box::new(AnalyticBackend::new(Vector3::z(), ANALYTIC_DEPTH))))),
        "cpu" => Ok(Box::new(move |bytes| {
            let weights = Weights::from_bytes(bytes)?;
            let backend: Box<dyn DepthBackend> = Box::new(CpuBackend::new(&weights, threads, memory_bytes)?);
            Ok(backend)
        })),
        name if name == "torch" || name == "cuda" || name.starts_with("cuda:") => {
            let device = if name == "torch" { "cpu".to_owned() } else { name.to_owned() };
            Ok(Box::new(move |bytes| {
                let weights = Weights::from_bytes(bytes)?;
                let backend: Box<dyn DepthBackend> = Box::new(TorchBackend::new(&weights, &device, threads)?);
                Ok(backend)
            }))
        }
        _ => bail!("device \"{device}\" is none of cpu, torch, cuda and cuda:N"),
    }
}

/// What a worker needs beside its inference: images, depth maps, the program itself.
pub const WORKER_BYTES: u64 = 400 << 20;
/// The plain network's peak, in bytes per voxel of the padded volume: the cost volume of 32 floats
/// and what is alive beside it.
const PLAIN_BYTES_PER_VOXEL: u64 = 32 * 4 * 2;

/// Sizes of the inference of a view.
pub fn infer_size(view: &ViewPlan, refined: bool) -> InferSize {
    InferSize {
        width: view.working_size.0 as usize,
        height: view.working_size.1 as usize,
        depths: view.hypotheses.count() as usize,
        views: view.sources.len() + 1,
        refined,
    }
}

/// Threads that one inference on the processor keeps busy.
const THREADS_PER_WORKER: usize = 8;

/// As many workers as make the machine busy, while the memory that is available holds them.
pub fn default_workers(plan: &Plan, device: &str, refined: bool) -> u32 {
    let inference_bytes = |view: &ViewPlan| {
        let size = infer_size(view, refined);
        if device == "cpu" {
            InferCost::predict(size, 1, None).bytes
        } else {
            let quarter = |side: usize| side.next_multiple_of(32) as u64 / 4;
            quarter(size.width) * quarter(size.height) * size.depths as u64 * PLAIN_BYTES_PER_VOXEL
        }
    };
    let worker_bytes = WORKER_BYTES + plan.views.iter().map(inference_bytes).max().unwrap_or(0);
    // The kernels of our own keep several processors busy with one view and share its features; the
    // plain network does not.
    let threads = if device == "cpu" { THREADS_PER_WORKER } else { 1 };
    let most = processors().div_ceil(threads).min(plan.views.len().max(1)) as u64;
    (available_bytes() / worker_bytes).clamp(1, most) as u32
}

/// Processors of this machine that the program may use.
pub fn processors() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Memory that is free or can be freed, in bytes: the machine's, or the container's where that is less.
fn available_bytes() -> u64 {
    let meminfo = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let line = meminfo.lines().find_map(|line| line.strip_prefix("MemAvailable:"));
    let kib = line.and_then(|rest| rest.split_whitespace().next()?.parse::<u64>().ok());
    let machine = kib.unwrap_or(0) << 10;
    let cgroup = |file: &str| -> Option<u64> {
        std::fs::read_to_string(format!("/sys/fs/cgroup/{file}")).ok()?.trim().parse().ok()
    };
    match (cgroup("memory.max"), cgroup("memory.current")) {
        (Some(limit), Some(used)) => machine.min(limit.saturating_sub(used)),
        _ => machine,
    }
}
