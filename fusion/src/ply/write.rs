//! A streaming writer of binary PLY files in the layout of COLMAP's `fused.ply`.

use std::path::Path;

use planesweep_scene::Camera;
use rayon::prelude::*;

use super::PlyError;
use crate::cloud::Point;
use crate::output::Output;

/// What a file holds of each point; the default is what COLMAP writes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct VertexFormat {
    /// Positions as doubles: floats keep seven digits only, which georeferenced coordinates use up.
    pub double: bool,
    /// Confidence (float, 0 to 1) and number of views (uchar) of each point, after its colour.
    pub quality: bool,
}

impl VertexFormat {
    /// Whether positions in floats would lose more than a quarter of a pixel of `camera` at
    /// `nearest_depth` (scene units); when that is not known, whether coordinates reach a hundred
    /// thousand.
    pub fn needs_doubles(camera: &Camera, nearest_depth: Option<f64>) -> bool {
        let reach = camera.pose.centre().coords.amax();
        match nearest_depth {
            // A float is off by up to 2^-25 of the value.
            Some(depth) => reach * 0.5_f64.powi(25) > 0.25 * depth / camera.intrinsics.fx,
            None => reach > 1e5,
        }
    }

    /// Bytes of a vertex.
    pub fn vertex_bytes(self) -> usize {
        let position = if self.double { 8 } else { 4 };
        3 * position + 3 * 4 + 3 + if self.quality { 5 } else { 0 }
    }
}

/// The points as the file holds them, little-endian and one after the other.
pub fn encode(points: &[Point], format: VertexFormat) -> Vec<u8> {
    let mut bytes = vec![0; points.len() * format.vertex_bytes()];
    let vertices = bytes.par_chunks_exact_mut(format.vertex_bytes());
    vertices
        .zip(points)
        .with_min_len(1 << 12)
        .for_each(|(vertex, point)| encode_point(point, format, vertex));
    bytes
}

/// One point, into as many bytes as it takes.
fn encode_point(point: &Point, format: VertexFormat, vertex: &mut [u8]) {
    let mut at = 0;
    let mut append = |bytes: &[u8]| {
        vertex[at..at + bytes.len()].copy_from_slice(bytes);
        at += bytes.len();
    };
    for value in point.position {
        if format.double {
            append(&value.to_le_bytes());
        } else {
            append(&(value as f32).to_le_bytes());
        }
    }
    for value in point.normal {
        append(&value.to_le_bytes());
    }
    append(&point.color);
    if format.quality {
        append(&point.confidence.to_le_bytes());
        append(&[point.views]);
    }
}

/// Writes a cloud piece by piece; the file appears under its name when [`PlyWriter::finish`] returns,
/// whole, and never otherwise.
#[derive(Debug)]
pub struct PlyWriter {
    output: Output,
    format: VertexFormat,
    vertices: u64,
}

impl PlyWriter {
    /// Begins a cloud that will stand at `path`. Its folder must exist: the temporary file lies beside
    /// it until then.
    pub fn create(path: &Path, format: VertexFormat) -> Result<Self, PlyError> {
        let output =
            Output::create(path).map_err(|source| PlyError::Create { path: path.to_path_buf(), source })?;
        let mut writer = Self { output, format, vertices: 0 };
        writer.write_all(ply_header(0, format).as_bytes())?;
        Ok(writer)
    }

    /// Appends points.
    pub fn write(&mut self, points: &[Point]) -> Result<(), PlyError> {
        self.vertices += points.len() as u64;
        points.chunks(1 << 16).try_for_each(|chunk| self.write_all(&encode(chunk, self.format)))
    }

    /// Flushes the file to disk and gives it its name, replacing what was there; returns how many
    /// points it has.
    pub fn finish(self) -> Result<u64, PlyError> {
        let path = self.output.path().to_path_buf();
        let head = ply_header(self.vertices, self.format);
        self.output.finish(head.as_bytes()).map_err(|source| PlyError::Write { path, source })?;
        Ok(self.vertices)
    }

    fn write_all(&mut self, bytes: &[u8]) -> Result<(), PlyError> {
        let written = self.output.write(bytes);
        written.map_err(|source| PlyError::Write { path: self.output.path().to_path_buf(), source })
    }
}

