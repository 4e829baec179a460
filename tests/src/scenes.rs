//! Small scenes and weights, made where a test runs.

use std::fs;
use std::path::{Path, PathBuf};

use image::RgbImage;
use nalgebra::{Point3, Vector3};
use planesweep_mvsnet::{Refinement, Weights, WeightsMetadata};
use planesweep_scene::{Camera, DepthRange, Distortion, Intrinsics, Pose, Scene, View, ViewId, write_mvsnet};
use planesweep_synth::{DemoOptions, Style, write_demo};

/// Writes a COLMAP model with images of `width` by `height` and sparse points, and true depth in depth_gt/.
pub fn courtyard(folder: &Path, views: usize, width: u32, height: u32) {
    let style = Style { views, width, height, ..Style::default() };
    let options = DemoOptions { style, supersampling: 1, points_per_view: 300, ..DemoOptions::default() };
    write_demo(folder, &options).expect("a scene");
}

/// Writes an MVSNet folder whose cameras see the plane z = 5 of the world, the one that the device
/// `analytic` knows; the images show something else. Returns the scene.
pub fn plane(folder: &Path, views: u32) -> Scene {
    plane_of_size(folder, views, 160, 128)
}

/// The same with images of `width` by `height`.
pub fn plane_of_size(folder: &Path, views: u32, width: u32, height: u32) -> Scene {
    let images = folder.join("images");
    fs::create_dir_all(&images).expect("made");
    let (cx, cy) = (f64::from(width - 1) / 2.0, f64::from(height - 1) / 2.0);
    let intrinsics = Intrinsics { width, height, fx: 190.0, fy: 190.0, skew: 0.0, cx, cy };
    let mut scene = Scene::default();
    for k in 0..views {
        let name = format!("{k:08}.png");
        let image = images.join(&name);
        let pixel = |x: u32, y: u32| image::Rgb([(x ^ y) as u8, (x * y + k) as u8, (3 * x + 7 * y) as u8]);
        RgbImage::from_fn(width, height, pixel).save(&image).expect("written");
        // Not on one line, so that the trajectory fixes a similarity.
        let (x, y) = (0.25 * k as f64, 0.1 + 0.15 * (k % 3) as f64);
        let (centre, target) = (Point3::new(x, y, 0.0), Point3::new(0.5, 0.0, 5.0));
        let pose = Pose::look_at(&centre, &target, &-Vector3::y());
        let view = View {
            id: ViewId(k),
            name,
            image,
            camera: Camera { intrinsics, pose },
            distortion: Distortion::None,
            depth_range: Some(DepthRange { min: 4.0, max: 6.0, count: Some(16) }),
        };
        scene.views.insert(view.id, view);
    }
    write_mvsnet(&scene, folder).expect("written");
    scene
}

/// Writes untrained weights and returns their path.
pub fn seeded_weights(folder: &Path) -> PathBuf {
    seeded_weights_with(folder, Refinement::None)
}

/// The same for a network with this refinement.
pub fn seeded_weights_with(folder: &Path, refinement: Refinement) -> PathBuf {
    let path = folder.join("seeded.safetensors");
    let weights = Weights::seeded(WeightsMetadata::untrained(refinement), 7);
    fs::write(&path, weights.to_bytes()).expect("written");
    path
}
