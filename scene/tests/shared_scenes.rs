//! Scenes of other people's programs, where they lie beside the checkout.

use std::path::PathBuf;

use nalgebra::Point2;
use planesweep_scene::{
    DepthRange, Distortion, ReadOptions, Scene, View, ViewId, WorkingImage, image_size, read_image,
    read_scene, undistorted_intrinsics,
};

/// The folder of a shared scene, or a line that says that the test was skipped.
fn shared(test: &str, path: &str) -> Option<PathBuf> {
    let folder = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data")).join(path);
    if folder.is_dir() {
        return Some(folder);
    }
    eprintln!("SKIPPED {test}: {path} is not there");
    None
}

fn read(folder: &std::path::Path) -> Scene {
    read_scene(folder, &ReadOptions::default()).expect("a good scene")
}

/// Where the stored image shows a point.
fn project(view: &View, world: &nalgebra::Point3<f64>) -> Option<Point2<f64>> {
    let point = view.camera.pose.to_camera(world);
    if point.z <= 0.0 {
        return None;
    }
    let (x, y) = view.distortion.distort(point.x / point.z, point.y / point.z);
    let k = &view.camera.intrinsics;
    Some(Point2::new(k.fx * x + k.skew * y + k.cx, k.fy * y + k.cy))
}

/// Every point lies before and inside the image, or within two pixels of it, of every view of its track.
fn assert_points_are_seen(scene: &Scene) {
    let mut observations = 0;
    for (position, track) in scene.points.iter() {
        for id in track {
            let view = &scene.views[id];
            let pixel = project(view, position).expect("before the camera");
            let (width, height) = (view.camera.intrinsics.width as f64, view.camera.intrinsics.height as f64);
            let inside = (-2.5..width + 1.5).contains(&pixel.x) && (-2.5..height + 1.5).contains(&pixel.y);
            assert!(inside, "{pixel} of {}", view.name);
            observations += 1;
        }
    }
    assert!(observations > 2 * scene.points.len());
}

#[test]
fn sceaux_is_read_with_its_lens() {
    let Some(folder) = shared("sceaux_is_read_with_its_lens", "colmap/sceaux") else { return };
    let scene = read(&folder);
    assert_eq!(scene.views.len(), 11);
    assert!(scene.warnings.is_empty() && scene.skipped.is_empty(), "{:?}", scene.warnings);
    assert_points_are_seen(&scene);
    for view in scene.views.values() {
        let k = view.camera.intrinsics;
        assert_eq!((k.width, k.height), (2832, 2128));
        assert_eq!(image_size(&view.image).expect("a header"), (2832, 2128));
        assert!(matches!(view.distortion, Distortion::Radial { k1, k2: 0.0 } if k1 != 0.0));
    }
}

#[test]
fn a_photograph_becomes_a_working_image() {
    let Some(folder) = shared("a_photograph_becomes_a_working_image", "colmap/sceaux") else { return };
    let scene = read(&folder);
    let view = scene.views.values().next().expect("a view");
    let stored = read_image(&view.image).expect("a photograph");
    let working = WorkingImage::prepare(stored, &view.camera, &view.distortion, 1152, 866).expect("prepared");
    assert_eq!((working.pixels.width(), working.pixels.height()), (1152, 866));
    let pinhole = undistorted_intrinsics(&view.camera.intrinsics, &view.distortion);
    assert_eq!(working.camera.intrinsics, pinhole.resized(1152, 866));
    let colors = working.map_colors(288, 217);
    assert_eq!((colors.width(), colors.height()), (288, 217));
    // SCENE_PICTURE names a file to look at.
    if let Some(path) = std::env::var_os("SCENE_PICTURE") {
        let bytes = working.pixels.values().as_flattened().to_vec();
        image::RgbImage::from_raw(1152, 866, bytes).expect("its size").save(path).expect("written");
    }
}

#[test]
fn a_dense_workspace_is_read() {
    let Some(folder) = shared("a_dense_workspace_is_read", "colmap/bartoszek/dense/0") else { return };
    let scene = read(&folder);
    assert_eq!(scene.views.len(), 23);
    assert_points_are_seen(&scene);
    assert!(scene.views.values().all(|view| view.distortion == Distortion::None));
}

#[test]
fn a_model_without_images_says_so() {
    let Some(folder) = shared("a_model_without_images_says_so", "colmap/bartoszek") else { return };
    let error = read_scene(&folder, &ReadOptions::default()).expect_err("no images");
    assert!(error.to_string().contains("but no folder"), "{error}");
}

#[test]
fn a_workspace_of_odd_geometry_is_read() {
    let Some(folder) = shared("a_workspace_of_odd_geometry_is_read", "colmap/testColmap/dense") else {
        return;
    };
    assert_eq!(read(&folder).views.len(), 15);
}

#[test]
fn mvsnet_folders_are_read() {
    for (name, views, size, fx, range) in [
        ("hololens_b", 9, (540, 360), 495.567757, (1.0412999, 7.0223999, Some(192))),
        ("hololens_c", 9, (540, 360), 495.567757, (0.0, 0.0, Some(192))),
        ("dtu_scan37_10v", 10, (1600, 1200), 2892.328856, (425.0, 425.0 + 2.5 * 1.06 * 191.0, None)),
        ("meeting_room_40", 40, (0, 0), 905.6701326, (4.336407, 8.482101, None)),
    ] {
        let Some(folder) = shared("mvsnet_folders_are_read", &format!("scenes/{name}")) else { continue };
        let scene = read(&folder);
        // The meeting room's pair.txt was cut off after 26 reference views.
        let pairs = if name == "meeting_room_40" { 26 } else { views };
        assert_eq!((scene.views.len(), scene.pairs.len()), (views, pairs), "{name}");
        let view = &scene.views[&ViewId(0)];
        let k = view.camera.intrinsics;
        assert_eq!(image_size(&view.image).expect("a header"), (k.width, k.height));
        if size.0 > 0 {
            assert_eq!((k.width, k.height), size, "{name}");
        }
        let DepthRange { min, max, count } = view.depth_range.expect("a range");
        assert_eq!(count, range.2, "{name}");
        if range.0 > 0.0 {
            assert_eq!((k.fx, min), (fx, range.0), "{name}");
            assert!((max - range.1).abs() < 1e-5, "{name}: {max}");
        }
        // Every view there lists itself, too; the other folders have nothing odd.
        assert_eq!(scene.warnings.is_empty(), name != "meeting_room_40", "{:?}", scene.warnings);
        for (reference, sources) in &scene.pairs {
            assert!(!sources.is_empty() && sources.iter().all(|s| s.view != *reference));
        }
    }
}
