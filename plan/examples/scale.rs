//! How time and memory of reading and planning grow with the scene; the figures of docs/scale.md.
//!
//!     cargo run --release -p planesweep-plan --example scale -- generate FOLDER 100 521
//!     cargo run --release -p planesweep-plan --example scale -- plan FOLDER
//!     cargo run --release -p planesweep-plan --example scale -- growth FOLDER

#[path = "../tests/colmap2mvsnet/mod.rs"]
mod colmap2mvsnet;
#[path = "../tests/generated/mod.rs"]
mod generated;

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::time::Instant;

use planesweep_plan::{BlobKey, PlanOptions, jobs, plan, rank_sources};
use planesweep_scene::{ReadOptions, read_scene};

use generated::Flight;

fn main() {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    match args[..] {
        ["generate", folder, side, points_per_block] => generate(folder, side, points_per_block),
        ["plan", folder] => measure(Path::new(folder)),
        ["growth", folder] => growth(Path::new(folder)),
        _ => eprintln!("usage: scale generate FOLDER SIDE POINTS_PER_BLOCK | plan FOLDER | growth FOLDER"),
    }
}

fn generate(folder: &str, side: &str, points_per_block: &str) {
    let number = |text: &str| text.parse().expect("a number");
    let flight = Flight { side: number(side), points_per_block: u64::from(number(points_per_block)) };
    flight.write(Path::new(folder)).expect("written");
    println!("{} views, {} points, {} observations", flight.views(), flight.points(), flight.observations());
}

/// Each step of what happens before the first job is handed out, but for the hashes of photographs.
fn measure(folder: &Path) {
    let all = Instant::now();
    let start = Instant::now();
    let scene = read_scene(folder, &ReadOptions::default()).expect("a good scene");
    report("read", start);
    let start = Instant::now();
    let plan = plan(&scene, &PlanOptions::default());
    report("plan (views, ranges, order)", start);
    let start = Instant::now();
    let hashes: BTreeMap<_, _> =
        scene.views.values().map(|view| (view.id, BlobKey::of(view.name.as_bytes()))).collect();
    let jobs = jobs(&scene, &plan, &hashes, BlobKey::of(b"weights")).expect("all views are known");
    report("jobs", start);
    println!("{} views planned, {} skipped, {} jobs", plan.views.len(), plan.skipped.len(), jobs.len());
    report("all", all);
}

fn report(what: &str, start: Instant) {
    let seconds = start.elapsed().as_secs_f64();
    let peak = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let peak = peak.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap_or("unknown").trim();
    println!("{what}: {seconds:.2} s, peak memory so far {peak}");
}

/// View selection alone, beside that of the script, while the views grow and each sees as many points.
fn growth(folder: &Path) {
    println!("views  observations  here (s)  colmap2mvsnet (s)");
    for side in [8, 12, 16, 24, 32] {
        let flight = Flight { side, points_per_block: 100 };
        let place = folder.join(side.to_string());
        flight.write(&place).expect("written");
        let scene = read_scene(&place, &ReadOptions::default()).expect("a good scene");
        let cameras = scene.undistorted_cameras();
        let start = Instant::now();
        let ours = rank_sources(&scene, &cameras, &BTreeMap::new());
        let ours_seconds = start.elapsed().as_secs_f64();
        let start = Instant::now();
        let theirs = colmap2mvsnet::rank(&scene);
        let theirs_seconds = start.elapsed().as_secs_f64();
        assert_eq!(ours.len(), theirs.len());
        let (views, observations) = (flight.views(), flight.observations());
        println!("{views:5}  {observations:12}  {ours_seconds:8.4}  {theirs_seconds:17.3}");
    }
}
