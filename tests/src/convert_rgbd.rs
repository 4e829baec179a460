//! RGB-D sequences as Open3D and TSDF-fusion keep them, as MVSNet folders with true depth.
//!
//! `color/NAME.jpg`, `depth/NAME.png` (16 bits, millimetres, registered to colour), and a trajectory of
//! camera-to-world matrices, one per image in the order of their names.

use std::fs;
use std::path::Path;

use nalgebra::{Matrix3, Vector3};
use planesweep_scene::{
    Camera, DepthRange, Distortion, Intrinsics, Pose, Raster, Scene, View, ViewId, image_size, write_mvsnet,
    write_pfm,
};

/// The fewest that a plan takes: between neighbouring frames a point moves by a few pixels only, and
/// planes much finer than a pixel tell the network nothing.
const PLANES: u32 = 64;

/// Converts the sequence in `source` with the intrinsics of the JSON file `camera`, and writes true
/// depth in metres to depth_gt/. Depth ranges are those of the sensor, widened by a tenth.
pub fn convert_rgbd(source: &Path, camera: &Path, target: &Path) {
    let (images, truths) = (target.join("images"), target.join("depth_gt"));
    for folder in [&images, &truths] {
        fs::create_dir_all(folder).expect("made");
    }
    let json = fs::read_to_string(camera).expect("the intrinsics");
    let json: serde_json::Value = serde_json::from_str(&json).expect("JSON");
    // Column-major, as Open3D writes matrices.
    let k = |index: usize| json["intrinsic_matrix"][index].as_f64().expect("a number");
    let mut scene = Scene::default();
    for (index, pose) in poses(&source.join("trajectory.log")).into_iter().enumerate() {
        let stem = format!("{index:05}");
        let name = format!("{index:08}.jpg");
        let image = images.join(&name);
        fs::copy(source.join("color").join(format!("{stem}.jpg")), &image).expect("copied");
        let (width, height) = image_size(&image).expect("an image");
        let intrinsics = Intrinsics { width, height, fx: k(0), fy: k(4), skew: 0.0, cx: k(6), cy: k(7) };
        let depth = depth_in_metres(&source.join("depth").join(format!("{stem}.png")));
        write_pfm(&truths.join(format!("{index:08}.pfm")), &depth).expect("written");
        let known = depth.values().iter().filter(|depth| **depth > 0.0);
        let (near, far) = known.fold((f32::MAX, 0.0_f32), |(a, b), z| (a.min(*z), b.max(*z)));
        let view = View {
            id: ViewId(index as u32),
            name,
            image,
            camera: Camera { intrinsics, pose },
            distortion: Distortion::None,
            depth_range: Some(DepthRange {
                min: 0.9 * near as f64,
                max: 1.1 * far as f64,
                count: Some(PLANES),
            }),
        };
        scene.views.insert(view.id, view);
    }
    write_mvsnet(&scene, target).expect("written");
}

/// World-to-camera poses of a trajectory: three integers and a camera-to-world matrix each.
fn poses(path: &Path) -> Vec<Pose> {
    let text = fs::read_to_string(path).expect("the trajectory");
    let numbers: Vec<f64> =
        text.split_ascii_whitespace().map(|word| word.parse().expect("a number")).collect();
    assert_eq!(numbers.len() % 19, 0, "three integers and sixteen numbers per pose");
    let pose = |entry: &[f64]| {
        let matrix = &entry[3..];
        let rotation = Matrix3::from_fn(|row, column| matrix[4 * row + column]).transpose();
        let centre = Vector3::new(matrix[3], matrix[7], matrix[11]);
        Pose::new(rotation, -(rotation * centre)).expect("a pose")
    };
    numbers.chunks_exact(19).map(pose).collect()
}

fn depth_in_metres(path: &Path) -> Raster<f32> {
    let image = image::open(path).expect("a depth image").into_luma16();
    let (width, height) = (image.width() as usize, image.height() as usize);
    let depths = image.into_raw().into_iter().map(|millimetres| millimetres as f32 / 1000.0).collect();
    Raster::new(width, height, depths).expect("the image's own size")
}
