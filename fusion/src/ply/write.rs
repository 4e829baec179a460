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
    written_bytes: u64,
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
            written_bytes: 0,
        };
        writer.write_all(ply_header(vertices).as_bytes())?;
        Ok(writer)
    }

    /// Appends points.
    pub fn write(&mut self, points: &[Point]) -> Result<(), PlyError> {
        points.chunks(1 << 16).try_for_each(|chunk| self.write_encoded(&encode(chunk)))
    }

    /// Appends points that [`encode`] made bytes of.
    pub fn write_encoded(&mut self, vertices: &[u8]) -> Result<(), PlyError> {
        self.written_bytes += vertices.len() as u64;
        self.write_all(vertices)
    }

    /// Flushes the file to disk and gives it its name, replacing what was there; refused when not
    /// exactly the announced number of vertices was written.
    pub fn finish(self) -> Result<(), PlyError> {
        let Self { path, file, announced, written_bytes } = self;
        if announced.checked_mul(VERTEX_BYTES as u64) != Some(written_bytes) {
            let written = written_bytes / VERTEX_BYTES as u64;
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

/// The header of a file of `vertices` points in the layout of [`encode`].
pub fn ply_header(vertices: u64) -> String {
    let properties: String = ["x", "y", "z", "nx", "ny", "nz"]
        .map(|name| ("float", name))
        .into_iter()
        .chain(["red", "green", "blue"].map(|name| ("uchar", name)))
        .map(|(scalar, name)| ["property ", scalar, " ", name, "\n"].concat())
        .collect();
    format!("ply\nformat binary_little_endian 1.0\nelement vertex {vertices}\n{properties}end_header\n")
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::super::read_ply;
    use super::*;

    fn points(count: usize) -> Vec<Point> {
        (0..count)
            .map(|i| Point {
                position: [i as f64, -0.5, 1e6],
                normal: [0.0, 0.6, -0.8],
                color: [i as u8, 128, 255],
                ..Point::default()
            })
            .collect()
    }

    #[test]
    fn what_is_written_is_read_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cloud.ply");
        let points = points(70_000);
        let mut writer = PlyWriter::create(&path, 70_000).expect("created");
        writer.write(&points[..69_000]).expect("written");
        writer.write_encoded(&encode(&points[69_000..])).expect("written");
        assert!(!path.exists(), "nothing stands under the name before the end");
        writer.finish().expect("finished");
        assert_eq!(read_ply(&path).expect("read"), points);
        let bytes = fs::read(&path).expect("read");
        assert_eq!(bytes.len() as u64, ply_header(70_000).len() as u64 + 70_000 * 27);
        assert_eq!(fs::read_dir(folder.path()).expect("listed").count(), 1);
    }

    #[test]
    fn a_wrong_count_leaves_the_old_file() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cloud.ply");
        fs::write(&path, "old").expect("written");
        for count in [2, 4] {
            let mut writer = PlyWriter::create(&path, 3).expect("created");
            writer.write(&points(count)).expect("written");
            let error = writer.finish().expect_err("another count");
            assert!(
                matches!(error, PlyError::Count { announced: 3, written, .. } if written == count as u64)
            );
        }
        let mut writer = PlyWriter::create(&path, 3).expect("created");
        writer.write_encoded(&[0; 3 * VERTEX_BYTES + 1]).expect("written");
        writer.finish().expect_err("a part of a vertex too many");
        assert_eq!(fs::read_to_string(&path).expect("read"), "old");
        assert_eq!(fs::read_dir(folder.path()).expect("listed").count(), 1);
    }

    #[test]
    fn a_missing_folder_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let error = PlyWriter::create(&folder.path().join("no/cloud.ply"), 1).expect_err("no folder");
        assert!(error.to_string().ends_with("no/cloud.ply"), "{error}");
    }
}
