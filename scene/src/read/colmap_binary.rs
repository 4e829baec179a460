//! COLMAP's binary models: cameras.bin, images.bin, points3D.bin, little endian.

use std::collections::HashSet;
use std::path::Path;

use nalgebra::Point3;

use super::ReadError;
use super::colmap::{CameraModel, RawCamera, RawImage};

/// Bytes of one observation in images.bin: two coordinates and a point id.
const OBSERVATION: usize = 24;

/// The bytes of a file not read yet; every error knows where it happened.
struct Bytes<'a> {
    path: &'a Path,
    all: &'a [u8],
    at: usize,
}

impl<'a> Bytes<'a> {
    fn new(path: &'a Path, all: &'a [u8]) -> Self {
        Self { path, all, at: 0 }
    }

    fn error(&self, what: impl Into<String>) -> ReadError {
        ReadError::Binary { path: self.path.to_owned(), offset: self.at, what: what.into() }
    }

    fn slice(&mut self, length: usize) -> Result<&'a [u8], ReadError> {
        let rest = &self.all[self.at..];
        let slice = rest.get(..length).ok_or_else(|| {
            self.error(format!("the file is truncated: {length} bytes needed, {} left", rest.len()))
        })?;
        self.at += length;
        Ok(slice)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], ReadError> {
        let mut array = [0; N];
        array.copy_from_slice(self.slice(N)?);
        Ok(array)
    }

    fn u32(&mut self) -> Result<u32, ReadError> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, ReadError> {
        self.array().map(u64::from_le_bytes)
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = f64::from_le_bytes(self.array()?);
        }
        Ok(values)
    }

    /// A number of records, each of `least` bytes or more, that the rest of the file can hold.
    fn count(&mut self, least: usize, of: &str) -> Result<usize, ReadError> {
        let start = self.at;
        let count = self.u64()?;
        let room = (self.all.len() - self.at) / least;
        if count > room as u64 {
            self.at = start;
            return Err(self.error(format!("{count} {of} are announced, the rest of the file holds {room}")));
        }
        Ok(count as usize)
    }

    fn name(&mut self) -> Result<String, ReadError> {
        let rest = &self.all[self.at..];
        let end = rest.iter().position(|b| *b == 0).ok_or_else(|| self.error("an image name has no end"))?;
        let name = std::str::from_utf8(&rest[..end]).map_err(|_| self.error("an image name is not UTF-8"))?;
        self.at += end + 1;
        Ok(name.to_owned())
    }

    fn finish(self) -> Result<(), ReadError> {
        match self.all.len() - self.at {
            0 => Ok(()),
            left => Err(self.error(format!("{left} bytes follow the last record"))),
        }
    }
}

pub(super) fn cameras(path: &Path, bytes: &[u8]) -> Result<Vec<RawCamera>, ReadError> {
    let mut bytes = Bytes::new(path, bytes);
    let count = bytes.count(24, "cameras")?;
    let mut cameras = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u32()?;
        let number = bytes.u32()?;
        let model = CameraModel::by_number(number)
            .ok_or_else(|| bytes.error(format!("camera {id} has the unknown model {number}")))?;
        let (width, height) = (bytes.u64()?, bytes.u64()?);
        let size = u32::try_from(width).ok().zip(u32::try_from(height).ok());
        let (width, height) =
            size.ok_or_else(|| bytes.error(format!("camera {id} is {width}x{height} pixels")))?;
        let params =
            (0..model.params).map(|_| bytes.array().map(f64::from_le_bytes)).collect::<Result<_, _>>()?;
        cameras.push(RawCamera { id, model, width, height, params });
    }
    bytes.finish()?;
    Ok(cameras)
}

pub(super) fn images(path: &Path, bytes: &[u8]) -> Result<Vec<RawImage>, ReadError> {
    let mut bytes = Bytes::new(path, bytes);
    let count = bytes.count(4 + 7 * 8 + 4 + 1 + 8, "images")?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u32()?;
        let quaternion = bytes.f64s()?;
        let translation = bytes.f64s()?;
        let camera = bytes.u32()?;
        let name = bytes.name()?;
        let observations = bytes.count(OBSERVATION, "observations")?;
        bytes.slice(observations * OBSERVATION)?;
        images.push(RawImage { id, quaternion, translation, camera, name });
    }
    bytes.finish()?;
    Ok(images)
}

/// Hands each point with the ids of the images that see it to `push`. An id that is not in `images`
/// is an error.
pub(super) fn points(
    path: &Path,
    bytes: &[u8],
    images: &HashSet<u32>,
    mut push: impl FnMut(Point3<f64>, &mut dyn Iterator<Item = u32>),
) -> Result<(), ReadError> {
    let mut bytes = Bytes::new(path, bytes);
    let count = bytes.count(8 + 24 + 3 + 8 + 8, "points")?;
    for _ in 0..count {
        let id = bytes.u64()?;
        let position = bytes.f64s::<3>()?;
        bytes.slice(3 + 8)?; // colour and reprojection error
        let length = bytes.count(8, "track elements")?;
        let start = bytes.at;
        let (track, _) = bytes.slice(8 * length)?.as_chunks::<8>();
        let mut seen_by = track.iter().map(|[a, b, c, d, ..]| u32::from_le_bytes([*a, *b, *c, *d]));
        if let Some((k, image)) = seen_by.clone().enumerate().find(|(_, image)| !images.contains(image)) {
            bytes.at = start + 8 * k;
            return Err(bytes.error(format!("point {id} is seen by image {image}, which does not exist")));
        }
        push(position.into(), &mut seen_by);
    }
    bytes.finish()
}
