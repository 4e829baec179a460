//! COLMAP's binary sparse model.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::{Point3, Rotation3, UnitQuaternion};

use super::{WriteError, create_folder, write_file};
use crate::{Camera, Distortion, Intrinsics, Scene, View, ViewId};

/// A camera as cameras.bin holds it: number of its model, size, and the bits of its parameters.
type CameraRecord = (u32, u32, u32, Vec<u64>);

/// Writes `sparse/cameras.bin`, `images.bin` and `points3D.bin` below `root`; images are not copied.
///
/// Views with equal intrinsics share a camera: PINHOLE, or the model of the lens.
/// A point becomes an observation where the camera sees it. Skew, depth ranges and pairs have no
/// place in the format: skew is refused, the others are left out. Colours are not known: grey.
pub fn write_colmap(scene: &Scene, root: &Path) -> Result<(), WriteError> {
    let mut camera_ids: BTreeMap<CameraRecord, u32> = BTreeMap::new();
    let mut camera_of = BTreeMap::new();
    for view in scene.views.values() {
        let next = camera_ids.len() as u32 + 1;
        camera_of.insert(view.id, *camera_ids.entry(camera_record(view)?).or_insert(next));
    }
    let (observations, points) = observations_and_points(scene);
    let folder = root.join("sparse");
    create_folder(&folder)?;
    write_file(&folder.join("cameras.bin"), &cameras(&camera_ids))?;
    write_file(&folder.join("images.bin"), &images(scene, &camera_of, &observations))?;
    write_file(&folder.join("points3D.bin"), &points)
}

fn camera_record(view: &View) -> Result<CameraRecord, WriteError> {
    let Intrinsics { width, height, fx, fy, skew, cx, cy } = view.camera.intrinsics;
    let refused = |what| Err(WriteError::NotHeld { view: view.name.clone(), format: "COLMAP", what });
    if skew != 0.0 {
        return refused("skew");
    }
    // COLMAP puts the top-left pixel's centre at (0.5, 0.5).
    let (cx, cy) = (cx + 0.5, cy + 0.5);
    let model = match view.distortion {
        Distortion::None => 1,
        Distortion::Radial { .. } if fx == fy => 3,
        Distortion::Radial { .. } | Distortion::OpenCv { .. } => 4,
        Distortion::Fisheye { .. } => 5,
        Distortion::FullOpenCv { .. } => 6,
        Distortion::Fov { .. } => 7,
        Distortion::ThinPrismFisheye { .. } => 10,
    };
    let mut params = if model == 3 { vec![fx, cx, cy] } else { vec![fx, fy, cx, cy] };
    params.extend(view.distortion.coefficients());
    if matches!(view.distortion, Distortion::Radial { .. }) && model == 4 {
        params.extend([0.0, 0.0]);
    }
    Ok((model, width, height, params.into_iter().map(f64::to_bits).collect()))
}

fn cameras(ids: &BTreeMap<CameraRecord, u32>) -> Vec<u8> {
    let mut records: Vec<_> = ids.iter().collect();
    records.sort_unstable_by_key(|(_, id)| **id);
    let mut bytes = (records.len() as u64).to_le_bytes().to_vec();
    for ((model, width, height, params), id) in records {
        bytes.extend(id.to_le_bytes());
        bytes.extend(model.to_le_bytes());
        bytes.extend((*width as u64).to_le_bytes());
        bytes.extend((*height as u64).to_le_bytes());
        bytes.extend(params.iter().flat_map(|bits| bits.to_le_bytes()));
    }
    bytes
}

/// An image's observations: position in the image and id of the point.
type Observations = BTreeMap<ViewId, Vec<([f64; 2], u64)>>;

