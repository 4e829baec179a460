//! Training samples from data sets on disk: MVSNet and BlendedMVS folders, and DTU as it is laid out for
//! training.

mod dtu;
mod fit;
mod folders;

use std::io;
use std::path::{Path, PathBuf};

use planesweep_scene::{
    Camera, DepthRange, ImageError, PfmError, PrepareError, Raster, ReadError, TrainingSample, ViewId,
    read_depth_pfm, read_image,
};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use thiserror::Error;

pub use dtu::DtuSplit;
pub(crate) use fit::range as range_of;

use self::fit::Fit;

/// What samples should be like.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleShape {
    /// Columns of the images.
    pub width: u32,
    /// Rows of the images.
    pub height: u32,
    /// Reference and source views together, 2 and up.
    pub views: usize,
}

/// Why a data set or one of its samples cannot be used.
#[derive(Debug, Error)]
pub enum DataSetError {
    /// A folder could not be listed.
    #[error("cannot list the folder {}", path.display())]
    List {
        /// The folder.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
    /// There is nothing to train on.
    #[error("found no view with sources and true depth in the data set {}", path.display())]
    NoSamples {
        /// The folder.
        path: PathBuf,
    },
    /// A camera, pair file or scene could not be read.
    #[error("cannot read the cameras of a data set")]
    Cameras(#[from] ReadError),
    /// An image could not be read.
    #[error("cannot read an image of a data set")]
    Image(#[from] ImageError),
    /// A depth map could not be read.
    #[error("cannot read a depth map of a data set")]
    Depth(#[from] PfmError),
    /// An image is not that of its camera.
    #[error("cannot use the image {}", path.display())]
    Prepare {
        /// The image.
        path: PathBuf,
        /// Why.
        #[source]
        source: PrepareError,
    },
    /// No pixel of the sample has depth that a source view sees.
    #[error("found no depth that a source view sees in {}", path.display())]
    NoDepth {
        /// The depth map.
        path: PathBuf,
    },
}

/// References with their sources and depth maps, in a fixed order. Files are read when a sample is asked
/// for.
#[derive(Clone, Debug)]
pub struct DataSet {
    scenes: Vec<SceneFiles>,
    /// Each a sample: the scene, its reference view, and which of its images.
    entries: Vec<(usize, usize, usize)>,
}

/// One scene of a data set.
#[derive(Clone, Debug)]
struct SceneFiles {
    views: Vec<ViewFiles>,
}

#[derive(Clone, Debug)]
struct ViewFiles {
    id: ViewId,
    /// Of the stored image.
    camera: Camera,
    /// The same view under one light each.
    images: Vec<PathBuf>,
    depth: Option<PathBuf>,
    grid: DepthGrid,
    range: Option<DepthRange>,
    /// Positions in the scene, best first.
    sources: Vec<usize>,
}

/// How the pixels of a depth map lie in the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum DepthGrid {
    /// Pixel `u` on image pixel `4u`, as the network's, when the map is a quarter of the image; else as
    /// after resizing the image to the map's size.
    Image,
    /// DTU's maps of the whole photographs: the training images are their halves, cropped.
    DtuRaw,
}

impl DataSet {
    /// Opens an MVSNet or BlendedMVS folder, or a folder of such: `images` or `blended_images`, `cams`,
    /// `pair.txt`, and depth as PFM in `rendered_depth_maps`, `depths`, `depth_maps`, `depth_gt` or
    /// `depth`. Views without depth or sources are no samples.
    pub fn open(root: &Path) -> Result<Self, DataSetError> {
        Self::of_scenes(root, folders::scenes(root)?)
    }

    /// Opens DTU's training data: `Cameras/train` (for images a quarter of the size), `Cameras/pair.txt`,
    /// `Rectified/scanN_train` with seven lights each, and `Depths_raw/scanN` or `Depths/scanN_train`.
    pub fn open_dtu(root: &Path, split: DtuSplit) -> Result<Self, DataSetError> {
        Self::of_scenes(root, dtu::scenes(root, split)?)
    }

    fn of_scenes(root: &Path, scenes: Vec<SceneFiles>) -> Result<Self, DataSetError> {
        let mut entries = Vec::new();
        for (scene, files) in scenes.iter().enumerate() {
            for (view, files) in files.views.iter().enumerate() {
                if files.depth.is_some() && !files.sources.is_empty() {
                    entries.extend((0..files.images.len()).map(|image| (scene, view, image)));
                }
            }
        }
        if entries.is_empty() {
            return Err(DataSetError::NoSamples { path: root.to_owned() });
        }
        Ok(Self { scenes, entries })
    }

    /// Number of samples: reference views times lights.
    pub fn len(&self) -> usize {
        self.entries.len()
    }

    /// Never: a data set without samples is not opened.
    pub fn is_empty(&self) -> bool {
        self.entries.is_empty()
    }

    /// Reads a sample. Images are scaled until they cover the size asked for, and cropped where `seed`
    /// says. With fewer sources than asked for, the last stands for the missing ones.
    ///
    /// Depth is taken from the nearest pixel of the map, and left out where no source sees it: outside
    /// of all of them, or hidden by what their own maps show.
    ///
    /// # Panics
    /// When `index` is not below [`Self::len`] or the shape has no pixels.
    pub fn sample(
        &self,
        index: usize,
        shape: &SampleShape,
        seed: u64,
    ) -> Result<TrainingSample, DataSetError> {
        let (scene, reference, light) = self.entries[index];
        let files = &self.scenes[scene].views;
        let mut chosen = vec![&files[reference]];
        let sources = &files[reference].sources;
        chosen.extend((0..shape.views.max(2) - 1).map(|i| &files[sources[i.min(sources.len() - 1)]]));
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let crop = [rng.random_range(0.0..1.0), rng.random_range(0.0..1.0)];
        let fits: Vec<Fit> = chosen.iter().map(|view| Fit::new(&view.camera, shape, crop)).collect();
        let mut views = Vec::new();
        for (view, fit) in chosen.iter().zip(&fits) {
            let path = &view.images[light.min(view.images.len() - 1)];
            let working = fit.image(read_image(path)?);
            views.push(working.map_err(|source| DataSetError::Prepare { path: path.clone(), source })?);
        }
        let maps: Vec<Option<Raster<f32>>> = chosen
            .iter()
            .map(|view| view.depth.as_ref().map(|path| read_depth_pfm(path)).transpose())
            .collect::<Result<_, _>>()?;
        let depth = fit::depth(&chosen, &fits, &maps);
        let range = chosen[0].range.or_else(|| fit::range(&depth));
        let path = chosen[0].depth.clone().unwrap_or_default();
        match range {
            Some(range) if depth.values().iter().any(|d| *d > 0.0) => {
                Ok(TrainingSample { views, depth, range })
            }
            _ => Err(DataSetError::NoDepth { path }),
        }
    }
}
