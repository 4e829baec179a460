//! The Tanks and Temples metric against Open3D, which the benchmark's own scripts use, on the same clouds.
//!
//! Cutting and thinning must give the same numbers; the figures, after an alignment that both begin from
//! random samples, the same within a tenth of a point.

use std::fs;
use std::path::Path;
use std::process::Command;

use nalgebra::{Matrix4, Point3, Similarity3, Vector3};
use planesweep_evaluate::tnt::{
    Correspondence, CropVolume, TntScores, align_cloud, align_trajectories, score,
};
use planesweep_evaluate::voxel_down_sample;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::Value;

mod reference;

const THRESHOLD: f64 = 0.01;

const CROP: &str = r#"{ "class_name": "SelectionPolygonVolume", "version_major": 1, "version_minor": 0,
    "axis_max": 0.9, "axis_min": -0.3, "orthogonal_axis": "Z",
    "bounding_polygon": [[-0.8, -0.9, 0.0], [0.9, -0.7, 0.0], [0.6, 0.1, 0.0], [0.8, 0.9, 0.0], [-0.9, 0.7, 0.0]] }"#;

/// A hilly ground with a dome, sampled at random, `noise` thick.
fn surface(points: usize, noise: f64, seed: u64) -> Vec<Point3<f64>> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut uniform = |from: f64, to: f64| random.random_range(from..to);
    (0..points)
        .map(|_| {
            let (x, y) = (uniform(-1.0, 1.0), uniform(-1.0, 1.0));
            let dome = (0.25 - x * x - y * y).max(0.0).sqrt();
            let z = 0.1 * (5.0 * x).sin() * (4.0 * y).cos() + dome;
            Point3::new(x, y, z + uniform(-noise, noise))
        })
        .collect()
}

fn read(folder: &Path, name: &str) -> Vec<Point3<f64>> {
    let bytes = fs::read(folder.join(name)).expect("written by the script");
    let numbers: Vec<f64> = bytes.as_chunks().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
    numbers.as_chunks::<3>().0.iter().map(|p| Point3::from(*p)).collect()
}

fn sorted(mut points: Vec<Point3<f64>>) -> Vec<Point3<f64>> {
    points.sort_by(|a, b| a.coords.iter().partial_cmp(b.coords.iter()).expect("finite"));
    points
}

#[track_caller]
fn assert_close(ours: &TntScores, theirs: &Value) {
    eprintln!("ours {:.6} {:.6} {:.6}, Open3D's {theirs}", ours.precision, ours.recall, ours.f_score);
    for (field, value) in [("precision", ours.precision), ("recall", ours.recall), ("f_score", ours.f_score)]
    {
        let difference = value - theirs[field].as_f64().expect("a number");
        assert!(difference.abs() < 0.001, "{field} differs by {difference}");
    }
}

#[test]
fn the_tanks_and_temples_metric_is_open3ds() {
    let test = "the_tanks_and_temples_metric_is_open3ds";
    let Some(python) = reference::python(test, &["open3d-cpu==0.19.0", "numpy==2.2.6"]) else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let folder = folder.path();

    // A scan, and a reconstruction of most of it that is thicker than the threshold, has another scale and
    // stands elsewhere; its cameras on an arc around it.
    let scan = surface(60_000, 0.001, 1);
    let misplaced = Similarity3::new(Vector3::new(3.0, -1.0, 2.0), Vector3::new(0.4, -1.1, 0.7), 0.37);
    let cloud: Vec<Point3<f64>> =
        surface(60_000, 0.02, 2).into_iter().filter(|p| p.x < 0.5).map(|p| misplaced * p).collect();
    let target: Vec<Point3<f64>> = (0..40)
        .map(|i| {
            let t = 0.1 * f64::from(i);
            Point3::new(3.0 * t.cos(), 3.0 * t.sin(), 1.5 + 0.3 * (3.0 * t).sin())
        })
        .collect();
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let source: Vec<Point3<f64>> = target
        .iter()
        .map(|p| misplaced * (p + Vector3::from_fn(|_, _| random.random_range(-0.005..0.005))))
        .collect();
    let known = misplaced.inverse().to_homogeneous();

    for (name, points) in
        [("scan.f64", &scan), ("cloud.f64", &cloud), ("source.f64", &source), ("target.f64", &target)]
    {
        reference::write_points(&folder.join(name), points);
    }
    fs::write(folder.join("crop.json"), CROP).expect("written");
    let rows: Vec<String> =
        known.row_iter().map(|r| r.iter().map(f64::to_string).collect::<Vec<_>>().join(" ")).collect();
    fs::write(folder.join("known.txt"), rows.join("\n")).expect("written");
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/reference/open3d_tnt.py");
    let done =
        Command::new(python).arg(script).arg(folder).arg(THRESHOLD.to_string()).status().expect("started");
    assert!(done.success(), "the script failed");
    let result: Value =
        serde_json::from_slice(&fs::read(folder.join("result.json")).expect("written")).expect("JSON");

    let volume = CropVolume::parse(CROP).expect("a volume");
    let cropped = volume.crop(&scan);
    assert!(cropped.len() > 20_000 && cropped.len() < 50_000, "{}", cropped.len());
    assert_eq!(sorted(cropped.clone()), read(folder, "cropped.f64"));
    let thinned = voxel_down_sample(&cropped, THRESHOLD / 2.0);
    assert!(thinned.len() < cropped.len());
    assert_eq!(sorted(thinned), read(folder, "thinned.f64"));

    let evaluate = |cloud: &[Point3<f64>], transform: &Matrix4<f64>| {
        score(cloud, &scan, transform, &volume, THRESHOLD).scores
    };
    assert_close(&evaluate(&scan, &Matrix4::identity()), &result["as_it_is"]);
    let with_known = evaluate(&cloud, &known);
    assert_close(&with_known, &result["known"]);
    assert_eq!(with_known.cloud_points as u64, result["known"]["points"].as_u64().expect("a number"));
    assert!(
        (0.3..0.9).contains(&with_known.precision) && (0.3..0.9).contains(&with_known.recall),
        "{with_known:?}"
    );

    let pairs: Vec<_> =
        source.into_iter().zip(target).map(|(from, to)| Correspondence { from, to }).collect();
    let initial = align_trajectories(&pairs, 7).expect("aligned");
    let transform = align_cloud(&cloud, &scan, &initial, &volume, THRESHOLD);
    assert_close(&evaluate(&cloud, &transform), &result["refined"]);
}
