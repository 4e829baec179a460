//! Fused depth maps as a dense workspace of COLMAP, for its `stereo_fusion` and its meshers.
//!
//! ```text
//! images/NAME                            photographs, undistorted, an integer times the size of their maps
//! sparse/                                their cameras, and points that tell which views overlap
//! stereo/depth_maps/NAME.geometric.bin   depth, checked against the other views
//! stereo/normal_maps/NAME.geometric.bin  normals in the frame of the camera
//! stereo/fusion.cfg patch-match.cfg      the views
//! .planesweep-workspace                  that all this is written here, and may be written again
//! ```

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail, ensure};
use image::RgbImage;
use nalgebra::{Point2, Vector3};
use planesweep_fusion::{FilteredMap, normals};
use planesweep_scene::{
    Camera, DepthFiles, Distortion, Scene, View, ViewId, WorkingImage, safe_name, write_colmap,
    write_colmap_array, write_colmap_workspace,
};

use crate::console::UsageError;
use crate::out_folder::{is_scene, make_folder_of};

/// What is in a workspace; also in a scene, and in a workspace of COLMAP's own.
const FOLDERS: [&str; 3] = ["images", "sparse", "stereo"];
/// Tells a workspace that `fuse` wrote.
const MARK: &str = ".planesweep-workspace";
/// Rows and columns of a map between the pixels that become points of the sparse model.
const STEP: usize = 8;

/// A workspace in the making.
pub struct Workspace {
    root: PathBuf,
    scene: Scene,
}

impl Workspace {
    /// Begins one in a folder, which may hold an earlier one but no photograph, camera or map of anybody else:
    /// `maps` is where the depth maps come from, `photographs` are theirs.
    pub fn create<'a>(
        root: PathBuf,
        maps: &Path,
        mut photographs: impl Iterator<Item = &'a Path>,
    ) -> Result<Self> {
        let found = root.canonicalize();
        let within = |photograph: &Path| {
            found
                .as_ref()
                .is_ok_and(|root| photograph.canonicalize().is_ok_and(|path| path.starts_with(root)))
        };
        if is_scene(&root, maps) || photographs.any(within) {
            bail!(UsageError(format!(
                "the workspace would be written over the scene in {}; choose another folder for --workspace",
                root.display()
            )));
        }
        let mark = root.join(MARK);
        if let (false, Some(used)) = (mark.exists(), FOLDERS.iter().find(|name| root.join(name).exists())) {
            bail!(UsageError(format!(
                "{} holds {used}/, which `fuse` did not write; choose another folder for --workspace",
                root.display()
            )));
        }
        make_folder_of(&mark)?;
        fs::write(&mark, "planesweep fuse --workspace writes images/, sparse/ and stereo/ here\n")
            .with_context(|| format!("cannot write {}", mark.display()))?;
        Ok(Self { root, scene: Scene::default() })
    }

    /// Writes what belongs to a view: `map` is what the filter left of the map in `files`, `neighbours` are the views
    /// that it was checked against.
    pub fn add(&mut self, files: &DepthFiles, map: &FilteredMap, neighbours: &[ViewId]) -> Result<()> {
        let name = &files.view.name;
        safe_name(name)?;
        let (read, photograph) = files.read_with_photograph()?;
        let step = if map.camera == photograph.camera {
            1
        } else {
            (photograph.camera.intrinsics.fx / read.camera.intrinsics.fx).round() as usize
        };
        let (camera, width, height) = self.add_image(name, &photograph, map, step)?;
        // COLMAP takes the scale of a map from the sizes, so both are cut to where it is exact.
        let depth = map.depth.cropped(width, height);
        let (depth_maps, normal_maps) = ("stereo/depth_maps", "stereo/normal_maps");
        let path = |folder: &str| self.root.join(folder).join(format!("{name}.geometric.bin"));
        let rotation = map.camera.pose.rotation.map(|r| r as f32);
        let normals = normals(&map.camera, &map.depth).cropped(width, height);
        write_colmap_array(&path(depth_maps), &depth.map(|depth| [*depth]))?;
        write_colmap_array(&path(normal_maps), &normals.map(|n| (rotation * Vector3::from(*n)).into()))?;
        self.add_points(files.view.id, map, neighbours);
        let view = View {
            id: files.view.id,
            name: name.clone(),
            image: self.root.join("images").join(name),
            camera,
            distortion: Distortion::None,
            depth_range: files.view.depth_range,
        };
        self.scene.views.insert(view.id, view);
        Ok(())
    }

    /// Writes the part of the photograph that whole pixels of the map cover; returns its camera, and how many columns
    /// and rows of the map these are.
    fn add_image(
        &self,
        name: &str,
        photograph: &WorkingImage,
        map: &FilteredMap,
        step: usize,
    ) -> Result<(Camera, usize, usize)> {
        let width = map.depth.width().min(photograph.pixels.width() / step.max(1));
        let height = map.depth.height().min(photograph.pixels.height() / step.max(1));
        ensure!(
            step > 0 && width > 0 && height > 0,
            "the photograph of {name} is smaller than its depth map"
        );
        let pixels = photograph.pixels.cropped(step * width, step * height);
        let (columns, rows) = (pixels.width() as u32, pixels.height() as u32);
        let path = self.root.join("images").join(name);
        make_folder_of(&path)?;
        let bytes = pixels.into_values().into_flattened();
        RgbImage::from_raw(columns, rows, bytes)
            .context("an image has the bytes of its size")?
            .save(&path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        let intrinsics = photograph.camera.intrinsics.with_size(columns, rows);
        Ok((Camera { intrinsics, pose: map.camera.pose }, width, height))
    }

    /// Some points of the view with the views that agree on them.
    fn add_points(&mut self, view: ViewId, map: &FilteredMap, neighbours: &[ViewId]) {
        for y in (0..map.depth.height()).step_by(STEP) {
            for x in (0..map.depth.width()).step_by(STEP) {
                let (depth, agreeing) = (map.depth.at(x, y), map.agreeing.at(x, y));
                if depth > 0.0 && agreeing != 0 {
                    let pixel = Point2::new(x as f64, y as f64);
                    let others = neighbours.iter().take(64).enumerate();
                    let others = others.filter(|(k, _)| agreeing >> k & 1 == 1).map(|(_, view)| *view);
                    let track = std::iter::once(view).chain(others);
                    self.scene.points.push(map.camera.unproject(&pixel, f64::from(depth)), track);
                }
            }
        }
    }

    /// Writes what all views share.
    pub fn finish(mut self) -> Result<()> {
        // A neighbour without a map of its own is no view of the workspace.
        let points = std::mem::take(&mut self.scene.points);
        for (position, track) in points.iter() {
            let known = track.iter().copied().filter(|view| self.scene.views.contains_key(view));
            self.scene.points.push(*position, known);
        }
        write_colmap(&self.scene, &self.root)?;
        write_colmap_workspace(&self.scene, &BTreeMap::new(), &self.root)?;
        Ok(())
    }
}
