//! COLMAP itself, by its Python package, reads what is written and undistorts as we do.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use image::{Rgb, RgbImage};
use nalgebra::{Point2, Point3, Vector3};
use planesweep_scene::{
    Camera, Distortion, Intrinsics, Pose, Raster, Scene, View, ViewId, WorkingImage, undistorted_intrinsics,
    write_colmap, write_colmap_text,
};
use serde_json::Value;

const PACKAGES: [&str; 2] = ["pycolmap==4.2.1", "numpy==2.2.6"];

/// The interpreter of an environment that has COLMAP, or a line that says that the test was skipped.
fn python(test: &str) -> Option<PathBuf> {
    let script = scripts().join("reference_venv.py");
    let output = Command::new("python3").arg(script).args(PACKAGES).stderr(Stdio::inherit()).output();
    match output {
        Ok(output) if output.status.success() => {
            Some(PathBuf::from(String::from_utf8(output.stdout).expect("a path").trim()))
        }
        _ => {
            eprintln!("SKIPPED {test}: pycolmap is not in the cache and cannot be fetched");
            None
        }
    }
}

fn scripts() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../scripts")
}

/// A view of every lens, of photographs of 320x240 pixels.
fn lenses() -> Vec<Distortion> {
    vec![
        Distortion::None,
        Distortion::Radial { k1: -0.18, k2: 0.03 },
        Distortion::OpenCv { k1: 0.12, k2: -0.02, p1: 0.002, p2: -0.003 },
        Distortion::FullOpenCv {
            k1: 0.2,
            k2: 0.02,
            p1: 0.001,
            p2: -0.002,
            k3: 0.003,
            k4: 0.4,
            k5: 0.05,
            k6: 0.004,
        },
        Distortion::Fov { omega: 0.9 },
        Distortion::Fisheye { k1: 0.04, k2: -0.01, k3: 0.003, k4: -0.0005 },
        Distortion::ThinPrismFisheye {
            k1: 0.03,
            k2: -0.01,
            p1: 0.001,
            p2: 0.002,
            k3: 0.002,
            k4: -0.0003,
            sx1: 0.002,
            sy1: -0.001,
        },
    ]
}

/// A smooth picture, so that interpolation, and not noise, makes the difference.
fn photograph(width: u32, height: u32, seed: f64) -> RgbImage {
    RgbImage::from_fn(width, height, |x, y| {
        let (x, y) = (x as f64, y as f64);
        let wave = |a: f64, b: f64, c: f64| (127.0 + 110.0 * (a * x + b * y + c + seed).sin()) as u8;
        Rgb([wave(0.11, 0.05, 0.0), wave(0.02, -0.13, 1.0), wave(-0.07, 0.09, 2.0)])
    })
}

fn scene(folder: &Path) -> Scene {
    let mut scene = Scene::default();
    for (distortion, k) in lenses().into_iter().zip(0_u32..) {
        let (id, name) = (ViewId(2 + 5 * k), format!("rig_{k}/photo.png"));
        let image = folder.join("images").join(&name);
        fs::create_dir_all(image.parent().expect("a folder")).expect("made");
        photograph(320, 240, k as f64).save(&image).expect("written");
        let fy = if matches!(distortion, Distortion::Radial { .. }) { 260.0 } else { 263.0 };
        let intrinsics =
            Intrinsics { width: 320, height: 240, fx: 260.0, fy, skew: 0.0, cx: 163.2, cy: 117.9 };
        let centre = Point3::new(0.3 * k as f64 - 1.0, 0.1 * k as f64, 0.0);
        let pose = Pose::look_at(&centre, &Point3::new(0.0, 0.0, 5.0), &-Vector3::y());
        let camera = Camera { intrinsics, pose };
        scene.views.insert(id, View { id, name, image, camera, distortion, depth_range: None });
    }
    for k in 0..40_u32 {
        let point = Point3::new(0.05 * k as f64 - 1.0, 0.2 * ((k % 7) as f64 - 3.0), 5.0 + 0.01 * k as f64);
        scene
            .points
            .push(point, scene.views.keys().copied().filter(|id| (id.0 + k) % 3 != 0).collect::<Vec<_>>());
    }
    scene
}

fn floats(value: &Value) -> Vec<f64> {
    value.as_array().expect("an array").iter().map(|v| v.as_f64().expect("a number")).collect()
}

fn pairs(value: &Value) -> Vec<[f64; 2]> {
    value.as_array().expect("an array").iter().map(|v| floats(v).try_into().expect("two numbers")).collect()
}

/// Equal but for the last digits, which JSON and COLMAP's composition of poses cost.
#[track_caller]
fn assert_same(theirs: &[f64], ours: &[f64]) {
    let near = |(a, b): (&f64, &f64)| (a - b).abs() <= 1e-14 * (1.0 + b.abs());
    assert!(theirs.len() == ours.len() && theirs.iter().zip(ours).all(near), "{theirs:?} {ours:?}");
}

