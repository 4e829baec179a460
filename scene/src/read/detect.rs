//! What kind of scene lies at a path.

use std::fmt;
use std::path::{Path, PathBuf};

use super::{ReadError, colmap, mvsnet};

/// A format that scenes are read from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SceneFormat {
    /// A COLMAP model with its photographs, or a dense workspace.
    Colmap,
    /// A folder of MVSNet or BlendedMVS.
    Mvsnet,
    /// OpenMVG's `sfm_data.json`.
    OpenMvg,
    /// nerfstudio's or instant-ngp's `transforms.json`.
    Nerfstudio,
    /// Bundler's `bundle.out` with its list of images.
    Bundler,
    /// OpenMVS's `scene.mvs`.
    OpenMvs,
}

impl fmt::Display for SceneFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Colmap => "COLMAP",
            Self::Mvsnet => "MVSNet",
            Self::OpenMvg => "OpenMVG",
            Self::Nerfstudio => "nerfstudio",
            Self::Bundler => "Bundler",
            Self::OpenMvs => "OpenMVS",
        })
    }
}

/// All formats in the order in which a folder is searched for them.
const FORMATS: [SceneFormat; 6] = [
    SceneFormat::Colmap,
    SceneFormat::Mvsnet,
    SceneFormat::OpenMvg,
    SceneFormat::Nerfstudio,
    SceneFormat::OpenMvs,
    SceneFormat::Bundler,
];

impl SceneFormat {
    /// What a folder of this format holds.
    fn looked_for(self) -> &'static str {
        match self {
            Self::Colmap => "model in sparse/ or sparse/0/",
            Self::Mvsnet => "folder cams/",
            Self::OpenMvg => "sfm_data.json",
            Self::Nerfstudio => "transforms.json",
            Self::Bundler => "bundle.out or bundle/bundle.out",
            Self::OpenMvs => "scene.mvs",
        }
    }

    /// What to read of a folder: COLMAP's model folder, the MVSNet folder itself, or a file.
    fn in_folder(self, root: &Path) -> Option<PathBuf> {
        let files: &[&str] = match self {
            Self::Colmap => return colmap::find_model(root),
            Self::Mvsnet => return mvsnet::is_scene(root).then(|| root.to_owned()),
            Self::OpenMvg => &["sfm_data.json"],
            Self::Nerfstudio => &["transforms.json"],
            Self::Bundler => &["bundle.out", "bundle/bundle.out"],
            Self::OpenMvs => &["scene.mvs"],
        };
        files.iter().map(|file| root.join(file)).find(|file| file.is_file())
    }

    /// The format of a file, by its name.
    fn of_file(file: &Path) -> Option<Self> {
        let name = file.file_name()?.to_str()?;
        let extension = file.extension()?.to_str()?;
        match extension {
            "json" if name.contains("transforms") => Some(Self::Nerfstudio),
            "json" => Some(Self::OpenMvg),
            "mvs" => Some(Self::OpenMvs),
            "out" => Some(Self::Bundler),
            _ => None,
        }
    }
}

/// The scenes in folders one or two below this one, in the order of their names.
pub fn scenes_below(folder: &Path) -> Vec<PathBuf> {
    let below = folders_in(folder);
    let mut folders: Vec<PathBuf> =
        below.iter().flat_map(|child| folders_in(child)).chain(below.clone()).collect();
    folders.retain(|folder| is_whole(folder));
    folders.sort();
    folders
}

fn folders_in(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| path.is_dir()).collect()
}

/// Whether there is a scene, and with its photographs where these have their place.
fn is_whole(folder: &Path) -> bool {
    find(folder, None)
        .is_ok_and(|found| found.format != SceneFormat::Colmap || folder.join("images").is_dir())
}

/// What to read, and how.
pub(super) struct Found {
    pub format: SceneFormat,
    pub path: PathBuf,
}

/// Looks for a scene at a path, of one format if that is given.
pub(super) fn find(path: &Path, wanted: Option<SceneFormat>) -> Result<Found, ReadError> {
    if path.is_file() {
        let format = wanted.or_else(|| SceneFormat::of_file(path));
        let format = format.ok_or_else(|| ReadError::NoScene { path: path.to_owned() })?;
        if matches!(format, SceneFormat::Colmap | SceneFormat::Mvsnet) {
            let looked_for = format.looked_for();
            return Err(ReadError::NotThisFormat { path: path.to_owned(), format, looked_for });
        }
        return Ok(Found { format, path: path.to_owned() });
    }
    let formats = wanted.as_ref().map_or(&FORMATS[..], std::slice::from_ref);
    let mut found =
        formats.iter().filter_map(|format| Some(Found { format: *format, path: format.in_folder(path)? }));
    found.next().ok_or_else(|| match wanted {
        Some(format) => {
            let looked_for = format.looked_for();
            ReadError::NotThisFormat { path: path.to_owned(), format, looked_for }
        }
        None => ReadError::NoScene { path: path.to_owned() },
    })
}
