//! OpenMVG, nerfstudio, Bundler and OpenMVS scenes as their own programs write them.

use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;
use nalgebra::Point3;
use planesweep_scene::{Distortion, Pose, ReadError, ReadOptions, Scene, SceneFormat, ViewId, read_scene};
use tempfile::TempDir;

fn folder_with(images: &[&str], width: u32, height: u32) -> TempDir {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for name in images {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        RgbImage::new(width, height).save(path).expect("written");
    }
    folder
}

fn read(path: &Path) -> Scene {
    read_scene(path, &ReadOptions::default()).expect("a good scene")
}

fn message(path: &Path, options: &ReadOptions) -> String {
    read_scene(path, options).expect_err("no good scene").to_string()
}

/// A camera at (1, 2, 3) turned by a quarter about x.
fn posed(pose: &Pose) -> bool {
    let centre = (pose.centre() - Point3::new(1.0, 2.0, 3.0)).norm();
    centre < 1e-12
        && (pose.to_camera(&Point3::new(1.0, 7.0, 3.0)) - Point3::new(0.0, 0.0, 5.0)).norm() < 1e-12
}

/// Old nesting for the first intrinsic, new nesting for the second; the third has the first's type.
const SFM_DATA: &str = r#"{ "sfm_data_version": "0.3", "root_path": "/home/someone/photos", "views": [
 {"key": 4, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": 2147483649, "data": {"local_path": "a/", "filename": "x y.png", "width": 16, "height": 12, "id_view": 4, "id_intrinsic": 0, "id_pose": 9}}}},
 {"key": 5, "value": {"polymorphic_id": 2147483649, "polymorphic_name": "view_priors", "ptr_wrapper": {"id": 2147483650, "data": {"use_pose_center_prior": true, "local_path": "", "filename": "b.png", "width": 16, "height": 12, "id_view": 5, "id_intrinsic": 1, "id_pose": 5}}}},
 {"key": 6, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": 2147483651, "data": {"local_path": "", "filename": "c.png", "width": 16, "height": 12, "id_view": 6, "id_intrinsic": 2, "id_pose": 4294967295}}}},
 {"key": 7, "value": {"polymorphic_id": 1073741824, "ptr_wrapper": {"id": 2147483652, "data": {"local_path": "", "filename": "d.png", "width": 16, "height": 12, "id_view": 7, "id_intrinsic": 2, "id_pose": 5}}}}
 ], "intrinsics": [
 {"key": 0, "value": {"polymorphic_id": 2147483650, "polymorphic_name": "pinhole_radial_k3", "ptr_wrapper": {"id": 2147483653, "data": {"width": 16, "height": 12, "focal_length": 20.0, "principal_point": [8.0, 6.0], "disto_k3": [0.1, 0.2, 0.3]}}}},
 {"key": 1, "value": {"polymorphic_id": 2147483651, "polymorphic_name": "fisheye", "ptr_wrapper": {"id": 2147483654, "data": {"value0": {"value0": {"width": 16, "height": 12}, "focal_length": 21.0, "principal_point": [8.0, 6.0]}, "fisheye": [0.1, 0.2, 0.3, 0.4]}}}},
 {"key": 2, "value": {"polymorphic_id": 2, "ptr_wrapper": {"id": 2147483655, "data": {"width": 16, "height": 12, "focal_length": 22.0, "principal_point": [8.0, 6.0], "disto_k3": [0.1, 0.0, 0.0]}}}}
 ], "extrinsics": [
 {"key": 9, "value": {"rotation": [[1, 0, 0], [0, 0, -1], [0, 1, 0]], "center": [1, 2, 3]}},
 {"key": 5, "value": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "center": [0, 0, 0]}}
 ], "structure": [ {"key": 3, "value": {"X": [0.5, 7.0, 3.0], "observations": [
   {"key": 4, "value": {"id_feat": 1, "x": [1.0, 2.0]}}, {"key": 6, "value": {"id_feat": 1, "x": [1.0, 2.0]}}, {"key": 7, "value": {"id_feat": 1, "x": [1.0, 2.0]}}]}}
 ], "control_points": [] }"#;

