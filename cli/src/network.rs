//! From `--weights` and `--device` to a network.

use std::path::Path;

use anyhow::{Context, Result, bail};
use nalgebra::Vector3;
use planesweep_mvsnet::{AnalyticBackend, DepthBackend, TorchBackend, Weights};
use planesweep_plan::Plan;
use planesweep_worker::BackendFactory;

/// The device of the test double.
const ANALYTIC: &str = "analytic";
/// Depth of the plane that the test double knows.
const ANALYTIC_DEPTH: f64 = 5.0;

/// What stands for the weights of the test double, so that its results are never taken for real ones.
const ANALYTIC_WEIGHTS: &[u8] = b"analytic backend";

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

/// Makes networks on a device, such as "cpu", "cuda" or "cuda:1".
pub fn backend_factory(device: &str) -> Result<BackendFactory> {
    if device == ANALYTIC {
        return Ok(Box::new(|_, _| Ok(Box::new(AnalyticBackend::new(Vector3::z(), ANALYTIC_DEPTH)))));
    }
    if device != "cpu" && device != "cuda" && !device.starts_with("cuda:") {
        bail!("device \"{device}\" is none of cpu, cuda and cuda:N");
    }
    let device = device.to_owned();
    Ok(Box::new(move |bytes, threads| {
        let weights = Weights::from_bytes(bytes)?;
        let backend: Box<dyn DepthBackend> =
            Box::new(TorchBackend::new(&weights, &device, threads as usize)?);
        Ok(backend)
    }))
}

/// What a worker needs beside the network's volumes.
const WORKER_BYTES: u64 = 500 << 20;
/// The plain network's peak, in bytes per voxel of the padded volume: the cost volume of 32 floats
/// and what is alive beside it.
const BYTES_PER_VOXEL: u64 = 32 * 4 * 2;

/// As many workers as there are processors, while the memory that is available holds them.
pub fn default_workers(plan: &Plan) -> u32 {
    let processors = std::thread::available_parallelism().map_or(1, usize::from) as u64;
    let voxels = plan.views.iter().map(|view| {
        let quarter = |side: u32| u64::from(side.next_multiple_of(32) / 4);
        let (width, height) = view.working_size;
        quarter(width) * quarter(height) * u64::from(view.hypotheses.count())
    });
    let worker_bytes = WORKER_BYTES + BYTES_PER_VOXEL * voxels.max().unwrap_or(0);
    (available_bytes() / worker_bytes).clamp(1, processors).min(plan.views.len().max(1) as u64) as u32
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
