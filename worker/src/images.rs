//! Working images, decoded once for all the jobs that need them.

use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use planesweep_plan::{BlobKey, ImageSpec, MaskSpec};
use planesweep_scene::{ImageError, PrepareError, Raster, WorkingImage, decode_image};
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use thiserror::Error;

use crate::cache::cache;

/// Why a working image could not be made.
#[derive(Debug, Error)]
pub enum ImagesError {
    /// The file cannot be read.
    #[error("cannot read image {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The file is not the one that was planned with.
    #[error("image {} has changed since the run was planned", path.display())]
    Changed {
        /// The file.
        path: PathBuf,
    },
    /// The file is no image.
    #[error("cannot decode view {name}")]
    Decode {
        /// The view.
        name: String,
        /// What is wrong with it.
        #[source]
        source: ImageError,
    },
    /// The image does not fit its camera.
    #[error("cannot prepare view {name}")]
    Prepare {
        /// The view.
        name: String,
        /// What does not fit.
        #[source]
        source: PrepareError,
    },
}

/// What makes two working images the same; cameras are compared by their bits.
#[derive(Clone, PartialEq, Eq, Hash)]
struct ImageKey {
    file: BlobKey,
    width: u32,
    height: u32,
    lens: String,
}

#[derive(Clone)]
struct ByPixels;

impl Weighter<ImageKey, Arc<WorkingImage>> for ByPixels {
    fn weight(&self, _: &ImageKey, image: &Arc<WorkingImage>) -> u64 {
        image.pixels.values().len() as u64 * 3
    }
}

/// Working images within a budget of bytes.
pub(crate) struct Images {
    cache: Cache<ImageKey, Arc<WorkingImage>, ByPixels>,
}

impl Images {
    pub fn new(budget_bytes: u64) -> Self {
        Self { cache: cache(budget_bytes, ByPixels) }
    }

    /// The working image of a specification; several that ask for the same one wait for one of them.
    pub async fn get(&self, spec: &ImageSpec) -> Result<Arc<WorkingImage>, ImagesError> {
        let key = ImageKey {
            file: spec.hash,
            width: spec.working_width,
            height: spec.working_height,
            lens: format!("{:?} {:?}", spec.camera, spec.distortion),
        };
        let spec = spec.clone();
        let make = async {
            tokio::task::spawn_blocking(move || load(&spec).map(Arc::new))
                .await
                .expect("loading an image does not panic")
        };
        self.cache.get_or_insert_async(&key, make).await
    }
}

/// The mask of a specification.
pub(crate) fn load_mask(spec: &MaskSpec) -> Result<Raster<[u8; 3]>, ImagesError> {
    let bytes = bytes(&spec.path, spec.hash)?;
    let name = || spec.path.display().to_string();
    decode_image(&spec.path, &bytes).map_err(|source| ImagesError::Decode { name: name(), source })
}

/// The bytes of a file, which must be those that the run was planned with.
fn bytes(path: &Path, hash: BlobKey) -> Result<Vec<u8>, ImagesError> {
    let bytes = std::fs::read(path).map_err(|source| ImagesError::Read { path: path.to_owned(), source })?;
    if BlobKey::of(&bytes) == hash { Ok(bytes) } else { Err(ImagesError::Changed { path: path.to_owned() }) }
}

fn load(spec: &ImageSpec) -> Result<WorkingImage, ImagesError> {
    let bytes = bytes(&spec.path, spec.hash)?;
    let name = || spec.name.clone();
    let pixels =
        decode_image(&spec.path, &bytes).map_err(|source| ImagesError::Decode { name: name(), source })?;
    WorkingImage::prepare(pixels, &spec.camera, &spec.distortion, spec.working_width, spec.working_height)
        .map_err(|source| ImagesError::Prepare { name: name(), source })
}
