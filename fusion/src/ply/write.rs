//! A streaming writer of binary PLY files in the layout of COLMAP's `fused.ply`.

use std::fs::Permissions;
use std::io::{BufWriter, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;

use super::PlyError;
use crate::cloud::Point;

/// Bytes of a vertex: six floats (position, normal) and three unsigned characters (RGB).
pub const VERTEX_BYTES: usize = 27;

/// The points as the file holds them, little-endian and one after the other: [`VERTEX_BYTES`] each.
///
/// Positions are rounded to `f32`, as everywhere in this format.
pub fn encode(points: &[Point]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(points.len() * VERTEX_BYTES);
    for point in points {
        for value in point.position {
            bytes.extend_from_slice(&(value as f32).to_le_bytes());
        }
        for value in point.normal {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        bytes.extend_from_slice(&point.color);
    }
    bytes
}

/// Writes a cloud piece by piece; the file appears under its name when [`PlyWriter::finish`] returns,
/// whole, and never otherwise.
#[derive(Debug)]
pub struct PlyWriter {
    path: PathBuf,
    file: BufWriter<NamedTempFile>,
    announced: u64,
    written: u64,
}

impl PlyWriter {
    /// Begins a cloud of `vertices` points that will stand at `path`. Its folder must exist: the
    /// temporary file lies beside it until then.
    pub fn create(path: &Path, vertices: u64) -> Result<Self, PlyError> {
        let folder = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let file = tempfile::Builder::new()
            .prefix(".cloud-")
            .suffix(".ply.tmp")
            .permissions(Permissions::from_mode(0o666)) // less the umask, as for any other file
            .tempfile_in(folder)
            .map_err(|source| PlyError::Create { path: path.to_path_buf(), source })?;
        let mut writer = Self {
            path: path.to_path_buf(),
            file: BufWriter::with_capacity(1 << 20, file),
            announced: vertices,
            written: 0,
        };
        writer.write_all(header(vertices).as_bytes())?;
        Ok(writer)
    }

    /// Appends points.
    pub fn write(&mut self, points: &[Point]) -> Result<(), PlyError> {
        points.chunks(1 << 16).try_for_each(|chunk| self.write_encoded(&encode(chunk)))
    }

    /// Appends points that [`encode`] made bytes of; a part of a vertex at the end is not counted and
    /// makes [`Self::finish`] fail.
    pub fn write_encoded(&mut self, vertices: &[u8]) -> Result<(), PlyError> {
        self.written += (vertices.len() / VERTEX_BYTES) as u64;
        self.write_all(vertices)
    }

    /// Flushes the file to disk and gives it its name, replacing what was there; refused when not
    /// exactly the announced number of vertices was written.
    pub fn finish(self) -> Result<(), PlyError> {
        let Self { path, file, announced, written } = self;
        if written != announced {
            return Err(PlyError::Count { path, announced, written });
        }
        let placed = (|| {
            let file = file.into_inner().map_err(std::io::IntoInnerError::into_error)?;
            file.as_file().sync_all()?;
            file.persist(&path)?;
            Ok(())
        })();
        placed.map_err(|source| PlyError::Write { path, source })
    }

    fn write_all(&mut self, bytes: &[u8]) -> Result<(), PlyError> {
        let written = self.file.write_all(bytes);
        written.map_err(|source| PlyError::Write { path: self.path.clone(), source })
    }
}

fn header(vertices: u64) -> String {
    let properties: String = ["x", "y", "z", "nx", "ny", "nz"]
        .map(|name| ("float", name))
        .into_iter()
        .chain(["red", "green", "blue"].map(|name| ("uchar", name)))
        .map(|(scalar, name)| ["property ", scalar, " ", name, "\n"].concat())
        .collect();
    format!("ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{properties}end_header\n")
}
