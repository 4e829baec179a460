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
    let arguments: Result<Vec<usize>, _> = std::env::args().skip(1).map(|a| a.parse()).collect();
    let [width, height, depths, views, threads, runs] = match arguments.as_deref() {
        Ok([]) => [320, 256, 64, 3, 2, 5],
        Ok(&[a, b, c, d, e, f]) => [a, b, c, d, e, f],
        _ => {
            eprintln!("usage: bench_train [WIDTH HEIGHT DEPTHS VIEWS THREADS RUNS]");
            std::process::exit(2);
        }
    };
    let config = TrainConfig::default();
    let example = example(config.network, [width, height], depths as u32, views);
    let weights = initial_weights(config.network, 1);
    let options =
        GradientOptions { network: config.network, loss: config.loss, statistics: BatchStatistics::Own };
    let mut ours = KernelEngine::new(threads).expect("threads");
    let mut stock = TorchEngine::new("cpu", threads).expect("a processor");
    let time = |engine: &mut dyn GradientEngine| {
        let (begun, before) = (Instant::now(), processor_seconds());
        let gradient = engine.gradient(&weights, &example, &options).expect("a gradient");
        Timed {
            wall: begun.elapsed().as_secs_f64(),
            processor: processor_seconds() - before,
            loss: gradient.loss,
        }
    };
    println!("{width}x{height}, {views} views, {depths} planes, {threads} threads");
    // The first steps take memory from the system.
    let (_, first) = (time(&mut stock), time(&mut ours));
    let mut pairs = Vec::new();
    for _ in 0..runs {
        let (ours, stock) = (time(&mut ours), time(&mut stock));
        println!(
            "ours {:.3} s ({:.3} s of processors), libtorch {:.3} s ({:.3} s), ratio {:.2}; losses {:.5}, {:.5}",
            ours.wall,
            ours.processor,
            stock.wall,
            stock.processor,
            stock.wall / ours.wall,
            ours.loss,
            stock.loss,
        );
        pairs.push((ours, stock));
    }
    let of = |what: &str, seconds: fn(&Timed) -> f64| {
        let [least, median, greatest] =
            spread(pairs.iter().map(|(ours, stock)| seconds(stock) / seconds(ours)).collect());
        let [_, ours, _] = spread(pairs.iter().map(|(ours, _)| seconds(ours)).collect());
        let [_, stock, _] = spread(pairs.iter().map(|(_, stock)| seconds(stock)).collect());
        println!(
            "{what}: median {ours:.3} s and {stock:.3} s; ratio: median {median:.2}, from {least:.2} to {greatest:.2}"
        );
    };
    of("wall time", |timed| timed.wall);
    // libtorch's threads that wait for each other count as if they worked.
    of("processor time", |timed| timed.processor);
    println!("first loss {:.5}", first.loss);
}

struct Timed {
    wall: f64,
    processor: f64,
    loss: f64,
}

/// The least, the median and the greatest.
fn spread(mut values: Vec<f64>) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    [values[0], values[values.len() / 2], values[values.len() - 1]]
}

/// What all threads have spent on processors, where the system says so.
fn processor_seconds() -> f64 {
    let threads = std::fs::read_dir("/proc/self/task").into_iter().flatten().flatten();
    let nanoseconds = threads.filter_map(|thread| {
        let text = std::fs::read_to_string(thread.path().join("schedstat")).ok()?;
        text.split_whitespace().next()?.parse::<f64>().ok()
    });
    nanoseconds.sum::<f64>() / 1e9
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
