//! What is written is read again, in every format, as far as the format can hold it.

use std::path::{Path, PathBuf};

use image::RgbImage;
use nalgebra::{Matrix3, Point3, Vector3};
use planesweep_scene::{
    Camera, DepthRange, Distortion, Intrinsics, Pose, ReadOptions, Scene, SourceScore, TargetFormat, View,
    ViewId, held, read_scene, write_scene,
};
use proptest::prelude::*;

const FORMATS: [TargetFormat; 4] =
    [TargetFormat::Colmap, TargetFormat::ColmapText, TargetFormat::Mvsnet, TargetFormat::OpenMvg];

fn close(a: f64, b: f64, scale: f64) -> bool {
    (a - b).abs() <= 1e-11 * (scale + a.abs() + b.abs())
}

/// Equal but for the rounding of rotations through quaternions, of centres and of intervals, and of the
/// last digit of numbers in JSON.
#[track_caller]
fn assert_same(read: &Scene, written: &Scene) {
    assert_eq!(read.views.keys().collect::<Vec<_>>(), written.views.keys().collect::<Vec<_>>());
    for (read, written) in read.views.values().zip(written.views.values()) {
        assert_eq!((&read.name, read.distortion.model()), (&written.name, written.distortion.model()));
        let coefficients = read.distortion.coefficients().into_iter().zip(written.distortion.coefficients());
        assert!(coefficients.into_iter().all(|(a, b)| close(a, b, 0.0)), "{:?}", read.distortion);
        let (a, b) = (&read.camera.intrinsics, &written.camera.intrinsics);
        assert_eq!((a.width, a.height), (b.width, b.height));
        let numbers = |k: &Intrinsics| [k.fx, k.fy, k.skew, k.cx, k.cy];
        assert!(numbers(a).iter().zip(numbers(b)).all(|(a, b)| close(*a, b, 1.0)), "{a:?} {b:?}");
        let (a, b) = (&read.camera.pose, &written.camera.pose);
        // Rotations of six digits are made exact ones by formats that hold nothing else.
        let inexact = (b.rotation * b.rotation.transpose() - Matrix3::identity()).amax();
        let off = (a.rotation - b.rotation).amax();
        assert!(off <= 1e-12 + inexact, "{off} {inexact}");
        let off = (a.centre() - b.centre()).norm();
        assert!(off <= (1e-11 + 4.0 * inexact) * (1.0 + b.translation.norm()), "{off} {inexact}");
        let same_range = match (read.depth_range, written.depth_range) {
            (Some(a), Some(b)) => a.count == b.count && a.min == b.min && close(a.max, b.max, 0.0),
            (a, b) => a == b,
        };
        assert!(same_range, "{:?} {:?}", read.depth_range, written.depth_range);
        assert_eq!(read.image.canonicalize().expect("there"), written.image.canonicalize().expect("there"));
    }
    assert_eq!(read.points.len(), written.points.len());
    for ((a, a_track), (b, b_track)) in read.points.iter().zip(written.points.iter()) {
        assert!(a_track == b_track && (a - b).norm() <= 1e-11 * b.coords.norm(), "{a} {b}");
    }
    assert_eq!(read.pairs, written.pairs);
    assert!(read.skipped.is_empty() && read.warnings.is_empty(), "{:?}", read.warnings);
}

fn lens() -> impl Strategy<Value = Distortion> {
    (0..7, proptest::array::uniform8(-0.01..0.01)).prop_map(|(model, [k1, k2, p1, p2, a, b, c, d])| {
        match model {
            0 => Distortion::None,
            1 => Distortion::Radial { k1, k2 },
            2 => Distortion::OpenCv { k1, k2, p1, p2 },
            3 => Distortion::FullOpenCv { k1, k2, p1, p2, k3: a, k4: b, k5: c, k6: d },
            4 => Distortion::Fov { omega: 0.3 + k1 },
            5 => Distortion::Fisheye { k1, k2, k3: a, k4: b },
            _ => Distortion::ThinPrismFisheye { k1, k2, p1, p2, k3: a, k4: b, sx1: c, sy1: d },
        }
    })
}

