//! Readers of the field's formats, all into a [`Scene`].

mod bundler;
mod bytes;
mod colmap;
mod colmap_binary;
mod colmap_text;
mod detect;
mod json;
mod mvsnet;
mod names;
mod nerfstudio;
mod openmvg;
mod openmvs;
mod pairs;
mod points;
mod views;

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

pub use detect::{SceneFormat, scenes_below};
pub use mvsnet::{read_mvsnet_cam, read_mvsnet_pairs};
pub use names::{NameError, ResolveError, resolve_inside, safe_name};

use crate::{CameraError, Scene, SizeMismatch, first_reasons};

/// What a reader cannot know from the files.
#[derive(Clone, Debug, PartialEq)]
pub struct ReadOptions {
    /// The format; when not given it is told by the files.
    pub format: Option<SceneFormat>,
    /// The folder that image names count from; when not given, where the format has it.
    pub images: Option<PathBuf>,
    /// Leave out views with an impossible camera, name or size, with a warning, instead of refusing
    /// the scene.
    pub skip_bad_views: bool,
    /// What the two numbers of a short depth line in a cam.txt mean.
    pub depth_line: DepthLine,
    /// Where the principal point of a cam.txt counts from. COLMAP models always count from corners.
    pub pixel_centre: PixelCentre,
    /// Depth planes where a cam.txt states none; 192 when not given.
    pub plane_count: Option<u32>,
    /// Factor on the depth interval of a cam.txt; when not given, 1.06 where the file states no
    /// number of planes (as the DTU files need) and 1 where it does.
    pub interval_scale: Option<f64>,
}

impl Default for ReadOptions {
    fn default() -> Self {
        Self {
            format: None,
            images: None,
            skip_bad_views: false,
            depth_line: DepthLine::Auto,
            pixel_centre: PixelCentre::Integer,
            plane_count: None,
            interval_scale: None,
        }
    }
}

/// The meaning of a depth line of two numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DepthLine {
    /// Minimum and maximum when the second is larger, else minimum and interval.
    Auto,
    /// Minimum and interval.
    Interval,
    /// Minimum and maximum.
    MinMax,
}

/// The coordinates of the top-left pixel's centre.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PixelCentre {
    /// (0, 0).
    Integer,
    /// (0.5, 0.5), as in folders made from COLMAP models by the common script.
    Half,
}

/// Why a scene could not be read.
#[derive(Debug, Error)]
pub enum ReadError {
    /// The path holds nothing that is known.
    #[error(
        "found no scene in {}: a COLMAP scene has images/ and a model in sparse/ or sparse/0/, an MVSNet folder cams/ and images/ or blended_images/, others a file sfm_data.json, transforms.json, bundle.out or scene.mvs",
        path.display()
    )]
    NoScene {
        /// The folder or file.
        path: PathBuf,
    },
    /// The path does not hold what the user says it holds.
    #[error("found no {format} scene in {}: there is no {looked_for}", path.display())]
    NotThisFormat {
        /// The folder or file.
        path: PathBuf,
        /// What the user asked for.
        format: SceneFormat,
        /// What such a scene has.
        looked_for: &'static str,
    },
    /// There is a model, but no folder with its photographs.
    #[error("found {}, but no folder {}; --images names the one with the photographs", model.display(), images.display())]
    NoImages {
        /// The model or the folder of cameras.
        model: PathBuf,
        /// Where images were expected.
        images: PathBuf,
    },
    /// A file or folder could not be read.
    #[error("could not read {}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// A binary file is truncated or contradicts itself.
    #[error("could not parse {} at byte {offset}: {what}", path.display())]
    Binary {
        /// The file.
        path: PathBuf,
        /// Where.
        offset: u64,
        /// What is wrong there.
        what: String,
    },
    /// A text file breaks its format.
    #[error("could not parse {} at line {line}: {what}", path.display())]
    Text {
        /// The file.
        path: PathBuf,
        /// Where, from 1.
        line: usize,
        /// What is wrong there.
        what: String,
    },
    /// A file contradicts itself or the others.
    #[error("could not use {}: it has {what}", path.display())]
    Inconsistent {
        /// The file.
        path: PathBuf,
        /// The contradiction.
        what: String,
    },
    /// A view cannot be used.
    #[error("could not take view {view:?} (leave such views out with --skip-bad-views)")]
    View {
        /// The view's name.
        view: String,
        /// What is wrong with it.
        #[source]
        source: ViewError,
    },
    /// No view is left.
    #[error("found no usable view in {}{}", path.display(), first_reasons(skipped))]
    NoViews {
        /// The scene.
        path: PathBuf,
        /// The views that were skipped, each with the reason.
        skipped: BTreeMap<String, String>,
    },
}