fn observations_and_points(scene: &Scene) -> (Observations, Vec<u8>) {
    let mut observations = Observations::new();
    let mut bytes = (scene.points.len() as u64).to_le_bytes().to_vec();
    for ((position, track), id) in scene.points.iter().zip(1_u64..) {
        bytes.extend(id.to_le_bytes());
        bytes.extend(position.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend([128; 3]);
        bytes.extend(0.0_f64.to_le_bytes());
        let views: Vec<_> = track.iter().filter_map(|id| scene.views.get(id)).collect();
        bytes.extend((views.len() as u64).to_le_bytes());
        for view in views {
            let of_view = observations.entry(view.id).or_default();
            bytes.extend(view.id.0.to_le_bytes());
            bytes.extend((of_view.len() as u32).to_le_bytes());
            of_view.push((observed(&view.camera, &view.distortion, position), id));
        }
    }
    (observations, bytes)
}

/// Where the stored image shows a point, in COLMAP's pixels; the principal point when behind.
fn observed(camera: &Camera, distortion: &Distortion, position: &Point3<f64>) -> [f64; 2] {
    let point = camera.pose.to_camera(position);
    let (x, y) =
        if point.z > 0.0 { distortion.distort(point.x / point.z, point.y / point.z) } else { (0.0, 0.0) };
    let k = &camera.intrinsics;
    [k.fx * x + k.cx + 0.5, k.fy * y + k.cy + 0.5]
}

fn images(scene: &Scene, camera_of: &BTreeMap<ViewId, u32>, observations: &Observations) -> Vec<u8> {
    let mut bytes = (scene.views.len() as u64).to_le_bytes().to_vec();
    for view in scene.views.values() {
        let rotation = Rotation3::from_matrix_unchecked(view.camera.pose.rotation);
        let q = UnitQuaternion::from_rotation_matrix(&rotation);
        bytes.extend(view.id.0.to_le_bytes());
        bytes.extend([q.w, q.i, q.j, q.k].iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(view.camera.pose.translation.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend(camera_of[&view.id].to_le_bytes());
        bytes.extend(view.name.as_bytes());
        bytes.push(0);
        let of_view = observations.get(&view.id).map_or(&[][..], Vec::as_slice);
        bytes.extend((of_view.len() as u64).to_le_bytes());
        for ([x, y], point) in of_view {
            bytes.extend(x.to_le_bytes());
            bytes.extend(y.to_le_bytes());
            bytes.extend(point.to_le_bytes());
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::{Pose, ReadOptions, read_scene};

    /// Three views of two sizes and three lenses, ids with gaps, names with folders and spaces.
    fn scene(root: &Path) -> Scene {
        let mut scene = Scene::default();
        for (id, name, width, distortion) in [
            (3, "left/a 1.png", 16, Distortion::None),
            (7, "b.png", 16, Distortion::Radial { k1: 0.01, k2: -0.002 }),
            (40, "right/c.png", 12, Distortion::OpenCv { k1: 0.01, k2: 0.0, p1: 1e-3, p2: -1e-3 }),
        ] {
            let image = root.join("images").join(name);
            std::fs::create_dir_all(image.parent().expect("a folder")).expect("made");
            image::RgbImage::new(width, 10).save(&image).expect("written");
            let centre = Point3::new(id as f64 * 0.1, 0.3, -4.0);
            let pose = Pose::look_at(&centre, &Point3::origin(), &Vector3::y());
            let intrinsics =
                Intrinsics { width, height: 10, fx: 20.0, fy: 20.0, skew: 0.0, cx: 7.25, cy: 4.5 };
            let (id, name, camera) = (ViewId(id), name.to_owned(), Camera { intrinsics, pose });
            scene.views.insert(id, View { id, name, image, camera, distortion, depth_range: None });
        }
        scene.points.push(Point3::new(0.1, 0.2, 0.3), [ViewId(40), ViewId(3)]);
        scene.points.push(Point3::new(-0.1, 0.2, 0.0), [ViewId(7)]);
        scene.points.push(Point3::new(0.0, 0.0, 0.1), []);
        scene
    }

    #[test]
    fn reading_inverts_writing() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let written = scene(folder.path());
        write_colmap(&written, folder.path()).expect("written");
        let mut read = read_scene(folder.path(), &ReadOptions::default()).expect("read");
        for (id, view) in &mut read.views {
            // The rotation goes through a quaternion, so only nearly the same comes back.
            let rotation = written.views[id].camera.pose.rotation;
            assert!((view.camera.pose.rotation - rotation).amax() < 1e-12);
            view.camera.pose.rotation = rotation;
        }
        assert_eq!(read, written);
    }

    #[test]
    fn equal_intrinsics_share_a_camera() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut scene = scene(folder.path());
        for view in scene.views.values_mut() {
            view.distortion = Distortion::None;
        }
        write_colmap(&scene, folder.path()).expect("written");
        let bytes = std::fs::read(folder.path().join("sparse/cameras.bin")).expect("read");
        assert_eq!(bytes[0], 2);
        assert_eq!(bytes.len(), 8 + 2 * (24 + 4 * 8));
    }

    #[test]
    fn skew_is_refused() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut scene = scene(folder.path());
        scene.views.get_mut(&ViewId(7)).expect("a view").camera.intrinsics.skew = 0.1;
        let error = write_colmap(&scene, folder.path()).expect_err("skew");
        assert_eq!(error.to_string(), "could not write view \"b.png\": COLMAP has no place for skew");
        assert!(!folder.path().join("sparse").exists());
    }
}
