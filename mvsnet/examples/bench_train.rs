//! Steps of training by our own kernels and by libtorch's autograd, alternating.
//!
//! `bench_train WIDTH HEIGHT DEPTHS VIEWS THREADS RUNS`

use std::time::Instant;

use nalgebra::{Point3, Vector3};
use planesweep_mvsnet::train::{
    BatchStatistics, Example, GradientEngine, GradientOptions, KernelEngine, NetworkConfig, TorchEngine,
    TrainConfig, initial_weights,
};
use planesweep_scene::{
    Camera, DepthHypotheses, DepthRange, Intrinsics, Pose, Raster, Sampling, TrainingSample, WorkingImage,
};

fn main() {
    let arguments: Vec<usize> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let [width, height, depths, views, threads, runs] = match arguments[..] {
        [a, b, c, d, e, f] => [a, b, c, d, e, f],
        _ => [320, 256, 64, 3, 2, 5],
    };
    let config = TrainConfig::default();
    let example = example(config.network, [width, height], depths as u32, views);
    let weights = initial_weights(config.network, 1);
    let options =
        GradientOptions { network: config.network, loss: config.loss, statistics: BatchStatistics::Own };
    let mut ours = KernelEngine::new(threads).expect("threads");
    let mut stock = TorchEngine::new("cpu", threads).expect("a processor");
    let time = |engine: &mut dyn GradientEngine| {
        let begun = Instant::now();
        let gradient = engine.gradient(&weights, &example, &options).expect("a gradient");
        (begun.elapsed().as_secs_f64(), gradient.loss)
    };
    println!("{width}x{height}, {views} views, {depths} planes, {threads} threads");
    // The first steps take memory from the system.
    let (_, first) = (time(&mut stock), time(&mut ours));
    let mut ratios = Vec::new();
    let (mut least_ours, mut least_stock) = (f64::INFINITY, f64::INFINITY);
    for _ in 0..runs {
        let (ours, loss) = time(&mut ours);
        let (stock, stock_loss) = time(&mut stock);
        println!(
            "ours {ours:.3} s, libtorch {stock:.3} s, ratio {:.2}; losses {loss:.5}, {stock_loss:.5}",
            stock / ours
        );
        ratios.push(stock / ours);
        (least_ours, least_stock) = (least_ours.min(ours), least_stock.min(stock));
    }
    ratios.sort_by(f64::total_cmp);
    println!(
        "ratio: median {:.2}, from {:.2} to {:.2}; of the fastest steps ({least_ours:.3} s, {least_stock:.3} s) {:.2}; first loss {:.5}",
        ratios[ratios.len() / 2],
        ratios[0],
        ratios[ratios.len() - 1],
        least_stock / least_ours,
        first.1,
    );
}

/// A slanted surface before cameras in a row.
fn example(network: NetworkConfig, [width, height]: [usize; 2], depths: u32, views: usize) -> Example {
    let camera = |i: usize| {
        let fx = width as f64;
        let (cx, cy) = ((width - 1) as f64 / 2.0, (height - 1) as f64 / 2.0);
        let intrinsics =
            Intrinsics { width: width as u32, height: height as u32, fx, fy: fx, skew: 0.0, cx, cy };
        let centre =
            Point3::new(0.4 * i.div_ceil(2) as f64 * if i.is_multiple_of(2) { 1.0 } else { -1.0 }, 0.0, 0.0);
        Camera { intrinsics, pose: Pose::look_at(&centre, &Point3::new(0.0, 0.0, 4.0), &-Vector3::y()) }
    };
    let view = |i: usize| WorkingImage {
        camera: camera(i),
        pixels: Raster::from_fn(width, height, |x, y| {
            let x = x + 5 * i;
            [(x * x / 7 + y) as u8, ((x * 5) ^ (y * 3)) as u8, (y * y / 5 + 2 * x) as u8]
        }),
    };
    let depth = Raster::from_fn(width / 4, height / 4, |x, y| {
        3.0 + x as f32 / width as f32 * 8.0 + y as f32 / height as f32 * 4.0
    });
    let range = DepthRange { min: 2.5, max: 9.0, count: None };
    let sample = TrainingSample { views: (0..views).map(view).collect(), depth, range };
    let hypotheses = DepthHypotheses::new(Sampling::Inverse, 2.5, 9.0, depths).expect("a valid range");
    Example::new(&sample, hypotheses, network).expect("a fine example")
}
