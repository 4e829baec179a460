//! The DTU distances against a twin in numpy and scipy that compares in blocks, as the data set's own program
//! does. The twin writes the MATLAB files, too.

use std::fs;
use std::process::Command;

use nalgebra::Point3;
use planesweep_evaluate::dtu::{DistanceStatistics, DtuScores, ObservabilityMask, TablePlane, compare, thin};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

mod reference;

/// A bumpy surface of 120 by 130 mm, sampled at random, `noise` thick; some points are far off.
fn surface(points: usize, noise: f64, far: f64, seed: u64) -> Vec<Point3<f64>> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut uniform = |from: f64, to: f64| random.random_range(from..to);
    (0..points)
        .map(|_| {
            let (x, y) = (uniform(-50.0, 70.0), uniform(-40.0, 90.0));
            let z = 560.0 + 20.0 * (0.05 * x).sin() + 15.0 * (0.06 * y).cos();
            let off = if uniform(0.0, 1.0) < far { uniform(-70.0, 70.0) } else { uniform(-noise, noise) };
            Point3::new(x, y, z + off)
        })
        .collect()
}

#[track_caller]
fn assert_statistics(ours: &DistanceStatistics, theirs: &Value, relative: f64) {
    for (field, value) in [("mean", ours.mean), ("median", ours.median), ("variance", ours.variance)] {
        let expected = theirs[field].as_f64().expect("a number");
        assert!((value - expected).abs() <= relative * expected, "{field} is {value}, there {expected}");
    }
}

#[track_caller]
fn assert_scores(ours: &DtuScores, theirs: &Value, relative: f64) {
    assert_statistics(&ours.accuracy, &theirs["accuracy"], relative);
    assert_statistics(&ours.completeness, &theirs["completeness"], relative);
    let overall = theirs["overall"].as_f64().expect("a number");
    assert!((ours.overall - overall).abs() <= relative * overall);
}

#[test]
fn distances_are_those_of_the_blockwise_program() {
    let test = "distances_are_those_of_the_blockwise_program";
    let Some(python) = reference::python(test, &["numpy==2.2.6", "scipy==1.15.3"]) else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();
    let truth = surface(60_000, 0.01, 0.0, 1);
    let cloud: Vec<Point3<f64>> =
        surface(90_000, 0.8, 0.05, 2).into_iter().filter(|p| p.x < 20.0 || p.y < 50.0).collect();
    let thinned = thin(&cloud, 0.2, 3);
    assert!(thinned.len() < cloud.len() * 99 / 100, "{} of {}", thinned.len(), cloud.len());
    for (name, points) in [("truth.f64", &truth), ("cloud.f64", &cloud), ("thinned.f64", &thinned)] {
        reference::write_points(&folder.join(name), points);
    }
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/reference/dtu_blocks.py");
    let done = Command::new(python).arg(script).arg(folder).status().expect("started");
    assert!(done.success(), "the script failed");
    let result: Value =
        serde_json::from_slice(&fs::read(folder.join("result.json")).expect("written")).expect("JSON");

    let mask = ObservabilityMask::read(&folder.join("ObsMask.mat")).expect("a mask");
    let table = TablePlane::read(&folder.join("Plane.mat")).expect("a plane");
    let scores = compare(&thinned, &truth, &mask, &table).scores;
    eprintln!("{scores:?}\n{result}");
    assert_scores(&scores, &result["same"], 1e-9);
    for (ours, theirs) in [(&scores.accuracy, "accuracy"), (&scores.completeness, "completeness")] {
        assert_eq!(Some(ours.kept as u64), result["same"][theirs]["kept"].as_u64());
        assert!(ours.kept < ours.points, "the clouds have outliers");
    }
    let within = scores.percentages[0];
    let theirs: Vec<f64> = serde_json::from_value(result["same"]["within_1_mm"].clone()).expect("two shares");
    assert_eq!([within.accuracy, within.completeness], theirs[..]);
    // Another random order of thinning.
    assert_scores(&scores, &result["own_thinning"], 0.005);

    let cut = folder.join("cut.mat");
    let whole = fs::read(folder.join("ObsMask.mat")).expect("written");
    fs::write(&cut, &whole[..whole.len() / 2]).expect("written");
    let error = ObservabilityMask::read(&cut).expect_err("cut off").to_string();
    assert!(error.starts_with("cannot ") && error.contains("cut.mat"), "{error}");
    let error = TablePlane::read(&folder.join("ObsMask.mat")).expect_err("no plane").to_string();
    assert!(error.ends_with("variable P is missing or has another form"), "{error}");
}
