//! OpenMVG's `sfm_data.json`, as its serialisation library writes it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use serde_json::{Map, Value};

use super::json::{json_at, number, numbers};
use super::points::PointsInto;
use super::views::{Candidate, Geometry, Units, admit};
use super::{ReadError, ReadOptions, ViewError, inconsistent, relative_name};
use crate::{Distortion, Intrinsics, Pose, Scene, ViewId, Warning};

/// The id that stands for "none".
const UNDEFINED: u32 = u32::MAX;
/// Set in a polymorphic id where the name of the type is given, once per type.
const NAMED_HERE: u32 = 1 << 31;

#[derive(Deserialize)]
struct SfmData {
    #[serde(default)]
    root_path: String,
    views: Vec<Entry<Polymorphic<View>>>,
    intrinsics: Vec<Entry<Polymorphic<Map<String, Value>>>>,
    extrinsics: Vec<Entry<Extrinsic>>,
    #[serde(default)]
    structure: Vec<Entry<Landmark>>,
}

#[derive(Deserialize)]
struct Entry<T> {
    key: u32,
    value: T,
}

#[derive(Deserialize)]
struct Polymorphic<T> {
    #[serde(default, rename = "polymorphic_id")]
    type_id: u32,
    #[serde(rename = "polymorphic_name")]
    type_name: Option<String>,
    ptr_wrapper: Pointer<T>,
}

#[derive(Deserialize)]
struct Pointer<T> {
    data: T,
}

#[derive(Deserialize)]
struct View {
    #[serde(default)]
    local_path: String,
    filename: String,
    id_intrinsic: u32,
    id_pose: u32,
}

#[derive(Deserialize)]
struct Extrinsic {
    /// Row by row, world to camera.
    rotation: [[f64; 3]; 3],
    center: [f64; 3],
}

#[derive(Deserialize)]
struct Landmark {
    #[serde(rename = "X")]
    position: [f64; 3],
    #[serde(default)]
    observations: Vec<Observation>,
}

/// The rest of an observation, where and by which feature, is not needed.
#[derive(Deserialize)]
struct Observation {
    key: u32,
}

pub(super) fn read(file: &Path, options: &ReadOptions) -> Result<Scene, ReadError> {
    let data: SfmData = json_at(file)?;
    let images = image_folder(file, &data.root_path, options)?;
    let mut scene = Scene::default();
    let lenses = lenses(file, data.intrinsics)?;
    let poses = unique(file, "pose", data.extrinsics)?;
    let views = unique(file, "view", data.views)?;
    let known: Vec<u32> = views.keys().copied().collect();
    let mut unposed = 0;
    let mut candidates = Vec::new();
    for (id, view) in views {
        let View { local_path, filename, id_intrinsic, id_pose } = view.ptr_wrapper.data;
        let Some(pose) = poses.get(&id_pose).filter(|_| id_pose != UNDEFINED && id_intrinsic != UNDEFINED)
        else {
            unposed += 1;
            continue;
        };
        let name = match relative_name(&local_path) {
            folder if folder.is_empty() => relative_name(&filename),
            folder => format!("{folder}/{}", relative_name(&filename)),
        };
        let Some(lens) = lenses.get(&id_intrinsic) else {
            let what = format!("view {id} with the intrinsic {id_intrinsic}, which does not exist");
            return Err(inconsistent(file, what));
        };
        let geometry = geometry(pose, lens.clone());
        candidates.push(Candidate { id: ViewId(id), name, geometry });
    }
    if unposed > 0 {
        scene.warnings.push(Warning::new(
            format!("{unposed} views of {} have no pose or no camera", file.display()),
            "localise them with openMVG_main_SfM_Localization, or add photographs between them and the others",
        ));
    }
    admit(candidates, file, &images, options, &mut scene)?;

    let mut points = PointsInto::new(&mut scene);
    for Entry { key: point, value: landmark } in data.structure {
        if let Some(stranger) = landmark.observations.iter().find(|o| known.binary_search(&o.key).is_err()) {
            let what = format!("point {point} seen by view {}, which does not exist", stranger.key);
            return Err(inconsistent(file, what));
        }
        points.push(landmark.position, landmark.observations.iter().map(|o| o.key));
    }
    points.finish();
    Ok(scene)
}

/// Where the images lie: where the user says, where the file says, or beside the file, for the file
/// often names a folder of another machine.
fn image_folder(file: &Path, stated: &str, options: &ReadOptions) -> Result<PathBuf, ReadError> {
    if let Some(folder) = &options.images {
        return Ok(folder.clone());
    }
    let beside = file.parent().unwrap_or(Path::new("."));
    let stated = beside.join(stated);
    let candidates = [stated.clone(), beside.join("images"), beside.to_owned()];
    candidates
        .into_iter()
        .find(|folder| folder.is_dir())
        .ok_or_else(|| ReadError::NoImages { model: file.to_owned(), images: stated })
}

