//! Photographs for a scene that was written: copied, or resampled for another camera.

use std::fs;
use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::codecs::jpeg::JpegEncoder;
use image::{ImageFormat, RgbImage};
use rayon::prelude::*;

use super::held::Held;
use super::{WriteError, create_folder, write_file};
use crate::undistort::resampled;
use crate::{Scene, View, ViewId, read_image, safe_name};

/// Resampled JPEGs keep nearly all that the decoder gave.
const JPEG_QUALITY: u8 = 98;

/// Where below `root` the image of a view lies.
pub(super) fn image_path(root: &Path, view: &View) -> PathBuf {
    root.join("images").join(&view.name)
}

/// Writes the image of every view of `held` below `root`, from those of `scene`.
pub(super) fn write_images(scene: &Scene, held: &Held, root: &Path) -> Result<(), WriteError> {
    let views: Vec<(&ViewId, &View)> = held.scene.views.iter().collect();
    views.into_par_iter().try_for_each(|(id, view)| {
        let stored = &scene.views[id];
        safe_name(&view.name)?;
        let path = image_path(root, view);
        create_folder(path.parent().expect("an image lies in a folder"))?;
        if held.resampled.contains(id) {
            return write_file(&path, &resampled_image(stored, view)?);
        }
        let io_error = |path: &Path| {
            let path = path.to_owned();
            move |source| WriteError::Io { path, source }
        };
        if path.canonicalize().is_ok_and(|there| stored.image.canonicalize().is_ok_and(|from| from == there))
        {
            return Ok(());
        }
        let bytes = fs::read(&stored.image).map_err(io_error(&stored.image))?;
        write_file(&path, &bytes)
    })
}

/// The bytes of the image of `wanted`, a pinhole view, made of the photograph of `stored`.
fn resampled_image(stored: &View, wanted: &View) -> Result<Vec<u8>, WriteError> {
    let pixels = read_image(&stored.image)?;
    let camera = &stored.camera.intrinsics;
    let image = resampled(&pixels, camera, &stored.distortion, &wanted.camera.intrinsics);
    let (width, height) = (image.width() as u32, image.height() as u32);
    let bytes = image.values().as_flattened().to_vec();
    let image = RgbImage::from_raw(width, height, bytes).expect("a raster has the bytes of its size");
    let mut file = Cursor::new(Vec::new());
    let encoded = match ImageFormat::from_path(&wanted.name) {
        Ok(ImageFormat::Jpeg) => {
            image.write_with_encoder(JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY))
        }
        Ok(format) => image.write_to(&mut file, format),
        Err(error) => Err(error),
    };
    encoded.map_err(|source| WriteError::Encode { view: wanted.name.clone(), source })?;
    Ok(file.into_inner())
}
