//! Point clouds as LAS and LAZ files.

use std::fs::File;
use std::io::{self, BufWriter, Seek, Write};
use std::mem;
use std::path::{Path, PathBuf};

use las::point::Format;
use las::{Builder, Color, Transform, Vector};
use thiserror::Error;

use crate::cloud::Point;
use crate::output::Output;

/// Coordinates, less those of the first point, and colours: nothing of a flight.
const POINT_FORMAT: u8 = 2;

/// Why a LAS file could not be written.
#[derive(Debug, Error)]
pub enum LasError {
    /// A file cannot be made, or given its name.
    #[error("cannot write {}", path.display())]
    Output {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// A point is farther from the first than the format's integers reach.
    #[error("cannot write to {}: a point at {position:?} is too far from the first", path.display())]
    TooFar {
        /// The file.
        path: PathBuf,
        /// The point.
        position: [f64; 3],
    },
    /// The points cannot be written.
    #[error("cannot write points to {}", path.display())]
    Points {
        /// The file.
        path: PathBuf,
        /// What the format does not allow.
        #[source]
        source: las::Error,
    },
}

/// Writes a cloud piece by piece as LAS 1.2, compressed where the name ends in `.laz`; the file appears
/// under its name when it is finished.
///
/// Coordinates are integers times a power of ten from an offset, the first point's, so those of
/// georeferenced scenes keep all digits. The intensity is the confidence, the user data the number of
/// views. Normals have no place in the format.
pub struct LasWriter {
    output: Output,
    resolution: f64,
    writer: Points,
}

impl LasWriter {
    /// Begins the file that will stand at `path`, for coordinates of which `resolution` (scene units)
    /// matters.
    pub fn create(path: &Path, resolution: f64) -> Result<Self, LasError> {
        let output =
            Output::create(path).map_err(|source| LasError::Output { path: path.to_owned(), source })?;
        let resolution = if resolution > 0.0 && resolution.is_finite() { resolution } else { 1e-3 };
        Ok(Self { output, resolution, writer: Points(None) })
    }

    /// Appends points.
    pub fn write(&mut self, points: &[Point]) -> Result<(), LasError> {
        let Some(first) = points.first() else { return Ok(()) };
        let path = self.output.path().to_owned();
        let error = |source| LasError::Points { path: path.clone(), source };
        if self.writer.0.is_none() {
            let file =
                self.output.reopen().map_err(|source| LasError::Output { path: path.clone(), source })?;
            let header = self.header(first).and_then(Builder::into_header).map_err(error)?;
            let writer = las::Writer::new(BufWriter::with_capacity(1 << 20, file), header).map_err(error)?;
            self.writer.0 = Some(writer);
        }
        let Some(writer) = &mut self.writer.0 else { return Ok(()) };
        let transforms = *writer.header().transforms();
        for point in points {
            let [x, y, z] = point.position;
            let axes = [(x, transforms.x), (y, transforms.y), (z, transforms.z)];
            // Beyond them the file's header makes no sense.
            if axes.iter().any(|(value, axis)| axis.inverse(*value).is_err()) {
                return Err(LasError::TooFar { path, position: point.position });
            }
            let [red, green, blue] = point.color.map(|c| u16::from(c) * 257);
            let point = las::Point {
                x,
                y,
                z,
                intensity: (point.confidence * 65_535.0) as u16,
                user_data: point.views,
                color: Some(Color { red, green, blue }),
                ..las::Point::default()
            };
            writer.write_point(point).map_err(error)?;
        }
        Ok(())
    }

    fn header(&self, first: &Point) -> Result<Builder, las::Error> {
        let scale = 10_f64.powi(self.resolution.log10().floor() as i32);
        let mut builder = Builder::from((1, 2));
        builder.date = None; // the same points give the same bytes
        "planesweep".clone_into(&mut builder.generating_software);
        builder.point_format = Format::new(POINT_FORMAT)?;
        builder.point_format.is_compressed =
            self.output.path().extension().is_some_and(|e| e.eq_ignore_ascii_case("laz"));
        let [x, y, z] = first.position.map(|offset| Transform { scale, offset: offset.floor() });
        builder.transforms = Vector { x, y, z };
        Ok(builder)
    }

