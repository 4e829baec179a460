//! Odd and hostile scene folders: each is read right, or refused with file, view and field named.

use std::error::Error;
use std::fs;
use std::path::Path;

use image::RgbImage;
use planesweep_scene::{
    Camera, DepthRange, Distortion, Intrinsics, PixelCentre, Pose, ReadError, ReadOptions, Scene, View,
    ViewId, read_scene, write_colmap,
};
use tempfile::TempDir;

const CAMERA: &str = "1 PINHOLE 16 12 20 21 8.5 6.5";

fn photo(folder: &TempDir, name: &str, width: u32, height: u32) {
    let path = folder.path().join("images").join(name);
    fs::create_dir_all(path.parent().expect("a folder")).expect("made");
    RgbImage::new(width, height).save(path).expect("written");
}

/// A COLMAP text model with the images `a.png` and `b.png` of 16x12 pixels.
fn model(cameras: &str, images: &[&str], points: &str) -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for name in ["a.png", "b.png"] {
        photo(&folder, name, 16, 12);
    }
    let sparse = folder.path().join("sparse/0");
    fs::create_dir_all(&sparse).expect("made");
    fs::write(sparse.join("cameras.txt"), format!("# cameras\n{cameras}\n")).expect("written");
    // The line of observations after each image is empty.
    let images = [&["# images"], images].concat().join("\n\n");
    fs::write(sparse.join("images.txt"), images).expect("written");
    fs::write(sparse.join("points3D.txt"), points).expect("written");
    folder
}

fn read(folder: &TempDir) -> Result<Scene, ReadError> {
    read_scene(folder.path(), &ReadOptions::default())
}

fn read_skipping(folder: &TempDir) -> Scene {
    let options = ReadOptions { skip_bad_views: true, ..ReadOptions::default() };
    read_scene(folder.path(), &options).expect("the bad view is left out")
}

/// The error with its causes.
fn text(error: &ReadError) -> String {
    match error.source() {
        Some(source) => format!("{error}: {source}"),
        None => error.to_string(),
    }
}

/// Reading fails with all the words; leaving bad views out gives the other view.
fn assert_bad_view(folder: &TempDir, words: &[&str]) {
    let message = text(&read(folder).expect_err("a bad view"));
    for word in words {
        assert!(message.contains(word), "{word} in {message}");
    }
    let scene = read_skipping(folder);
    assert_eq!(scene.views.values().map(|v| v.name.as_str()).collect::<Vec<_>>(), ["b.png"]);
    assert_eq!((scene.warnings.len(), scene.skipped.len()), (0, 1));
}

#[test]
fn nan_infinite_or_non_rotation_pose_is_refused_with_view_and_field() {
    for (pose, field) in [
        ("NaN 0 0 0 0 0 0", "rotation is not finite"),
        ("1 0 0 0 0 inf 0", "translation is not finite"),
        ("0 0 0 0 0 0 0", "not orthonormal"),
        ("1 1 0 0 0 0 0", "not orthonormal"),
    ] {
        let folder = model(CAMERA, &[&format!("1 {pose} 1 a.png"), "2 1 0 0 0 0 0 0 1 b.png"], "");
        assert_bad_view(&folder, &["\"a.png\"", field, "--skip-bad-views"]);
    }
}

#[test]
fn focal_length_not_positive_is_refused_with_view_and_field() {
    for (focal, field) in [("0", "focal length 0"), ("-5", "focal length -5"), ("nan", "not finite")] {
        let cameras = format!("{CAMERA}\n2 SIMPLE_PINHOLE 16 12 {focal} 8 6");
        let folder = model(&cameras, &["1 1 0 0 0 0 0 0 2 a.png", "2 1 0 0 0 0 0 0 1 b.png"], "");
        assert_bad_view(&folder, &["\"a.png\"", field]);
    }
}

