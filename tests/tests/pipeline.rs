//! The whole way from a scene to a cloud, through the program.

use std::collections::BTreeSet;
use std::path::Path;

use planesweep_fusion::read_ply;
use planesweep_tests::{Bench, Finished, courtyard, files_below, plane, plane_of_size, run};
use serde_json::Value;

fn of_plane() -> Bench {
    Bench::new(|folder| drop(plane(folder, 4)))
}

fn of_courtyard() -> Bench {
    Bench::new(|folder| courtyard(folder, 4, 160, 128))
}

fn json_file(bench: &Bench, name: &str) -> Value {
    serde_json::from_slice(&bench.read(name)).expect("JSON")
}

#[test]
fn the_plane_comes_out_exact_and_the_folder_is_complete() {
    let bench = of_plane();
    // The default tolerance would let samples at the border of a map in, which mix with the nothing
    // beside it; this one is 1e-4 in depth.
    // Every view emits what it sees, so that the points can be counted.
    let exact =
        ["--device", "analytic", "--min-views", "3", "--max-depth-difference", "0.00002", "--every-view"];
    let value = bench.reconstruct("out", &exact).expect_code(0).json();
    let out = bench.path("out");

    let points = read_ply(Path::new(&bench.path("out/cloud.ply"))).expect("a cloud");
    assert_eq!(value["points"], points.len());
    // Most of the four depth maps of 40 x 32 see what two others see.
    assert!(points.len() > 2000, "{} points", points.len());
    for point in &points {
        assert!((point.position[2] - 5.0).abs() < 1e-4, "{:?}", point.position);
        assert!((point.normal[2] + 1.0).abs() < 1e-2, "{:?}", point.normal);
    }
    let files: BTreeSet<String> =
        files_below(Path::new(&out)).into_iter().filter(|f| !f.starts_with('.')).collect();
    let mut expected: BTreeSet<String> =
        ["cloud.ply", "cloud.png", "pair.txt", "trajectory.log", "report.json", "report.html", "run.json"]
            .map(str::to_owned)
            .into();
    for id in 0..4 {
        let of_view = ["cams/ID_cam.txt", "depth/ID.pfm", "confidence/ID.pfm", "preview/ID.png"];
        expected.extend(of_view.map(|name| name.replace("ID", &format!("{id:08}"))));
    }
    assert_eq!(files, expected);

    let report = json_file(&bench, "out/report.json");
    assert_eq!(report["views"].as_array().map(Vec::len), Some(4));
    assert_eq!(report["totals"]["points"], points.len());
    let record = json_file(&bench, "out/run.json");
    assert_eq!(record["device"], "analytic");
    assert_eq!(record["cloud_blake3"], value["cloud_blake3"]);
    let trajectory = String::from_utf8(bench.read("out/trajectory.log")).expect("text");
    assert_eq!(trajectory.lines().count(), 4 * 5);
}

#[test]
fn the_number_of_workers_changes_no_bit() {
    let bench = of_courtyard();
    let one = bench.reconstruct("one", &["--workers", "1"]).expect_code(0).json();
    let two = bench.reconstruct("two", &["--workers", "2"]).expect_code(0).json();
    assert!(one["points"].as_u64() > Some(500), "{}", one["points"]);
    assert_eq!(one["cloud_blake3"], two["cloud_blake3"]);
    assert!(bench.read("one/cloud.ply") == bench.read("two/cloud.ply"));
    for name in ["run.json", "pair.txt", "depth/00000000.pfm", "confidence/00000003.pfm"] {
        let read = |out: &str| bench.read(&format!("{out}/{name}"));
        assert!(read("one") == read("two"), "{name} differs");
    }
}

#[test]
fn the_weights_that_come_with_the_program_find_the_true_depth() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let (scene, out) = (folder.path().join("scene"), folder.path().join("out"));
    courtyard(&scene, 5, 320, 256);
    let path = |path: &Path| path.to_str().expect("UTF-8").to_owned();
    let done = run(["reconstruct", &path(&scene), "-o", &path(&out), "--json"]).expect_code(0).json();
    assert!(done["points"].as_u64() > Some(2000), "{done}");
    let truth = path(&scene.join("depth_gt"));
    let errors = run(["evaluate", "depth", &path(&out), &truth, "--json"]).expect_code(0).json();
    let median = errors["mean"]["confident"]["median_relative"].as_f64().expect("a number");
    // A small scene of 320x256; wrong weights are off by tens of percent.
    assert!(median < 0.03, "the median error is {} %", 100.0 * median);
}

#[test]
fn bands_of_rows_change_no_bit() {
    // 2080 rows: four bands of 512 and more.
    let bench = Bench::new(|folder| drop(plane_of_size(folder, 3, 64, 2080)));
    let size = ["--depths", "16", "--max-size", "2080"];
    let whole = bench.reconstruct("whole", &size).expect_code(0).json();
    let options = [&size[..], &["--band-rows", "512", "--workers", "2"]].concat();
    let banded = bench.reconstruct("banded", &options).expect_code(0).json();
    assert!(whole["points"].as_u64() > Some(500), "{}", whole["points"]);
    assert!(bench.read("whole/cloud.ply") == bench.read("banded/cloud.ply"));
    for name in ["depth/00000000.pfm", "confidence/00000002.pfm", "cams/00000001_cam.txt"] {
        let read = |out: &str| bench.read(&format!("{out}/{name}"));
        assert!(read("whole") == read("banded"), "{name} differs");
    }
    let seen = run(["inspect", &bench.scene(), "--max-size", "2080", "--band-rows", "512", "--json"])
        .expect_code(0)
        .json();
    let bands = seen["plan"]["views"][0]["bands"].as_array().map(Vec::len);
    assert_eq!(bands, Some(4));
    let stages: Vec<String> =
        banded["stages"].as_array().into_iter().flatten().map(|s| s[0].to_string()).collect();
    assert!(stages.iter().any(|name| name.contains("stitch")), "{stages:?}");
}

