//! The real scenes beside the checkout.

use std::path::{Path, PathBuf};

use nalgebra::Point3;

use crate::convert_middlebury::{Bounds, convert_middlebury};
use crate::convert_rgbd::convert_rgbd;
use crate::data::shared_data;

/// The scenes that are there, by name; those in formats that are not read are converted into `out` first.
pub fn shared_scenes(test: &str, out: &Path) -> Vec<(&'static str, PathBuf)> {
    let read_as_they_are = [
        ("hololens_b", "scenes/hololens_b"),
        ("hololens_c", "scenes/hololens_c"),
        ("dtu_scan37_10v", "scenes/dtu_scan37_10v"),
        ("bartoszek", "colmap/bartoszek/dense/0"),
        ("sceaux", "colmap/sceaux"),
        ("meeting_room_40", "scenes/meeting_room_40"),
    ];
    let mut scenes = Vec::new();
    if let Some(source) = shared_data(test, "scenes/open3d_rgbd") {
        let scene = out.join("scenes/open3d_rgbd");
        convert_rgbd(&source.join("RGBD"), &source.join("camera_primesense.json"), &scene);
        scenes.push(("open3d_rgbd", scene));
    }
    if let Some(source) = shared_data(test, "scenes/templeSparseRing") {
        let scene = out.join("scenes/templeSparseRing");
        convert_middlebury(&source, "templeSR_par.txt", TEMPLE, &scene);
        scenes.push(("templeSparseRing", scene));
    }
    let there =
        read_as_they_are.into_iter().filter_map(|(name, path)| Some((name, shared_data(test, path)?)));
    scenes.extend(there);
    scenes
}

/// From the README of the data set.
const TEMPLE: Bounds = Bounds {
    min: Point3::new(-0.073568, 0.021728, -0.012445),
    max: Point3::new(0.028855, 0.181892, 0.062736),
};
