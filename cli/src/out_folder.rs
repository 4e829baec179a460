//! The folder that a result goes to.
//!
//! ```text
//! cloud.ply                 the point cloud
//! depth/NAME.pfm            depth of each view, a quarter of the working image
//! confidence/NAME.pfm       its confidence
//! preview/NAME.png          image, depth, confidence and mask side by side
//! cloud.png                 the cloud as the middle view's camera sees it
//! cams/ID_cam.txt pair.txt  cameras of the depth maps and who was checked against whom, as in an
//!                           MVSNet folder
//! trajectory.log            the cameras as Tanks and Temples wants them
//! report.json report.html   what was done
//! run.json                  every parameter, hash and version
//! .planesweep/              ledger and store; delete it when the result is not to be resumed
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use planesweep_report::{PreviewOptions, draw_preview, encode_png};
use planesweep_scene::{
    Camera, DepthHypotheses, DepthMap, DepthRange, Raster, Sampling, ViewId, write_atomically, write_pfm,
};

use crate::console::UsageError;

/// All that a run writes, the cloud first and the record last: while anything is left of an earlier
/// run, its record says so.
const WRITTEN: [&str; 11] = [
    "cloud.ply",
    "cloud.png",
    "report.html",
    "report.json",
    "depth",
    "confidence",
    "preview",
    "cams",
    "pair.txt",
    "trajectory.log",
    crate::run_record::FILE_NAME,
];

/// A folder for results, with a file name for every view.
pub struct OutFolder {
    root: PathBuf,
    names: BTreeMap<ViewId, String>,
}

/// Where a depth map was written.
pub struct MapFiles {
    /// Depth, PFM.
    pub depth: PathBuf,
    /// Confidence, PFM.
    pub confidence: PathBuf,
    /// Picture, PNG.
    pub preview: PathBuf,
    /// The picture's name within the folder.
    pub preview_name: String,
    /// The picture itself.
    pub picture: Raster<[u8; 3]>,
}

impl OutFolder {
    /// Makes the folder. Files are named after the views, less the image's extension where that
    /// leaves the names distinct.
    pub fn create<'a>(root: &Path, views: impl IntoIterator<Item = (ViewId, &'a str)>) -> Result<Self> {
        fs::create_dir_all(root).with_context(|| format!("cannot make the folder {}", root.display()))?;
        let views: Vec<(ViewId, &str)> = views.into_iter().collect();
        let stems: BTreeSet<String> = views.iter().map(|(_, name)| stem(name)).collect();
        let distinct = stems.len() == views.len();
        let file_name = |name: &str| if distinct { stem(name) } else { name.to_owned() };
        let names = views.iter().map(|(id, name)| (*id, file_name(name))).collect();
        Ok(Self { root: root.to_owned(), names })
    }

    /// Removes what an earlier run left, so that no file of it is taken for one of this run. Does
    /// nothing in a folder that no run has written to.
    pub fn clear(&self) -> Result<()> {
        if !self.root.join(crate::run_record::FILE_NAME).exists() {
            return Ok(());
        }
        let remove = |name: &str| {
            let path = self.root.join(name);
            let removed = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
            match removed {
                Err(error) if error.kind() != ErrorKind::NotFound => {
                    Err(error).with_context(|| format!("cannot remove {}", path.display()))
                }
                _ => Ok(()),
            }
        };
        WRITTEN.iter().try_for_each(|name| remove(name))
    }

    /// The folder itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Writes a file of this name, with the folders in it.
    pub fn write_file(&self, name: &str, bytes: &[u8]) -> Result<PathBuf> {
        let path = self.path(name)?;
        write_atomically(&path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(path)
    }

    /// Writes depth, confidence and preview of a view.
    pub fn write_map(
        &self,
        view: ViewId,
        map: &DepthMap,
        kept: &Raster<bool>,
        hypotheses: &DepthHypotheses,
    ) -> Result<MapFiles> {
        let name = self.names.get(&view).context("the view has no name")?;
        let depth = self.path(&format!("depth/{name}.pfm"))?;
        write_pfm(&depth, &map.depth)?;
        let confidence = self.path(&format!("confidence/{name}.pfm"))?;
        write_pfm(&confidence, &map.confidence)?;
        let inverse_depth = hypotheses.sampling() == Sampling::Inverse;
        let options = PreviewOptions { inverse_depth, ..PreviewOptions::default() };
        let picture = draw_preview(map, kept, &depth_range(hypotheses), &options)?;
        let preview_name = format!("preview/{name}.png");
        let preview = self.write_file(&preview_name, &encode_png(&picture)?)?;
        Ok(MapFiles { depth, confidence, preview, preview_name, picture })
    }

    /// The name of a view's files; empty for a view that the folder was not made for.
    pub fn file_name(&self, view: ViewId) -> &str {
        self.names.get(&view).map_or("", String::as_str)
    }

    fn path(&self, name: &str) -> Result<PathBuf> {
        let path = self.root.join(name);
        make_folder_of(&path)?;
        Ok(path)
    }
}

