//! OpenMVG's `sfm_data.json`, version 0.3.

use std::collections::BTreeMap;
use std::path::Path;

use nalgebra::Matrix3;
use serde_json::{Value, json};

use super::{WriteError, create_folder, observed, write_file};
use crate::{Distortion, Intrinsics, Scene, View, ViewId};

/// A plain type, neither named nor numbered.
const PLAIN: u32 = 1 << 30;
/// Set in ids of pointers and types where they appear first.
const FIRST: u32 = 1 << 31;

/// Writes `sfm_data.json` below `root`, whose images lie in `root/images`; they are not copied.
///
/// The scene must be one that [`super::held`] made for this format: other cameras are refused.
pub fn write_openmvg(scene: &Scene, root: &Path) -> Result<(), WriteError> {
    let mut intrinsics: Vec<(Model, Value)> = Vec::new();
    let mut intrinsic_of = BTreeMap::new();
    for view in scene.views.values() {
        let intrinsic = intrinsic(view)?;
        let known = intrinsics.iter().position(|other| *other == intrinsic);
        let index = known.unwrap_or_else(|| {
            intrinsics.push(intrinsic);
            intrinsics.len() - 1
        });
        intrinsic_of.insert(view.id, index);
    }
    let mut pointers = (1_u32..).map(|id| id | FIRST);
    let mut pointer = |data: Value| json!({ "id": pointers.next(), "data": data });
    let views: Vec<Value> = scene
        .views
        .values()
        .map(|view| {
            let (folder, file) = view.name.rsplit_once('/').unwrap_or(("", &view.name));
            let id = view.id.0;
            let data = json!({
                "local_path": folder,
                "filename": file,
                "width": view.camera.intrinsics.width,
                "height": view.camera.intrinsics.height,
                "id_view": id,
                "id_intrinsic": intrinsic_of[&view.id],
                "id_pose": id,
            });
            json!({ "key": id, "value": { "polymorphic_id": PLAIN, "ptr_wrapper": pointer(data) } })
        })
        .collect();
    let mut type_ids: BTreeMap<&str, u32> = BTreeMap::new();
    let mut entries = Vec::new();
    for (key, (model, data)) in intrinsics.into_iter().enumerate() {
        let next = type_ids.len() as u32 + 1;
        let mut value = match type_ids.get(model) {
            Some(id) => json!({ "polymorphic_id": id }),
            None => json!({ "polymorphic_id": next | FIRST, "polymorphic_name": model }),
        };
        type_ids.entry(model).or_insert(next);
        value["ptr_wrapper"] = pointer(data);
        entries.push(json!({ "key": key, "value": value }));
    }
    let rows = |m: &Matrix3<f64>| [0, 1, 2].map(|row| [0, 1, 2].map(|column| m[(row, column)]));
    let extrinsic = |(id, view): (&ViewId, &View)| {
        let pose = &view.camera.pose;
        let centre: [f64; 3] = pose.centre().coords.into();
        json!({ "key": id.0, "value": { "rotation": rows(&pose.rotation), "center": centre } })
    };
    let extrinsics: Vec<Value> = scene.views.iter().map(extrinsic).collect();
    let root_path = "images";
    let data = json!({
        "sfm_data_version": "0.3",
        "root_path": root_path,
        "views": views,
        "intrinsics": entries,
        "extrinsics": extrinsics,
        "structure": structure(scene),
        "control_points": [],
    });
    create_folder(root)?;
    write_file(&root.join("sfm_data.json"), data.to_string().as_bytes())
}

fn structure(scene: &Scene) -> Vec<Value> {
    let mut features: BTreeMap<ViewId, u32> = BTreeMap::new();
    let mut landmark = |key: usize, position: &nalgebra::Point3<f64>, track: &[ViewId]| {
        let views = track.iter().filter_map(|id| scene.views.get(id));
        let observations: Vec<Value> = views
            .map(|view| {
                let feature = features.entry(view.id).or_default();
                *feature += 1;
                let x = observed(&view.camera, &view.distortion, position);
                json!({ "key": view.id.0, "value": { "id_feat": *feature - 1, "x": x } })
            })
            .collect();
        let x: [f64; 3] = position.coords.into();
        json!({ "key": key, "value": { "X": x, "observations": observations } })
    };
    scene.points.iter().enumerate().map(|(key, (position, track))| landmark(key, position, track)).collect()
}

/// OpenMVG's name of a camera model.
type Model = &'static str;

fn intrinsic(view: &View) -> Result<(Model, Value), WriteError> {
    let Intrinsics { width, height, fx, fy, skew, cx, cy } = view.camera.intrinsics;
    let refused = |what| Err(WriteError::NotHeld { view: view.name.clone(), format: "OpenMVG", what });
    if fx != fy || skew != 0.0 {
        return refused("two focal lengths or skew");
    }
    let mut data =
        json!({ "width": width, "height": height, "focal_length": fx, "principal_point": [cx, cy] });
    let model = match view.distortion {
        Distortion::None => "pinhole",
        Distortion::Radial { k1, k2 } => {
            data["disto_k3"] = json!([k1, k2, 0.0]);
            "pinhole_radial_k3"
        }
        Distortion::OpenCv { k1, k2, p1, p2 } => {
            data["disto_t2"] = json!([k1, k2, 0.0, p1, p2]);
            "pinhole_brown_t2"
        }
        Distortion::FullOpenCv { k1, k2, p1, p2, k3, k4: 0.0, k5: 0.0, k6: 0.0 } => {
            data["disto_t2"] = json!([k1, k2, k3, p1, p2]);
            "pinhole_brown_t2"
        }
        Distortion::Fisheye { k1, k2, k3, k4 } => {
            data["fisheye"] = json!([k1, k2, k3, k4]);
            "fisheye"
        }
        Distortion::FullOpenCv { .. } | Distortion::Fov { .. } | Distortion::ThinPrismFisheye { .. } => {
            return refused("this lens");
        }
    };
    Ok((model, data))
}
