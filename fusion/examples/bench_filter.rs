//! Milliseconds per view of the filter and of the emission of points, on a wavy surface seen by ten
//! cameras: `cargo run --release -p planesweep-fusion --example bench_filter`.

use std::hint::black_box;
use std::time::Instant;

use nalgebra::{Point2, Point3, Vector3};
use planesweep_fusion::{FilterOptions, emit, encode, filter};
use planesweep_scene::{Camera, DepthMap, Intrinsics, Pose, Raster};

const VIEWS: usize = 10;
const RUNS: usize = 20;

fn main() {
    println!("{} threads, {VIEWS} views", rayon_threads());
    for (width, height) in [(288, 216), (1152, 864)] {
        let maps: Vec<DepthMap> = (0..VIEWS).map(|k| view(k, width, height)).collect();
        let neighbours: Vec<&DepthMap> = maps[1..].iter().collect();
        let options = FilterOptions::default();
        let filtered = filter(&maps[0], &neighbours, &options);
        let filter_ms = least_ms(|| {
            black_box(filter(&maps[0], &neighbours, &options));
        });
        let emit_ms = least_ms(|| {
            black_box(emit(&filtered));
        });
        let points = emit(&filtered);
        let encode_ms = least_ms(|| {
            black_box(encode(&points));
        });
        println!(
            "{width}x{height}, {} neighbours: filter {filter_ms:.2} ms, emit {emit_ms:.2} ms, encode {encode_ms:.2} ms per view, {:?}",
            neighbours.len(),
            filtered.funnel
        );
    }
}

fn rayon_threads() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// A surface `z = 0.1 sin(3 x) cos(2 y)` seen from `z = -3`; a fifth of the pixels unsure, some wrong.
fn view(index: usize, width: u32, height: u32) -> DepthMap {
    let f = width as f64 * 0.9;
    let (cx, cy) = (width as f64 / 2.0, height as f64 / 2.0);
    let intrinsics = Intrinsics { width, height, fx: f, fy: f, skew: 0.0, cx, cy };
    let angle = index as f64 * 0.63;
    let centre = Point3::new(0.5 * angle.cos(), 0.4 * angle.sin(), -3.0);
    let pose = Pose::look_at(&centre, &Point3::origin(), &-Vector3::y());
    let camera = Camera { intrinsics, pose };
    let (columns, rows) = (width as usize, height as usize);
    let surface = |x: f64, y: f64| 0.1 * (3.0 * x).sin() * (2.0 * y).cos();
    let depth = Raster::from_fn(columns, rows, |x, y| {
        let pixel = Point2::new(x as f64, y as f64);
        let mut depth = 3.0;
        for _ in 0..8 {
            let point = camera.unproject(&pixel, depth);
            let along = camera.unproject(&pixel, 1.0) - camera.pose.centre();
            depth += (surface(point.x, point.y) - point.z) / along.z;
        }
        if hash(x, y, index).is_multiple_of(11) { depth as f32 * 1.05 } else { depth as f32 }
    });
    let confidence =
        Raster::from_fn(
            columns,
            rows,
            |x, y| {
                if hash(x / 9, y / 9, index).is_multiple_of(5) { 0.5 } else { 0.95 }
            },
        );
    let color = Raster::from_fn(columns, rows, |x, y| [x as u8, y as u8, index as u8 * 20]);
    DepthMap::new(camera, depth, confidence, color).expect("sizes agree")
}

fn hash(x: usize, y: usize, k: usize) -> usize {
    let mixed = (x * 0x9E37_79B1) ^ (y * 0x85EB_CA77) ^ (k * 0xC2B2_AE3D);
    (mixed ^ (mixed >> 15)).wrapping_mul(0x2C1B_3C6D) >> 12
}

/// The least of several times: the run that others on the machine disturbed least.
fn least_ms(mut run: impl FnMut()) -> f64 {
    let times = (0..RUNS).map(|_| {
        let start = Instant::now();
        run();
        start.elapsed().as_secs_f64() * 1e3
    });
    times.fold(f64::INFINITY, f64::min)
}
