//! What is written is read again, in every format, as far as the format can hold it.

use std::path::{Path, PathBuf};

use image::RgbImage;
use nalgebra::{Matrix3, Point2, Point3, Vector3};
use planesweep_scene::{
    Camera, DepthRange, Distortion, Held, Intrinsics, Pose, ReadOptions, Scene, SourceScore, TargetFormat,
    View, ViewId, held, read_image, read_scene, write_scene,
};
use proptest::prelude::*;

const FORMATS: [TargetFormat; 4] =
    [TargetFormat::Colmap, TargetFormat::ColmapText, TargetFormat::Mvsnet, TargetFormat::OpenMvg];

fn close(a: f64, b: f64, scale: f64) -> bool {
    (a - b).abs() <= 1e-11 * (scale + a.abs() + b.abs())
}

/// Equal but for the rounding of rotations through quaternions, of principal points that are shifted by half a
/// pixel, of centres and of intervals.
#[track_caller]
fn assert_same(read: &Scene, written: &Scene) {
    assert_eq!(read.views.keys().collect::<Vec<_>>(), written.views.keys().collect::<Vec<_>>());
    for (read, written) in read.views.values().zip(written.views.values()) {
        assert_eq!((&read.name, read.distortion.model()), (&written.name, written.distortion.model()));
        assert_eq!(read.distortion, written.distortion);
        let (a, b) = (&read.camera.intrinsics, &written.camera.intrinsics);
        let exact = |k: &Intrinsics| (k.width, k.height, k.fx, k.fy, k.skew);
        assert_eq!(exact(a), exact(b));
        assert!(close(a.cx, b.cx, 1.0) && close(a.cy, b.cy, 1.0), "{a:?} {b:?}");
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
        assert_eq!((a, a_track), (b, b_track));
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

/// A pixel in so many is compared on either axis.
const COMPARED: usize = 8;
/// Grey levels by which resampled photographs may differ on average: what JPEG takes from fine texture.
const RESAMPLED_LEVELS: f64 = 2.0;

/// The photographs of a scene as they were written: the same bytes, or the same colours along the rays of the
/// pinhole camera that resampled ones were made for.
#[track_caller]
fn assert_same_photographs(held: &Held, original: &Scene) {
    for (id, written) in &held.scene.views {
        let stored = &original.views[id];
        if !held.resampled.contains(id) {
            let bytes = |path: &Path| std::fs::read(path).expect("a photograph");
            assert!(bytes(&written.image) == bytes(&stored.image), "{}", written.name);
            continue;
        }
        let (image, photograph) =
            [&written.image, &stored.image].map(|path| read_image(path).expect("read")).into();
        let (k, lens) = (&stored.camera.intrinsics, &stored.distortion);
        let (mut sum, mut count) = (0.0, 0_usize);
        for row in (0..image.height()).step_by(COMPARED) {
            for column in (0..image.width()).step_by(COMPARED) {
                let ray = written.camera.intrinsics.unproject(&Point2::new(column as f64, row as f64), 1.0);
                let (x, y) = lens.distort(ray.x, ray.y);
                let (u, v) = (k.fx * x + k.skew * y + k.cx, k.fy * y + k.cy);
                let (left, top) = (u.floor(), v.floor());
                let inside =
                    left >= 0.0 && top >= 0.0 && left + 1.0 < k.width as f64 && top + 1.0 < k.height as f64;
                if !inside {
                    continue;
                }
                let (left, top, u, v) = (left as usize, top as usize, u - left, v - top);
                for (channel, value) in image.at(column, row).into_iter().enumerate() {
                    let at = |dx, dy| f64::from(photograph.at(left + dx, top + dy)[channel]);
                    let above = at(0, 0) * (1.0 - u) + at(1, 0) * u;
                    let below = at(0, 1) * (1.0 - u) + at(1, 1) * u;
                    sum += (above * (1.0 - v) + below * v - f64::from(value)).abs();
                    count += 1;
                }
            }
        }
        let compared = image.height().div_ceil(COMPARED) * image.width().div_ceil(COMPARED) * 3;
        assert!(count as f64 > 0.95 * compared as f64, "{}: {count} of {compared}", written.name);
        let levels = sum / count as f64;
        eprintln!("{}: resampled for another camera, {levels:.2} grey levels off", written.name);
        assert!(levels < RESAMPLED_LEVELS, "{}: {levels}", written.name);
    }
}

/// Reads each shared scene, keeps `views` of it, writes it in every format, and reads it again.
fn shared_scenes_go_in_and_out(test: &str, views: usize) {
    let dense = (TargetFormat::Colmap, true);
    for path in shared_scenes(test) {
        let mut scene = read_scene(&path, &ReadOptions::default()).expect("a good scene");
        let kept: Vec<ViewId> = scene.views.keys().copied().take(views).collect();
        scene.views.retain(|id, _| kept.contains(id));
        scene.pairs.retain(|id, _| kept.contains(id));
        scene.pairs.values_mut().for_each(|sources| sources.retain(|source| kept.contains(&source.view)));
        for (format, undistort) in FORMATS.into_iter().map(|format| (format, false)).chain([dense]) {
            let out = tempfile::tempdir().expect("a temporary folder");
            let written = write_scene(&scene, format, undistort, out.path()).expect("written");
            assert_eq!(written.scene.views.len(), kept.len());
            let read = read_scene(out.path(), &ReadOptions::default()).expect("read");
            assert_same(&read, &written.scene);
            assert_same_photographs(&written, &scene);
            eprintln!("{} as {format:?}: {} views", path.display(), read.views.len());
        }
    }
}

#[test]
fn every_shared_scene_goes_in_and_out_of_every_format_unharmed() {
    shared_scenes_go_in_and_out("every_shared_scene_goes_in_and_out_of_every_format_unharmed", 3);
}

#[test]
#[ignore = "minutes: every photograph of every shared scene; scripts/slow.sh runs it"]
fn all_photographs_of_shared_scenes_go_in_and_out_of_every_format() {
    shared_scenes_go_in_and_out("all_photographs_of_shared_scenes_go_in_and_out_of_every_format", usize::MAX);
}
