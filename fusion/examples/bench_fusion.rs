//! Milliseconds per view of each method of fusion, on a wavy surface seen by eleven cameras, alternating
//! with one thread and, if asked, with the same filter in numpy and OpenCV:
//!
//! ```text
//! cargo run --release -p planesweep-fusion --example bench_fusion -- --twin python3 --runs 15
//! ```
//!
//! `--width 288` runs one of the sizes alone, 96, 288 or 1152; `--method dynamic` that method.

use std::fmt::Write as _;
use std::fs;
use std::hint::black_box;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

use nalgebra::{Point2, Point3, Vector3};
use planesweep_fusion::{
    FilterOptions, FilteredMap, FusionMethod, VertexFormat, emit, emitted, encode, filter,
};
use planesweep_scene::{Camera, DepthMap, Intrinsics, Pose, Raster};

const NEIGHBOURS: usize = 10;
/// About how long ours is timed in a turn.
const TURN_MS: f64 = 20.0;
/// Longer than the threads of numpy and OpenCV wait in loops.
const IDLE: Duration = Duration::from_millis(200);
const METHODS: [FusionMethod; 4] = [
    FusionMethod::Consistency,
    FusionMethod::Dynamic,
    FusionMethod::Visibility,
    FusionMethod::VisibilityConfidence,
];

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let option = |name: &str| Some(arguments.get(arguments.iter().position(|a| a == name)? + 1)?.as_str());
    let runs = option("--runs").map_or(15, |runs| runs.parse().expect("--runs N"));
    let wanted = option("--method").map_or_else(
        || METHODS.to_vec(),
        |name| {
            METHODS.into_iter().filter(|method| format!("{method:?}").eq_ignore_ascii_case(name)).collect()
        },
    );
    let only = option("--width").map(|width| width.parse().expect("--width PIXELS"));
    for (width, height) in [(96, 72), (288, 216), (1152, 864)] {
        if only.is_some_and(|only: u32| only != width) {
            continue;
        }
        let maps: Vec<DepthMap> = (0..=NEIGHBOURS).map(|k| view(k, width, height)).collect();
        println!(
            "{width}x{height}, {NEIGHBOURS} neighbours, median of {runs} runs, with the least and the most"
        );
        methods(&maps, &wanted, runs);
        if let Some(python) = option("--twin") {
            against_twin(&maps, python, runs);
        }
    }
}

/// All methods, on all processors and on one.
fn methods(maps: &[DepthMap], methods: &[FusionMethod], runs: usize) {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool of one thread");
    let mut times = vec![(Vec::new(), Vec::new(), 0.0); methods.len()];
    let mut emit_ms = Vec::new();
    let (mut kept, mut kept_points) = (None, None);
    // Of each view: emission asks all of them.
    let filtered: Vec<FilteredMap> = (0..maps.len())
        .map(|view| {
            let others: Vec<&DepthMap> =
                maps.iter().enumerate().filter(|(other, _)| *other != view).map(|(_, map)| map).collect();
            filter(&maps[view], &others, &FilterOptions::default())
        })
        .collect();
    let others: Vec<&FilteredMap> = filtered[1..].iter().collect();
    for _ in 0..runs {
        for (method, (all, one, cpu)) in methods.iter().zip(&mut times) {
            let run = || black_box(fuse(maps, *method));
            all.push(milliseconds(&mut kept, run));
            let before = cpu_milliseconds();
            one.push(pool.install(|| milliseconds(&mut kept, run)));
            *cpu += cpu_milliseconds() - before;
        }
        emit_ms.push(milliseconds(&mut kept_points, || {
            encode(&emit(&filtered[0], &emitted(&filtered[0], &others, 0.01)), VertexFormat::default())
        }));
    }
    for (method, (all, one, cpu)) in methods.iter().zip(&times) {
        let funnel = fuse(maps, *method).funnel;
        let cpu = cpu / runs as f64;
        println!("  {method:?}: {} ms; one thread {} ms, {cpu:.2} ms of CPU", spread(all), spread(one));
        println!("    {funnel:?}");
    }
    println!("  emission of points, 10 neighbours asked: {} ms", spread(&emit_ms));
}

fn fuse(maps: &[DepthMap], method: FusionMethod) -> FilteredMap {
    let neighbours: Vec<&DepthMap> = maps[1..].iter().collect();
    filter(&maps[0], &neighbours, &FilterOptions { method, ..FilterOptions::default() })
}

/// Time of a run, and of dropping the result of the one before, which is kept until then as workers keep what others will
/// ask for.
fn milliseconds<T>(kept: &mut Option<T>, run: impl Fn() -> T) -> f64 {
    let begun = Instant::now();
    *kept = Some(black_box(run()));
    begun.elapsed().as_secs_f64() * 1e3
}

/// CPU time of all threads of this process so far.
fn cpu_milliseconds() -> f64 {
    let tasks = fs::read_dir("/proc/self/task").expect("a proc file system");
    let of = |task: fs::DirEntry| {
        let text = fs::read_to_string(task.path().join("schedstat")).unwrap_or_default();
        text.split(' ').next().and_then(|nanoseconds| nanoseconds.parse().ok()).unwrap_or(0.0)
    };
    tasks.map(|task| of(task.expect("a thread"))).sum::<f64>() / 1e6
}

