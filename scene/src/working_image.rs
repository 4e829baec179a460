//! The image as the network wants it.

use crate::{Camera, Raster};

/// An undistorted image at working size with its pinhole camera.
#[derive(Clone, Debug, PartialEq)]
pub struct WorkingImage {
    /// The camera of these pixels; its size is theirs.
    pub camera: Camera,
    /// RGB.
    pub pixels: Raster<[u8; 3]>,
}