fn unique<T>(file: &Path, what: &str, entries: Vec<Entry<T>>) -> Result<BTreeMap<u32, T>, ReadError> {
    let mut map = BTreeMap::new();
    for Entry { key, value } in entries {
        if map.insert(key, value).is_some() {
            return Err(inconsistent(file, format!("{what} {key} twice")));
        }
    }
    Ok(map)
}

/// Intrinsics and lens of a camera, or why it cannot be used.
type Lens = Result<(Intrinsics, Distortion), ViewError>;

fn lenses(
    file: &Path,
    entries: Vec<Entry<Polymorphic<Map<String, Value>>>>,
) -> Result<BTreeMap<u32, Lens>, ReadError> {
    let mut names: BTreeMap<u32, String> = BTreeMap::new();
    for entry in &entries {
        if let (id, Some(name)) = (entry.value.type_id, &entry.value.type_name) {
            names.insert(id & !NAMED_HERE, name.clone());
        }
    }
    let mut lenses = BTreeMap::new();
    for (id, intrinsic) in unique(file, "intrinsic", entries)? {
        let Some(model) = names.get(&(intrinsic.type_id & !NAMED_HERE)) else {
            return Err(inconsistent(file, format!("intrinsic {id} whose type is named nowhere")));
        };
        let lens = lens(model, &flattened(intrinsic.ptr_wrapper.data))
            .map_err(|what| inconsistent(file, format!("intrinsic {id} {what}")))?;
        lenses.insert(id, lens);
    }
    Ok(lenses)
}

/// The fields of an object and of those nested in it as its base classes, `value0`.
fn flattened(mut object: Map<String, Value>) -> Map<String, Value> {
    while let Some(Value::Object(base)) = object.remove("value0") {
        for (key, value) in base {
            object.entry(key).or_insert(value);
        }
    }
    object
}

/// The lens of a camera model that is known; the outer error says what the fields lack.
fn lens(model: &str, fields: &Map<String, Value>) -> Result<Lens, String> {
    let distortion = match model {
        "pinhole" => Distortion::None,
        "pinhole_radial_k1" => {
            let [k1] = numbers(fields, "disto_k1")?;
            Distortion::Radial { k1, k2: 0.0 }
        }
        "pinhole_radial_k3" => match numbers(fields, "disto_k3")? {
            [k1, k2, 0.0] => Distortion::Radial { k1, k2 },
            [k1, k2, k3] => brown(k1, k2, k3, 0.0, 0.0),
        },
        "pinhole_brown_t2" => {
            let [k1, k2, k3, t1, t2] = numbers(fields, "disto_t2")?;
            brown(k1, k2, k3, t1, t2)
        }
        "fisheye" => {
            let [k1, k2, k3, k4] = numbers(fields, "fisheye")?;
            Distortion::Fisheye { k1, k2, k3, k4 }
        }
        model => return Ok(Err(ViewError::UnsupportedModel { model: model.to_owned() })),
    };
    let side = |key| {
        let value = number(fields, key)?;
        let whole = value.fract() == 0.0 && (0.0..=u32::MAX as f64).contains(&value);
        whole.then_some(value as u32).ok_or_else(|| format!("whose {key} is {value}"))
    };
    let focal = number(fields, "focal_length")?;
    let [cx, cy] = numbers(fields, "principal_point")?;
    let (width, height) = (side("width")?, side("height")?);
    let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, skew: 0.0, cx, cy };
    Ok(intrinsics.checked().map(|intrinsics| (intrinsics, distortion)).map_err(ViewError::from))
}

fn brown(k1: f64, k2: f64, k3: f64, p1: f64, p2: f64) -> Distortion {
    if k3 == 0.0 {
        return Distortion::OpenCv { k1, k2, p1, p2 };
    }
    Distortion::FullOpenCv { k1, k2, p1, p2, k3, k4: 0.0, k5: 0.0, k6: 0.0 }
}

fn geometry(pose: &Extrinsic, lens: Lens) -> Result<Geometry, ViewError> {
    let (intrinsics, distortion) = lens?;
    let rotation = Matrix3::from_fn(|row, column| pose.rotation[row][column]);
    let pose = Pose::new(rotation, -(rotation * Vector3::from(pose.center)))?;
    Ok(Geometry { pose, intrinsics, units: Units::Pixels, distortion, depth_range: None })
}
