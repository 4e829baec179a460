//! Small scenes in the folders of the benchmarks. The surface is the plane that the device `analytic` knows.

use std::fs;
use std::path::Path;

use nalgebra::{Point3, Similarity3, Vector3};
use planesweep_fusion::{PlyWriter, Point, VertexFormat};
use planesweep_scene::Scene;

use crate::scenes::plane;

/// Writes the scene `scenes/NAME` and its ground truth `truth/NAME`, laid out as Tanks and Temples is; the scan
/// stands elsewhere and is half as large.
pub fn tanks_and_temples(folder: &Path, name: &str) {
    let scene = plane(&folder.join("scenes").join(name), 12);
    let truth = folder.join("truth").join(name);
    fs::create_dir_all(&truth).expect("made");
    let file = |ending: &str| truth.join(format!("{name}{ending}"));
    let to_scan = Similarity3::new(Vector3::new(3.0, -2.0, 1.0), Vector3::new(0.0, 0.0, 0.3), 0.5);
    let scan: Vec<Point3<f64>> = plane_points(0.05).into_iter().map(|p| to_scan * p).collect();
    write_cloud(&file(".ply"), &scan);
    let corners =
        [[-0.8, -0.8], [1.8, -0.8], [1.8, 0.8], [-0.8, 0.8]].map(|[x, y]| to_scan * Point3::new(x, y, 5.0));
    let polygon: Vec<[f64; 3]> = corners.iter().map(|corner| (*corner).into()).collect();
    let crop = serde_json::json!({
        "class_name": "SelectionPolygonVolume", "version_major": 1, "version_minor": 0,
        "orthogonal_axis": "Z", "axis_min": 0.0, "axis_max": 9.0, "bounding_polygon": polygon,
    });
    fs::write(file(".json"), crop.to_string()).expect("written");
    let rows: Vec<String> = to_scan
        .to_homogeneous()
        .row_iter()
        .map(|row| format!("{} {} {} {}\n", row[0], row[1], row[2], row[3]))
        .collect();
    fs::write(file("_trans.txt"), rows.concat()).expect("written");
    fs::write(file("_COLMAP_SfM.log"), log(&scene)).expect("written");
}

/// Writes the scene `scenes/scanN` and its ground truth below `truth`, laid out as DTU is.
pub fn dtu(folder: &Path, scan: u32) {
    let _ = plane(&folder.join("scenes").join(format!("scan{scan}")), 6);
    let truth = folder.join("truth");
    for part in ["Points/stl", "ObsMask"] {
        fs::create_dir_all(truth.join(part)).expect("made");
    }
    write_cloud(&truth.join(format!("Points/stl/stl{scan:03}_total.ply")), &plane_points(0.2));
    // All that lies within 1.2 mm of the origin of the plane and 1 mm of the plane can be seen.
    let (side, height) = (24, 20);
    let mask = vec![1; side * side * height];
    let corners = [-1.2, 1.2, -1.2, 1.2, 4.0, 6.0].map(f64::to_le_bytes).concat();
    let variables = [
        variable("ObsMask", Class::Logical, &[side, side, height], &mask),
        variable("BB", Class::Double, &[2, 3], &corners),
        variable("Res", Class::Double, &[1, 1], &0.1_f64.to_le_bytes()),
    ];
    fs::write(truth.join(format!("ObsMask/ObsMask{scan}_10.mat")), matlab_file(&variables)).expect("written");
    let plane = variable("P", Class::Double, &[4, 1], &[0.0, 0.0, -1.0, 8.0].map(f64::to_le_bytes).concat());
    fs::write(truth.join(format!("ObsMask/Plane{scan}.mat")), matlab_file(&[plane])).expect("written");
}

/// Points of the plane z = 5, `spacing` apart, where the cameras look.
fn plane_points(spacing: f64) -> Vec<Point3<f64>> {
    let steps = (2.0 / spacing).round() as i32;
    let places = (-steps..=steps).flat_map(|y| (-steps..=steps).map(move |x| (x, y)));
    places.map(|(x, y)| Point3::new(f64::from(x) * spacing, f64::from(y) * spacing, 5.0)).collect()
}

fn write_cloud(path: &Path, points: &[Point3<f64>]) {
    let points: Vec<Point> = points
        .iter()
        .map(|p| Point {
            position: (*p).into(),
            normal: [0.0; 3],
            color: [128; 3],
            confidence: 0.0,
            views: 0,
            seen_by: 0,
        })
        .collect();
    let mut writer = PlyWriter::create(path, VertexFormat::default()).expect("created");
    writer.write(&points).expect("written");
    writer.finish().expect("finished");
}

/// The cameras in the format of Tanks and Temples.
fn log(scene: &Scene) -> String {
    let mut text = String::new();
    for (index, view) in scene.views.values().enumerate() {
        let (r, centre) = (view.camera.pose.rotation.transpose(), view.camera.pose.centre());
        text.push_str(&format!("{index} {index} 0\n"));
        for k in 0..3 {
            text.push_str(&format!("{} {} {} {}\n", r[(k, 0)], r[(k, 1)], r[(k, 2)], centre[k]));
        }
        text.push_str("0 0 0 1\n");
    }
    text
}

#[derive(Clone, Copy)]
enum Class {
    Logical,
    Double,
}

/// A MATLAB file of version 5, not compressed.
fn matlab_file(variables: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = format!("{:124}", "MATLAB 5.0 MAT-file").into_bytes();
    bytes.extend([0x00, 0x01, b'I', b'M']);
    bytes.extend(variables.concat());
    bytes
}

fn variable(name: &str, class: Class, size: &[usize], data: &[u8]) -> Vec<u8> {
    let (flags, data_type) = match class {
        Class::Logical => ([9, 2, 0, 0, 0, 0, 0, 0], 2),
        Class::Double => ([6, 0, 0, 0, 0, 0, 0, 0], 9),
    };
    let sides: Vec<u8> = size.iter().flat_map(|side| (*side as i32).to_le_bytes()).collect();
    let parts =
        [element(6, &flags), element(5, &sides), element(1, name.as_bytes()), element(data_type, data)];
    element(14, &parts.concat())
}

/// A tagged piece of a MATLAB file, padded to 8 bytes.
fn element(data_type: u32, data: &[u8]) -> Vec<u8> {
    let mut bytes = [data_type.to_le_bytes(), (data.len() as u32).to_le_bytes()].concat();
    bytes.extend(data);
    bytes.resize(bytes.len().next_multiple_of(8), 0);
    bytes
}
