//! The clouds of our network and of libtorch's plain one, over every scene of the data beside the checkout:
//! `cargo run --release -p planesweep-tests --example compare_clouds -- OUT [MAX_SIZE]`.
//!
//! Results stay in OUT/cpu and OUT/torch, and running it again resumes. Distances are relative to that from the nearest
//! camera.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use nalgebra::{Point3, distance};
use planesweep_fusion::read_ply;
use planesweep_tests::{reference_weights, run, shared_scenes};

const NAME: &str = "compare_clouds";

/// The longest side that every scene is reduced to unless a second argument names another.
const MAX_SIZE: &str = "640";

/// Points nearer than this, relative to the nearest camera, are the same.
const SAME: f64 = 1e-4;
/// Cells in which neighbours are looked for, relative to the farthest point.
const CELL: f64 = 1e-3;

fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let Some(out) = arguments.next().map(PathBuf::from) else {
        eprintln!("usage: compare_clouds OUT [MAX_SIZE]");
        return ExitCode::from(2);
    };
    let max_size = arguments.next().unwrap_or_else(|| MAX_SIZE.to_owned());
    fs::create_dir_all(&out).expect("the folder for results");
    let Some(weights) = reference_weights(NAME, &out) else { return ExitCode::FAILURE };
    println!(
        "{:20} {:>8} {:>8} {:>8} {:>9} {:>9} {:>9}",
        "scene", "ours", "plain", "counts", "in plain", "in ours", "median"
    );
    for (name, scene) in shared_scenes(NAME, &out) {
        let [ours, plain] = ["cpu", "torch"].map(|device| {
            let result = out.join(device).join(name);
            let arguments = ["reconstruct", text(&scene), "-o", text(&result), "--weights", text(&weights)];
            let more = ["--json", "--max-size", &max_size, "--device", device];
            let finished = run(arguments.into_iter().chain(more));
            // Skipped views are no failure.
            matches!(finished.code, Some(0 | 3)).then(|| Cloud::read(&result))
        });
        let (Some(ours), Some(plain)) = (ours, plain) else {
            println!("{name:20} gives no cloud");
            continue;
        };
        let (here, there) = (ours.distances(&plain), plain.distances(&ours));
        let share = |distances: &[f64]| {
            let same = distances.iter().filter(|distance| **distance <= SAME).count();
            same as f64 / distances.len().max(1) as f64
        };
        let counts = ours.points.len() as f64 / plain.points.len() as f64 - 1.0;
        println!(
            "{name:20} {:>8} {:>8} {:>7.3}% {:>8.3}% {:>8.3}% {:>9.1e}",
            ours.points.len(),
            plain.points.len(),
            100.0 * counts,
            100.0 * share(&here),
            100.0 * share(&there),
            here[here.len() / 2],
        );
    }
    ExitCode::SUCCESS
}

struct Cloud {
    points: Vec<Point3<f64>>,
    cameras: Vec<Point3<f64>>,
}

impl Cloud {
    fn read(result: &Path) -> Self {
        let points = read_ply(&result.join("cloud.ply")).expect("a cloud");
        let points = points.iter().map(|point| Point3::from(point.position)).collect();
        let log = fs::read_to_string(result.join("trajectory.log")).expect("the cameras");
        let numbers: Vec<f64> =
            log.split_whitespace().map(|number| number.parse().expect("a number")).collect();
        // Three integers, then a pose from the camera to the world.
        let cameras = numbers.chunks_exact(19).map(|pose| Point3::new(pose[6], pose[10], pose[14])).collect();
        Self { points, cameras }
    }

    fn depth(&self, point: &Point3<f64>) -> f64 {
        self.cameras.iter().map(|camera| distance(camera, point)).fold(f64::INFINITY, f64::min)
    }

    /// From each point to the nearest of another cloud, relative to the nearest camera, sorted.
    fn distances(&self, other: &Self) -> Vec<f64> {
        let depths: Vec<f64> = self.points.iter().map(|point| self.depth(point)).collect();
        let size = CELL * depths.iter().copied().fold(0.0, f64::max);
        let cell = |point: &Point3<f64>| point.coords.map(|x| (x / size).floor() as i64);
        let mut cells: HashMap<_, Vec<Point3<f64>>> = HashMap::new();
        for point in &other.points {
            cells.entry(cell(point)).or_default().push(*point);
        }
        let mut distances: Vec<f64> = self
            .points
            .iter()
            .zip(&depths)
            .map(|(point, depth)| {
                let middle = cell(point);
                let mut nearest = f64::INFINITY;
                for neighbour in 0..27 {
                    let offset =
                        nalgebra::Vector3::new(neighbour % 3 - 1, neighbour / 3 % 3 - 1, neighbour / 9 - 1);
                    for candidate in cells.get(&(middle + offset)).into_iter().flatten() {
                        nearest = nearest.min(distance(point, candidate));
                    }
                }
                nearest / depth
            })
            .collect();
        distances.sort_by(f64::total_cmp);
        distances
    }
}

fn text(path: &Path) -> &str {
    path.to_str().expect("the paths are UTF-8")
}
