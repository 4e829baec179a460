//! Times one view on synthetic images, stage by stage:
//! `bench_infer WIDTH HEIGHT DEPTHS VIEWS [--threads N] [--runs N] [--torch]`.
//!
//! Each run has images of its own, so that no features are known. With `--torch` (and the feature of that name) runs of the plain
//! network alternate with ours; its memory then hides ours, so measure peaks without it.

use std::time::{Duration, Instant};

use nalgebra::{Point3, Vector3};
use planesweep_mvsnet::{
    CpuBackend, DepthBackend, InferInput, InferSize, InferTimes, Refinement, Weights, WeightsMetadata,
};
use planesweep_scene::{Camera, DepthHypotheses, Intrinsics, Pose, Raster, Sampling, WorkingImage};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let option = |name: &str| arguments.iter().position(|argument| argument == name);
    let number = |name: &str, default: usize| {
        option(name).and_then(|at| arguments.get(at + 1)?.parse().ok()).unwrap_or(default)
    };
    let size = |at: usize| arguments.get(at).and_then(|argument| argument.parse::<usize>().ok());
    let (Some(width), Some(height), Some(depths), Some(views)) = (size(0), size(1), size(2), size(3)) else {
        eprintln!("usage: bench_infer WIDTH HEIGHT DEPTHS VIEWS [--threads N] [--runs N] [--torch]");
        std::process::exit(2);
    };
    let (threads, runs) = (number("--threads", 2), number("--runs", 3));
    let mut images: Vec<_> = (0..views).map(|view| image(width, height, view)).collect();
    let hypotheses = DepthHypotheses::new(Sampling::Inverse, 2.0, 8.0, depths as u32).expect("a valid range");
    let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::None), 1);
    println!(
        "{width}x{height}, {depths} depths, {views} views, {threads} threads, {} MiB before",
        peak_mib()
    );
    let cost = CpuBackend::new(&weights, threads, None).expect("threads").predict(InferSize {
        width,
        height,
        depths,
        views,
    });
    println!("predicted {} MiB, {:.1} GFLOP", cost.bytes >> 20, cost.operations / 1e9);
    let mut backend = CpuBackend::new(&weights, threads, None).expect("threads");
    for run in 0..runs {
        // Another pixel makes it another image, whose features are not known.
        for image in &mut images {
            image.pixels.values_mut()[run][0] ^= 1;
        }
        let sources: Vec<_> = images[1..].iter().collect();
        let input = InferInput { reference: &images[0], sources: &sources, hypotheses: &hypotheses };
        let begin = Instant::now();
        let map = backend.infer(input).expect("a depth map");
        let seconds = begin.elapsed();
        report(backend.times(), seconds, (width, height, depths, views));
        let sum: f64 = map.depth.values().iter().map(|depth| f64::from(*depth)).sum();
        println!("  peak {} MiB, mean depth {:.6}", peak_mib(), sum / map.depth.values().len() as f64);
        #[cfg(feature = "torch")]
        if option("--torch").is_some() {
            let mut torch =
                planesweep_mvsnet::TorchBackend::new(&weights, "cpu", threads).expect("the CPU is there");
            let begin = Instant::now();
            torch.infer(input).expect("a depth map");
            println!("plain libtorch {:.3} s", begin.elapsed().as_secs_f64());
        }
    }
}

fn report(times: InferTimes, all: Duration, (width, height, depths, views): (usize, usize, usize, usize)) {
    let pixels = (width.next_multiple_of(32) * height.next_multiple_of(32)) as f64;
    let voxels = pixels / 16.0 * depths as f64;
    // Operations of the plain convolutions; Winograd's are fewer.
    let stages = [
        ("features", times.features, pixels * 9400.0 * views as f64),
        ("cost and first layer", times.cost, voxels * (13824.0 + 380.0 * (views as f64 - 1.0))),
        ("other 3D layers", times.regularization, voxels * 6048.0),
        ("last layer, regression", times.regression, voxels * 432.0),
        ("refinement", times.refinement, 0.0),
    ];
    for (name, time, operations) in stages {
        let seconds = time.as_secs_f64();
        println!("  {name:24} {seconds:.3} s {:6.0} GFLOP/s", operations / seconds / 1e9);
    }
    println!("ours {:.3} s", all.as_secs_f64());
}

/// A view of waves on a plane that is not fronto-parallel, from a place beside the first.
fn image(width: usize, height: usize, view: usize) -> WorkingImage {
    let x = [0.0, 0.15, -0.15, 0.3, -0.3].get(view).copied().unwrap_or(0.1 * view as f64);
    let (fx, cx, cy) = (width as f64, width as f64 / 2.0, height as f64 / 2.0);
    let intrinsics = Intrinsics { width: width as u32, height: height as u32, fx, fy: fx, skew: 0.0, cx, cy };
    let pose = Pose::look_at(&Point3::new(x, 0.05 * x, 0.0), &Point3::new(0.0, 0.0, 4.0), &-Vector3::y());
    let pixels = Raster::from_fn(width, height, |u, v| {
        let (u, v) = (u as f64 + x * 300.0, v as f64);
        let wave = |a: f64, b: f64| (128.0 + 120.0 * (u * a + v * b).sin() * (v * a * 0.7).cos()) as u8;
        [wave(0.21, 0.05), wave(0.07, 0.31), wave(0.5, 0.11)]
    });
    WorkingImage { camera: Camera { intrinsics, pose }, pixels }
}

/// The most memory this process has had.
fn peak_mib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"));
    line.and_then(|line| line.split_whitespace().next()?.parse::<u64>().ok()).unwrap_or(0) / 1024
}