#[test]
fn openmvg_is_read_in_old_and_new_nesting_with_types_named_once() {
    let folder = folder_with(&["images/a/x y.png", "images/b.png", "images/d.png"], 16, 12);
    fs::write(folder.path().join("sfm_data.json"), SFM_DATA).expect("written");
    let scene = read(folder.path());
    let names: Vec<_> = scene.views.values().map(|v| (v.id.0, v.name.as_str())).collect();
    assert_eq!(names, [(4, "a/x y.png"), (5, "b.png"), (7, "d.png")]);
    assert!(posed(&scene.views[&ViewId(4)].camera.pose));
    let lens = |id| scene.views[&ViewId(id)].distortion;
    let k3 =
        Distortion::FullOpenCv { k1: 0.1, k2: 0.2, p1: 0.0, p2: 0.0, k3: 0.3, k4: 0.0, k5: 0.0, k6: 0.0 };
    assert_eq!(lens(4), k3);
    assert_eq!(lens(5), Distortion::Fisheye { k1: 0.1, k2: 0.2, k3: 0.3, k4: 0.4 });
    assert_eq!(lens(7), Distortion::Radial { k1: 0.1, k2: 0.0 });
    let k = scene.views[&ViewId(5)].camera.intrinsics;
    assert_eq!((k.fx, k.fy, k.cx, k.cy, k.width), (21.0, 21.0, 8.0, 6.0, 16));
    assert_eq!(scene.points.iter().next().expect("a point").1, [ViewId(4), ViewId(7)]);
    assert!(
        scene.warnings.len() == 1 && scene.warnings[0].what.starts_with("1 views of"),
        "{:?}",
        scene.warnings
    );
}

#[test]
fn an_openmvg_scene_takes_its_images_from_where_the_user_says() {
    let folder = folder_with(&["elsewhere/a/x y.png", "elsewhere/b.png", "elsewhere/d.png"], 16, 12);
    let file = folder.path().join("my_scene.json");
    fs::write(&file, SFM_DATA).expect("written");
    let options = ReadOptions { images: Some(folder.path().join("elsewhere")), ..ReadOptions::default() };
    assert_eq!(read_scene(&file, &options).expect("read").views.len(), 3);
    for (from, to, what) in [
        ("\"fisheye\", \"ptr", "\"spherical\", \"ptr", "could not take view \"b.png\""),
        ("\"id_intrinsic\": 1", "\"id_intrinsic\": 8", "view 5 with the intrinsic 8"),
        ("\"key\": 6, \"value\": {\"id_feat\"", "\"key\": 66, \"value\": {\"id_feat\"", "seen by view 66"),
        ("\"key\": 5, \"value\": {\"rot", "\"key\": 9, \"value\": {\"rot", "pose 9 twice"),
        ("\"focal_length\": 22.0", "\"focal\": 22.0", "intrinsic 2 without the number \"focal_length\""),
        ("[0.1, 0.2, 0.3, 0.4]", "[0.1, 0.2]", "without the 4 numbers \"fisheye\""),
        ("\"views\": [", "\"views\": {", "at line 1"),
        ("\"x y.png\"", "\"../../x.png\"", "could not take view \"a/../../x.png\""),
    ] {
        assert!(SFM_DATA.contains(from), "{from}");
        fs::write(&file, SFM_DATA.replacen(from, to, 1)).expect("written");
        let message = message(&file, &options);
        assert!(message.contains(what), "{message}");
    }
}