/// Refuses an output folder that would be written over the scene or cannot be named on the wire.
pub fn check_out(out: &Path, scene: &Path) -> Result<()> {
    if is_scene(out, scene) {
        bail!(UsageError(
            "the result would be written over the scene; choose another folder for -o".to_owned()
        ));
    }
    let absolute = std::path::absolute(out).with_context(|| format!("cannot find {}", out.display()))?;
    if absolute.to_str().is_none() {
        bail!(UsageError(format!(
            "the path of {} is not UTF-8; choose another folder for -o",
            out.display()
        )));
    }
    Ok(())
}

/// Whether a folder is that of a scene, which is named by its folder or by a file in there.
pub fn is_scene(folder: &Path, scene: &Path) -> bool {
    let (Ok(folder), Ok(scene)) = (folder.canonicalize(), scene.canonicalize()) else { return false };
    scene == folder || (scene.is_file() && scene.parent() == Some(&folder))
}

/// Refuses a folder that holds anything: what is written would mix with it, or replace it.
pub fn check_empty(folder: &Path) -> Result<()> {
    let is_used = match fs::read_dir(folder) {
        Ok(mut entries) => entries.next().is_some(),
        Err(error) if error.kind() == ErrorKind::NotFound => false,
        Err(error) => return Err(error).with_context(|| format!("cannot list {}", folder.display())),
    };
    if is_used {
        bail!(UsageError(format!(
            "{} is not empty; name a new folder, or remove this one first",
            folder.display()
        )));
    }
    Ok(())
}

/// Makes the folder that a file goes to.
pub fn make_folder_of(file: &Path) -> Result<()> {
    let folder = file.parent().unwrap_or(file);
    fs::create_dir_all(folder).with_context(|| format!("cannot make the folder {}", folder.display()))
}

fn stem(name: &str) -> String {
    match name.rsplit_once('.') {
        Some((stem, extension)) if !stem.is_empty() && !extension.contains('/') => stem.to_owned(),
        _ => name.to_owned(),
    }
}

/// The range of a view's hypotheses.
pub fn depth_range(hypotheses: &DepthHypotheses) -> DepthRange {
    DepthRange { min: hypotheses.min(), max: hypotheses.max(), count: Some(hypotheses.count()) }
}

/// Cameras in the format of Tanks and Temples: three integers, then the camera-to-world matrix.
pub fn trajectory<'a>(cameras: impl IntoIterator<Item = &'a Camera>) -> String {
    let mut text = String::new();
    for (index, camera) in cameras.into_iter().enumerate() {
        let rotation = camera.pose.rotation.transpose();
        let centre = camera.pose.centre();
        text.push_str(&format!("{index} {index} 0\n"));
        for row in 0..3 {
            let r = rotation.row(row);
            text.push_str(&format!("{} {} {} {}\n", r[0], r[1], r[2], centre[row]));
        }
        text.push_str("0 0 0 1\n");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_named_after_views_and_never_collide() {
        let root = tempfile::tempdir().expect("a folder");
        let names = |views: &[(u32, &str)]| {
            let views = views.iter().map(|(id, name)| (ViewId(*id), *name));
            let folder = OutFolder::create(root.path(), views).expect("made");
            folder.names.into_values().collect::<Vec<_>>()
        };
        assert_eq!(names(&[(1, "a/IMG.1.JPG"), (2, "a/IMG.2.JPG")]), ["a/IMG.1", "a/IMG.2"]);
        assert_eq!(names(&[(1, "x.jpg"), (2, "x.png")]), ["x.jpg", "x.png"]);
        assert_eq!(names(&[(1, "v1.2/plain"), (2, ".hidden")]), ["v1.2/plain", ".hidden"]);
    }

    #[test]
    fn a_result_goes_neither_over_a_scene_nor_into_a_used_folder() {
        let root = tempfile::tempdir().expect("a folder");
        let scene = root.path().join("scene");
        assert!(check_out(&scene, &scene).is_ok(), "neither is there");
        assert!(check_empty(&scene).is_ok());
        fs::create_dir(&scene).expect("made");
        assert!(check_empty(&scene).is_ok());
        let file = scene.join("transforms.json");
        fs::write(&file, "{}").expect("written");
        assert!(check_empty(&file).is_err(), "it is no folder");
        let used = check_empty(&scene).expect_err("it holds a file");
        assert!(used.is::<UsageError>() && used.to_string().contains("scene is not empty"), "{used}");
        for named in [&scene, &file] {
            let refused = check_out(&scene.join("../scene"), named).expect_err("it is the scene");
            assert!(
                refused.is::<UsageError>() && refused.to_string().contains("over the scene"),
                "{refused}"
            );
        }
        let out = scene.join("out");
        assert!(check_out(&out, &scene).is_ok() && !out.exists());
    }
}
