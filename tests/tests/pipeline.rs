//! The whole way from a scene to a cloud, through the program.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use planesweep_fusion::read_ply;
use planesweep_scene::read_depth_pfm;
use planesweep_tests::{Finished, courtyard, files_below, plane, run, seeded_weights};
use serde_json::Value;
use tempfile::TempDir;

/// A folder with weights and a scene, and where its result goes.
struct Bench {
    folder: TempDir,
    weights: PathBuf,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let weights = seeded_weights(folder.path());
        Self { folder, weights }
    }

    /// Of the plane z = 5, four views.
    fn of_plane() -> Self {
        let bench = Self::new();
        plane(&bench.scene(), 4);
        bench
    }

    /// Of a courtyard, four views.
    fn of_courtyard() -> Self {
        let bench = Self::new();
        courtyard(&bench.scene(), 4, 160, 128);
        bench
    }

    fn scene(&self) -> PathBuf {
        self.folder.path().join("scene")
    }

    fn out(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Reconstructs into `out`; an untrained network is never sure of itself, so everything counts.
    fn reconstruct(&self, out: &str, more: &[&str]) -> Finished {
        let (scene, out) = (self.scene(), self.out(out));
        let given =
            ["reconstruct", text(&scene), "-o", text(&out), "--weights", text(&self.weights), "--json"];
        let easy = ["--min-confidence", "0", "--min-views", "1", "--views", "3", "--depths", "32"];
        // What is given replaces what is the same here.
        let easy = easy.chunks(2).filter(|option| !more.contains(&option[0])).flatten();
        run(given.iter().chain(easy).chain(more))
    }
}

fn text(path: &Path) -> &str {
    path.to_str().expect("a temporary folder is UTF-8")
}

fn cloud(out: &Path) -> Vec<u8> {
    fs::read(out.join("cloud.ply")).expect("a cloud")
}

fn json_file(path: &Path) -> Value {
    serde_json::from_slice(&fs::read(path).expect("a file")).expect("JSON")
}

#[test]
fn the_plane_comes_out_exact_and_the_folder_is_complete() {
    let bench = Bench::of_plane();
    // The default tolerance would let samples at the border of a map in, which mix with the nothing
    // beside it; this one is 1e-4 in depth.
    let exact = ["--device", "analytic", "--min-views", "3", "--max-depth-difference", "0.00002"];
    let value = bench.reconstruct("out", &exact).expect_code(0).json();
    let out = bench.out("out");

    let points = read_ply(&out.join("cloud.ply")).expect("a cloud");
    assert_eq!(value["points"], points.len());
    // Most of the four depth maps of 40 x 32 see what two others see.
    assert!(points.len() > 2000, "{} points", points.len());
    for point in &points {
        assert!((point.position[2] - 5.0).abs() < 1e-4, "{:?}", point.position);
        assert!((point.normal[2] + 1.0).abs() < 1e-2, "{:?}", point.normal);
    }
    let files: BTreeSet<String> = files_below(&out).into_iter().filter(|f| !f.starts_with('.')).collect();
    let mut expected: BTreeSet<String> =
        ["cloud.ply", "cloud.png", "pair.txt", "trajectory.log", "report.json", "report.html", "run.json"]
            .map(str::to_owned)
            .into();
    for id in 0..4 {
        let of_view = ["cams/ID_cam.txt", "depth/ID.pfm", "confidence/ID.pfm", "preview/ID.png"];
        expected.extend(of_view.map(|name| name.replace("ID", &format!("{id:08}"))));
    }
    assert_eq!(files, expected);

    let report = json_file(&out.join("report.json"));
    assert_eq!(report["views"].as_array().map(Vec::len), Some(4));
    assert_eq!(report["totals"]["points"], points.len());
    let record = json_file(&out.join("run.json"));
    assert_eq!(record["device"], "analytic");
    assert_eq!(record["cloud_blake3"], value["cloud_blake3"]);
    let trajectory = fs::read_to_string(out.join("trajectory.log")).expect("a trajectory");
    assert_eq!(trajectory.lines().count(), 4 * 5);
}

#[test]
fn the_number_of_workers_changes_no_bit() {
    let bench = Bench::of_courtyard();
    let one = bench.reconstruct("one", &["--workers", "1"]).expect_code(0).json();
    let two = bench.reconstruct("two", &["--workers", "2"]).expect_code(0).json();
    assert!(one["points"].as_u64() > Some(1000), "{}", one["points"]);
    assert_eq!(one["cloud_blake3"], two["cloud_blake3"]);
    assert!(cloud(&bench.out("one")) == cloud(&bench.out("two")));
    for name in ["run.json", "pair.txt", "depth/00000000.pfm", "confidence/00000003.pfm"] {
        let read = |out: &str| fs::read(bench.out(out).join(name)).expect(name);
        assert!(read("one") == read("two"), "{name} differs");
    }
}

