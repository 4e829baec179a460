//! COLMAP's sparse models, binary and text, and the files of a dense workspace.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

use nalgebra::{Point3, Quaternion, Rotation3, UnitQuaternion};

use super::{WriteError, create_folder, observed, write_file};
use crate::{Distortion, Intrinsics, Scene, View, ViewId};

/// A camera as cameras.bin holds it: number of its model, size, and the bits of its parameters.
type CameraRecord = (u32, u32, u32, Vec<u64>);

/// How a model is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Encoding {
    Binary,
    Text,
}

/// Writes `sparse/cameras.bin`, `images.bin` and `points3D.bin` below `root`; images are not copied.
///
/// Views with equal intrinsics share a camera: PINHOLE, or the model of the lens.
/// A point becomes an observation where the camera sees it. Skew, depth ranges and pairs have no
/// place in the format: skew is refused, the others are left out. Colours are not known: grey.
pub fn write_colmap(scene: &Scene, root: &Path) -> Result<(), WriteError> {
    write(scene, root, Encoding::Binary)
}

/// Like [`write_colmap`], as `cameras.txt`, `images.txt` and `points3D.txt`.
pub fn write_colmap_text(scene: &Scene, root: &Path) -> Result<(), WriteError> {
    write(scene, root, Encoding::Text)
}

/// Writes what makes a dense workspace of a model of undistorted images: `stereo/` with its folders,
/// `patch-match.cfg` with the source views of `pairs` or for COLMAP to choose, and `fusion.cfg`.
pub fn write_colmap_workspace(
    scene: &Scene,
    pairs: &BTreeMap<ViewId, Vec<crate::SourceScore>>,
    root: &Path,
) -> Result<(), WriteError> {
    let stereo = root.join("stereo");
    for folder in ["depth_maps", "normal_maps", "consistency_graphs"] {
        create_folder(&stereo.join(folder))?;
    }
    let (mut patch_match, mut fusion) = (String::new(), String::new());
    for view in scene.views.values() {
        let sources = pairs.get(&view.id).map_or(&[][..], Vec::as_slice);
        let names: Vec<&str> =
            sources.iter().filter_map(|s| Some(scene.views.get(&s.view)?.name.as_str())).collect();
        let sources = if names.is_empty() { "__auto__, 20".to_owned() } else { names.join(", ") };
        patch_match.push_str(&format!("{}\n{sources}\n", view.name));
        fusion.push_str(&format!("{}\n", view.name));
    }
    write_file(&stereo.join("patch-match.cfg"), patch_match.as_bytes())?;
    write_file(&stereo.join("fusion.cfg"), fusion.as_bytes())
}

fn write(scene: &Scene, root: &Path, encoding: Encoding) -> Result<(), WriteError> {
    let mut camera_ids: BTreeMap<CameraRecord, u32> = BTreeMap::new();
    let mut camera_of = BTreeMap::new();
    for view in scene.views.values() {
        let next = camera_ids.len() as u32 + 1;
        camera_of.insert(view.id, *camera_ids.entry(camera_record(view)?).or_insert(next));
    }
    let mut cameras: Vec<_> = camera_ids.into_iter().map(|(record, id)| (id, record)).collect();
    cameras.sort_unstable_by_key(|(id, _)| *id);
    let points = points(scene);
    let mut observations = Observations::new();
    for point in &points {
        for (view, _) in &point.track {
            let view = &scene.views[view];
            let [x, y] = observed(&view.camera, &view.distortion, point.position);
            // COLMAP puts the top-left pixel's centre at (0.5, 0.5).
            observations.entry(view.id).or_default().push(([x + 0.5, y + 0.5], point.id));
        }
    }
    let folder = root.join("sparse");
    create_folder(&folder)?;
    let (extension, files) = match encoding {
        Encoding::Binary => (
            "bin",
            [cameras_bin(&cameras), images_bin(scene, &camera_of, &observations), points_bin(&points)],
        ),
        Encoding::Text => {
            let texts =
                [cameras_txt(&cameras), images_txt(scene, &camera_of, &observations), points_txt(&points)];
            ("txt", texts.map(String::into_bytes))
        }
    };
    for (stem, bytes) in ["cameras", "images", "points3D"].iter().zip(files) {
        write_file(&folder.join(format!("{stem}.{extension}")), &bytes)?;
    }
    Ok(())
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

/// The name of a model that [`camera_record`] gives.
fn model_name(model: u32) -> &'static str {
    match model {
        1 => "PINHOLE",
        3 => "RADIAL",
        4 => "OPENCV",
        5 => "OPENCV_FISHEYE",
        6 => "FULL_OPENCV",
        7 => "FOV",
        _ => "THIN_PRISM_FISHEYE",
    }
}

