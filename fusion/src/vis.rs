//! Which views see each point of a cloud, in COLMAP's `fused.ply.vis`: what meshers need besides points.
//!
//! ```text
//! points u64 | of each point: views u32, then the number of each view u32; all little-endian
//! ```

use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::cloud::Point;
use crate::output::Output;

/// Why a visibility file could not be written.
#[derive(Debug, Error)]
#[error("cannot write {}", path.display())]
pub struct VisibilityError {
    /// The file.
    path: PathBuf,
    /// What the system said.
    #[source]
    source: io::Error,
}

/// Writes a visibility file piece by piece; it appears under its name when it is finished.
#[derive(Debug)]
pub struct VisibilityWriter {
    output: Output,
    points: u64,
}

impl VisibilityWriter {
    /// Begins the file that will stand at `path`.
    pub fn create(path: &Path) -> Result<Self, VisibilityError> {
        let error = |source| VisibilityError { path: path.to_owned(), source };
        let mut output = Output::create(path).map_err(error)?;
        output.write(&0_u64.to_le_bytes()).map_err(error)?;
        Ok(Self { output, points: 0 })
    }

    /// Appends the points that the view numbered `view` emits, whose neighbours have the given numbers.
    pub fn write(&mut self, view: u32, neighbours: &[u32], points: &[Point]) -> Result<(), VisibilityError> {
        let mut bytes = Vec::with_capacity(points.len() * 16);
        for point in points {
            let seen = (0..).zip(neighbours).filter(|(k, _)| *k < 64 && point.seen_by >> *k & 1 == 1);
            let start = bytes.len();
            bytes.extend_from_slice(&[0; 4]);
            bytes.extend_from_slice(&view.to_le_bytes());
            let mut count = 1_u32;
            for (_, neighbour) in seen {
                bytes.extend_from_slice(&neighbour.to_le_bytes());
                count += 1;
            }
            bytes[start..start + 4].copy_from_slice(&count.to_le_bytes());
        }
        self.points += points.len() as u64;
        let written = self.output.write(&bytes);
        written.map_err(|source| VisibilityError { path: self.output.path().to_owned(), source })
    }

    /// Gives the file its name.
    pub fn finish(self) -> Result<(), VisibilityError> {
        let path = self.output.path().to_owned();
        let count = self.points.to_le_bytes();
        self.output.finish(&count).map_err(|source| VisibilityError { path, source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bytes_are_those_of_colmap() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cloud.ply.vis");
        let mut writer = VisibilityWriter::create(&path).expect("created");
        let point = |seen_by| Point { seen_by, ..Point::default() };
        writer.write(7, &[3, 9, 4], &[point(0b101), point(0)]).expect("written");
        writer.write(1, &[], &[]).expect("written");
        writer.finish().expect("finished");
        let words: Vec<u32> = std::fs::read(&path)
            .expect("read")
            .as_chunks::<4>()
            .0
            .iter()
            .map(|bytes| u32::from_le_bytes(*bytes))
            .collect();
        assert_eq!(words, [2, 0, 3, 7, 3, 4, 1, 7]);
    }
}