fn assert_same_numbers(model: &Value, scene: &Scene) {
    assert_eq!(model["images"].as_object().expect("images").len(), scene.views.len());
    for view in scene.views.values() {
        let image = &model["images"][&view.name];
        let k = &view.camera.intrinsics;
        let camera = &image["camera"];
        assert_eq!((&camera["width"], &camera["height"]), (&k.width.into(), &k.height.into()));
        let params = floats(&camera["params"]);
        let mut expected = if camera["model"] == "RADIAL" {
            vec![k.fx, k.cx + 0.5, k.cy + 0.5]
        } else {
            vec![k.fx, k.fy, k.cx + 0.5, k.cy + 0.5]
        };
        expected.extend(view.distortion.coefficients());
        assert_same(&params, &expected);
        let pose = &view.camera.pose;
        for (row, values) in image["rotation"].as_array().expect("rows").iter().enumerate() {
            for (column, value) in floats(values).iter().enumerate() {
                assert!((value - pose.rotation[(row, column)]).abs() < 1e-12);
            }
        }
        assert_same(&floats(&image["translation"]), pose.translation.as_slice());
    }
    let points = model["points"].as_array().expect("points");
    assert_eq!(points.len(), scene.points.len());
    for (point, (position, track)) in points.iter().zip(scene.points.iter()) {
        assert_same(&floats(&point["xyz"]), position.coords.as_slice());
        let names: Vec<&str> = track.iter().map(|id| scene.views[id].name.as_str()).collect();
        assert_eq!(point["track"], Value::from(names));
    }
    // Observations are projections, so COLMAP projects to the same pixels.
    let error = model["error"].as_f64().expect("a number");
    assert!(error < 1e-6, "{error}");
}

fn assert_same_undistortion(folder: &Path, view: &View, found: &Value) {
    let pinhole = undistorted_intrinsics(&view.camera.intrinsics, &view.distortion);
    let camera = &found["camera"];
    assert_eq!(
        (&camera["width"], &camera["height"]),
        (&pinhole.width.into(), &pinhole.height.into()),
        "{}",
        view.name
    );
    let params = [pinhole.fx, pinhole.fy, pinhole.cx + 0.5, pinhole.cy + 0.5];
    for (ours, theirs) in params.iter().zip(floats(&camera["params"])) {
        assert!((ours - theirs).abs() < 1e-9, "{params:?} {camera}");
    }
    let k = &view.camera.intrinsics;
    let mut worst: f64 = 0.0;
    for (undistorted, stored) in pairs(&found["undistorted"]).into_iter().zip(pairs(&found["stored"])) {
        let p = pinhole.unproject(&Point2::new(undistorted[0] - 0.5, undistorted[1] - 0.5), 1.0);
        let (x, y) = view.distortion.distort(p.x, p.y);
        let ours = [k.fx * x + k.cx + 0.5, k.fy * y + k.cy + 0.5];
        worst = worst.max((ours[0] - stored[0]).hypot(ours[1] - stored[1]));
    }
    assert!(worst < 0.05, "{worst} pixels in {}", view.name);
    // Agreement is far better than what is asked for, and should stay so.
    assert!(worst < 1e-6, "{worst} pixels in {}", view.name);

    let theirs = image::open(folder.join("undistorted").join(&view.name)).expect("written").into_rgb8();
    let stored = image::open(&view.image).expect("a photograph").into_rgb8();
    let pixels = stored.pixels().map(|p| p.0).collect();
    let stored = Raster::new(stored.width() as usize, stored.height() as usize, pixels).expect("its size");
    let (width, height) = (pinhole.width, pinhole.height);
    let ours =
        WorkingImage::prepare(stored, &view.camera, &view.distortion, width, height).expect("prepared");
    let (mut total, mut most) = (0_u64, 0);
    // The outermost pixels lie on the border of the photograph: COLMAP leaves some of them black.
    for y in 1..height - 1 {
        for x in 1..width - 1 {
            for (ours, theirs) in ours.pixels.at(x as usize, y as usize).iter().zip(theirs.get_pixel(x, y).0)
            {
                let off = ours.abs_diff(theirs);
                total += u64::from(off);
                most = most.max(off);
            }
        }
    }
    let mean = total as f64 / (3 * (width - 2) * (height - 2)) as f64;
    eprintln!("{}: {worst:.1e} pixels, {mean:.3} grey levels on average, {most} at most", view.name);
    assert!(most <= 2 && mean < 0.6, "{mean} on average, {most} at most in {}", view.name);
}

#[test]
fn colmap_reads_the_same_numbers_and_undistorts_to_the_same_pixels() {
    let Some(python) = python("colmap_reads_the_same_numbers_and_undistorts_to_the_same_pixels") else {
        return;
    };
    let folder = tempfile::tempdir().expect("a temporary folder");
    let scene = scene(folder.path());
    write_colmap(&scene, &folder.path().join("binary")).expect("written");
    write_colmap_text(&scene, &folder.path().join("text")).expect("written");
    let output = Command::new(python)
        .arg(scripts().join("pycolmap_check.py"))
        .arg(folder.path())
        .args(["binary/sparse", "text/sparse"])
        .stderr(Stdio::inherit())
        .output()
        .expect("started");
    assert!(output.status.success());
    let found: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    for model in ["binary/sparse", "text/sparse"] {
        assert_same_numbers(&found["models"][model], &scene);
    }
    for view in scene.views.values() {
        assert_same_undistortion(folder.path(), view, &found["undistorted"][&view.name]);
    }
}