#[test]
fn a_second_run_does_nothing_again_and_a_changed_option_only_what_it_changes() {
    let bench = Bench::of_courtyard();
    let _ = bench.reconstruct("out", &[]).expect_code(0);
    let (first, record) =
        (cloud(&bench.out("out")), fs::read(bench.out("out").join("run.json")).expect("read"));

    let again = bench.reconstruct("out", &[]).expect_code(0);
    // Four views, three jobs each, and the cloud.
    assert!(again.stderr.contains("13 of 13 jobs are done already"), "{}", again.stderr);
    assert!(cloud(&bench.out("out")) == first);
    assert!(fs::read(bench.out("out").join("run.json")).expect("read") == record);

    let stricter = bench.reconstruct("out", &["--min-views", "2"]).expect_code(0);
    assert!(stricter.stderr.contains("4 of 13 jobs are done already"), "{}", stricter.stderr);
    assert!(cloud(&bench.out("out")) != first);

    let other_planes = bench.reconstruct("out", &["--depths", "40"]).expect_code(0);
    assert!(!other_planes.stderr.contains("are done already"), "{}", other_planes.stderr);

    let back = bench.reconstruct("out", &[]).expect_code(0);
    assert!(back.stderr.contains("13 of 13 jobs are done already"), "{}", back.stderr);
    assert!(cloud(&bench.out("out")) == first);

    let fresh = bench.reconstruct("out", &["--fresh"]).expect_code(0);
    assert!(!fresh.stderr.contains("are done already"), "{}", fresh.stderr);
    assert!(cloud(&bench.out("out")) == first);
}

#[test]
fn one_view_in_this_process_is_the_view_of_the_whole_run() {
    let bench = Bench::of_courtyard();
    let _ = bench.reconstruct("out", &[]).expect_code(0);
    let (scene, alone) = (bench.scene(), bench.out("alone"));
    let arguments = ["depth", text(&scene), "--view", "00000002.png", "-o", text(&alone), "--json"];
    let same = ["--weights", text(&bench.weights), "--views", "3", "--depths", "32", "--probe", "7,5"];
    let value = run(arguments.iter().chain(&same)).expect_code(0).json();
    assert_eq!((value["width"].as_u64(), value["height"].as_u64()), (Some(40), Some(32)));
    for name in ["depth/00000002.pfm", "confidence/00000002.pfm"] {
        let read = |folder: &Path| fs::read(folder.join(name)).expect(name);
        assert!(read(&bench.out("out")) == read(&alone), "{name} differs");
    }

    let csv = fs::read_to_string(alone.join("probability-7-5.csv")).expect("the probed pixel");
    let probabilities: Vec<f64> = csv
        .lines()
        .skip(1)
        .map(|l| l.split(',').nth(1).expect("two columns").parse().expect("a number"))
        .collect();
    assert_eq!(probabilities.len(), 32);
    assert!((probabilities.iter().sum::<f64>() - 1.0).abs() < 1e-4);
}

#[test]
fn every_command_prints_one_json_object() {
    let bench = Bench::new();
    let (scene, out) = (bench.scene(), bench.out("out"));
    let small = ["--views", "4", "--width", "160", "--height", "128"];
    let made = run(["synth", text(&scene), "--json"].iter().chain(&small)).expect_code(0).json();
    assert_eq!(made["views"], 4);

    let seen = run(["inspect", text(&scene), "--json"]).expect_code(0).json();
    assert_eq!((seen["views"].as_u64(), &seen["sparse_points"]), (Some(4), &made["points"]));

    let weights = run(["weights", "inspect", text(&bench.weights), "--json"]).expect_code(0).json();
    let result = bench.reconstruct("out", &[]).expect_code(0).json();
    assert_eq!(json_file(&out.join("run.json"))["weights_blake3"], weights["blake3"]);
    assert_eq!(result["report"]["views"].as_array().map(Vec::len), Some(4));

    let truth = scene.join("depth_gt");
    let errors = run(["evaluate", "depth", text(&out), text(&truth), "--json"]).expect_code(0).json();
    assert_eq!(errors["mean"]["views"], 4);
    // Both are within the range of the sparse points, so even an untrained network is not far off.
    let error = errors["mean"]["all"]["median_relative"].as_f64().expect("a number");
    assert!(error > 0.0 && error < 1.0, "{error}");
    assert!(read_depth_pfm(&truth.join("00000000.pfm")).is_ok());

    // Its standard input has ended already, so it leaves before it has found a coordinator.
    let nowhere = ["worker", "--stop-with-stdin", "--coordinator", "http://127.0.0.1:9", "--json"];
    assert!(run(nowhere).expect_code(0).json()["worker"].is_string());

    let failed = run(["inspect", "no/such/scene", "--json"]).expect_code(1);
    assert!(
        failed.json()["error"].as_str().is_some_and(|e| e.contains("no/such/scene")),
        "{}",
        failed.stdout
    );
}

#[test]
fn wrong_arguments_are_usage_and_name_themselves() {
    let unknown = run(["reconstruct", "scene", "-o", "out", "--no-such-option"]).expect_code(2);
    assert!(unknown.stderr.contains("--no-such-option") && unknown.stdout.is_empty(), "{}", unknown.stderr);
    let too_few = run(["reconstruct", "scene", "-o", "out", "--weights", "w", "--views", "1"]).expect_code(2);
    assert!(too_few.stderr.contains("--views"), "{}", too_few.stderr);
    let _ = run(["--help"]).expect_code(0);

    let bench = Bench::of_plane();
    let device = bench.reconstruct("out", &["--device", "abacus"]).expect_code(1);
    assert!(device.stderr.contains("abacus"), "{}", device.stderr);
    assert!(!bench.out("out").exists());
}
