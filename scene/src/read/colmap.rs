//! COLMAP sparse models with their photographs, and dense workspaces, which hold the same.

use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use super::points::PointsInto;
use super::views::{Candidate, Geometry, Units, admit};
use super::{ReadError, ReadOptions, ViewError, colmap_binary, colmap_text, inconsistent};
use crate::{CameraError, Distortion, Intrinsics, Pose, Scene, ViewId, Warning};

/// COLMAP's camera models; a model's number in binary files is its place here. All are known, so
/// that files parse; [`lens`] says which can be used.
const MODELS: [CameraModel; 18] = [
    CameraModel { name: "SIMPLE_PINHOLE", params: 3 },
    CameraModel { name: "PINHOLE", params: 4 },
    CameraModel { name: "SIMPLE_RADIAL", params: 4 },
    CameraModel { name: "RADIAL", params: 5 },
    CameraModel { name: "OPENCV", params: 8 },
    CameraModel { name: "OPENCV_FISHEYE", params: 8 },
    CameraModel { name: "FULL_OPENCV", params: 12 },
    CameraModel { name: "FOV", params: 5 },
    CameraModel { name: "SIMPLE_RADIAL_FISHEYE", params: 4 },
    CameraModel { name: "RADIAL_FISHEYE", params: 5 },
    CameraModel { name: "THIN_PRISM_FISHEYE", params: 12 },
    CameraModel { name: "RAD_TAN_THIN_PRISM_FISHEYE", params: 16 },
    CameraModel { name: "SIMPLE_DIVISION", params: 4 },
    CameraModel { name: "DIVISION", params: 5 },
    CameraModel { name: "SIMPLE_FISHEYE", params: 3 },
    CameraModel { name: "FISHEYE", params: 4 },
    CameraModel { name: "EUCM", params: 6 },
    CameraModel { name: "EQUIRECTANGULAR", params: 2 },
];

/// The name of a camera model and how many parameters it has.
#[derive(Clone, Copy)]
pub(super) struct CameraModel {
    pub name: &'static str,
    pub params: usize,
}

impl CameraModel {
    pub fn by_number(number: u32) -> Option<Self> {
        MODELS.get(number as usize).copied()
    }

    pub fn by_name(name: &str) -> Option<Self> {
        MODELS.into_iter().find(|model| model.name == name)
    }
}

/// A camera as the files have it.
pub(super) struct RawCamera {
    pub id: u32,
    pub model: CameraModel,
    pub width: u32,
    pub height: u32,
    pub params: Vec<f64>,
}

/// A registered image as the files have it.
pub(super) struct RawImage {
    pub id: u32,
    /// w, x, y, z.
    pub quaternion: [f64; 4],
    pub translation: [f64; 3],
    pub camera: u32,
    pub name: String,
}

/// The folder of the model, where there is one: `sparse`, as in dense workspaces, or `sparse/0`.
pub(super) fn find_model(root: &Path) -> Option<PathBuf> {
    ["sparse", "sparse/0"]
        .map(|folder| root.join(folder))
        .into_iter()
        .find(|folder| is_binary(folder) || folder.join("images.txt").is_file())
}

fn is_binary(model: &Path) -> bool {
    model.join("images.bin").is_file()
}

pub(super) fn read(root: &Path, model: &Path, options: &ReadOptions) -> Result<Scene, ReadError> {
    let image_folder = options.images.clone().unwrap_or_else(|| root.join("images"));
    if !image_folder.is_dir() {
        return Err(ReadError::NoImages { model: model.to_owned(), images: image_folder });
    }
    let mut scene = Scene::default();
    if root.join("sparse/1").is_dir() && model.ends_with("0") {
        scene.warnings.push(Warning::new(
            "sparse/ holds several models; only sparse/0 is read".to_owned(),
            "compare the models' numbers of images; for another one make a folder with images/ and that model in sparse/",
        ));
    }
    let binary = is_binary(model);
    let file = |stem: &str| model.join(format!("{stem}.{}", if binary { "bin" } else { "txt" }));

    let path = file("cameras");
    let cameras = if binary { colmap_binary::cameras(&path) } else { colmap_text::cameras(&path) };
    let cameras =
        by_id(cameras?, |camera| camera.id, |id| inconsistent(&path, format!("camera {id} twice")))?;

    let path = file("images");
    let images = if binary { colmap_binary::images(&path) } else { colmap_text::images(&path) };
    let images = by_id(images?, |image| image.id, |id| inconsistent(&path, format!("image {id} twice")))?;
    let ids: HashSet<u32> = images.keys().copied().collect();
    let candidates: Vec<_> = images
        .into_values()
        .map(|image| match cameras.get(&image.camera) {
            Some(camera) => Ok(candidate(image, camera)),
            None => Err(inconsistent(
                &path,
                format!("image {:?} with camera {}, which does not exist", image.name, image.camera),
            )),
        })
        .collect::<Result<_, _>>()?;
    admit(candidates, &path, &image_folder, options, &mut scene)?;

    let path = file("points3D");
    if !path.is_file() {
        scene.warnings.push(Warning::new(
            format!("{} is missing: there are no sparse points", path.display()),
            "copy it from where the model was made: source views and depth ranges come from it",
        ));
        return Ok(scene);
    }
    let mut points = PointsInto::new(&mut scene);
    if binary {
        colmap_binary::points(&path, &ids, &mut points)?;
    } else {
        colmap_text::points(&path, &ids, &mut points)?;
    }
    points.finish();
    Ok(scene)
}