fn view() -> impl Strategy<Value = (Intrinsics, Distortion, [f64; 3], Option<DepthRange>)> {
    let sides = (8_u32..24, 8_u32..24);
    let focals = (10.0..40.0, prop_oneof![Just(1.0), 0.9..1.1], prop_oneof![Just(0.0), -0.2..0.2]);
    let intrinsics =
        (sides, focals, (0.3..0.7, 0.3..0.7)).prop_map(|((width, height), (fx, ratio, skew), (u, v))| {
            Intrinsics {
                width,
                height,
                fx,
                fy: fx * ratio,
                skew,
                cx: u * width as f64,
                cy: v * height as f64,
            }
        });
    let range = proptest::option::of((1.0..2.0, 0.1..9.0, proptest::option::of(2_u32..400)));
    let range =
        range.prop_map(|r| r.map(|(min, extent, count)| DepthRange { min, max: min + extent, count }));
    (intrinsics, lens(), proptest::array::uniform3(-3.0..-1.0), range)
}

/// Views with gaps in their ids, folders and spaces in their names, and points that some of them see.
fn scene(folder: &Path, views: Vec<(Intrinsics, Distortion, [f64; 3], Option<DepthRange>)>) -> Scene {
    let mut scene = Scene::default();
    for ((intrinsics, distortion, centre, depth_range), k) in views.into_iter().zip(0_u32..) {
        let id = ViewId(3 + 7 * k);
        let name = format!("left camera/{k} photo.png");
        let image = folder.join(format!("{k}.png"));
        RgbImage::new(intrinsics.width, intrinsics.height).save(&image).expect("written");
        let pose = Pose::look_at(&Point3::from(centre), &Point3::new(0.1, 0.2, 5.0), &-Vector3::y());
        let camera = Camera { intrinsics, pose };
        scene.views.insert(id, View { id, name, image, camera, distortion, depth_range });
    }
    let ids: Vec<ViewId> = scene.views.keys().copied().collect();
    for k in 0..5 {
        let seen = ids.iter().copied().filter(|id| (id.0 + k) % 3 != 0);
        scene.points.push(Point3::new(0.1 * k as f64, 0.3, 5.0), seen.collect::<Vec<_>>());
    }
    let sources = ids[1..].iter().map(|id| SourceScore { view: *id, score: 1.0 / id.0 as f64 });
    scene.pairs.insert(ids[0], sources.collect());
    scene
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn reading_inverts_writing_in_all_that_the_format_holds(
        views in proptest::collection::vec(view(), 2..5), undistort in any::<bool>()
    ) {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let scene = scene(folder.path(), views);
        for format in FORMATS {
            let out = folder.path().join(format!("{format:?}"));
            let written = write_scene(&scene, format, undistort, &out).expect("written");
            let read = read_scene(&out, &ReadOptions::default()).expect("read");
            assert_same(&read, &written.scene);
            // What is held is held: a second time nothing is lost that the first time left.
            let again = held(&read, format, undistort);
            prop_assert!(again.resampled.is_empty(), "{:?}", again.losses);
            for (id, view) in &again.scene.views {
                prop_assert_eq!(view, &read.views[id]);
            }
        }
    }
}

#[test]
fn what_is_lost_is_named() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let k = Intrinsics { width: 12, height: 10, fx: 12.0, fy: 12.0, skew: 0.0, cx: 5.5, cy: 4.5 };
    let bent = Distortion::Radial { k1: 0.01, k2: 0.0 };
    let range = Some(DepthRange { min: 1.0, max: 2.0, count: None });
    let scene = scene(
        folder.path(),
        vec![
            (k, bent, [-1.0, -1.0, -1.0], range),
            (Intrinsics { fy: 13.0, ..k }, bent, [-2.0, -1.0, -1.0], range),
        ],
    );
    let losses = |format, undistort| held(&scene, format, undistort).losses.join("\n");
    let mvsnet = losses(TargetFormat::Mvsnet, false);
    for what in [
        "2 views, the first \"left camera/0 photo.png\": the lens",
        "gets 192",
        "5 sparse points",
        "it is numbered",
    ] {
        assert!(mvsnet.contains(what), "{what}: {mvsnet}");
    }
    let colmap = losses(TargetFormat::Colmap, false);
    for what in ["the depth range", "the list of source views", "grey"] {
        assert!(colmap.contains(what), "{what}: {colmap}");
    }
    assert!(!colmap.contains("lens") && losses(TargetFormat::Colmap, true).contains("as asked for"));
    let openmvg = losses(TargetFormat::OpenMvg, false);
    assert!(openmvg.contains("view \"left camera/1 photo.png\": two focal lengths"), "{openmvg}");
}