/// Median, least and most.
fn spread(values: &[f64]) -> String {
    let mut values = values.to_vec();
    values.sort_by(f64::total_cmp);
    format!("{:.2} ({:.2} to {:.2})", values[values.len() / 2], values[0], values[values.len() - 1])
}

/// Consistency and its twin in turn, and how far the results differ.
fn against_twin(maps: &[DepthMap], python: &str, runs: usize) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    write_maps(maps, folder.path());
    let mut twin = Twin::start(python, folder.path());
    let (mut ours, mut theirs, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
    let (mut own_cpu, mut twin_cpu) = (0.0, 0.0);
    let mut kept = None;
    for _ in 0..runs {
        // Numpy's threads wait in loops for more to do, and would take a processor from us.
        sleep(IDLE);
        // The first run warms the caches that the other program emptied, as numpy's first does; then enough of them that
        // the second thread is awake for most of the time, as numpy's are.
        let first = milliseconds(&mut kept, || fuse(maps, FusionMethod::Consistency));
        let views = (TURN_MS / first).ceil().max(1.0);
        let before = cpu_milliseconds();
        let all =
            (0..views as usize).map(|_| milliseconds(&mut kept, || fuse(maps, FusionMethod::Consistency)));
        ours.push(all.sum::<f64>() / views);
        own_cpu += (cpu_milliseconds() - before) / views;
        twin.run();
        let [wall, cpu] = twin.run();
        theirs.push(wall);
        twin_cpu += cpu;
        ratios.push(theirs[theirs.len() - 1] / ours[ours.len() - 1]);
    }
    println!("  consistency: ours {} ms, twin {} ms", spread(&ours), spread(&theirs));
    let cpu = [own_cpu, twin_cpu].map(|sum| sum / runs as f64);
    println!(
        "  ratio: {}; of CPU time {:.1} ({:.2} and {:.2} ms)",
        spread(&ratios),
        cpu[1] / cpu[0],
        cpu[0],
        cpu[1]
    );
    twin.finish();
    let fused = fuse(maps, FusionMethod::Consistency);
    let read = |name: &str| fs::read(folder.path().join(name)).expect("the twin's result");
    let views = read("twin_views.u8");
    let depth = read("twin_depth.f32");
    let depth = depth.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes));
    let (mut kept, mut differing, mut most) = (0_u64, 0_u64, 0.0_f32);
    for ((own, views), (theirs, twin_views)) in
        fused.depth.values().iter().zip(fused.views.values()).zip(depth.zip(views))
    {
        kept += u64::from(*own > 0.0);
        differing += u64::from((*own > 0.0) != (theirs > 0.0));
        if *own > 0.0 && *views == twin_views {
            most = most.max((own - theirs).abs() / own);
        }
    }
    println!(
        "  masks differ in {differing} of {kept} kept pixels; depths of the same views by {most:.1e} at most"
    );
}

/// Writes the maps as `bench/fusion_twin.py` reads them.
fn write_maps(maps: &[DepthMap], folder: &Path) {
    let mut meta = format!("{} {} {}\n", maps[0].width(), maps[0].height(), maps.len());
    for (index, map) in maps.iter().enumerate() {
        let Pose { rotation, translation } = map.camera.pose;
        let rows = (0..3)
            .flat_map(|row| rotation.row(row).iter().copied().chain([translation[row]]).collect::<Vec<_>>());
        for number in map.camera.intrinsics.matrix().transpose().iter().copied().chain(rows) {
            write!(meta, "{number:.17e} ").expect("a string takes all");
        }
        for (name, raster) in [("depth", &map.depth), ("confidence", &map.confidence)] {
            let bytes: Vec<u8> = raster.values().iter().flat_map(|value| value.to_le_bytes()).collect();
            fs::write(folder.join(format!("{name}_{index}.f32")), bytes).expect("written");
        }
    }
    fs::write(folder.join("meta.txt"), meta).expect("written");
}

/// The filter in numpy, waiting for lines.
struct Twin {
    child: Child,
    orders: ChildStdin,
    answers: BufReader<ChildStdout>,
}

impl Twin {
    fn start(python: &str, folder: &Path) -> Self {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../bench/fusion_twin.py");
        let mut command = Command::new(python);
        command.arg(script).arg(folder).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn().expect("python starts");
        let orders = child.stdin.take().expect("piped");
        let mut answers = BufReader::new(child.stdout.take().expect("piped"));
        answers.read_line(&mut String::new()).expect("the twin says that it is ready");
        Self { child, orders, answers }
    }

    /// Milliseconds of one run, by the clock and of CPU time.
    fn run(&mut self) -> [f64; 2] {
        writeln!(self.orders, "run").expect("the twin listens");
        let mut line = String::new();
        self.answers.read_line(&mut line).expect("the twin answers");
        let mut seconds = line.split_whitespace().map(|text| text.parse::<f64>().expect("seconds") * 1e3);
        [seconds.next().expect("wall time"), seconds.next().expect("CPU time")]
    }

    /// Lets it write its result.
    fn finish(mut self) {
        drop(self.orders);
        self.child.wait().expect("the twin ends");
    }
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
