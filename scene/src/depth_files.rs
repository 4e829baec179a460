//! The depth map of a view as files, and all that is needed to make a [`DepthMap`] of them.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::{
    Camera, DepthMap, DepthMapError, ImageError, Intrinsics, PfmError, PrepareError, Raster, View, ViewId,
    WorkingImage, read_depth_pfm, read_image, read_pfm, undistorted_intrinsics,
};

/// Where depth maps lie in the folders that networks of the MVSNet family write: ours first.
const DEPTH_FOLDERS: [&str; 4] = ["depth", "depth_est", "depths_mvsnet", "depths"];
/// And their confidences, in folders of their own.
const CONFIDENCE_FOLDERS: [&str; 2] = ["confidence", "confidence_est"];
/// How much wider, in pixels of the map, an image may be than its map times an integer: networks crop or pad to
/// multiples of 32 pixels of the image.
const CROP: u32 = 32;

/// The files of one view's depth map.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthFiles {
    /// The view, with its photograph.
    pub view: View,
    /// How the map's pixels lie in the photograph.
    pub geometry: MapGeometry,
    /// Depth, PFM of one channel.
    pub depth: PathBuf,
    /// Confidence, PFM of the same size; everything is sure when there is none.
    pub confidence: Option<PathBuf>,
    /// An image of the map's or the photograph's shape that is black where pixels are to be left out.
    pub mask: Option<PathBuf>,
}

/// How the pixels of a depth map lie in the photograph.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum MapGeometry {
    /// As sizes tell: where the map is the photograph's size, a half or a quarter, but for a few cropped or
    /// padded rows and columns, pixel u of the map is centred on that multiple of u, as strided
    /// convolutions make it; otherwise it is a photograph resized.
    BySize,
    /// The working image of this size.
    Whole {
        /// Columns of the working image.
        width: u32,
        /// Rows of the working image.
        height: u32,
    },
    /// A quarter of the working image of this size.
    QuarterOf {
        /// Columns of the working image.
        width: u32,
        /// Rows of the working image.
        height: u32,
    },
}