    /// Gives the file its name.
    pub fn finish(mut self) -> Result<(), LasError> {
        let path = self.output.path().to_owned();
        if let Some(writer) = self.writer.0.take() {
            end(writer).map_err(|source| LasError::Points { path: path.clone(), source })?;
        }
        self.output.finish(&[]).map_err(|source| LasError::Output { path, source })
    }
}

/// A writer of points, once there is a first one.
struct Points(Option<las::Writer<BufWriter<File>>>);

impl Drop for Points {
    fn drop(&mut self) {
        // Whoever drops it has an error of his own to tell.
        self.0.take().map(end).transpose().ok();
    }
}

/// Completes the file. A writer that cannot, on a full disk for one, is leaked, for it would panic if it were
/// dropped.
fn end<W: Write + Seek + Send + Sync + 'static>(mut writer: las::Writer<W>) -> Result<(), las::Error> {
    if let Err(error) = writer.close() {
        mem::forget(writer);
        return Err(error);
    }
    writer.into_inner()?.flush()?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn georeferenced_points_keep_their_digits() {
        let folder = tempfile::tempdir().expect("a folder");
        let point = |k: usize| Point {
            position: [4_412_345.678 + 0.001 * k as f64, 5_312_345.012, -412.5],
            color: [1, 2, k as u8],
            confidence: 1.0,
            views: 3,
            ..Point::default()
        };
        let points: Vec<Point> = (0..2000).map(point).collect();
        let mut sizes = Vec::new();
        for name in ["cloud.las", "cloud.laz"] {
            let path = folder.path().join(name);
            let mut writer = LasWriter::create(&path, 0.003).expect("created");
            writer.write(&[]).expect("nothing");
            writer.write(&points[..7]).expect("written");
            writer.write(&points[7..]).expect("written");
            assert!(!path.exists());
            writer.finish().expect("finished");
            let mut reader = las::Reader::from_path(&path).expect("a LAS file");
            let data = reader.read_all().expect("read");
            let read: Vec<las::Point> = data.points().collect::<Result<_, _>>().expect("points");
            assert_eq!(read.len(), points.len());
            for (read, point) in read.iter().zip(&points) {
                let found = [read.x, read.y, read.z];
                for (a, b) in found.iter().zip(point.position) {
                    assert!((a - b).abs() < 0.000_6, "{a} for {b}");
                }
                assert_eq!(read.color, Some(Color::new(257, 514, u16::from(point.color[2]) * 257)));
                assert_eq!((read.intensity, read.user_data), (65_535, 3));
            }
            sizes.push(std::fs::metadata(&path).expect("there").len());
        }
        assert!(sizes[1] * 3 < sizes[0], "{sizes:?}");
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 2);
    }

    #[test]
    fn points_too_far_apart_are_an_error_and_leave_nothing() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cloud.las");
        let mut writer = LasWriter::create(&path, 1e-6).expect("created");
        let far = Point { position: [1e9, 0.0, 0.0], ..Point::default() };
        let error = writer.write(&[Point::default(), far]).expect_err("beyond 32 bits");
        assert!(matches!(error, LasError::TooFar { .. }));
        drop(writer);
        assert_eq!(std::fs::read_dir(folder.path()).expect("listed").count(), 0);
    }

    #[test]
    fn a_full_disk_is_an_error_and_no_panic() {
        let Ok(full) = File::options().write(true).open("/dev/full") else {
            eprintln!("SKIPPED a_full_disk_is_an_error_and_no_panic: there is no /dev/full");
            return;
        };
        for compressed in [false, true] {
            let mut builder = Builder::from((1, 2));
            builder.point_format.is_compressed = compressed;
            let file = BufWriter::with_capacity(1 << 20, full.try_clone().expect("cloned"));
            let header = builder.into_header().expect("a header");
            let mut writer = las::Writer::new(file, header).expect("begun");
            // A compressed point goes to the file at once, an uncompressed one at the end.
            assert_eq!(writer.write_point(las::Point::default()).is_err(), compressed);
            let error = end(writer).expect_err("the disk is full");
            assert!(error.to_string().contains("No space left"), "{error}");
        }
    }
}
