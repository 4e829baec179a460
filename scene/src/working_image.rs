//! The image as the network wants it.

use std::ops::RangeInclusive;

use fast_image_resize::images::{TypedImage, TypedImageRef};
use fast_image_resize::pixels::U8x3;
use fast_image_resize::{FilterType, ResizeAlg, ResizeOptions, Resizer};
use thiserror::Error;

use crate::undistort::resampled;
use crate::{Camera, Distortion, Raster, undistorted_intrinsics};

/// An undistorted image at working size with its pinhole camera.
#[derive(Clone, Debug, PartialEq)]
pub struct WorkingImage {
    /// The camera of these pixels; its size is theirs.
    pub camera: Camera,
    /// RGB.
    pub pixels: Raster<[u8; 3]>,
}

/// Why an image could not be prepared.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum PrepareError {
    /// The pixels are not those of the camera.
    #[error("image is {width}x{height}, its camera {camera_width}x{camera_height}")]
    SizeMismatch {
        /// Columns of the image.
        width: usize,
        /// Rows of the image.
        height: usize,
        /// Columns the camera states.
        camera_width: u32,
        /// Rows the camera states.
        camera_height: u32,
    },
    /// The working size has no pixels.
    #[error("working size {width}x{height} is empty")]
    EmptyWorkingSize {
        /// Columns asked for.
        width: u32,
        /// Rows asked for.
        height: u32,
    },
}

impl WorkingImage {
    /// Undistorts a stored image, then resizes it to `width` by `height`.
    ///
    /// `camera` is the camera of the stored image. The undistorted one has the focal lengths of it
    /// and the size that [`undistorted_intrinsics`] gives; what the lens did not see is black.
    /// Resizing averages over all pixels that fall into one (a triangle filter as wide as the
    /// reduction), so nothing aliases.
    pub fn prepare(
        stored: Raster<[u8; 3]>,
        camera: &Camera,
        distortion: &Distortion,
        width: u32,
        height: u32,
    ) -> Result<Self, PrepareError> {
        let intrinsics = &camera.intrinsics;
        if (stored.width(), stored.height()) != (intrinsics.width as usize, intrinsics.height as usize) {
            return Err(PrepareError::SizeMismatch {
                width: stored.width(),
                height: stored.height(),
                camera_width: intrinsics.width,
                camera_height: intrinsics.height,
            });
        }
        if width == 0 || height == 0 {
            return Err(PrepareError::EmptyWorkingSize { width, height });
        }
        let pinhole = undistorted_intrinsics(intrinsics, distortion);
        let camera = Camera { intrinsics: pinhole.resized(width, height), pose: camera.pose };
        let pinhole = match distortion {
            Distortion::None => stored,
            _ => resampled(&stored, intrinsics, distortion, &pinhole),
        };
        Ok(Self { camera, pixels: resized(pinhole, width, height) })
    }

    /// The colours of the network's maps, `width` by `height`: pixel `u` of a map is centred on
    /// image pixel `4u`, and its colour is the mean of the 3x3 pixels there, as far as they lie in
    /// the image. Pixels of the map beyond the image (its padding) repeat the border.
    pub fn map_colors(&self, width: usize, height: usize) -> Raster<[u8; 3]> {
        let window = |u: usize, size: usize| {
            let centre = (4 * u).min(size - 1);
            centre.saturating_sub(1)..=(centre + 1).min(size - 1)
        };
        let (columns, rows) = (self.pixels.width(), self.pixels.height());
        Raster::from_fn(width, height, |x, y| mean(&self.pixels, window(x, columns), window(y, rows)))
    }
}

fn mean(pixels: &Raster<[u8; 3]>, columns: RangeInclusive<usize>, rows: RangeInclusive<usize>) -> [u8; 3] {
    let mut sum = [0_u32; 3];
    let mut count = 0;
    for y in rows {
        for pixel in &pixels.row(y)[columns.clone()] {
            count += 1;
            for (total, value) in sum.iter_mut().zip(pixel) {
                *total += *value as u32;
            }
        }
    }
    sum.map(|total| ((total + count / 2) / count) as u8)
}

