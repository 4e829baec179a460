//! Real photographs with the reference weights; without the data beside the checkout there is nothing to do.
//!
//! One small scene per format. The depth in both is a sensor's, with errors of its own, and the weights
//! were trained on objects on a table: the bounds say that depth is right where the network is sure, not
//! how good it is. `cargo run -p planesweep-tests --example all_scenes` measures all scenes.

use std::path::{Path, PathBuf};

use planesweep_tests::{Bounds, convert_middlebury, convert_rgbd, reference_weights, run, shared_data};
use serde_json::Value;
use tempfile::TempDir;

fn text(path: &Path) -> &str {
    path.to_str().expect("the paths are UTF-8")
}

/// Reconstructs a scene at a small size; the result and its folder.
fn reconstruct(test: &str, folder: &TempDir, scene: &Path, more: &[&str]) -> Option<(Value, PathBuf)> {
    let weights = reference_weights(test, folder.path())?;
    let out = folder.path().join("out");
    let arguments = ["reconstruct", text(scene), "-o", text(&out), "--weights", text(&weights), "--json"];
    Some((run(arguments.iter().chain(more)).expect_code(0).json(), out))
}

/// Options that keep runs short.
const SMALL: [&str; 6] = ["--max-size", "320", "--views", "3", "--depths", "96"];

/// The error of the pixels above confidence 0.8: median of the relative error and their share.
fn confident_error(out: &Path, truth: &Path) -> (f64, f64) {
    let errors = run(["evaluate", "depth", text(out), text(truth), "--json"]).expect_code(0).json();
    eprintln!("{}", errors["mean"]);
    let confident = &errors["mean"]["confident"];
    let number = |field: &str| confident[field].as_f64().expect("there are confident pixels");
    (number("median_relative"), number("share"))
}

#[test]
fn an_mvsnet_folder_of_a_room() {
    let test = "an_mvsnet_folder_of_a_room";
    let Some(scene) = shared_data(test, "scenes/hololens_c") else { return };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let Some((value, out)) = reconstruct(test, &folder, &scene, &SMALL) else { return };
    assert!(value["points"].as_u64() > Some(1000), "{}", value["points"]);
    let (median, share) = confident_error(&out, &scene.join("depth_gt"));
    assert!(median < BOUND && share > 0.1, "median relative error {median} of a share of {share}");
}

/// Largest median error of confident depths: the sensor's own 2 % and one of 96 planes, which are some
/// 2 % apart, each way, at a sixteenth of the photographs' pixels.
const BOUND: f64 = 0.06;

#[test]
fn a_middlebury_ring() {
    let test = "a_middlebury_ring";
    let Some(source) = shared_data(test, "scenes/templeSparseRing") else { return };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = folder.path().join("scene");
    // From the README of the data set.
    let temple =
        Bounds { min: [-0.073568, 0.021728, -0.012445].into(), max: [0.028855, 0.181892, 0.062736].into() };
    convert_middlebury(&source, "templeSR_par.txt", temple, &scene);
    let Some((value, out)) = reconstruct(test, &folder, &scene, &SMALL) else { return };
    assert_eq!(value["report"]["views"].as_array().map(Vec::len), Some(16));
    // The black background gives few points, so most lie in the box of the temple, a little widened.
    let points = planesweep_fusion::read_ply(&out.join("cloud.ply")).expect("a cloud");
    let is_inside =
        |p: &[f64; 3]| (0..3).all(|k| (temple.min[k] - 0.005..temple.max[k] + 0.005).contains(&p[k]));
    let inside = points.iter().filter(|point| is_inside(&point.position)).count();
    eprintln!("{inside} of {} points are in the box", points.len());
    assert!(points.len() > 1000 && 10 * inside > 8 * points.len(), "{inside} of {}", points.len());
}

#[test]
fn an_rgbd_sequence() {
    let test = "an_rgbd_sequence";
    let Some(source) = shared_data(test, "scenes/open3d_rgbd") else { return };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = folder.path().join("scene");
    convert_rgbd(&source.join("RGBD"), &source.join("camera_primesense.json"), &scene);
    // From the first view to the last, two pixels of the depth map are all that a point at the middle
    // distance moves, so that full size is needed and a tenth of a pixel is some 5 % of depth.
    let Some((value, out)) = reconstruct(test, &folder, &scene, &["--views", "5"]) else { return };
    assert_eq!(value["report"]["views"].as_array().map(Vec::len), Some(5));
    let (median, share) = confident_error(&out, &scene.join("depth_gt"));
    assert!(median < 0.15 && share > 0.05, "median relative error {median} of a share of {share}");
}