#[test]
fn ids_with_gaps_unregistered_images_folders_in_names_several_cameras_and_mixed_sizes() {
    let cameras = "7 SIMPLE_RADIAL 16 12 20 8.5 6.5 0.1\n90 OPENCV 10 8 9 9.5 5 4 .1 .2 .3 .4";
    let images = ["5 1 0 0 0 1 2 3 90 left camera/IMG 1.png", "4000000000 1 0 0 0 0 0 0 7 a.png"];
    let points = "# points\n9 1 2 3 0 0 0 0.5 5 0 4000000000 3 5 8\n12 4 5 6 0 0 0 0.5\n";
    let folder = model(cameras, &images, points);
    photo(&folder, "left camera/IMG 1.png", 10, 8);
    let scene = read(&folder).expect("all fine");
    assert!(scene.warnings.is_empty());
    let (five, big) = (ViewId(5), ViewId(4_000_000_000));
    assert_eq!(scene.views.keys().copied().collect::<Vec<_>>(), [five, big]);
    let view = &scene.views[&five];
    assert_eq!(view.name, "left camera/IMG 1.png");
    assert_eq!(view.distortion, Distortion::OpenCv { k1: 0.1, k2: 0.2, p1: 0.3, p2: 0.4 });
    assert_eq!(
        view.camera.intrinsics,
        Intrinsics { width: 10, height: 8, fx: 9.0, fy: 9.5, skew: 0.0, cx: 4.5, cy: 3.5 }
    );
    assert_eq!(view.camera.pose.translation.as_slice(), [1.0, 2.0, 3.0]);
    assert_eq!(scene.views[&big].distortion, Distortion::Radial { k1: 0.1, k2: 0.0 });
    let tracks: Vec<_> = scene.points.iter().map(|(p, track)| (p.x, track.to_vec())).collect();
    assert_eq!(tracks, [(1.0, vec![five, big]), (4.0, vec![])]);
}

#[test]
fn image_size_that_differs_from_the_camera_s() {
    let images = ["1 1 0 0 0 0 0 0 2 a.png", "2 1 0 0 0 0 0 0 1 b.png"];
    let folder = model(&format!("{CAMERA}\n2 PINHOLE 32 24 40 42 17 13"), &images, "");
    let scene = read(&folder).expect("the aspect agrees");
    let k = scene.views[&ViewId(1)].camera.intrinsics;
    assert_eq!((k.width, k.height, k.fx, k.fy, k.cx, k.cy), (16, 12, 20.0, 21.0, 8.0, 6.0));
    assert!(scene.warnings[0].what.contains("16x12") && scene.warnings[0].what.contains("32x24"));
    let folder = model(&format!("{CAMERA}\n2 PINHOLE 12 16 40 42 17 13"), &images, "");
    assert_bad_view(&folder, &["\"a.png\"", "16x12", "12x16"]);
}

#[test]
fn missing_and_damaged_images_are_left_out() {
    let images = ["1 1 0 0 0 0 0 0 1 a.png", "2 1 0 0 0 0 0 0 1 b.png", "3 1 0 0 0 0 0 0 1 c.png"];
    let folder = model(CAMERA, &images, "1 0 0 1 0 0 0 0.5 1 0 2 0 3 0\n");
    fs::write(folder.path().join("images/c.png"), b"\x89PNG\r\n\x1a\n damaged").expect("written");
    fs::remove_file(folder.path().join("images/a.png")).expect("removed");
    let scene = read(&folder).expect("one view is left");
    assert_eq!(scene.skipped.keys().collect::<Vec<_>>(), ["a.png", "c.png"]);
    assert!(scene.skipped["c.png"].contains("could not read the header"), "{:?}", scene.skipped);
    assert_eq!(scene.points.iter().next().expect("a point").1, [ViewId(2)]);
    fs::remove_file(folder.path().join("images/b.png")).expect("removed");
    assert!(matches!(read(&folder), Err(ReadError::NoViews { .. })));
}