fn resized(image: Raster<[u8; 3]>, width: u32, height: u32) -> Raster<[u8; 3]> {
    let (from_width, from_height) = (image.width() as u32, image.height() as u32);
    if (from_width, from_height) == (width, height) {
        return image;
    }
    let source = TypedImageRef::<U8x3>::from_buffer(from_width, from_height, image.values().as_flattened())
        .expect("a raster has the bytes of its size");
    let mut pixels = vec![[0; 3]; width as usize * height as usize];
    let mut target = TypedImage::<U8x3>::from_buffer(width, height, pixels.as_flattened_mut())
        .expect("the pixels were made for this size");
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
    Resizer::new()
        .resize_typed(&source, &mut target, &options)
        .expect("the whole source is a valid crop of itself");
    Raster::new(width as usize, height as usize, pixels).expect("the pixels were made for this size")
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Point2, Vector3};
    use proptest::prelude::*;

    use super::*;
    use crate::distortion::tests::lens;
    use crate::{Intrinsics, Pose};

    fn camera(width: u32, height: u32) -> Camera {
        let intrinsics = Intrinsics {
            width,
            height,
            fx: 0.9 * width as f64,
            fy: 0.92 * width as f64,
            skew: 0.3,
            cx: 0.48 * width as f64,
            cy: 0.53 * height as f64,
        };
        Camera { intrinsics, pose: Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() } }
    }

    /// A smooth picture on the plane of normalised coordinates.
    fn pattern(x: f64, y: f64) -> f64 {
        128.0 + 60.0 * (5.0 * x).sin() + 50.0 * (4.0 * y + 1.0).cos()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn undistorting_gives_back_the_pattern(lens in lens()) {
            let camera = camera(160, 120);
            let k = camera.intrinsics;
            let stored = Raster::from_fn(160, 120, |column, row| {
                let p = k.unproject(&Point2::new(column as f64, row as f64), 1.0);
                // Where the lens shows nothing any value does: no undistorted pixel comes from there.
                let (x, y) = lens.undistort(p.x, p.y).unwrap_or((0.0, 0.0));
                [pattern(x, y).round() as u8; 3]
            });
            let pinhole = undistorted_intrinsics(&k, &lens);
            let (width, height) = (pinhole.width, pinhole.height);
            let image = WorkingImage::prepare(stored, &camera, &lens, width, height).expect("sizes agree");
            prop_assert_eq!(image.camera.intrinsics, pinhole);
            let mut total = 0.0;
            for row in 0..height as usize {
                for column in 0..width as usize {
                    let p = pinhole.unproject(&Point2::new(column as f64, row as f64), 1.0);
                    // Half a grey level of rounding on either side, and the curvature between pixels.
                    let error = (image.pixels.at(column, row)[1] as f64 - pattern(p.x, p.y)).abs();
                    let border = column < 2 || row < 2 || column + 3 > width as usize || row + 3 > height as usize;
                    prop_assert!(error < if border { 8.0 } else { 1.6 }, "{error} at {column}, {row}");
                    total += error;
                }
            }
            prop_assert!(total / ((width * height) as f64) < 0.6);
        }

        #[test]
        fn resizing_keeps_a_ramp(width in 20_u32..=120, height in 20_u32..=90) {
            let stored = Raster::from_fn(120, 90, |x, y| [(2 * x) as u8, (2 * y) as u8, 7]);
            let image = WorkingImage::prepare(stored, &camera(120, 90), &Distortion::None, width, height)
                .expect("sizes agree");
            prop_assert_eq!(image.camera.intrinsics, camera(120, 90).intrinsics.resized(width, height));
            let (sx, sy) = (120.0 / width as f64, 90.0 / height as f64);
            // At the border the filter has no pixels beyond it to average over.
            for y in 2..height as usize - 2 {
                for x in 2..width as usize - 2 {
                    let [red, green, blue] = image.pixels.at(x, y);
                    prop_assert!((red as f64 - 2.0 * ((x as f64 + 0.5) * sx - 0.5)).abs() <= 1.0);
                    prop_assert!((green as f64 - 2.0 * ((y as f64 + 0.5) * sy - 0.5)).abs() <= 1.0);
                    prop_assert_eq!(blue, 7);
                }
            }
        }
    }

    #[test]
    fn reducing_a_checkerboard_gives_its_mean() {
        let stored = Raster::from_fn(120, 90, |x, y| [if (x + y) % 2 == 0 { 200 } else { 100 }; 3]);
        let image =
            WorkingImage::prepare(stored, &camera(120, 90), &Distortion::None, 30, 30).expect("sizes agree");
        let worst = image.pixels.values().iter().map(|p| p[0].abs_diff(150)).max();
        assert!(worst <= Some(3), "{worst:?}");
    }

    #[test]
    fn an_image_of_working_size_is_not_touched() {
        let stored = Raster::from_fn(9, 7, |x, y| [x as u8, y as u8, 3]);
        let image = WorkingImage::prepare(stored.clone(), &camera(9, 7), &Distortion::None, 9, 7);
        assert_eq!(image, Ok(WorkingImage { camera: camera(9, 7), pixels: stored }));
    }

    #[test]
    fn a_strong_barrel_does_not_show_its_border_twice() {
        let lens = Distortion::Radial { k1: -1.0, k2: 0.0 };
        let white = Raster::filled(160, 120, [255; 3]);
        let pinhole = undistorted_intrinsics(&camera(160, 120).intrinsics, &lens);
        let image = WorkingImage::prepare(white, &camera(160, 120), &lens, pinhole.width, pinhole.height)
            .expect("sizes agree");
        for row in 0..pinhole.height as usize {
            for column in 0..pinhole.width as usize {
                let p = pinhole.unproject(&Point2::new(column as f64, row as f64), 1.0);
                if p.x.hypot(p.y) > (1.0_f64 / 3.0).sqrt() + 1e-3 {
                    assert_eq!(image.pixels.at(column, row), [0; 3]);
                }
            }
        }
    }

    #[test]
    fn map_colours_are_centred_on_every_fourth_pixel() {
        let pixels = Raster::from_fn(10, 6, |x, y| [10 * x as u8, 10 * y as u8, 9]);
        let image = WorkingImage { camera: camera(10, 6), pixels };
        let colors = image.map_colors(4, 2);
        assert_eq!(colors.at(1, 1), [40, 40, 9]);
        assert_eq!(colors.at(0, 0), [5, 5, 9]);
        // Column 2 is centred on pixel 8 of 10, column 3 lies in the padding.
        assert_eq!(colors.at(2, 1), [80, 40, 9]);
        assert_eq!(colors.at(3, 1), [85, 40, 9]);
    }

    #[test]
    fn sizes_are_checked() {
        let pixels = Raster::filled(4, 4, [0; 3]);
        let error = WorkingImage::prepare(pixels.clone(), &camera(5, 4), &Distortion::None, 4, 4);
        assert_eq!(error.expect_err("narrower").to_string(), "image is 4x4, its camera 5x4");
        assert!(WorkingImage::prepare(pixels, &camera(4, 4), &Distortion::None, 0, 4).is_err());
    }
}