#[test]
fn a_scene_of_any_format_gives_the_same_cloud() {
    let bench = of_courtyard();
    let points = |scene: &str, out: &str| {
        let options = ["--views", "3", "--depths", "32", "--max-size", "160"];
        let run = run([&["reconstruct", scene, "-o", out, "--json"], &options[..]].concat());
        run.expect_code(0).json()["points"].as_f64().expect("a number")
    };
    let of_colmap = points(&bench.scene(), &bench.path("colmap"));
    assert!(of_colmap > 500.0, "{of_colmap} points");
    for format in ["colmap-text", "openmvg", "mvsnet"] {
        let [scene, out] = ["scene", "out"].map(|kind| bench.path(&format!("{format}-{kind}")));
        let _ = run(["convert", &bench.scene(), &scene, "--to", format]).expect_code(0);
        let of_format = points(&scene, &out);
        // A camera matrix written as text may have another last digit.
        assert!(
            (of_format / of_colmap - 1.0).abs() < 0.01,
            "{format}: {of_format} points, COLMAP {of_colmap}"
        );
    }
}

#[test]
fn a_second_run_does_nothing_again_and_a_changed_option_only_what_it_changes() {
    let bench = of_courtyard();
    // Four views, three jobs each, and the cloud: progress is shown whenever one of them runs.
    let worked = |run: &Finished| run.stderr.contains("/13 jobs, ");
    assert!(worked(&bench.reconstruct("out", &[]).expect_code(0)));
    let (first, record) = (bench.read("out/cloud.ply"), bench.read("out/run.json"));

    let again = bench.reconstruct("out", &[]).expect_code(0);
    assert!(!worked(&again), "{}", again.stderr);
    assert!(bench.read("out/cloud.ply") == first);
    assert!(bench.read("out/run.json") == record);

    let stricter = bench.reconstruct("out", &["--min-views", "2"]).expect_code(0);
    assert!(stricter.stderr.contains("4 of 13 jobs are done already"), "{}", stricter.stderr);
    assert!(bench.read("out/cloud.ply") != first);

    let other_planes = bench.reconstruct("out", &["--depths", "40"]).expect_code(0);
    assert!(!other_planes.stderr.contains("are done already"), "{}", other_planes.stderr);

    let back = bench.reconstruct("out", &[]).expect_code(0);
    assert!(!worked(&back), "{}", back.stderr);
    assert!(bench.read("out/cloud.ply") == first);

    let fresh = bench.reconstruct("out", &["--fresh"]).expect_code(0);
    assert!(worked(&fresh) && !fresh.stderr.contains("are done already"), "{}", fresh.stderr);
    assert!(bench.read("out/cloud.ply") == first);
}

#[test]
fn one_view_in_this_process_is_the_view_of_the_whole_run() {
    let bench = of_courtyard();
    let _ = bench.reconstruct("out", &[]).expect_code(0);
    let (scene, weights, alone) = (bench.scene(), bench.weights(), bench.path("alone"));
    let arguments = ["depth", &scene, "--view", "00000002.png", "-o", &alone, "--json"];
    let same = ["--weights", &weights, "--views", "3", "--depths", "32", "--probe", "7,5"];
    let value = run(arguments.iter().chain(&same)).expect_code(0).json();
    assert_eq!((value["width"].as_u64(), value["height"].as_u64()), (Some(40), Some(32)));
    for name in ["depth/00000002.pfm", "confidence/00000002.pfm"] {
        let read = |out: &str| bench.read(&format!("{out}/{name}"));
        assert!(read("out") == read("alone"), "{name} differs");
    }

    let csv = String::from_utf8(bench.read("alone/probability-7-5.csv")).expect("text");
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
    let bench = Bench::new(|_| {});
    let (scene, out, weights) = (bench.scene(), bench.path("out"), bench.weights());
    let small = ["--views", "4", "--width", "160", "--height", "128"];
    let made = run(["synth", &scene, "--json"].iter().chain(&small)).expect_code(0).json();
    assert_eq!(made["views"], 4);

    let seen = run(["inspect", &scene, "--json"]).expect_code(0).json();
    assert_eq!((seen["views"].as_u64(), &seen["sparse_points"]), (Some(4), &made["points"]));

    let known = run(["weights", "inspect", &weights, "--json"]).expect_code(0).json();
    let result = bench.reconstruct("out", &[]).expect_code(0).json();
    assert_eq!(json_file(&bench, "out/run.json")["weights_blake3"], known["blake3"]);
    assert_eq!(result["report"]["views"].as_array().map(Vec::len), Some(4));

    let truth = bench.path("scene/depth_gt");
    let errors = run(["evaluate", "depth", &out, &truth, "--json"]).expect_code(0).json();
    assert_eq!(errors["mean"]["views"], 4);
    // Both are within the range of the sparse points, so even an untrained network is not far off.
    let error = errors["mean"]["all"]["median_relative"].as_f64().expect("a number");
    assert!(error > 0.0 && error < 1.0, "{error}");

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

    let bench = of_plane();
    let device = bench.reconstruct("out", &["--device", "abacus"]).expect_code(2);
    assert!(device.stderr.contains("abacus"), "{}", device.stderr);
    assert!(!Path::new(&bench.path("out")).exists());
}
