//! Other software to compare with, installed on demand.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use nalgebra::Point3;

/// An interpreter with these Python packages; `None`, and a line on stderr, where they cannot be installed.
pub fn python(test: &str, packages: &[&str]) -> Option<PathBuf> {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../scripts/reference_venv.py");
    let made = Command::new("python3").arg(script).args(packages).output();
    let reason = match made {
        Ok(output) if output.status.success() => {
            return Some(String::from_utf8_lossy(&output.stdout).trim().into());
        }
        Ok(output) => String::from_utf8_lossy(&output.stderr).trim().to_owned(),
        Err(error) => format!("python3: {error}"),
    };
    eprintln!("SKIPPED {test}: {reason}");
    None
}

/// Writes points as the scripts read them: three little-endian 64-bit numbers each.
pub fn write_points(path: &Path, points: &[Point3<f64>]) {
    let numbers = points.iter().flat_map(|point| [point.x, point.y, point.z]);
    let bytes: Vec<u8> = numbers.flat_map(f64::to_le_bytes).collect();
    fs::write(path, bytes).expect("written");
}