/// Why a view cannot be used.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum ViewError {
    /// Its camera is impossible.
    #[error(transparent)]
    Camera(#[from] CameraError),
    /// Its name is no safe path.
    #[error(transparent)]
    Name(#[from] NameError),
    /// Its image has another shape than its camera.
    #[error(transparent)]
    Size(#[from] SizeMismatch),
    /// Its lens follows a model that is not supported.
    #[error("camera model {model} is not supported")]
    UnsupportedModel {
        /// The model's name in its format.
        model: String,
    },
    /// Its camera file breaks the format.
    #[error("its camera file {} {what}", path.display())]
    CameraFile {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
}

/// Reads a scene: a folder in one of the known layouts, or the file that describes it.
///
/// Views whose image is missing or has no readable header are skipped and named; their ids
/// vanish from tracks and pairs too.
pub fn read_scene(path: &Path, options: &ReadOptions) -> Result<Scene, ReadError> {
    let found = detect::find(path, options.format)?;
    let scene = match found.format {
        SceneFormat::Colmap => colmap::read(path, &found.path, options)?,
        SceneFormat::Mvsnet => mvsnet::read(&found.path, options)?,
        SceneFormat::OpenMvg => openmvg::read(&found.path, options)?,
        SceneFormat::Nerfstudio => nerfstudio::read(&found.path, options)?,
        SceneFormat::Bundler => bundler::read(&found.path, options)?,
        SceneFormat::OpenMvs => openmvs::read(&found.path, options)?,
    };
    if scene.views.is_empty() {
        return Err(ReadError::NoViews { path: path.to_owned(), skipped: scene.skipped });
    }
    Ok(scene)
}

fn inconsistent(path: &Path, what: String) -> ReadError {
    ReadError::Inconsistent { path: path.to_owned(), what }
}

/// A path of a foreign file as a name: without `./` at its start and slashes at its end.
fn relative_name(path: &str) -> String {
    path.trim_start_matches("./").trim_end_matches('/').to_owned()
}

fn read_bytes(path: &Path) -> Result<Vec<u8>, ReadError> {
    fs::read(path).map_err(|source| ReadError::Io { path: path.to_owned(), source })
}

fn read_text(path: &Path) -> Result<String, ReadError> {
    String::from_utf8(read_bytes(path)?).map_err(|error| {
        let valid = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = valid.split(|b| *b == b'\n').count();
        ReadError::Text { path: path.to_owned(), line, what: "not UTF-8".to_owned() }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_folder_without_a_scene_is_named() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let error = read_scene(folder.path(), &ReadOptions::default()).expect_err("empty");
        assert!(matches!(&error, ReadError::NoScene { path } if path == folder.path()), "{error}");
    }

    #[test]
    fn scenes_one_or_two_folders_below_are_found_when_they_are_whole() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let make = |name: &str| fs::create_dir_all(folder.path().join(name)).expect("made");
        for name in
            ["dense/0/images", "dense/0/sparse", "no_photographs/sparse", "a/b/c/images", "a/b/c/cams"]
        {
            make(name);
        }
        for name in ["dense/0", "no_photographs"] {
            fs::write(folder.path().join(name).join("sparse/images.bin"), b"").expect("written");
        }
        assert_eq!(scenes_below(folder.path()), [folder.path().join("dense/0")]);
        assert_eq!(scenes_below(&folder.path().join("dense")), [folder.path().join("dense/0")]);
    }
}