/// An image's observations: position in the image and id of the point.
type Observations = BTreeMap<ViewId, Vec<([f64; 2], u64)>>;

/// A point with, for each view of its track, its place among the observations of that view.
struct PointRecord<'a> {
    id: u64,
    position: &'a Point3<f64>,
    track: Vec<(ViewId, u32)>,
}

fn points(scene: &Scene) -> Vec<PointRecord<'_>> {
    let mut counts: BTreeMap<ViewId, u32> = BTreeMap::new();
    let record = |((position, track), id): ((_, &[ViewId]), u64)| {
        let known = track.iter().filter(|id| scene.views.contains_key(id));
        let place = |id: &ViewId| {
            let count = counts.entry(*id).or_default();
            *count += 1;
            (*id, *count - 1)
        };
        PointRecord { id, position, track: known.map(place).collect() }
    };
    scene.points.iter().zip(1_u64..).map(record).collect()
}

/// w, x, y, z.
fn quaternion(view: &View) -> [f64; 4] {
    let rotation = Rotation3::from_matrix_unchecked(view.camera.pose.rotation);
    let Quaternion { coords } = *UnitQuaternion::from_rotation_matrix(&rotation).quaternion();
    [coords.w, coords.x, coords.y, coords.z]
}

fn cameras_bin(cameras: &[(u32, CameraRecord)]) -> Vec<u8> {
    let mut bytes = (cameras.len() as u64).to_le_bytes().to_vec();
    for (id, (model, width, height, params)) in cameras {
        bytes.extend(id.to_le_bytes());
        bytes.extend(model.to_le_bytes());
        bytes.extend((*width as u64).to_le_bytes());
        bytes.extend((*height as u64).to_le_bytes());
        bytes.extend(params.iter().flat_map(|bits| bits.to_le_bytes()));
    }
    bytes
}

fn images_bin(scene: &Scene, camera_of: &BTreeMap<ViewId, u32>, observations: &Observations) -> Vec<u8> {
    let mut bytes = (scene.views.len() as u64).to_le_bytes().to_vec();
    for view in scene.views.values() {
        bytes.extend(view.id.0.to_le_bytes());
        bytes.extend(quaternion(view).iter().flat_map(|v| v.to_le_bytes()));
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

fn points_bin(points: &[PointRecord]) -> Vec<u8> {
    let mut bytes = (points.len() as u64).to_le_bytes().to_vec();
    for point in points {
        bytes.extend(point.id.to_le_bytes());
        bytes.extend(point.position.iter().flat_map(|v| v.to_le_bytes()));
        bytes.extend([128; 3]);
        bytes.extend(0.0_f64.to_le_bytes());
        bytes.extend((point.track.len() as u64).to_le_bytes());
        for (view, place) in &point.track {
            bytes.extend(view.0.to_le_bytes());
            bytes.extend(place.to_le_bytes());
        }
    }
    bytes
}

/// Appends to a text; numbers have all their digits, so that reading gives the same bits.
macro_rules! push {
    ($text:expr, $($arguments:tt)*) => {
        write!($text, $($arguments)*).expect("a String takes any text")
    };
}

fn cameras_txt(cameras: &[(u32, CameraRecord)]) -> String {
    let mut text = "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n".to_owned();
    for (id, (model, width, height, params)) in cameras {
        push!(text, "{id} {} {width} {height}", model_name(*model));
        for bits in params {
            push!(text, " {}", f64::from_bits(*bits));
        }
        text.push('\n');
    }
    text
}

fn images_txt(scene: &Scene, camera_of: &BTreeMap<ViewId, u32>, observations: &Observations) -> String {
    let mut text = "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME\n# X Y POINT3D_ID ...\n".to_owned();
    for view in scene.views.values() {
        push!(text, "{}", view.id);
        for value in quaternion(view).iter().chain(view.camera.pose.translation.iter()) {
            push!(text, " {value}");
        }
        push!(text, " {} {}\n", camera_of[&view.id], view.name);
        let of_view = observations.get(&view.id).map_or(&[][..], Vec::as_slice);
        let words: Vec<String> = of_view.iter().map(|([x, y], point)| format!("{x} {y} {point}")).collect();
        push!(text, "{}\n", words.join(" "));
    }
    text
}

fn points_txt(points: &[PointRecord]) -> String {
    let mut text = "# POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_IDX) ...\n".to_owned();
    for PointRecord { id, position, track } in points {
        push!(text, "{id} {} {} {} 128 128 128 0", position.x, position.y, position.z);
        for (view, place) in track {
            push!(text, " {view} {place}");
        }
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::{Camera, Pose, ReadOptions, read_scene};

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