#[test]
fn nerfstudio_is_read_with_cameras_of_the_file_and_of_frames() {
    let folder = folder_with(&["images/1.png", "images/2.png", "train/r_0.png"], 16, 12);
    let pose = "[[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]";
    let transforms = format!(
        r#"{{"camera_model": "OPENCV", "fl_x": 20, "fl_y": 21, "cx": 8, "cy": 6, "w": 16, "h": 12,
            "k1": 0.1, "k2": 0.2, "p1": 0.3, "p2": 0.4, "ply_file_path": "sparse.ply", "frames": [
            {{"file_path": "./images/1.png", "transform_matrix": {pose}}},
            {{"file_path": "images/2.png", "transform_matrix": {pose}, "fl_x": 30, "fl_y": 30, "camera_model": "PINHOLE"}},
            {{"file_path": "./train/r_0", "transform_matrix": {pose}, "camera_model": "OPENCV_FISHEYE"}}]}}"#
    );
    fs::write(folder.path().join("transforms.json"), &transforms).expect("written");
    let scene = read(folder.path());
    let names: Vec<_> = scene.views.values().map(|v| v.name.as_str()).collect();
    assert_eq!(names, ["images/1.png", "images/2.png", "train/r_0.png"]);
    // OpenGL's camera looks along -z, here along +y of the world, with +z up.
    let view = &scene.views[&ViewId(0)];
    let up = view.camera.pose.to_camera(&Point3::new(1.0, 7.0, 4.0));
    assert!((up - Point3::new(0.0, -1.0, 5.0)).norm() < 1e-12, "{up}");
    let k = view.camera.intrinsics;
    assert_eq!((k.fx, k.fy, k.cx, k.cy), (20.0, 21.0, 7.5, 5.5));
    assert_eq!(view.distortion, Distortion::OpenCv { k1: 0.1, k2: 0.2, p1: 0.3, p2: 0.4 });
    assert_eq!(scene.views[&ViewId(1)].distortion, Distortion::None);
    assert_eq!(scene.views[&ViewId(1)].camera.intrinsics.fx, 30.0);
    assert_eq!(
        scene.views[&ViewId(2)].distortion,
        Distortion::Fisheye { k1: 0.1, k2: 0.2, k3: 0.0, k4: 0.0 }
    );
    assert!(scene.points.is_empty() && scene.warnings[0].what.contains("its points say not"));

    let angle = r#"{"camera_angle_x": 1.5707963267948966, "frames": [{"file_path": "images/1.png",
        "transform_matrix": [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]}]}"#;
    fs::write(folder.path().join("transforms.json"), angle).expect("written");
    let k = read(folder.path()).views[&ViewId(0)].camera.intrinsics;
    assert!((k.fx - 8.0).abs() < 1e-9 && (k.cx, k.cy, k.width) == (7.5, 5.5, 16), "{k:?}");
    for (from, to, what) in [
        ("camera_angle_x", "angle", "has neither fl_x nor camera_angle_x"),
        ("1.57", "\"x\": 1, \"k1\": \"wide\", \"y\": 1.57", "at line 1"),
        ("[0, 1, 0, 2]", "[0, 2, 0, 2]", "could not take view \"images/1.png\""),
        ("{\"camera", "{\"camera_model\": \"EQUIRECTANGULAR\", \"camera", "could not take view"),
        ("{\"camera", "{\"w\": -4, \"h\": 5, \"camera", "has the size"),
    ] {
        fs::write(folder.path().join("transforms.json"), angle.replacen(from, to, 1)).expect("written");
        let message = message(folder.path(), &ReadOptions::default());
        assert!(message.contains(what), "{message}");
    }
}

const BUNDLE: &str = "# Bundle file v0.3\n3 2\n20 0.1 -0.2\n1 0 0\n0 0 -1\n0 1 0\n-1 3 -2\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n0 0 0\n21 0 0\n1 0 0\n0 1 0\n0 0 1\n0 0 0\n0.5 7 3\n255 0 0\n2 0 5 1.5 -2.5 2 7 3 4\n0 0 -4\n1 2 3\n1 2 8 0 0\n";

#[test]
fn bundler_is_read_with_its_axes_turned() {
    let folder = folder_with(&["images/a.png", "images/b.png", "images/c.png"], 16, 12);
    let file = folder.path().join("bundle.out");
    fs::write(&file, BUNDLE).expect("written");
    assert!(message(folder.path(), &ReadOptions::default()).contains("list.txt"));
    fs::write(folder.path().join("list.txt"), "images/a.png 0 20\nimages/b.png\nimages/c.png\n")
        .expect("written");
    let scene = read(folder.path());
    let names: Vec<_> = scene.views.values().map(|v| (v.id.0, v.name.as_str())).collect();
    assert_eq!(names, [(0, "images/a.png"), (2, "images/c.png")]);
    let view = &scene.views[&ViewId(0)];
    let k = view.camera.intrinsics;
    assert_eq!((k.fx, k.cx, k.cy, k.width), (20.0, 7.5, 5.5, 16));
    assert_eq!(view.distortion, Distortion::Radial { k1: 0.1, k2: -0.2 });
    // Bundler's x_cam = R X + t with the camera looking along -z and y up: here at (1, 2, 3) it looks
    // along -y of the world, and the world's z is up.
    let centre = view.camera.pose.centre();
    assert!((centre - Point3::new(1.0, 2.0, 3.0)).norm() < 1e-12, "{centre}");
    let ahead = view.camera.pose.to_camera(&Point3::new(1.0, -3.0, 3.0));
    assert!((ahead.x, ahead.y) == (0.0, 0.0) && ahead.z.abs() == 5.0, "{ahead}");
    let tracks: Vec<_> = scene.points.iter().map(|(p, track)| (p.x, track.to_vec())).collect();
    assert_eq!(tracks, [(0.5, vec![ViewId(0), ViewId(2)]), (0.0, vec![ViewId(2)])]);
    let (point, _) = scene.points.iter().nth(1).expect("two points");
    let (pixel, depth) = scene.views[&ViewId(2)].camera.project(point).expect("in front");
    assert!((pixel.x, pixel.y, depth) == (7.5, 5.5, 4.0));
    for (from, to, what) in [
        ("3 2\n", "4 2\n", "4 cameras, but the list of images has 3"),
        ("2 0 5", "2 9 5", "at line 20: point 0 is seen by camera 9"),
        ("1 2 8 0 0", "1 2 8 0", "the file ends where a observation is due"),
        ("1 2 8 0 0", "1 2 8 0 0 1", "more words follow"),
        ("2 0 5", "2 99999999999 5", "is no camera index"),
    ] {
        fs::write(&file, BUNDLE.replacen(from, to, 1)).expect("written");
        let message = message(folder.path(), &ReadOptions::default());
        assert!(message.contains(what), "{message}");
    }
}