#[test]
fn hostile_image_names_are_refused() {
    let long = "x".repeat(300);
    for (name, what) in [
        ("../a.png", "has the part \"..\""),
        ("sub/../../a.png", "has the part \"..\""),
        ("/etc/hostname", "absolute"),
        ("a\0.png", "control character"),
        (long.as_str(), "too long"),
        ("link.png", "leads out of"),
    ] {
        let folder = model(CAMERA, &[&format!("1 1 0 0 0 0 0 0 1 {name}"), "2 1 0 0 0 0 0 0 1 b.png"], "");
        fs::write(folder.path().join("secret.png"), b"outside of images/").expect("written");
        #[cfg(unix)]
        std::os::unix::fs::symlink("../secret.png", folder.path().join("images/link.png")).expect("linked");
        assert_bad_view(&folder, &[what]);
    }
}

#[test]
fn every_camera_model_is_read() {
    let zero = Distortion::Fisheye { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 };
    for (camera, lens) in [
        ("SIMPLE_PINHOLE 16 12 20 8.5 6.5", Distortion::None),
        ("PINHOLE 16 12 20 20 8.5 6.5", Distortion::None),
        ("SIMPLE_RADIAL 16 12 20 8.5 6.5 .1", Distortion::Radial { k1: 0.1, k2: 0.0 }),
        ("RADIAL 16 12 20 8.5 6.5 .1 .2", Distortion::Radial { k1: 0.1, k2: 0.2 }),
        ("OPENCV 16 12 20 20 8.5 6.5 .1 .2 .3 .4", Distortion::OpenCv { k1: 0.1, k2: 0.2, p1: 0.3, p2: 0.4 }),
        (
            "OPENCV_FISHEYE 16 12 20 20 8.5 6.5 .1 .2 .3 .4",
            Distortion::Fisheye { k1: 0.1, k2: 0.2, k3: 0.3, k4: 0.4 },
        ),
        (
            "FULL_OPENCV 16 12 20 20 8.5 6.5 .1 .2 .3 .4 .5 .6 .7 .8",
            Distortion::FullOpenCv { k1: 0.1, k2: 0.2, p1: 0.3, p2: 0.4, k3: 0.5, k4: 0.6, k5: 0.7, k6: 0.8 },
        ),
        ("FOV 16 12 20 20 8.5 6.5 .9", Distortion::Fov { omega: 0.9 }),
        (
            "SIMPLE_RADIAL_FISHEYE 16 12 20 8.5 6.5 .1",
            Distortion::Fisheye { k1: 0.1, k2: 0.0, k3: 0.0, k4: 0.0 },
        ),
        ("RADIAL_FISHEYE 16 12 20 8.5 6.5 .1 .2", Distortion::Fisheye { k1: 0.1, k2: 0.2, k3: 0.0, k4: 0.0 }),
        (
            "THIN_PRISM_FISHEYE 16 12 20 20 8.5 6.5 .1 .2 .3 .4 .5 .6 .7 .8",
            Distortion::ThinPrismFisheye {
                k1: 0.1,
                k2: 0.2,
                p1: 0.3,
                p2: 0.4,
                k3: 0.5,
                k4: 0.6,
                sx1: 0.7,
                sy1: 0.8,
            },
        ),
        ("SIMPLE_FISHEYE 16 12 20 8.5 6.5", zero),
        ("FISHEYE 16 12 20 20 8.5 6.5", zero),
    ] {
        let folder = model(&format!("1 {camera}"), &["1 1 0 0 0 0 0 0 1 a.png"], "");
        let view = read(&folder).expect(camera).views[&ViewId(1)].clone();
        assert_eq!(view.distortion, lens, "{camera}");
        let k = view.camera.intrinsics;
        assert_eq!((k.fx, k.fy, k.cx, k.cy), (20.0, 20.0, 8.0, 6.0), "{camera}");
    }
}

#[test]
fn camera_models_that_are_not_supported_are_named() {
    let cameras = format!("{CAMERA}\n2 DIVISION 16 12 20 20 8 6 0.9");
    let folder = model(&cameras, &["1 1 0 0 0 0 0 0 2 a.png", "2 1 0 0 0 0 0 0 1 b.png"], "");
    assert_bad_view(&folder, &["camera model DIVISION is not supported"]);
    let folder = model("1 WARP 16 12 20", &[], "");
    assert!(text(&read(&folder).expect_err("unknown")).contains("at line 2: camera 1 has the unknown model"));
}

