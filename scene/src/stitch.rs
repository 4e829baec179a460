//! Depth maps in bands of rows, and whole again.

use std::ops::Range;

use thiserror::Error;

use crate::{Camera, DepthMap, Raster};

/// Why bands do not make a depth map.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum StitchError {
    /// There is none.
    #[error("cannot stitch a depth map of no bands")]
    Empty,
    /// A band does not continue those above it: another width, pose or lens, or rows that are missing.
    #[error("band {band} does not begin where band {} of the same camera ends", band - 1)]
    Gap {
        /// Which one, from the top, counted from 0.
        band: usize,
    },
}

impl DepthMap {
    /// Some rows of the depth map, with their camera.
    ///
    /// # Panics
    /// When the rows are not within the map.
    #[must_use]
    pub fn rows(&self, rows: &Range<usize>) -> Self {
        let width = self.width();
        let pixels = rows.start * width..rows.end * width;
        Self {
            camera: self.camera.rows(rows),
            depth: cut(&self.depth, &pixels),
            confidence: cut(&self.confidence, &pixels),
            color: cut(&self.color, &pixels),
        }
    }

    /// The depth map whose [`DepthMap::rows`] the bands are, from the top: the same bits.
    pub fn stitch(bands: &[Self]) -> Result<Self, StitchError> {
        let first = bands.first().ok_or(StitchError::Empty)?;
        let mut whole = first.camera;
        whole.intrinsics.height = bands.iter().map(|band| band.camera.intrinsics.height).sum();
        let mut begin = 0;
        for (band, part) in bands.iter().enumerate() {
            let rows = begin..begin + part.height();
            if part.camera != whole.rows(&rows) {
                return Err(StitchError::Gap { band });
            }
            begin = rows.end;
        }
        Ok(Self {
            camera: whole,
            depth: join(bands, |band| &band.depth),
            confidence: join(bands, |band| &band.confidence),
            color: join(bands, |band| &band.color),
        })
    }
}

impl Camera {
    /// The camera of some rows of its image.
    #[must_use]
    pub fn rows(mut self, rows: &Range<usize>) -> Self {
        self.intrinsics.height = rows.len() as u32;
        self.intrinsics.cy -= rows.start as f64;
        self
    }
}

fn cut<T: Clone>(raster: &Raster<T>, pixels: &Range<usize>) -> Raster<T> {
    let values = raster.values()[pixels.clone()].to_vec();
    let rows = pixels.len() / raster.width().max(1);
    Raster::new(raster.width(), rows, values).expect("whole rows were cut")
}

fn join<T: Clone>(bands: &[DepthMap], part: impl Fn(&DepthMap) -> &Raster<T>) -> Raster<T> {
    let values: Vec<T> = bands.iter().flat_map(|band| part(band).values().iter().cloned()).collect();
    let height = bands.iter().map(DepthMap::height).sum();
    Raster::new(part(&bands[0]).width(), height, values).expect("bands of one width")
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use proptest::prelude::*;

    use super::*;
    use crate::{Intrinsics, Pose};

    fn map(width: usize, height: usize, cy: f64) -> DepthMap {
        let intrinsics = Intrinsics {
            width: width as u32,
            height: height as u32,
            fx: 300.7,
            fy: 301.3,
            skew: 0.0,
            cx: width as f64 / 2.0,
            cy,
        };
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::new(1.0, 2.0, 3.0) };
        let value = |x: usize, y: usize| (1 + x + 31 * y) as f32;
        DepthMap {
            camera: Camera { intrinsics, pose },
            depth: Raster::from_fn(width, height, value),
            confidence: Raster::from_fn(width, height, |x, y| 1.0 / value(x, y)),
            color: Raster::from_fn(width, height, |x, y| [x as u8, y as u8, 7, 204]),
        }
    }

    proptest! {
        #[test]
        fn stitching_what_was_split_gives_the_same_bits(
            width in 1..9_usize, heights in proptest::collection::vec(1..20_usize, 1..7), cy in -1e4..1e4,
        ) {
            let whole = map(width, heights.iter().sum(), cy);
            let mut begin = 0;
            let bands: Vec<DepthMap> = heights.iter().map(|height| {
                begin += height;
                whole.rows(&(begin - height..begin))
            }).collect();
            prop_assert_eq!(DepthMap::stitch(&bands), Ok(whole));
        }
    }

    #[test]
    fn a_row_of_a_band_sees_what_it_saw_in_the_whole() {
        let whole = map(4, 10, 4.5);
        let band = whole.rows(&(3..8));
        let pixel = |y: f64| nalgebra::Point2::new(2.0, y);
        assert_eq!(band.camera.unproject(&pixel(1.0), 2.0), whole.camera.unproject(&pixel(4.0), 2.0));
        assert_eq!(band.depth.at(2, 1), whole.depth.at(2, 4));
    }

    #[test]
    fn missing_swapped_and_foreign_bands_are_named() {
        let whole = map(4, 12, 5.5);
        let [a, b, c] = [0..4, 4..8, 8..12].map(|rows| whole.rows(&rows));
        assert_eq!(DepthMap::stitch(&[]), Err(StitchError::Empty));
        assert_eq!(DepthMap::stitch(&[a.clone(), c.clone()]), Err(StitchError::Gap { band: 1 }));
        assert_eq!(DepthMap::stitch(&[a.clone(), c, b.clone()]), Err(StitchError::Gap { band: 1 }));
        let wide = map(5, 12, 5.5).rows(&(8..12));
        assert_eq!(DepthMap::stitch(&[a, b, wide]), Err(StitchError::Gap { band: 2 }));
    }
}
