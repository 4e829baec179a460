//! A depth map with its confidence, its colours and its own camera.

use std::ops::RangeInclusive;

use thiserror::Error;

use crate::{Camera, Raster};

/// What counts as a depth. Beyond, squares and sums of depths would not be floats; some programs write the greatest float
/// where they have no depth.
const DEPTHS: RangeInclusive<f32> = 1e-15..=1e15;

/// Depth, confidence and colour of one view, all of one size, with the camera they belong to.
#[derive(Clone, Debug, PartialEq)]
pub struct DepthMap {
    /// The camera of the depth map itself, not of the photograph.
    pub camera: Camera,
    /// Depth (z, scene units); 0 where there is none.
    pub depth: Raster<f32>,
    /// Confidence in `[0, 1]`.
    pub confidence: Raster<f32>,
    /// Red, green and blue of the reference image at each pixel of the depth map, and the confidence once more, in
    /// 255ths: a word for each pixel of what fusion asks a neighbour for beside its depth. Who changes one confidence
    /// changes the other ([`in_255ths`]).
    pub color: Raster<[u8; 4]>,
}

/// Why parts do not make a depth map.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum DepthMapError {
    /// A raster does not have the size of the camera.
    #[error("{part} is {got_width}x{got_height}, its camera {width}x{height}")]
    SizeMismatch {
        /// "depth", "confidence" or "color".
        part: &'static str,
        /// Columns of that part.
        got_width: usize,
        /// Rows of that part.
        got_height: usize,
        /// Columns of the camera.
        width: usize,
        /// Rows of the camera.
        height: usize,
    },
}

impl DepthMap {
    /// Puts the parts together; depths that are not between 1e-15 and 1e15 become invalid (0), and confidence is clamped
    /// to `[0, 1]`.
    pub fn new(
        camera: Camera,
        mut depth: Raster<f32>,
        mut confidence: Raster<f32>,
        color: Raster<[u8; 3]>,
    ) -> Result<Self, DepthMapError> {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        for (part, got_width, got_height) in [
            ("depth", depth.width(), depth.height()),
            ("confidence", confidence.width(), confidence.height()),
            ("color", color.width(), color.height()),
        ] {
            if (got_width, got_height) != (width, height) {
                return Err(DepthMapError::SizeMismatch { part, got_width, got_height, width, height });
            }
        }
        clear_what_is_no_depth(&mut depth);
        for c in confidence.values_mut() {
            *c = if c.is_nan() { 0.0 } else { c.clamp(0.0, 1.0) };
        }
        let color = with_confidence(color.into_values(), &confidence);
        Ok(Self { camera, depth, confidence, color })
    }

    /// Takes away the depth where a mask, stretched over the map, is black.
    pub fn leave_out(&mut self, mask: &Raster<[u8; 3]>) {
        let (width, height) = (self.width(), self.height());
        for (index, depth) in self.depth.values_mut().iter_mut().enumerate() {
            let (x, y) = (index % width, index / width);
            let at = |pixel: usize, size: usize, of: usize| ((2 * pixel + 1) * of / (2 * size)).min(of - 1);
            if mask.at(at(x, width, mask.width()), at(y, height, mask.height())) == [0; 3] {
                *depth = 0.0;
            }
        }
    }

    /// Red, green and blue of a pixel.
    ///
    /// # Panics
    /// When outside the map.
    pub fn rgb(&self, x: usize, y: usize) -> [u8; 3] {
        let [r, g, b, _] = self.color.at(x, y);
        [r, g, b]
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.depth.width()
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.depth.height()
    }
}

/// Makes 0, "no depth", of what is not within [`DEPTHS`].
pub(crate) fn clear_what_is_no_depth(depth: &mut Raster<f32>) {
    for d in depth.values_mut() {
        if !DEPTHS.contains(d) {
            *d = 0.0;
        }
    }
}

/// Colours, and beside each the confidence in 255ths.
///
/// # Panics
/// When there are fewer colours than confidences.
pub(crate) fn with_confidence(
    colors: impl IntoIterator<Item = [u8; 3]>,
    confidence: &Raster<f32>,
) -> Raster<[u8; 4]> {
    let words = colors.into_iter().zip(confidence.values());
    let words = words.map(|([r, g, b], confidence)| [r, g, b, in_255ths(*confidence)]);
    Raster::new(confidence.width(), confidence.height(), words.collect())
        .expect("a colour for each confidence")
}

/// A confidence as the fourth byte of [`DepthMap::color`], rounded: what is less is never more there, what lies outside
/// of [0, 1] becomes the nearer end, and what is no number 0.
pub fn in_255ths(confidence: f32) -> u8 {
    (confidence * 255.0 + 0.5) as u8
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::{Intrinsics, Pose};

    fn camera() -> Camera {
        let intrinsics = Intrinsics { width: 2, height: 2, fx: 1.0, fy: 1.0, skew: 0.0, cx: 0.5, cy: 0.5 };
        Camera { intrinsics, pose: Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() } }
    }

    #[test]
    fn what_is_no_depth_becomes_zero() {
        let depth = Raster::new(2, 2, vec![f32::NAN, -1.0, f32::MAX, 2.0]).expect("2x2");
        let confidence = Raster::new(2, 2, vec![f32::NAN, -1.0, 3.0, 0.5]).expect("2x2");
        let map =
            DepthMap::new(camera(), depth, confidence, Raster::filled(2, 2, [0; 3])).expect("sizes agree");
        assert_eq!(map.depth.values(), [0.0, 0.0, 0.0, 2.0]);
        assert_eq!(map.confidence.values(), [0.0, 0.0, 1.0, 0.5]);
        assert_eq!(map.color.values(), [[0; 4], [0; 4], [0, 0, 0, 255], [0, 0, 0, 128]]);
    }

    #[test]
    fn sizes_must_agree() {
        let error = DepthMap::new(
            camera(),
            Raster::filled(2, 2, 1.0),
            Raster::filled(3, 2, 1.0),
            Raster::filled(2, 2, [0; 3]),
        )
        .expect_err("confidence is wider");
        assert_eq!(error.to_string(), "confidence is 3x2, its camera 2x2");
    }
}
