//! The input and output of multi-view stereo: cameras, views, sparse points, images, depth maps.
//!
//! Every other crate speaks in these types, and their conventions hold everywhere:
//!
//! - A pose is world-to-camera: `x_cam = R x_world + t`, OpenCV axes (x right, y down, z forward).
//!   The centre is `c = -R^T t`. Depth is z in the camera frame, in scene units.
//! - Pixel centres are at integers: the top-left pixel's centre is (0, 0). Readers of formats that
//!   put it at (0.5, 0.5) subtract 0.5 from the principal point, writers add it.
//! - A camera carries the size of the image it belongs to. Resizing by `s` maps
//!   `x' = s (x + 0.5) - 0.5`, see [`Intrinsics::resized`].
//! - A feature map is a quarter of its image and centres its pixel `u` on image pixel `4u`, so its
//!   camera is exactly `K` with the first two rows divided by four, see [`Intrinsics::quartered`].
//! - Invalid depth is 0; confidence lies in `[0, 1]`.
//! - Views are addressed by [`ViewId`] and by name, never by their position in a list.

#![warn(missing_docs)]

mod camera;
mod depth_files;
mod depth_map;
mod distortion;
mod hypotheses;
mod ids;
mod image;
mod jpeg;
mod pfm;
mod raster;
mod read;
mod reasons;
mod scene;
mod stitch;
mod training_sample;
mod undistort;
mod upsample;
mod working_image;
mod write;

pub use camera::{Camera, CameraError, Intrinsics, Pose};
pub use depth_files::{DepthFiles, DepthFilesError, MapGeometry, find_depth_files, find_mask};
pub use depth_map::{DepthMap, DepthMapError, in_255ths};
pub use distortion::Distortion;
pub use hypotheses::{DepthHypotheses, HypothesesError, Sampling};
pub use ids::ViewId;
pub use image::{ImageError, MAX_PIXELS, SizeMismatch, decode_image, fit_to_image, image_size, read_image};
pub use pfm::{PfmError, PfmFormatError, decode_pfm, encode_pfm, read_depth_pfm, read_pfm, write_pfm};
pub use raster::{Raster, RasterError};
pub use read::{
    DepthLine, NameError, PixelCentre, ReadError, ReadOptions, ResolveError, SceneFormat, ViewError,
    read_mvsnet_cam, read_mvsnet_pairs, read_scene, resolve_inside, safe_name, scenes_below,
};
pub use reasons::first_reasons;
pub use scene::{DepthRange, Scene, SourceScore, SparsePoints, View, Warning};
pub use stitch::StitchError;
pub use training_sample::TrainingSample;
pub use undistort::undistorted_intrinsics;
pub use working_image::{PrepareError, WorkingImage};
pub use write::{
    Held, TargetFormat, WriteError, held, mvsnet_cam_text, mvsnet_pair_text, write_atomically, write_colmap,
    write_colmap_array, write_colmap_text, write_colmap_workspace, write_mvsnet, write_openmvg, write_scene,
};
