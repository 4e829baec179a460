//! COLMAP fuses the depth maps that `fuse --workspace` writes, and makes a mesh of them.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use planesweep_tests::{Bench, plane_of_size, run};
use serde_json::Value;

const PACKAGES: [&str; 2] = ["pycolmap==4.2.1", "numpy==2.2.6"];

fn script(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../scripts").join(name)
}

#[test]
fn colmap_fuses_the_maps_of_a_workspace() {
    let venv = Command::new("python3")
        .arg(script("reference_venv.py"))
        .args(PACKAGES)
        .stderr(Stdio::inherit())
        .output();
    let python = match venv {
        Ok(output) if output.status.success() => String::from_utf8(output.stdout).expect("a path"),
        _ => {
            eprintln!(
                "SKIPPED colmap_fuses_the_maps_of_a_workspace: pycolmap is not in the cache and cannot be fetched"
            );
            return;
        }
    };
    // 87 rows: the map has 22, the photograph is cut to 84.
    let bench = Bench::new(|folder| drop(plane_of_size(folder, 6, 160, 87)));
    let exact = ["--device", "analytic", "--min-views", "3"];
    let _ = bench.reconstruct("out", &exact).expect_code(0);
    let (out, workspace) = (bench.path("out"), bench.path("workspace"));
    let cloud = format!("{workspace}/fused.ply");
    fs::create_dir_all(&workspace).expect("made");
    let _ = run(["fuse", &out, "-o", &cloud, "--vis", "--workspace", &workspace, "--min-confidence", "0"])
        .expect_code(0);
    let depth = fs::read(format!("{workspace}/stereo/depth_maps/00000000.png.geometric.bin")).expect("a map");
    assert!(depth.starts_with(b"40&21&1&") && depth.len() == 8 + 40 * 21 * 4, "{}", depth.len());

    let fused = Command::new(python.trim())
        .arg(script("pycolmap_fusion.py"))
        .arg(&workspace)
        .stderr(Stdio::inherit())
        .output()
        .expect("python starts");
    let text = String::from_utf8_lossy(&fused.stdout);
    let json = text.lines().last().unwrap_or_default();
    let value: Value = serde_json::from_str(json).unwrap_or_else(|error| panic!("{error}: {text}"));
    assert!(value["points"].as_u64() > Some(500), "{value}");
    let z: Vec<f64> = value["z"].as_array().expect("numbers").iter().filter_map(Value::as_f64).collect();
    assert!(z.iter().all(|z| (z - 5.0).abs() < 0.02), "{value}");
    assert!(value["mesh_bytes"].as_u64() > Some(1000), "{value}");
}
