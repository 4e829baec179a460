//! OpenMVS's `scene.mvs`: undistorted photographs, cameras, and points with the views that see them.

use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use super::bytes::Bytes;
use super::points::PointsInto;
use super::views::{Candidate, Geometry, Units, admit};
use super::{ReadError, ReadOptions, ViewError, relative_name};
use crate::{Distortion, Intrinsics, Pose, Scene, ViewId, Warning};

/// The newest version of the file whose layout is known.
const NEWEST: u32 = 7;
/// Bytes of what version 7 keeps of the overlap with another image.
const VIEW_SCORE: u64 = 24;
/// The index that stands for "none".
const NONE: u32 = u32::MAX;

/// A platform's cameras and the poses it stood in.
struct Platform {
    cameras: Vec<Camera>,
    poses: Vec<([f64; 9], [f64; 3])>,
}

struct Camera {
    width: u32,
    height: u32,
    matrix: [f64; 9],
    /// Of the platform to the camera.
    rotation: [f64; 9],
    /// In the platform.
    centre: [f64; 3],
}

pub(super) fn read(file: &Path, options: &ReadOptions) -> Result<Scene, ReadError> {
    let mut bytes = Bytes::open(file)?;
    if bytes.array()? != *b"MVSI" {
        return Err(bytes.error_at(0, "it does not start with MVSI: older files cannot be read"));
    }
    let version = bytes.u32()?;
    if version > NEWEST {
        let what = format!("version {version} is newer than {NEWEST}, the newest that can be read");
        return Err(bytes.error(format!("{what}; export a COLMAP model instead")));
    }
    bytes.u32()?;
    let platforms = platforms(&mut bytes, version)?;
    let mut candidates = Vec::new();
    let images = bytes.count(8 + 12, "images")?;
    let mut unposed = 0;
    for id in 0..images as u32 {
        let at = bytes.at();
        let name = relative_name(&bytes.text_of_length()?);
        if version > 4 {
            bytes.text_of_length()?; // its mask
        }
        let [platform, camera, pose] = [bytes.u32()?, bytes.u32()?, bytes.u32()?];
        if version > 2 {
            bytes.u32()?; // the id that the program gave it, which its own tracks do not use
        }
        if version > 6 {
            bytes.skip(3 * 4)?; // least, mean and largest depth of its points, which may all be 0
            let scores = bytes.count(VIEW_SCORE, "scores of other images")?;
            bytes.skip(scores as u64 * VIEW_SCORE)?;
        }
        let Some(platform) = platforms.get(platform as usize) else {
            let what = format!("image {name:?} is of platform {platform}, which does not exist");
            return Err(bytes.error_at(at, what));
        };
        if pose == NONE {
            unposed += 1;
            continue;
        }
        let both = platform.cameras.get(camera as usize).zip(platform.poses.get(pose as usize));
        let Some((camera, pose)) = both else {
            let what = format!("image {name:?} has a camera or pose that does not exist");
            return Err(bytes.error_at(at, what));
        };
        candidates.push(Candidate { id: ViewId(id), name, geometry: geometry(camera, pose) });
    }
    let mut scene = Scene::default();
    if unposed > 0 {
        scene.warnings.push(Warning::new(
            format!("{unposed} images of {} have no pose", file.display()),
            "add photographs between them and the others where the scene was solved, if they are needed",
        ));
    }
    let folder = file.parent().unwrap_or(Path::new("."));
    let root = options.images.clone().unwrap_or_else(|| PathBuf::from(folder));
    admit(candidates, file, &root, options, &mut scene)?;
    points(&mut bytes, images as u32, &mut scene)?;
    // Normals, colours, lines and a box follow, which are not needed.
    Ok(scene)
}

fn platforms(bytes: &mut Bytes, version: u32) -> Result<Vec<Platform>, ReadError> {
    let mut platforms = Vec::new();
    for _ in 0..bytes.count(24, "platforms")? {
        bytes.text_of_length()?;
        let mut platform = Platform { cameras: Vec::new(), poses: Vec::new() };
        for _ in 0..bytes.count(8 + 21 * 8, "cameras")? {
            bytes.text_of_length()?;
            if version > 3 {
                bytes.text_of_length()?; // which band of light it takes
            }
            let (width, height) = if version > 0 { (bytes.u32()?, bytes.u32()?) } else { (0, 0) };
            let (matrix, rotation, centre) = (bytes.f64s()?, bytes.f64s()?, bytes.f64s()?);
            platform.cameras.push(Camera { width, height, matrix, rotation, centre });
        }
        for _ in 0..bytes.count(12 * 8, "poses")? {
            platform.poses.push((bytes.f64s()?, bytes.f64s()?));
        }
        platforms.push(platform);
    }
    Ok(platforms)
}

fn geometry(camera: &Camera, (rotation, centre): &([f64; 9], [f64; 3])) -> Result<Geometry, ViewError> {
    let &Camera { width, height, matrix: [fx, skew, cx, _, fy, cy, ..], .. } = camera;
    // Without a size, K is in units of the image's larger side, if its centre lies within a few of them.
    let units = match (width, height) {
        (1.., 1..) => Units::Pixels,
        _ if cx < 3.0 && cy < 3.0 => Units::LargerSide,
        _ => Units::PixelsOfImage,
    };
    let intrinsics = Intrinsics { width, height, fx, fy, skew, cx, cy };
    // The camera may stand away from its platform: x = R_c (R_p (X - C_p) - C_c).
    let platform = Matrix3::from_row_slice(rotation);
    let mount = Matrix3::from_row_slice(&camera.rotation);
    let rotation = mount * platform;
    let translation = -(rotation * Vector3::from(*centre)) - mount * Vector3::from(camera.centre);
    let pose = Pose::new(rotation, translation)?;
    Ok(Geometry { pose, intrinsics, units, distortion: Distortion::None, depth_range: None })
}

fn points(bytes: &mut Bytes, images: u32, scene: &mut Scene) -> Result<(), ReadError> {
    let mut points = PointsInto::new(scene);
    let mut track = Vec::new();
    for point in 0..bytes.count(12 + 8, "points")? {
        let position = [bytes.f32()?, bytes.f32()?, bytes.f32()?].map(f64::from);
        track.clear();
        for _ in 0..bytes.count(8, "views of a point")? {
            let at = bytes.at();
            let view = bytes.u32()?;
            if view >= images {
                let what = format!("point {point} is seen by image {view}, which does not exist");
                return Err(bytes.error_at(at, what));
            }
            bytes.f32()?; // how sure it is
            track.push(view);
        }
        points.push(position, track.iter().copied());
    }
    points.finish();
    Ok(())
}
