//! Writing training data in the layout of MVSNet and BlendedMVS.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder, ImageError};
use planesweep_scene::{
    PfmError, Raster, Scene, ViewId, WriteError, write_atomically, write_mvsnet, write_pfm,
};
use thiserror::Error;

/// Why a folder of training data could not be written.
#[derive(Debug, Error)]
pub enum TrainingFolderError {
    /// A folder could not be made.
    #[error("cannot make the folder {}", path.display())]
    MakeFolder {
        /// The folder.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// An image could not be encoded.
    #[error("cannot encode the image {}", path.display())]
    EncodeImage {
        /// The image.
        path: PathBuf,
        /// Why.
        #[source]
        source: ImageError,
    },
    /// An image could not be copied or written.
    #[error("cannot write the image {}", path.display())]
    WriteImage {
        /// The image.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// A depth map could not be written.
    #[error("cannot write a depth map")]
    WriteDepth(#[from] PfmError),
    /// Cameras and pairs could not be written.
    #[error("cannot write the cameras")]
    WriteCameras(#[from] WriteError),
}

/// A folder with `images`, `cams`, `pair.txt` and `rendered_depth_maps`, all by the views' ids.
pub struct TrainingFolder {
    root: PathBuf,
}

impl TrainingFolder {
    /// Makes the folders that are not there.
    pub fn create(root: &Path) -> Result<Self, TrainingFolderError> {
        for path in [root.join("images"), root.join("rendered_depth_maps")] {
            fs::create_dir_all(&path).map_err(|source| TrainingFolderError::MakeFolder { path, source })?;
        }
        Ok(Self { root: root.to_owned() })
    }

    /// Where the image of a view is to lie.
    fn image(&self, id: ViewId, extension: &str) -> PathBuf {
        self.root.join(format!("images/{:08}.{extension}", id.0))
    }

    /// Writes an image as PNG; returns its path.
    pub fn write_image(&self, id: ViewId, pixels: &Raster<[u8; 3]>) -> Result<PathBuf, TrainingFolderError> {
        let path = self.image(id, "png");
        let failed = |source| TrainingFolderError::EncodeImage { path: path.clone(), source };
        let bytes = encode_png(pixels).map_err(failed)?;
        match write_atomically(&path, &bytes) {
            Ok(()) => Ok(path),
            Err(source) => Err(TrainingFolderError::WriteImage { path, source }),
        }
    }

    /// Copies a stored image; returns the copy's path.
    pub fn copy_image(&self, id: ViewId, stored: &Path) -> Result<PathBuf, TrainingFolderError> {
        let path = self.image(id, stored.extension().and_then(|e| e.to_str()).unwrap_or("jpg"));
        match fs::copy(stored, &path) {
            Ok(_) => Ok(path),
            Err(source) => Err(TrainingFolderError::WriteImage { path, source }),
        }
    }

    /// Writes the depth map of a view.
    pub fn write_depth(&self, id: ViewId, depth: &Raster<f32>) -> Result<(), TrainingFolderError> {
        Ok(write_pfm(&self.root.join(format!("rendered_depth_maps/{:08}.pfm", id.0)), depth)?)
    }

    /// Writes cameras with their ranges, and pairs.
    pub fn write_cameras(&self, scene: &Scene) -> Result<(), TrainingFolderError> {
        Ok(write_mvsnet(scene, &self.root)?)
    }
}

/// The bytes of a PNG.
pub fn encode_png(pixels: &Raster<[u8; 3]>) -> Result<Vec<u8>, ImageError> {
    let mut bytes = Vec::new();
    let (width, height) = (pixels.width() as u32, pixels.height() as u32);
    PngEncoder::new_with_quality(&mut bytes, CompressionType::Fast, FilterType::Adaptive).write_image(
        pixels.values().as_flattened(),
        width,
        height,
        ExtendedColorType::Rgb8,
    )?;
    Ok(bytes)
}