#[test]
fn inconsistent_text_models_are_refused_with_file_and_line() {
    let image = "1 1 0 0 0 0 0 0 1 a.png";
    for (cameras, images, points, what) in [
        (CAMERA, vec![image], "1 0 0 1 0 0 0 1 7 0\n", "points3D.txt at line 1: point 1 is seen by image 7"),
        (CAMERA, vec![image], "1 0 x 1 0 0 0 1\n", "points3D.txt at line 1: \"x\" is no position"),
        (CAMERA, vec!["1 1 0 0 0 0 0 0"], "", "images.txt at line 3: the camera id is missing"),
        (CAMERA, vec!["1 1 0 0 0 0 0 0 8 a.png"], "", "\"a.png\" with camera 8, which does not exist"),
        (CAMERA, vec![image, image], "", "image 1 twice"),
        (CAMERA, vec![image, "2 1 0 0 0 0 0 0 1 a.png"], "", "two images with the name \"a.png\""),
        (
            "1 PINHOLE 16 12 20 21 8",
            vec![image],
            "",
            "cameras.txt at line 2: the camera parameter is missing",
        ),
        ("1 PINHOLE 16 12 20 21 8 6 5", vec![image], "", "PINHOLE has 4 parameters, there are more"),
    ] {
        let message = text(&read(&model(cameras, &images, points)).expect_err(what));
        assert!(message.contains(what), "{message}");
    }
}

/// A binary model of two views and two points.
fn binary_model() -> TempDir {
    let folder = model(CAMERA, &[], "");
    let mut scene = Scene::default();
    for (id, name) in [(1, "a.png"), (2, "b.png")] {
        let intrinsics =
            Intrinsics { width: 16, height: 12, fx: 20.0, fy: 21.0, skew: 0.0, cx: 8.0, cy: 6.0 };
        let pose = Pose::new(nalgebra::Matrix3::identity(), nalgebra::Vector3::zeros()).expect("a pose");
        let view = View {
            id: ViewId(id),
            name: name.to_owned(),
            image: folder.path().join("images").join(name),
            camera: Camera { intrinsics, pose },
            distortion: Distortion::None,
            depth_range: None,
        };
        scene.views.insert(view.id, view);
    }
    scene.points.push([0.0, 0.0, 1.0].into(), [ViewId(1), ViewId(2)]);
    scene.points.push([0.0, 0.1, 1.0].into(), [ViewId(2)]);
    write_colmap(&scene, folder.path()).expect("written");
    folder
}

#[test]
fn a_binary_model_wins_over_a_text_one() {
    let folder = binary_model();
    let sparse = folder.path().join("sparse");
    fs::write(sparse.join("images.txt"), "no model at all").expect("written");
    assert_eq!(read(&folder).expect("binary").views.len(), 2);
}

#[test]
fn truncated_bins_trailing_bytes_and_wrong_counts_are_refused_with_file_and_offset() {
    let folder = binary_model();
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        let path = folder.path().join("sparse").join(file);
        let whole = fs::read(&path).expect("read");
        let refused = |bytes: &[u8]| {
            fs::write(&path, bytes).expect("written");
            let error = read(&folder).expect_err("a broken file");
            assert!(matches!(&error, ReadError::Binary { path, .. } if path.ends_with(file)), "{error}");
            error.to_string()
        };
        for length in 0..whole.len() {
            refused(&whole[..length]);
        }
        let message = refused(&[whole.as_slice(), &[0]].concat());
        assert!(message.contains(&format!("at byte {}: 1 bytes follow", whole.len())), "{message}");
        for count in [3, 1 << 32, u64::MAX] {
            let bytes = [&count.to_le_bytes(), &whole[8..]].concat();
            assert!(count == 3 || refused(&bytes).contains(&format!("at byte 0: {count}")));
            refused(&bytes);
        }
        refused(&[&0_u64.to_le_bytes(), &whole[8..]].concat());
        fs::write(&path, whole).expect("written");
    }
    assert_eq!(read(&folder).expect("whole again").points.len(), 2);
}

