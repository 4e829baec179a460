//! The image as the network wants it.

use std::ops::RangeInclusive;

use fast_image_resize::images::{TypedImage, TypedImageRef};
use fast_image_resize::pixels::U8x3;
use fast_image_resize::{FilterType, ResizeAlg, ResizeOptions, Resizer};
use rayon::prelude::*;
use thiserror::Error;

use crate::{Camera, Distortion, Intrinsics, Raster};

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
    /// The undistorted image keeps the size and `K` of the stored one, so the camera changes by the
    /// resize alone; what the lens did not see is black. Resizing averages over all pixels that
    /// fall into one (a triangle filter as wide as the reduction), so nothing aliases.
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
        let pinhole = match distortion {
            Distortion::None => stored,
            _ => undistorted(&stored, intrinsics, distortion),
        };
        let camera = Camera { intrinsics: intrinsics.resized(width, height), pose: camera.pose };
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

/// The image of a pinhole camera with the same `K` and size, bilinear, black outside.
fn undistorted(stored: &Raster<[u8; 3]>, k: &Intrinsics, distortion: &Distortion) -> Raster<[u8; 3]> {
    let (width, height) = (stored.width(), stored.height());
    let fold = fold_radius_squared(distortion);
    let mut pixels = vec![[0; 3]; width * height];
    pixels.par_chunks_mut(width).enumerate().for_each(|(row, line)| {
        let y = (row as f64 - k.cy) / k.fy;
        for (column, pixel) in line.iter_mut().enumerate() {
            let x = (column as f64 - k.cx - k.skew * y) / k.fx;
            if x * x + y * y < fold {
                let (xd, yd) = distortion.distort(x, y);
                *pixel = bilinear(stored, k.fx * xd + k.skew * yd + k.cx, k.fy * yd + k.cy);
            }
        }
    });
    Raster::new(width, height, pixels).expect("the pixels were made for this size")
}

/// The squared radius where the radial polynomial stops growing. Beyond it the model folds the
/// image back onto itself and would show its border again, mirrored.
fn fold_radius_squared(distortion: &Distortion) -> f64 {
    let (k1, k2) = match *distortion {
        Distortion::None => (0.0, 0.0),
        Distortion::Radial { k1, k2 } | Distortion::OpenCv { k1, k2, .. } => (k1, k2),
    };
    // The derivative of r (1 + k1 r^2 + k2 r^4) is 1 + 3 k1 r^2 + 5 k2 r^4; its roots in r^2 are
    // 2 / (-3 k1 +- sqrt(9 k1^2 - 20 k2)), a form that holds for k2 = 0 too.
    let root = (9.0 * k1 * k1 - 20.0 * k2).sqrt();
    [2.0 / (-3.0 * k1 + root), 2.0 / (-3.0 * k1 - root)]
        .into_iter()
        .filter(|r2| *r2 > 0.0)
        .fold(f64::INFINITY, f64::min)
}

/// The colour at a position in pixels; the outermost half pixel repeats the border, the rest is black.
#[inline]
fn bilinear(image: &Raster<[u8; 3]>, x: f64, y: f64) -> [u8; 3] {
    let (width, height) = (image.width(), image.height());
    if !(x >= -0.5 && y >= -0.5 && x < width as f64 - 0.5 && y < height as f64 - 0.5) {
        return [0; 3];
    }
    let (x, y) = (x.clamp(0.0, (width - 1) as f64), y.clamp(0.0, (height - 1) as f64));
    let (left, top) = (x as usize, y as usize);
    // Weights in steps of 1/2048: far below a grey level, and integers are faster.
    let (u, v) = (((x - left as f64) * 2048.0) as u32, ((y - top as f64) * 2048.0) as u32);
    let right = usize::from(left + 1 < width);
    let upper = &image.row(top)[left..=left + right];
    let lower = &image.row((top + 1).min(height - 1))[left..=left + right];
    std::array::from_fn(|c| {
        let above = upper[0][c] as u32 * (2048 - u) + upper[right][c] as u32 * u;
        let below = lower[0][c] as u32 * (2048 - u) + lower[right][c] as u32 * u;
        ((above * (2048 - v) + below * v + (1 << 21)) >> 22) as u8
    })
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
    use nalgebra::{Matrix3, Vector3};
    use proptest::prelude::*;

    use super::*;
    use crate::Pose;

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

    /// Solves `distort(p) = target` by fixed-point steps; fine for the mild lenses of these tests.
    fn inverse(distortion: &Distortion, target: (f64, f64)) -> (f64, f64) {
        let mut p = target;
        for _ in 0..60 {
            let (x, y) = distortion.distort(p.0, p.1);
            p = (p.0 + target.0 - x, p.1 + target.1 - y);
        }
        p
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(12))]
        #[test]
        fn undistorting_gives_back_the_pattern(
            k1 in -0.25_f64..0.2, k2 in -0.02_f64..0.05, p1 in -0.004_f64..0.004, p2 in -0.004_f64..0.004,
            tangential in any::<bool>(),
        ) {
            let distortion = if tangential {
                Distortion::OpenCv { k1, k2, p1, p2 }
            } else {
                Distortion::Radial { k1, k2 }
            };
            let camera = camera(160, 120);
            let k = camera.intrinsics;
            let normalised = |column: usize, row: usize| {
                let p = k.unproject(&nalgebra::Point2::new(column as f64, row as f64), 1.0);
                (p.x, p.y)
            };
            let stored = Raster::from_fn(160, 120, |column, row| {
                let (x, y) = inverse(&distortion, normalised(column, row));
                [pattern(x, y).round() as u8; 3]
            });
            let image = WorkingImage::prepare(stored, &camera, &distortion, 160, 120).expect("sizes agree");
            let (mut total, mut count) = (0.0, 0);
            for row in 0..120 {
                for column in 0..160 {
                    let (x, y) = normalised(column, row);
                    let (xd, yd) = distortion.distort(x, y);
                    let (px, py) = (k.fx * xd + k.skew * yd + k.cx, k.fy * yd + k.cy);
                    let value = image.pixels.at(column, row)[1];
                    if px > 0.0 && py > 0.0 && px < 159.0 && py < 119.0 {
                        // Half a grey level of rounding on either side, and the curvature between pixels.
                        let error = (value as f64 - pattern(x, y)).abs();
                        prop_assert!(error < 1.3, "{error} at {column}, {row}");
                        total += error;
                        count += 1;
                    } else if px < -0.5 || py < -0.5 || px > 159.5 || py > 119.5 {
                        prop_assert_eq!(value, 0);
                    }
                }
            }
            prop_assert!(count > 10_000 && total / (count as f64) < 0.5);
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
        assert!((fold_radius_squared(&lens) - 1.0 / 3.0).abs() < 1e-12);
        assert!(fold_radius_squared(&Distortion::Radial { k1: 0.1, k2: 0.0 }) > 1e9);
        assert_eq!(fold_radius_squared(&Distortion::Radial { k1: 0.0, k2: 0.0 }), f64::INFINITY);
        assert!((fold_radius_squared(&Distortion::Radial { k1: 0.0, k2: -0.2 }) - 1.0).abs() < 1e-12);
        let white = Raster::filled(160, 120, [255; 3]);
        let image = WorkingImage::prepare(white, &camera(160, 120), &lens, 160, 120).expect("sizes agree");
        assert_eq!(image.pixels.at(0, 0), [0; 3]);
        assert_eq!(image.pixels.at(80, 60), [255; 3]);
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
