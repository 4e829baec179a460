//! A scene on disk: a COLMAP model with images, and the exact depth beside it.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use image::ImageError;
use planesweep_scene::{
    Distortion, PfmError, Raster, Scene, View, ViewId, WriteError, write_atomically, write_colmap, write_pfm,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::training_folder::encode_png;
use crate::{Style, SynthScene};

/// What [`write_demo`] writes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DemoOptions {
    /// The scene.
    pub seed: u64,
    /// Its kind, size and cameras.
    pub style: Style,
    /// Rays per pixel along each side.
    pub supersampling: u32,
    /// About how many sparse points each view contributes.
    pub points_per_view: usize,
}

impl Default for DemoOptions {
    fn default() -> Self {
        Self { seed: 1, style: Style::default(), supersampling: 3, points_per_view: 600 }
    }
}

/// Why a scene could not be written.
#[derive(Debug, Error)]
pub enum DemoError {
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
    /// An image could not be written.
    #[error("cannot write the image {}", path.display())]
    WriteImage {
        /// The image.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// The COLMAP model could not be written.
    #[error("cannot write the COLMAP model of {}", out.display())]
    WriteModel {
        /// The demo's folder.
        out: PathBuf,
        /// Why.
        #[source]
        source: WriteError,
    },
    /// A depth map could not be written.
    #[error("cannot write the true depth of view {view}")]
    WriteDepth {
        /// The view's name.
        view: String,
        /// Why.
        #[source]
        source: PfmError,
    },
}

/// Renders a scene and writes it into `out`: `images/NAME.png` and their COLMAP model, and
/// `depth_gt/NAME.pfm`, the exact depth at image size. The model comes last, so where it is, all is.
/// Returns the scene, whose image paths lie in `out`.
pub fn write_demo(out: &Path, options: &DemoOptions) -> Result<Scene, DemoError> {
    let (images, depths) = (out.join("images"), out.join("depth_gt"));
    for folder in [&images, &depths] {
        fs::create_dir_all(folder)
            .map_err(|source| DemoError::MakeFolder { path: folder.clone(), source })?;
    }
    let synth = SynthScene::new(options.seed, &options.style);
    let views = synth
        .cameras()
        .par_iter()
        .enumerate()
        .map(|(index, camera)| {
            let stem = format!("{index:08}");
            let name = format!("{stem}.png");
            let image = images.join(&name);
            let (color, depth) = synth.render(camera, options.supersampling);
            write_png(&image, &color)?;
            write_pfm(&depths.join(format!("{stem}.pfm")), &depth)
                .map_err(|source| DemoError::WriteDepth { view: name.clone(), source })?;
            let id = ViewId(index as u32 + 1);
            let distortion = Distortion::None;
            Ok((id, View { id, name, image, camera: *camera, distortion, depth_range: None }))
        })
        .collect::<Result<_, DemoError>>()?;
    let points = synth.sparse_points(synth.cameras(), options.points_per_view);
    let scene = Scene { views, points, ..Scene::default() };
    write_colmap(&scene, out).map_err(|source| DemoError::WriteModel { out: out.to_owned(), source })?;
    Ok(scene)
}

fn write_png(path: &Path, image: &Raster<[u8; 3]>) -> Result<(), DemoError> {
    let bytes =
        encode_png(image).map_err(|source| DemoError::EncodeImage { path: path.to_owned(), source })?;
    write_atomically(path, &bytes).map_err(|source| DemoError::WriteImage { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use planesweep_scene::{ReadOptions, read_depth_pfm, read_scene};

    use super::*;

    #[test]
    fn the_files_are_those_of_the_scene() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let style = Style { views: 3, width: 64, height: 48, ..Style::default() };
        let options = DemoOptions { style, supersampling: 1, points_per_view: 60, ..Default::default() };
        let scene = write_demo(folder.path(), &options).expect("written");
        assert_eq!(scene.views.len(), 3);
        assert!(scene.points.len() > 60, "{} points", scene.points.len());
        let read = read_scene(folder.path(), &ReadOptions::default()).expect("a COLMAP model");
        assert_eq!((read.views.len(), read.points.len()), (3, scene.points.len()));
        let synth = SynthScene::new(options.seed, &style);
        for (view, camera) in scene.views.values().zip(synth.cameras()) {
            let (color, depth) = synth.render(camera, 1);
            let stored = image::open(&view.image).expect("a PNG").to_rgb8();
            let ours = camera.projection() - read.views[&view.id].camera.projection();
            assert!(ours.amax() < 1e-9, "the camera changed by {}", ours.amax());
            assert_eq!(stored.as_raw(), color.values().as_flattened());
            let path = folder.path().join("depth_gt").join(&view.name).with_extension("pfm");
            assert_eq!(read_depth_pfm(&path).expect("a PFM"), depth);
        }
    }
}
