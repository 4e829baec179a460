//! Writers of the field's formats, and the one way in which files are written.

mod atomic;
mod colmap;
mod colmap_array;
mod held;
mod images;
mod mvsnet;
mod openmvg;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use nalgebra::Point3;
use thiserror::Error;

pub use atomic::write_atomically;
pub use colmap::{write_colmap, write_colmap_text, write_colmap_workspace};
pub use colmap_array::write_colmap_array;
pub use held::{Held, held};
pub use mvsnet::{mvsnet_cam_text, mvsnet_pair_text, write_mvsnet};
pub use openmvg::write_openmvg;

use crate::{Camera, Distortion, ImageError, NameError, Scene};

/// A format that scenes are written in.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TargetFormat {
    /// A binary COLMAP model in `sparse/`; a dense workspace when images are undistorted.
    Colmap,
    /// The same with a model in text.
    ColmapText,
    /// A folder of MVSNet.
    Mvsnet,
    /// OpenMVG's `sfm_data.json`.
    OpenMvg,
}

/// Why a scene could not be written.
#[derive(Debug, Error)]
pub enum WriteError {
    /// A file or folder could not be written.
    #[error("could not write {}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// A photograph could not be read.
    #[error("could not take the photograph over")]
    Image(#[from] ImageError),
    /// A name is no safe path.
    #[error(transparent)]
    Name(#[from] NameError),
    /// A resampled photograph could not be encoded.
    #[error("could not encode the image of view {view:?}")]
    Encode {
        /// The view's name.
        view: String,
        /// What the encoder said.
        #[source]
        source: image::ImageError,
    },
    /// The format cannot hold a view.
    #[error("could not write view {view:?}: {format} has no place for {what}")]
    NotHeld {
        /// The view's name.
        view: String,
        /// The format.
        format: &'static str,
        /// What it cannot hold.
        what: &'static str,
    },
}

/// Writes a scene with its images below `root`, in all that `format` can hold, and tells what that is
/// not; see [`held`]. With `undistort` images lose their lens, and COLMAP gets a dense workspace.
pub fn write_scene(
    scene: &Scene,
    format: TargetFormat,
    undistort: bool,
    root: &Path,
) -> Result<Held, WriteError> {
    let mut held = held(scene, format, undistort);
    images::write_images(scene, &held, root)?;
    for view in held.scene.views.values_mut() {
        view.image = images::image_path(root, view);
    }
    match format {
        TargetFormat::Colmap => write_colmap(&held.scene, root)?,
        TargetFormat::ColmapText => write_colmap_text(&held.scene, root)?,
        TargetFormat::Mvsnet => write_mvsnet(&held.scene, root)?,
        TargetFormat::OpenMvg => write_openmvg(&held.scene, root)?,
    }
    if undistort && matches!(format, TargetFormat::Colmap | TargetFormat::ColmapText) {
        write_colmap_workspace(&held.scene, &scene.pairs, root)?;
    }
    Ok(held)
}

/// Where the stored image shows a point, in pixels; the principal point when it is behind.
fn observed(camera: &Camera, distortion: &Distortion, position: &Point3<f64>) -> [f64; 2] {
    let point = camera.pose.to_camera(position);
    let (x, y) =
        if point.z > 0.0 { distortion.distort(point.x / point.z, point.y / point.z) } else { (0.0, 0.0) };
    let k = &camera.intrinsics;
    [k.fx * x + k.skew * y + k.cx, k.fy * y + k.cy]
}

fn create_folder(path: &Path) -> Result<(), WriteError> {
    fs::create_dir_all(path).map_err(|source| WriteError::Io { path: path.to_owned(), source })
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write_atomically(path, bytes).map_err(|source| WriteError::Io { path: path.to_owned(), source })
}
