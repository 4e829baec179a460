//! nerfstudio's and instant-ngp's `transforms.json`: poses and lens, no points.
//!
//! Poses are camera-to-world with OpenGL's axes (y up, z backwards); the top-left pixel's centre is
//! at (0.5, 0.5).

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use serde_json::{Map, Value};

use super::json::{json_at, number};
use super::names::resolve_inside;
use super::views::{Candidate, Geometry, Units, admit};
use super::{ReadError, ReadOptions, ViewError, inconsistent, relative_name};
use crate::{Distortion, Intrinsics, Pose, Scene, ViewId, Warning, image_size};

#[derive(Deserialize)]
struct Transforms {
    frames: Vec<Frame>,
    /// The camera of frames that state none themselves.
    #[serde(flatten)]
    camera: Map<String, Value>,
}

#[derive(Deserialize)]
struct Frame {
    file_path: String,
    transform_matrix: [[f64; 4]; 4],
    #[serde(flatten)]
    camera: Map<String, Value>,
}

pub(super) fn read(file: &Path, options: &ReadOptions) -> Result<Scene, ReadError> {
    let transforms: Transforms = json_at(file)?;
    let images = match &options.images {
        Some(folder) => folder.clone(),
        None => file.parent().map_or_else(|| PathBuf::from("."), Path::to_owned),
    };
    let mut candidates = Vec::with_capacity(transforms.frames.len());
    for (frame, id) in transforms.frames.into_iter().zip(0..) {
        let name = image_name(&images, &frame.file_path);
        let mut camera = transforms.camera.clone();
        camera.extend(frame.camera);
        let geometry = geometry(&camera, &frame.transform_matrix, &images, &name)
            .map_err(|what| inconsistent(file, format!("frame {name:?} {what}")))?;
        candidates.push(Candidate { id: ViewId(id), name, geometry });
    }
    let mut scene = Scene::default();
    if transforms.camera.contains_key("ply_file_path") {
        let what = "its points say not which view sees them and are not read";
        let advice = "give --depth-range NEAR,FAR, or read the COLMAP model that the file was made from";
        scene.warnings.push(Warning::new(format!("{}: {what}", file.display()), advice));
    }
    admit(candidates, file, &images, options, &mut scene)?;
    Ok(scene)
}

/// The name without the leading `./`; synthetic scenes leave out the extension.
fn image_name(images: &Path, stated: &str) -> String {
    let name = relative_name(stated);
    let extended = format!("{name}.png");
    let exists = |name: &str| resolve_inside(images, name).is_ok();
    if !exists(&name) && exists(&extended) { extended } else { name }
}

/// The outer error says what the file lacks.
fn geometry(
    camera: &Map<String, Value>,
    matrix: &[[f64; 4]; 4],
    images: &Path,
    name: &str,
) -> Result<Result<Geometry, ViewError>, String> {
    let optional = |key| if camera.contains_key(key) { number(camera, key).map(Some) } else { Ok(None) };
    let stated = match (optional("w")?, optional("h")?) {
        (Some(w), Some(h)) if w >= 1.0 && h >= 1.0 && w.max(h) <= u32::MAX as f64 => {
            Some((w as u32, h as u32))
        }
        (None, None) => None,
        (w, h) => return Err(format!("has the size {w:?} by {h:?}")),
    };
    // A missing image is found out, and told, later; until then any size does.
    let (width, height) =
        stated.or_else(|| image_size(&resolve_inside(images, name).ok()?).ok()).unwrap_or((1, 1));
    let angle = |key, pixels: u32| {
        let angle = optional(key)?;
        Ok::<_, String>(angle.map(|angle| 0.5 * pixels as f64 / (0.5 * angle).tan()))
    };
    let fx = optional("fl_x")?.or(angle("camera_angle_x", width)?);
    let fx = fx.ok_or("has neither fl_x nor camera_angle_x")?;
    let fy = optional("fl_y")?.or(angle("camera_angle_y", height)?).unwrap_or(fx);
    let cx = optional("cx")?.unwrap_or(0.5 * width as f64) - 0.5;
    let cy = optional("cy")?.unwrap_or(0.5 * height as f64) - 0.5;
    let distortion = match distortion(camera)? {
        Ok(distortion) => distortion,
        Err(error) => return Ok(Err(error)),
    };
    let geometry = || {
        let intrinsics = Intrinsics { width, height, fx, fy, skew: 0.0, cx, cy }.checked()?;
        // OpenGL's y and z axes point the other way.
        let axes = [1.0, -1.0, -1.0];
        let to_world = Matrix3::from_fn(|row, column| matrix[row][column] * axes[column]);
        let centre = Vector3::new(matrix[0][3], matrix[1][3], matrix[2][3]);
        let rotation = to_world.transpose();
        let pose = Pose::new(rotation, -(rotation * centre))?;
        Ok(Geometry { pose, intrinsics, units: Units::Pixels, distortion, depth_range: None })
    };
    Ok(geometry())
}

fn distortion(camera: &Map<String, Value>) -> Result<Result<Distortion, ViewError>, String> {
    let coefficient = |key| if camera.contains_key(key) { number(camera, key) } else { Ok(0.0) };
    let [k1, k2, k3, k4] = [coefficient("k1")?, coefficient("k2")?, coefficient("k3")?, coefficient("k4")?];
    let (p1, p2) = (coefficient("p1")?, coefficient("p2")?);
    let fisheye = camera.get("is_fisheye").and_then(Value::as_bool).unwrap_or(false);
    let model = camera.get("camera_model").and_then(Value::as_str);
    let unsupported = |model: &str| Ok(Err(ViewError::UnsupportedModel { model: model.to_owned() }));
    Ok(Ok(match model.unwrap_or(if fisheye { "OPENCV_FISHEYE" } else { "OPENCV" }) {
        "PINHOLE" | "SIMPLE_PINHOLE" => Distortion::None,
        "OPENCV" | "SIMPLE_RADIAL" | "RADIAL" if k4 == 0.0 => match [k1, k2, k3, p1, p2] {
            [0.0, 0.0, 0.0, 0.0, 0.0] => Distortion::None,
            [_, _, 0.0, 0.0, 0.0] => Distortion::Radial { k1, k2 },
            [_, _, 0.0, _, _] => Distortion::OpenCv { k1, k2, p1, p2 },
            _ => Distortion::FullOpenCv { k1, k2, p1, p2, k3, k4: 0.0, k5: 0.0, k6: 0.0 },
        },
        "OPENCV" => return unsupported("OPENCV with k4"),
        "OPENCV_FISHEYE" | "FISHEYE" => Distortion::Fisheye { k1, k2, k3, k4 },
        model => return unsupported(model),
    }))
}