#[test]
fn a_format_that_is_asked_for_wins_over_the_guess() {
    let folder = folder_with(&["images/a/x y.png", "images/b.png", "images/d.png"], 16, 12);
    fs::write(folder.path().join("sfm_data.json"), SFM_DATA).expect("written");
    fs::create_dir_all(folder.path().join("cams")).expect("made");
    let with = |format| ReadOptions { format: Some(format), ..ReadOptions::default() };
    assert!(matches!(read_scene(folder.path(), &ReadOptions::default()), Err(ReadError::NoViews { .. })));
    assert_eq!(read_scene(folder.path(), &with(SceneFormat::OpenMvg)).expect("read").views.len(), 3);
    let message = message(folder.path(), &with(SceneFormat::Bundler));
    assert!(message.contains("found no Bundler scene") && message.contains("bundle.out"), "{message}");
}

/// The scene that OpenMVS made of the photographs of sceaux, with another program's poses: distances
/// between camera centres agree with those of the COLMAP model up to one factor, and its points are
/// seen where its cameras say.
#[test]
fn openmvs_agrees_with_colmap_about_sceaux() {
    let test = "openmvs_agrees_with_colmap_about_sceaux";
    let data = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data"));
    let (mvs, colmap) = (data.join("openmvs/sceaux_scene.mvs"), data.join("colmap/sceaux"));
    if !mvs.is_file() || !colmap.is_dir() {
        eprintln!("SKIPPED {test}: openmvs/sceaux_scene.mvs or colmap/sceaux is not there");
        return;
    }
    let names: Vec<String> = (0..11).map(|k| format!("images/{k:05}.jpg")).collect();
    let folder = folder_with(&names[..1].iter().map(String::as_str).collect::<Vec<_>>(), 2832, 2128);
    for name in &names[1..] {
        fs::copy(folder.path().join(&names[0]), folder.path().join(name)).expect("copied");
    }
    let file = folder.path().join("scene.mvs");
    fs::copy(&mvs, &file).expect("copied");
    let (dense, solved) = (read(folder.path()), read(&colmap));
    assert_eq!((dense.views.len(), dense.points.len(), dense.warnings.len()), (11, 12683, 0));
    let centres = |scene: &Scene| {
        let mut views: Vec<_> = scene.views.values().collect();
        views.sort_by_key(|view| view.name.clone());
        views.iter().map(|view| view.camera.pose.centre()).collect::<Vec<_>>()
    };
    let (a, b) = (centres(&dense), centres(&solved));
    let mut ratios = Vec::new();
    for i in 0..11 {
        for j in 0..i {
            ratios.push((a[i] - a[j]).norm() / (b[i] - b[j]).norm());
        }
    }
    ratios.sort_by(f64::total_cmp);
    let (least, most) = (ratios[0], ratios[ratios.len() - 1]);
    assert!(most / least < 1.05, "{least} to {most}");
    let mut seen = 0;
    let mut inside = 0;
    for (position, track) in dense.points.iter() {
        for id in track {
            seen += 1;
            let projected = dense.views[id].camera.project(position);
            inside += usize::from(projected.is_some_and(|(pixel, _)| {
                (0.0..2832.0).contains(&pixel.x) && (0.0..2128.0).contains(&pixel.y)
            }));
        }
    }
    assert_eq!(seen, 45518);
    assert!(inside as f64 > 0.99 * seen as f64, "{inside}");

    let bytes = fs::read(&mvs).expect("read");
    let refused = |bytes: &[u8]| {
        fs::write(&file, bytes).expect("written");
        message(folder.path(), &ReadOptions::default())
    };
    assert!(refused(b"MVSX").contains("does not start with MVSI"));
    assert!(
        refused(&[b"MVSI".as_slice(), &[8, 0, 0, 0], &bytes[8..]].concat()).contains("version 8 is newer")
    );
    for length in [0, 3, 7, 11, 40, 300, 2000, 100_000] {
        let message = refused(&bytes[..length]);
        assert!(message.contains("at byte"), "{message}");
    }
}