#[test]
fn a_bin_track_that_names_no_image_is_refused() {
    let folder = binary_model();
    let path = folder.path().join("sparse/points3D.bin");
    let mut bytes = fs::read(&path).expect("read");
    // The first element of the first track, behind the counts, id, position, colour and error.
    let at = 8 + 8 + 24 + 3 + 8 + 8;
    bytes[at] = 77;
    fs::write(&path, bytes).expect("written");
    let message = read(&folder).expect_err("no such image").to_string();
    assert!(message.contains(&format!("at byte {at}: point 1 is seen by image 77")), "{message}");
}

/// An MVSNet folder with the cameras given, images beside them in `images`.
fn mvsnet(images: &str, cams: &[(&str, &str)]) -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    fs::create_dir_all(folder.path().join("cams")).expect("made");
    fs::create_dir_all(folder.path().join(images)).expect("made");
    for (stem, text) in cams {
        fs::write(folder.path().join(format!("cams/{stem}_cam.txt")), text).expect("written");
        for name in [format!("{stem}.png"), format!("{stem}_masked.png")] {
            RgbImage::new(8, 6).save(folder.path().join(images).join(name)).expect("written");
        }
    }
    folder
}

const CAM: &str = "extrinsic\r\n1 0 0 1\r\n0 1 0 2\r\n0 0 1 3\r\n0 0 0 1\r\nintrinsic\r\n9 0 4\r\n0 9 3\r\n0 0 1 \r\n2 0.5 11.0 7\r\n\r\n";

#[test]
fn blended_images_are_read_without_their_masked_twins() {
    let folder = mvsnet("blended_images", &[("00000002", CAM), ("00000011", CAM)]);
    let scene = read(&folder).expect("a good folder");
    assert_eq!(
        scene.views.values().map(|v| (v.id.0, v.name.as_str())).collect::<Vec<_>>(),
        [(2, "00000002.png"), (11, "00000011.png")]
    );
    let view = &scene.views[&ViewId(2)];
    assert_eq!(view.depth_range, Some(DepthRange { min: 2.0, max: 7.0, count: Some(11) }));
    assert_eq!((view.camera.intrinsics.width, view.camera.intrinsics.cx), (8, 4.0));
    let options = ReadOptions { pixel_centre: PixelCentre::Half, ..ReadOptions::default() };
    let scene = read_scene(folder.path(), &options).expect("a good folder");
    assert_eq!(scene.views[&ViewId(2)].camera.intrinsics.cx, 3.5);
}

#[test]
fn broken_camera_files_are_refused_with_view_and_field() {
    for (from, to, what) in [
        ("1 0 0 1", "nan 0 0 1", "rotation is not finite"),
        ("1 0 0 1", "2 0 0 1", "not orthonormal"),
        ("9 0 4", "-9 0 4", "focal length -9"),
        ("9 0 4", "9 0 inf", "intrinsics is not finite"),
        ("0 0 0 1", "0 0 1 1", "last row is not 0 0 0 1"),
        ("0 0 1 \r", "0 0 2 \r", "not upper triangular"),
        ("intrinsic", "", "has no intrinsic"),
        ("0.5 11.0", "many 11.0", "\"many\" in its depth line"),
        (&CAM[60..], "", "fewer than 3x3"),
    ] {
        let folder = mvsnet("images", &[("0", &CAM.replacen(from, to, 1)), ("1", CAM)]);
        let message = text(&read(&folder).expect_err(what));
        assert!(message.contains(what) && message.contains("\"0.png\""), "{message}");
        assert_eq!(read_skipping(&folder).views.len(), 1);
    }
}

#[test]
fn a_folder_of_cameras_without_images_says_so() {
    let folder = mvsnet("pictures", &[("0", CAM)]);
    assert!(
        matches!(read(&folder), Err(ReadError::NoImages { images, .. }) if images == Path::new(&folder.path().join("images")))
    );
}
