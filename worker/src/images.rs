//! Working images, decoded once for all the jobs that need them.

use std::sync::Arc;

use planesweep_plan::{BlobKey, ImageSpec, MaskSpec};
use planesweep_scene::{ImageError, PrepareError, Raster, WorkingImage, decode_image};
use quick_cache::Weighter;
use quick_cache::sync::Cache;
use thiserror::Error;

use crate::cache::cache;
use crate::files::{FileError, Files};
use crate::jobs::compute;

/// Why a working image could not be made.
#[derive(Debug, Error)]
pub enum ImagesError {
    /// Its bytes cannot be had.
    #[error(transparent)]
    File(#[from] FileError),
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
    files: Files,
    cache: Cache<ImageKey, Arc<WorkingImage>, ByPixels>,
}

impl Images {
    pub fn new(files: Files, budget_bytes: u64) -> Self {
        Self { files, cache: cache(budget_bytes, ByPixels) }
    }

    /// The working image of a specification; several that ask for the same one wait for one of them. Counts
    /// files that come from the store.
    pub async fn get(&self, spec: &ImageSpec, fetched: &mut u32) -> Result<Arc<WorkingImage>, ImagesError> {
        let key = ImageKey {
            file: spec.hash,
            width: spec.working_width,
            height: spec.working_height,
            lens: format!("{:?} {:?}", spec.camera, spec.distortion),
        };
        let spec = spec.clone();
        let make = async {
            let bytes = self.files.get(&spec.path, spec.hash, fetched).await?;
            compute(move || prepare(&spec, &bytes).map(Arc::new)).await
        };
        self.cache.get_or_insert_async(&key, make).await
    }

    /// The mask of a specification; counted as an image.
    pub async fn mask(&self, spec: MaskSpec, fetched: &mut u32) -> Result<Raster<[u8; 3]>, ImagesError> {
        let bytes = self.files.get(&spec.path, spec.hash, fetched).await?;
        compute(move || {
            let name = || spec.path.display().to_string();
            decode_image(&spec.path, &bytes).map_err(|source| ImagesError::Decode { name: name(), source })
        })
        .await
    }
}

fn prepare(spec: &ImageSpec, bytes: &[u8]) -> Result<WorkingImage, ImagesError> {
    let name = || spec.name.clone();
    let pixels =
        decode_image(&spec.path, bytes).map_err(|source| ImagesError::Decode { name: name(), source })?;
    WorkingImage::prepare(pixels, &spec.camera, &spec.distortion, spec.working_width, spec.working_height)
        .map_err(|source| ImagesError::Prepare { name: name(), source })
}
