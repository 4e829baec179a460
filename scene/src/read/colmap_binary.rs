//! COLMAP's binary models: cameras.bin, images.bin, points3D.bin, little endian.

use std::collections::HashSet;
use std::path::Path;

use super::ReadError;
use super::bytes::Bytes;
use super::colmap::{CameraModel, RawCamera, RawImage};
use super::points::PointsInto;

/// Bytes of one observation in images.bin: two coordinates and a point id.
const OBSERVATION: u64 = 24;

pub(super) fn cameras(path: &Path) -> Result<Vec<RawCamera>, ReadError> {
    let mut bytes = Bytes::open(path)?;
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

pub(super) fn images(path: &Path) -> Result<Vec<RawImage>, ReadError> {
    let mut bytes = Bytes::open(path)?;
    let count = bytes.count(4 + 7 * 8 + 4 + 1 + 8, "images")?;
    let mut images = Vec::with_capacity(count);
    for _ in 0..count {
        let id = bytes.u32()?;
        let quaternion = bytes.f64s()?;
        let translation = bytes.f64s()?;
        let camera = bytes.u32()?;
        let name = bytes.text_to_nul()?;
        let observations = bytes.count(OBSERVATION, "observations")?;
        bytes.skip(observations as u64 * OBSERVATION)?;
        images.push(RawImage { id, quaternion, translation, camera, name });
    }
    bytes.finish()?;
    Ok(images)
}

/// Reads each point with the ids of the images that see it. An id that is not in `images` is an error.
pub(super) fn points(path: &Path, images: &HashSet<u32>, points: &mut PointsInto) -> Result<(), ReadError> {
    let mut bytes = Bytes::open(path)?;
    let mut track = Vec::new();
    for _ in 0..bytes.count(8 + 24 + 3 + 8 + 8, "points")? {
        let id = bytes.u64()?;
        let position = bytes.f64s::<3>()?;
        bytes.skip(3 + 8)?; // colour and reprojection error
        track.clear();
        for _ in 0..bytes.count(8, "track elements")? {
            let at = bytes.at();
            let [a, b, c, d, ..] = bytes.array::<8>()?;
            let image = u32::from_le_bytes([a, b, c, d]);
            if !images.contains(&image) {
                let what = format!("point {id} is seen by image {image}, which does not exist");
                return Err(bytes.error_at(at, what));
            }
            track.push(image);
        }
        points.push(position, track.iter().copied());
    }
    bytes.finish()
}
