//! What every implementation of the network offers.

use std::ops::Range;

use planesweep_scene::{Camera, DepthHypotheses, DepthMap, Raster, WorkingImage};
use thiserror::Error;

/// One inference: a reference image, its sources, and the planes to sweep.
#[derive(Clone, Copy, Debug)]
pub struct InferInput<'a> {
    /// The reference image, not padded.
    pub reference: &'a WorkingImage,
    /// The source images, best first; at least one; sizes may differ.
    pub sources: &'a [&'a WorkingImage],
    /// Depth planes of the reference camera.
    pub hypotheses: &'a DepthHypotheses,
}

/// What a backend says of itself.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BackendInfo {
    /// For example "torch" or "analytic".
    pub name: String,
    /// For example "cpu" or "cuda:0".
    pub device: String,
}

/// Why an inference gave no depth map.
#[derive(Debug, Error)]
pub enum InferError {
    /// There is no source image.
    #[error("cannot infer depth without a source image")]
    NoSources,
    /// The matrix of the reference camera has no inverse.
    #[error("cannot invert the reference camera")]
    SingularCamera,
    /// A pixel was asked for that the depth map does not have.
    #[error("pixel ({x}, {y}) is outside the depth map of {width}x{height}")]
    PixelOutside {
        /// Column.
        x: usize,
        /// Row.
        y: usize,
        /// Columns of the depth map.
        width: usize,
        /// Rows of the depth map.
        height: usize,
    },
    /// Memory did not suffice; a smaller setting may.
    #[error("out of memory on {device} while {doing}")]
    OutOfMemory {
        /// The device.
        device: String,
        /// The step of the network.
        doing: &'static str,
    },
    /// The tensor library failed.
    #[error("{doing} failed on {device}: {message}")]
    Library {
        /// The step of the network.
        doing: &'static str,
        /// The device.
        device: String,
        /// What the library said.
        message: String,
    },
}

/// An implementation of the network. One OS thread owns it for as long as it lives.
pub trait DepthBackend {
    /// Name and device.
    fn info(&self) -> BackendInfo;

    /// Infers depth and confidence at a quarter of the reference image's size (rounded up), with the
    /// colours of the reference image sampled there.
    fn infer(&mut self, input: InferInput<'_>) -> Result<DepthMap, InferError>;

    /// Infers only some rows of the depth map: the same values as [`DepthBackend::infer`] gives there, bit for
    /// bit, with the camera of those rows. A backend that knows no bands infers all of it.
    fn infer_rows(&mut self, input: InferInput<'_>, rows: Range<usize>) -> Result<DepthMap, InferError> {
        check_rows(input, &rows)?;
        Ok(self.infer(input)?.rows(&rows))
    }
}

/// Refuses rows that the depth map of the reference does not have.
pub(crate) fn check_rows(input: InferInput<'_>, rows: &Range<usize>) -> Result<(), InferError> {
    let pixels = &input.reference.pixels;
    let (width, height) = (pixels.width().div_ceil(4), pixels.height().div_ceil(4));
    if rows.start < rows.end && rows.end <= height {
        return Ok(());
    }
    Err(InferError::PixelOutside { x: 0, y: rows.end.max(1) - 1, width, height })
}

/// The camera of an image's depth map, whose pixel `u` is centred on image pixel `4u`.
pub(crate) fn quarter_camera(image: &WorkingImage) -> Camera {
    let (width, height) = (image.pixels.width() as u32, image.pixels.height() as u32);
    Camera { intrinsics: image.camera.intrinsics.with_size(width, height).quartered(), ..image.camera }
}

/// The camera of an image's depth map, and the image's colours there.
pub(crate) fn quarter(image: &WorkingImage) -> (Camera, Raster<[u8; 3]>) {
    let camera = quarter_camera(image);
    let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
    (camera, image.map_colors(width, height))
}

/// What holds for every backend.
#[cfg(test)]
pub(crate) mod conformance {
    use nalgebra::{Point3, Vector3};
    use planesweep_scene::{Intrinsics, Pose, Sampling};

    use super::*;

    /// A reference image and sources that look along z from near the origin at depths 2 to 8.
    pub(crate) struct Images {
        pub(crate) reference: WorkingImage,
        pub(crate) sources: Vec<WorkingImage>,
        pub(crate) hypotheses: DepthHypotheses,
    }

    impl Images {
        /// A reference of this size, one source of the same size, one of another.
        pub(crate) fn new(width: usize, height: usize, sampling: Sampling) -> Self {
            Self {
                reference: image(width, height, 0.0),
                sources: vec![image(width, height, 0.3), image(width + 21, height + 8, -0.2)],
                hypotheses: DepthHypotheses::new(sampling, 2.0, 8.0, 16).expect("a valid range"),
            }
        }

        pub(crate) fn infer(&self, backend: &mut dyn DepthBackend) -> Result<DepthMap, InferError> {
            let sources: Vec<_> = self.sources.iter().collect();
            backend.infer(InferInput {
                reference: &self.reference,
                sources: &sources,
                hypotheses: &self.hypotheses,
            })
        }
    }

    fn image(width: usize, height: usize, x: f64) -> WorkingImage {
        let (fx, cx, cy) = (80.0, width as f64 / 2.0, height as f64 / 2.0);
        let intrinsics =
            Intrinsics { width: width as u32, height: height as u32, fx, fy: fx, skew: 0.0, cx, cy };
        let pose = Pose::look_at(&Point3::new(x, 0.0, 0.0), &Point3::new(0.0, 0.0, 4.0), &-Vector3::y());
        let shift = (20.0 * x) as usize + 50;
        let pixels = Raster::from_fn(width, height, |x, y| {
            let (x, y) = (x + shift, y);
            [(x * x / 7 + y) as u8, ((x * 5) ^ (y * 3)) as u8, (y * y / 5 + 2 * x) as u8]
        });
        WorkingImage { camera: Camera { intrinsics, pose }, pixels }
    }

    /// Sizes, camera, colours, ranges, determinism, and the error without sources.
    pub(crate) fn check(backend: &mut dyn DepthBackend) {
        for (width, height, sampling) in
            [(64, 64, Sampling::Uniform), (90, 70, Sampling::Inverse), (33, 47, Sampling::Uniform)]
        {
            let images = Images::new(width, height, sampling);
            let map = images.infer(backend).expect("a depth map");
            assert_eq!((map.width(), map.height()), (width.div_ceil(4), height.div_ceil(4)));
            let camera = images.reference.camera;
            assert_eq!(map.camera, Camera { intrinsics: camera.intrinsics.quartered(), ..camera });
            let colors = map.color.map(|[r, g, b, _]| [*r, *g, *b]);
            assert_eq!(colors, images.reference.map_colors(map.width(), map.height()));
            let range = 2.0 - 1e-5..=8.0 + 1e-5;
            assert!(map.depth.values().iter().all(|depth| *depth == 0.0 || range.contains(depth)));
            assert!(map.depth.values().iter().any(|depth| *depth > 0.0));
            assert!(map.confidence.values().iter().all(|confidence| (0.0..=1.0).contains(confidence)));
            assert_eq!(images.infer(backend).expect("a depth map"), map);
        }
        let mut images = Images::new(64, 64, Sampling::Uniform);
        images.sources.clear();
        assert!(matches!(images.infer(backend), Err(InferError::NoSources)));
        assert!(!backend.info().name.is_empty());
    }
}
