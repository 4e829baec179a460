//! Triangle meshes from files: PLY, OBJ, and NPZ archives of arrays.

mod npz;
mod obj;
mod ply;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use nalgebra::Point3;
use thiserror::Error;

use crate::geometry::TriangleMesh;

/// Why a mesh could not be read.
#[derive(Debug, Error)]
pub enum MeshError {
    /// The file could not be read.
    #[error("cannot read the mesh {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The file breaks its format.
    #[error("cannot parse the mesh {}: {problem}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
    /// The name does not end as that of a mesh.
    #[error("cannot tell the format of the mesh {}: the name ends neither in .ply, .obj nor .npz", path.display())]
    UnknownFormat {
        /// The file.
        path: PathBuf,
    },
    /// No triangle is left.
    #[error("found no triangle with an area in the mesh {}", path.display())]
    Empty {
        /// The file.
        path: PathBuf,
    },
}

/// What files hold.
#[derive(Default)]
struct Triangles {
    positions: Vec<Point3<f64>>,
    corners: Vec<[u32; 3]>,
    /// As [`TriangleMesh::new`] takes them.
    uv: Vec<[[f32; 2]; 3]>,
}

/// Whether a file's name ends as that of a mesh.
pub fn is_mesh(path: &Path) -> bool {
    matches!(extension(path).as_str(), "ply" | "obj" | "npz")
}

/// Reads a mesh; polygons become fans of triangles, triangles without area are left out.
///
/// NPZ archives hold `vertices` (n, 3) and `faces` (m, 3), and perhaps `uv` (k, 2) with `face_uv` (m, 3).
pub fn read_mesh(path: &Path) -> Result<TriangleMesh, MeshError> {
    let parse = match extension(path).as_str() {
        "ply" => ply::parse,
        "obj" => obj::parse,
        "npz" => npz::parse,
        _ => return Err(MeshError::UnknownFormat { path: path.to_owned() }),
    };
    let bytes = fs::read(path).map_err(|source| MeshError::Read { path: path.to_owned(), source })?;
    let Triangles { positions, corners, uv } =
        parse(&bytes).map_err(|problem| MeshError::Malformed { path: path.to_owned(), problem })?;
    let mesh = TriangleMesh::new(positions, &corners, &uv);
    if mesh.is_empty() { Err(MeshError::Empty { path: path.to_owned() }) } else { Ok(mesh) }
}

fn extension(path: &Path) -> String {
    path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formats_are_told_by_name_and_missing_files_are_named() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let error = read_mesh(Path::new("mesh.stl")).expect_err("no such format");
        assert!(matches!(error, MeshError::UnknownFormat { .. }));
        let missing = folder.path().join("missing.ply");
        let error = read_mesh(&missing).expect_err("no such file").to_string();
        assert!(error.contains("missing.ply"), "{error}");
        let flat = folder.path().join("flat.obj");
        fs::write(&flat, "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n").expect("written");
        assert!(matches!(read_mesh(&flat), Err(MeshError::Empty { .. })));
    }
}