fn by_id<T>(
    records: Vec<T>,
    id: impl Fn(&T) -> u32,
    repeated: impl Fn(u32) -> ReadError,
) -> Result<BTreeMap<u32, T>, ReadError> {
    let mut map = BTreeMap::new();
    for record in records {
        let id = id(&record);
        if map.insert(id, record).is_some() {
            return Err(repeated(id));
        }
    }
    Ok(map)
}

fn candidate(image: RawImage, camera: &RawCamera) -> Candidate {
    let geometry = geometry(&image, camera);
    Candidate { id: ViewId(image.id), name: image.name, geometry }
}

fn geometry(image: &RawImage, camera: &RawCamera) -> Result<Geometry, ViewError> {
    let pose = pose(image)?;
    let (fx, fy, cx, cy, distortion) = lens(camera)?;
    if !camera.params.iter().all(|v| v.is_finite()) {
        return Err(CameraError::NotFinite { field: "camera parameter" }.into());
    }
    // COLMAP puts the top-left pixel's centre at (0.5, 0.5).
    let (width, height) = (camera.width, camera.height);
    let intrinsics = Intrinsics { width, height, fx, fy, skew: 0.0, cx: cx - 0.5, cy: cy - 0.5 }.checked()?;
    Ok(Geometry { pose, intrinsics, units: Units::Pixels, distortion, depth_range: None })
}

/// Focal lengths, principal point and distortion, for the models that are supported.
fn lens(camera: &RawCamera) -> Result<(f64, f64, f64, f64, Distortion), ViewError> {
    let fisheye = |k1, k2, k3, k4| Distortion::Fisheye { k1, k2, k3, k4 };
    match (camera.model.name, camera.params.as_slice()) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => Ok((f, f, cx, cy, Distortion::None)),
        ("PINHOLE", &[fx, fy, cx, cy]) => Ok((fx, fy, cx, cy, Distortion::None)),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => Ok((f, f, cx, cy, Distortion::Radial { k1, k2: 0.0 })),
        ("RADIAL", &[f, cx, cy, k1, k2]) => Ok((f, f, cx, cy, Distortion::Radial { k1, k2 })),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
            Ok((fx, fy, cx, cy, Distortion::OpenCv { k1, k2, p1, p2 }))
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            Ok((fx, fy, cx, cy, Distortion::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 }))
        }
        ("FOV", &[fx, fy, cx, cy, omega]) => Ok((fx, fy, cx, cy, Distortion::Fov { omega })),
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => {
            Ok((fx, fy, cx, cy, fisheye(k1, k2, k3, k4)))
        }
        ("SIMPLE_FISHEYE", &[f, cx, cy]) => Ok((f, f, cx, cy, fisheye(0.0, 0.0, 0.0, 0.0))),
        ("FISHEYE", &[fx, fy, cx, cy]) => Ok((fx, fy, cx, cy, fisheye(0.0, 0.0, 0.0, 0.0))),
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k1]) => Ok((f, f, cx, cy, fisheye(k1, 0.0, 0.0, 0.0))),
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => Ok((f, f, cx, cy, fisheye(k1, k2, 0.0, 0.0))),
        ("THIN_PRISM_FISHEYE", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, sx1, sy1]) => {
            let lens = Distortion::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1, sy1 };
            Ok((fx, fy, cx, cy, lens))
        }
        (model, _) => Err(ViewError::UnsupportedModel { model: model.to_owned() }),
    }
}

fn pose(image: &RawImage) -> Result<Pose, CameraError> {
    let [w, x, y, z] = image.quaternion;
    // Not normalised, so that what is no rotation is refused and not bent into one.
    let rotation = Matrix3::new(
        w * w + x * x - y * y - z * z,
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        w * w - x * x + y * y - z * z,
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        w * w - x * x - y * y + z * z,
    );
    let pose = Pose::new(rotation, Vector3::from(image.translation))?;
    let unit = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    Ok(Pose { rotation: unit.to_rotation_matrix().into_inner(), ..pose })
}
