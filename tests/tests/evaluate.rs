//! The measures that need no ground truth, and that of ETH3D, on results whose quality is known: exact depth
//! must be judged better than wrong depth, whatever made either.

use std::fmt::Write;
use std::fs;
use std::path::Path;

use nalgebra::Matrix4;
use planesweep_scene::{Raster, read_depth_pfm, write_pfm};
use planesweep_tests::{Bench, courtyard, files_below, run};
use serde_json::Value;

/// A result of a scene with true depth. Its network is untrained, so depth maps are to be replaced.
fn of_courtyard() -> Bench {
    let bench = Bench::new(|folder| courtyard(folder, 8, 192, 128));
    let _ = bench.reconstruct("out", &["--workers", "1"]).expect_code(0);
    bench
}

/// Puts the true depth in place of every depth map, times a factor for the view, counted from 0.
fn replace_depth(bench: &Bench, factor: impl Fn(usize) -> f32) {
    let (scene, out) = (bench.scene(), bench.path("out"));
    let (truths, maps) = (Path::new(&scene).join("depth_gt"), Path::new(&out).join("depth"));
    let names = files_below(&maps);
    assert_eq!(names.len(), 8);
    for (view, name) in names.iter().enumerate() {
        let truth = read_depth_pfm(&truths.join(name)).expect("true depth");
        let map = read_depth_pfm(&maps.join(name)).expect("a depth map");
        // A depth map shows every fourth pixel.
        assert_eq!((4 * map.width(), 4 * map.height()), (truth.width(), truth.height()));
        let exact = Raster::from_fn(map.width(), map.height(), |x, y| truth.at(4 * x, 4 * y) * factor(view));
        write_pfm(&maps.join(name), &exact).expect("written");
    }
}

fn measure(bench: &Bench, metric: &str) -> Value {
    let figures = bench.path(metric);
    let done = run(["evaluate", metric, &bench.path("out"), "--json", "-o", &figures]).expect_code(0).json();
    for ending in ["json", "png"] {
        assert!(Path::new(&figures).join(format!("{metric}.{ending}")).is_file(), "{metric}.{ending}");
    }
    done
}

/// Every view sees the surface elsewhere: from a fifth too near to a fifth too far.
fn wrong(view: usize) -> f32 {
    0.79 + 0.06 * view as f32
}

#[test]
fn true_depth_shows_photographs_that_it_was_not_made_from() {
    let bench = of_courtyard();
    let grey_levels = |value: &Value| {
        assert_eq!(value["mean"]["views"], 8);
        let curve = value["mean"]["curve"].as_array().expect("a curve").clone();
        let all = curve.last().expect("points");
        assert_eq!((curve.len(), all["kept"].as_f64()), (20, Some(1.0)));
        all["mean"].as_f64().expect("a number")
    };
    replace_depth(&bench, |_| 1.0);
    let exact = grey_levels(&measure(&bench, "photometric"));
    replace_depth(&bench, wrong);
    let off = grey_levels(&measure(&bench, "photometric"));
    eprintln!("{exact:.2} grey levels with true depth, {off:.2} with depth that is up to 21 % off");
    assert!(exact < 0.85 * off, "{exact} {off}");
}

#[test]
fn views_agree_on_true_depth() {
    let bench = of_courtyard();
    let consistent = |value: &Value| {
        assert_eq!((&value["views"], &value["min_views"]), (&Value::from(8), &Value::from(3)));
        let curve = value["curve"].as_array().expect("a curve").clone();
        let all = curve.last().expect("points");
        assert_eq!((curve.len(), all["kept"].as_f64()), (10, Some(1.0)));
        all["consistent"].as_f64().expect("a number")
    };
    replace_depth(&bench, |_| 1.0);
    let exact = consistent(&measure(&bench, "consistency"));
    replace_depth(&bench, wrong);
    let off = consistent(&measure(&bench, "consistency"));
    eprintln!(
        "{exact:.3} of the pixels are consistent with true depth, {off:.3} with depth that is up to 21 % off"
    );
    assert!(exact > 0.7 && off < 0.2 * exact, "{exact} {off}");
}

#[test]
fn a_cloud_is_judged_by_where_lasers_went() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("UTF-8").to_owned();
    let write = |name: &str, points: &[[f64; 3]]| {
        let mut text = format!(
            "ply\nformat ascii 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\nend_header\n",
            points.len()
        );
        for [x, y, z] in points {
            let _ = writeln!(text, "{x} {y} {z}");
        }
        fs::write(path(name), text).expect("written");
    };
    // A wall at x = 5 of the scanner, which stands at z = 2 of the world; the cloud has half of it, a point in
    // the air before it, and one behind it, which nobody saw.
    let side = |k: i32| 0.004 * f64::from(k);
    let wall: Vec<[f64; 3]> =
        (-25..25).flat_map(|y| (-25..25).map(move |z| [5.0, side(y), side(z)])).collect();
    write("scan.ply", &wall);
    let mut cloud: Vec<[f64; 3]> =
        wall.iter().filter(|p| p[1] < 0.0).map(|p| [p[0], p[1], p[2] + 2.0]).collect();
    cloud.extend([[4.0, 0.0, 2.0], [6.0, 0.0, 2.0]]);
    write("cloud.ply", &cloud);
    let matrix = Matrix4::new_translation(&nalgebra::Vector3::new(0.0, 0.0, 2.0)).transpose();
    let numbers: Vec<String> = matrix.iter().map(f64::to_string).collect();
    let project = format!(
        "<!DOCTYPE MeshLabDocument>\n<MeshLabProject><MeshGroup><MLMesh label=\"1\" filename=\"scan.ply\"><MLMatrix44>{}\
         </MLMatrix44></MLMesh></MeshGroup></MeshLabProject>",
        numbers.join(" ")
    );
    fs::write(path("scans.mlp"), project).expect("written");
    let arguments =
        ["evaluate", "eth3d", &path("cloud.ply"), &path("scans.mlp"), "--json", "-o", &path("figures")];
    let value = run(arguments).expect_code(0).json();
    assert_eq!((&value["points"], &value["unobserved"]), (&Value::from(1252), &Value::from(1)));
    let scores = value["scores"].as_array().expect("scores");
    assert_eq!(scores.len(), 6);
    let at = |place: usize, field: &str| scores[place][field].as_f64().expect("a number");
    // One cell of some 130 holds the point in the air; more of the wall is near when near is farther.
    assert!((0.97..1.0).contains(&at(0, "accuracy")), "{scores:?}");
    assert!((0.45..0.65).contains(&at(0, "completeness")) && at(4, "completeness") == 1.0, "{scores:?}");
    for file in ["eth3d.json", "tolerances.png", "completeness.ply"] {
        assert!(folder.path().join("figures").join(file).is_file(), "{file}");
    }
    let nowhere = run(["evaluate", "eth3d", &path("cloud.ply"), &path("scan.ply")]).expect_code(1);
    assert!(
        nowhere.stderr.contains("cannot use") && nowhere.stderr.contains("scan.ply"),
        "{}",
        nowhere.stderr
    );
}