/// Why files are no depth map.
#[derive(Debug, Error)]
pub enum DepthFilesError {
    /// Depth or confidence cannot be read.
    #[error(transparent)]
    Pfm(#[from] PfmError),
    /// The photograph or the mask cannot be read.
    #[error(transparent)]
    Image(#[from] ImageError),
    /// The photograph does not fit its camera.
    #[error("cannot prepare the image of view {view:?}")]
    Prepare {
        /// The view's name.
        view: String,
        /// What does not fit.
        #[source]
        source: PrepareError,
    },
    /// Depth and confidence do not fit together.
    #[error("cannot use the depth map of view {view:?}")]
    DepthMap {
        /// The view's name.
        view: String,
        /// What does not fit.
        #[source]
        source: DepthMapError,
    },
    /// A folder cannot be listed.
    #[error("cannot list {}", path.display())]
    List {
        /// The folder.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
}

/// Finds the depth map of a view in a folder of the MVSNet layout: `depth_est/ID.pfm` with `confidence/ID.pfm`, or
/// `depths_mvsnet/ID_init.pfm` with `ID_prob.pfm`, the id with eight digits; `None` when there is none.
pub fn find_depth_files(root: &Path, view: &View, masks: Option<&Path>) -> Option<DepthFiles> {
    let ViewId(id) = view.id;
    let existing = |path: PathBuf| path.is_file().then_some(path);
    let names = [format!("{id:08}.pfm"), format!("{id:08}_init.pfm")];
    let depth = DEPTH_FOLDERS
        .iter()
        .flat_map(|folder| names.iter().map(move |name| root.join(folder).join(name)))
        .find_map(existing)?;
    let beside = depth.with_file_name(format!("{id:08}_prob.pfm"));
    let confidence = CONFIDENCE_FOLDERS
        .iter()
        .map(|folder| root.join(folder).join(&names[0]))
        .chain([beside])
        .find_map(existing);
    let mask = find_mask(view, masks);
    Some(DepthFiles { view: view.clone(), geometry: MapGeometry::BySize, depth, confidence, mask })
}

/// Finds the mask of a view: `STEM.png` or `NAME.png` in `masks`; without that folder `STEM.mask.png` beside the
/// photograph.
pub fn find_mask(view: &View, masks: Option<&Path>) -> Option<PathBuf> {
    let stem = view.name.rsplit_once('.').map_or(view.name.as_str(), |(stem, _)| stem);
    let candidates = match masks {
        Some(folder) => [stem, view.name.as_str()].map(|name| folder.join(format!("{name}.png"))),
        None => [view.image.with_extension("mask.png"), view.image.with_extension("mask.PNG")],
    };
    candidates.into_iter().find(|path| path.is_file())
}

impl DepthFiles {
    /// Reads the map.
    ///
    /// The depth of what the mask leaves out is 0. Colours are those of the photograph, undistorted.
    pub fn read(&self) -> Result<DepthMap, DepthFilesError> {
        self.read_with_photograph().map(|(map, _)| map)
    }

    /// Reads the map at the resolution of the photograph; see [`DepthMap::upsampled`].
    pub fn read_upsampled(&self) -> Result<DepthMap, DepthFilesError> {
        self.read_with_photograph().map(|(map, photograph)| map.upsampled(&photograph))
    }

    /// Reads the map, and the photograph as its pixels lie in it: undistorted, and of the working size where that is
    /// known; of the map's size where the map is a photograph resized.
    pub fn read_with_photograph(&self) -> Result<(DepthMap, WorkingImage), DepthFilesError> {
        let name = || self.view.name.clone();
        let depth = read_depth_pfm(&self.depth)?;
        let (width, height) = (depth.width() as u32, depth.height() as u32);
        let confidence = match &self.confidence {
            Some(path) => read_pfm(path)?,
            None => Raster::filled(depth.width(), depth.height(), 1.0),
        };
        let pixels = read_image(&self.view.image)?;
        let size = undistorted_intrinsics(&self.view.camera.intrinsics, &self.view.distortion);
        let (working, step) = match self.geometry {
            MapGeometry::Whole { width, height } => ((width, height), Some(1)),
            MapGeometry::QuarterOf { width, height } => ((width, height), Some(4)),
            MapGeometry::BySize => match step(&size, width, height) {
                Some(step) => ((size.width, size.height), Some(step)),
                None => ((width, height), None),
            },
        };
        let image =
            WorkingImage::prepare(pixels, &self.view.camera, &self.view.distortion, working.0, working.1)
                .map_err(|source| DepthFilesError::Prepare { view: name(), source })?;
        let k = image.camera.intrinsics;
        let (intrinsics, color) = match step {
            Some(4) => (k.quartered(), image.map_colors(depth.width(), depth.height())),
            Some(step) => {
                let s = f64::from(step);
                let k = Intrinsics {
                    fx: k.fx / s,
                    fy: k.fy / s,
                    skew: k.skew / s,
                    cx: k.cx / s,
                    cy: k.cy / s,
                    ..k
                };
                let step = step as usize;
                let (right, bottom) = (image.pixels.width() - 1, image.pixels.height() - 1);
                let color =
                    |x: usize, y: usize| image.pixels.at((step * x).min(right), (step * y).min(bottom));
                (k, Raster::from_fn(depth.width(), depth.height(), color))
            }
            None => (k, image.pixels.clone()),
        };
        let camera = Camera { intrinsics: intrinsics.with_size(width, height), pose: self.view.camera.pose };
        let mut map = DepthMap::new(camera, depth, confidence, color)
            .map_err(|source| DepthFilesError::DepthMap { view: name(), source })?;
        if let Some(path) = &self.mask {
            map.leave_out(&read_image(path)?);
        }
        Ok((map, image))
    }

    /// What tells whether the files have changed: their sizes and times of change.
    pub fn state(&self) -> String {
        let of = |path: &Path| {
            let found = fs::metadata(path).and_then(|data| Ok((data.len(), data.modified()?)));
            format!("{} {found:?}\n", path.display())
        };
        let paths = [Some(&self.depth), self.confidence.as_ref(), self.mask.as_ref(), Some(&self.view.image)];
        paths.into_iter().flatten().map(|path| of(path)).collect()
    }
}

/// The step in the photograph from one pixel of a map to the next, if it is one that strides make.
fn step(image: &Intrinsics, width: u32, height: u32) -> Option<u32> {
    let fits = |image: u32, map: u32, step: u32| (step * map).abs_diff(image) < CROP;
    [1, 2, 4].into_iter().find(|s| fits(image.width, width, *s) && fits(image.height, height, *s))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::{Distortion, Pose, write_pfm};

    /// A view of 64 x 48 in a folder, with a photograph that tells columns and rows.
    fn view(root: &Path) -> View {
        let image = root.join("00000003.png");
        let pixels = Raster::from_fn(64, 48, |x, y| [4 * x as u8, 5 * y as u8, 9]);
        save(&image, &pixels);
        let intrinsics =
            Intrinsics { width: 64, height: 48, fx: 60.0, fy: 62.0, skew: 0.0, cx: 31.5, cy: 23.5 };
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        View {
            id: ViewId(3),
            name: "00000003.png".into(),
            image,
            camera: Camera { intrinsics, pose },
            distortion: Distortion::None,
            depth_range: None,
        }
    }

    fn save(path: &Path, pixels: &Raster<[u8; 3]>) {
        let (width, height) = (pixels.width() as u32, pixels.height() as u32);
        let bytes = pixels.values().as_flattened().to_vec();
        let image = image::RgbImage::from_raw(width, height, bytes).expect("as many bytes as pixels");
        image.save(path).expect("saved");
    }

    fn write(path: &Path, width: usize, height: usize, value: f32) {
        fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        write_pfm(path, &Raster::filled(width, height, value)).expect("written");
    }

    #[test]
    fn both_naming_customs_are_found() {
        let root = tempfile::tempdir().expect("a folder");
        let view = view(root.path());
        assert_eq!(find_depth_files(root.path(), &view, None), None);
        write(&root.path().join("depths_mvsnet/00000003_init.pfm"), 16, 12, 2.0);
        write(&root.path().join("depths_mvsnet/00000003_prob.pfm"), 16, 12, 0.5);
        let map = find_depth_files(root.path(), &view, None).expect("found").read().expect("read");
        assert_eq!((map.depth.at(0, 0), map.confidence.at(0, 0)), (2.0, 0.5));
        write(&root.path().join("depth_est/00000003.pfm"), 16, 12, 3.0);
        let files = find_depth_files(root.path(), &view, None).expect("found");
        assert_eq!(files.read().expect("read").depth.at(0, 0), 3.0);
        assert_eq!(files.confidence, None, "the other custom's is not that of this map");
    }

    #[test]
    fn the_camera_and_the_colours_follow_the_size_of_the_map() {
        let root = tempfile::tempdir().expect("a folder");
        let view = view(root.path());
        let read = |width, height| {
            write(&root.path().join("depth/00000003.pfm"), width, height, 2.0);
            find_depth_files(root.path(), &view, None).expect("found").read().expect("read")
        };
        // A quarter with three rows cropped away: strides, no scale.
        let quarter = read(16, 9);
        let k = quarter.camera.intrinsics;
        assert_eq!((k.width, k.height, k.fx, k.cx, k.cy), (16, 9, 15.0, 31.5 / 4.0, 23.5 / 4.0));
        assert_eq!(quarter.rgb(5, 3), [80, 60, 9]);
        let same = read(64, 48);
        assert_eq!((same.camera, same.rgb(5, 3)), (view.camera, [20, 15, 9]));
        let half = read(32, 24);
        assert_eq!((half.camera.intrinsics.cx, half.rgb(5, 3)), (31.5 / 2.0, [40, 30, 9]));
        let resized = read(200, 150).camera.intrinsics;
        assert_eq!((resized.fx, resized.cx), (187.5, 32.0 * 3.125 - 0.5));
    }

    #[test]
    fn masks_take_depth_away() {
        let root = tempfile::tempdir().expect("a folder");
        let view = view(root.path());
        write(&root.path().join("depth/00000003.pfm"), 16, 12, 2.0);
        let left = Raster::from_fn(64, 48, |x, _| if x < 32 { [0; 3] } else { [255; 3] });
        save(&root.path().join("00000003.mask.png"), &left);
        let map = find_depth_files(root.path(), &view, None).expect("found").read().expect("read");
        assert_eq!((map.depth.at(7, 5), map.depth.at(8, 5)), (0.0, 2.0));
        let masks = root.path().join("masks");
        fs::create_dir_all(&masks).expect("made");
        save(&masks.join("00000003.png.png"), &Raster::filled(16, 12, [0; 3]));
        let map = find_depth_files(root.path(), &view, Some(&masks)).expect("found").read().expect("read");
        assert!(map.depth.values().iter().all(|depth| *depth == 0.0));
    }
}