/// The header of a file of `vertices` points in the layout of [`encode`]. Its length does not depend on
/// their number.
pub fn ply_header(vertices: u64, format: VertexFormat) -> String {
    let position = if format.double { "double" } else { "float" };
    let mut properties: Vec<(&str, &str)> = ["x", "y", "z"].map(|name| (position, name)).into();
    properties.extend(["nx", "ny", "nz"].map(|name| ("float", name)));
    properties.extend(["red", "green", "blue"].map(|name| ("uchar", name)));
    if format.quality {
        properties.extend([("float", "confidence"), ("uchar", "views")]);
    }
    let lines: Vec<String> =
        properties.iter().map(|(scalar, name)| ["property ", scalar, " ", name, "\n"].concat()).collect();
    let properties = lines.concat();
    let count = vertices.to_string();
    // The count is written when it is known, so room is kept for the longest.
    let room = ".".repeat(20 - count.len());
    format!(
        "ply\nformat binary_little_endian 1.0\ncomment planesweep{room}\nelement vertex {count}\n{properties}end_header\n"
    )
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
        let mut writer = PlyWriter::create(&path, VertexFormat::default()).expect("created");
        writer.write(&points[..69_000]).expect("written");
        writer.write(&points[69_000..]).expect("written");
        assert!(!path.exists(), "nothing stands under the name before the end");
        assert_eq!(writer.finish().expect("finished"), 70_000);
        assert_eq!(read_ply(&path).expect("read"), points);
        let bytes = fs::read(&path).expect("read");
        assert_eq!(bytes.len(), ply_header(0, VertexFormat::default()).len() + 70_000 * 27);
        assert_eq!(fs::read_dir(folder.path()).expect("listed").count(), 1);
    }

    #[test]
    fn doubles_keep_what_floats_lose() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cloud.ply");
        let position = [4_412_345.678_9, 5_312_345.012_3, 412.5];
        let point = Point { position, confidence: 0.75, views: 7, ..Point::default() };
        for (double, quality, bytes) in [(false, false, 27), (true, false, 39), (true, true, 44)] {
            let format = VertexFormat { double, quality };
            assert_eq!((format.vertex_bytes(), encode(&[point], format).len()), (bytes, bytes));
            let mut writer = PlyWriter::create(&path, format).expect("created");
            writer.write(&[point]).expect("written");
            writer.finish().expect("finished");
            let read = read_ply(&path).expect("read")[0].position;
            assert_eq!(read == position, double, "{read:?}");
        }
        let encoded = encode(&[point], VertexFormat { double: true, quality: true });
        assert_eq!(encoded[39..], [&0.75_f32.to_le_bytes()[..], &[7]].concat());
    }

    #[test]
    fn doubles_are_needed_far_from_the_origin() {
        let mut camera = crate::analytic::camera_at(0.0, 0.0, 1000, 800);
        assert!(!VertexFormat::needs_doubles(&camera, Some(1.0)));
        assert!(!VertexFormat::needs_doubles(&camera, None));
        camera.pose.translation.x = 4e5;
        assert!(
            VertexFormat::needs_doubles(&camera, Some(1.0)) && VertexFormat::needs_doubles(&camera, None)
        );
        assert!(!VertexFormat::needs_doubles(&camera, Some(500.0)), "what is far need not be so exact");
    }

    #[test]
    fn a_file_that_is_not_finished_leaves_the_old_one() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cloud.ply");
        fs::write(&path, "old").expect("written");
        let mut writer = PlyWriter::create(&path, VertexFormat::default()).expect("created");
        writer.write(&points(3)).expect("written");
        drop(writer);
        assert_eq!(fs::read_to_string(&path).expect("read"), "old");
        assert_eq!(fs::read_dir(folder.path()).expect("listed").count(), 1);
    }

    #[test]
    fn headers_are_of_one_length() {
        for format in [VertexFormat::default(), VertexFormat { double: true, quality: true }] {
            let length = ply_header(0, format).len();
            for vertices in [9, 10, 123_456_789, u64::MAX] {
                assert_eq!(ply_header(vertices, format).len(), length);
            }
        }
    }

    #[test]
    fn a_missing_folder_is_named() {
        let folder = tempfile::tempdir().expect("a folder");
        let error = PlyWriter::create(&folder.path().join("no/cloud.ply"), VertexFormat::default())
            .expect_err("no folder");
        assert!(error.to_string().ends_with("no/cloud.ply"), "{error}");
    }
}