#[test]
fn an_undistorted_colmap_scene_is_a_dense_workspace() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let k = Intrinsics { width: 12, height: 10, fx: 12.0, fy: 12.0, skew: 0.0, cx: 5.5, cy: 4.5 };
    let bent = Distortion::Radial { k1: 0.01, k2: 0.0 };
    let scene =
        scene(folder.path(), vec![(k, bent, [-1.0, -1.0, -1.0], None), (k, bent, [-2.0, -1.0, -1.0], None)]);
    let out = folder.path().join("dense");
    let written = write_scene(&scene, TargetFormat::Colmap, true, &out).expect("written");
    assert_eq!(written.resampled.len(), 2);
    assert!(written.scene.views.values().all(|view| view.distortion == Distortion::None));
    let text = |file: &str| std::fs::read_to_string(out.join("stereo").join(file)).expect("there");
    let (first, second) = ("left camera/0 photo.png", "left camera/1 photo.png");
    assert_eq!(text("patch-match.cfg"), format!("{first}\n{second}\n{second}\n__auto__, 20\n"));
    assert_eq!(text("fusion.cfg"), format!("{first}\n{second}\n"));
    assert!(out.join("stereo/depth_maps").is_dir());
}

/// The scenes that lie beside the checkout, as far as they are there.
fn shared_scenes(test: &str) -> Vec<PathBuf> {
    let data = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data"));
    let names = [
        "colmap/sceaux",
        "colmap/bartoszek/dense/0",
        "colmap/testColmap/dense",
        "scenes/hololens_b",
        "scenes/hololens_c",
        "scenes/dtu_scan37_10v",
        "scenes/meeting_room_40",
    ];
    let (there, missing): (Vec<_>, Vec<_>) = names.into_iter().partition(|name| data.join(name).is_dir());
    for name in missing {
        eprintln!("SKIPPED {test}: {name} is not there");
    }
    there.into_iter().map(|name| data.join(name)).collect()
}

#[test]
fn every_shared_scene_goes_in_and_out_of_every_format_unharmed() {
    for path in shared_scenes("every_shared_scene_goes_in_and_out_of_every_format_unharmed") {
        let mut scene = read_scene(&path, &ReadOptions::default()).expect("a good scene");
        let folder = tempfile::tempdir().expect("a temporary folder");
        for view in scene.views.values_mut() {
            // Blank images of the right size stand for the photographs.
            let k = &view.camera.intrinsics;
            let blank = folder.path().join(format!("{}x{}.png", k.width, k.height));
            if !blank.exists() {
                RgbImage::new(k.width, k.height).save(&blank).expect("written");
            }
            view.image = blank;
            let (stem, _) = view.name.rsplit_once('.').expect("an extension");
            view.name = format!("{stem}.png");
        }
        let kept: Vec<ViewId> = scene.views.keys().copied().collect();
        for format in FORMATS {
            let resamples = !held(&scene, format, false).resampled.is_empty();
            let mut scene = scene.clone();
            if resamples {
                // Resampling every photograph would take long; the first three show whether it is right.
                scene.views.retain(|id, _| kept[..3].contains(id));
                scene.pairs.clear();
            }
            let out = folder.path().join(format!("{format:?}"));
            let written = write_scene(&scene, format, false, &out).expect("written");
            let read = read_scene(&out, &ReadOptions::default()).expect("read");
            assert_same(&read, &written.scene);
            std::fs::remove_dir_all(&out).expect("removed");
        }
    }
}
