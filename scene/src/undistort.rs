//! From the image of a lens to that of a pinhole camera.

use rayon::prelude::*;

use crate::{Distortion, Intrinsics, Raster};

/// How much smaller, and how much larger, than the stored image the undistorted one may be.
const SCALES: (f64, f64) = (0.2, 2.0);

/// The pinhole camera of the undistorted image: the focal lengths of the stored one, and the largest
/// field of view in which no pixel is blank, as COLMAP chooses it.
///
/// The border of the stored image is undistorted. On either axis the field of view is scaled, about
/// the principal point, such that the undistorted border nearest to the centre becomes the new
/// border; the scale is kept within 0.2 and 2. Without a lens the camera stays what it is.
pub fn undistorted_intrinsics(stored: &Intrinsics, distortion: &Distortion) -> Intrinsics {
    if *distortion == Distortion::None {
        return *stored;
    }
    let (right, bottom) = (stored.width - 1, stored.height - 1);
    let undistorted = |column: u32, row: u32| {
        let y = (row as f64 - stored.cy) / stored.fy;
        let x = (column as f64 - stored.cx - stored.skew * y) / stored.fx;
        let (x, y) = distortion.undistort(x, y)?;
        Some((stored.fx * x + stored.skew * y, stored.fy * y))
    };
    // Distances from the principal point; what cannot be undistorted is no border.
    let columns = |column: u32| (0..=bottom).filter_map(move |row| Some(undistorted(column, row)?.0));
    let rows = |row: u32| (0..=right).filter_map(move |column| Some(undistorted(column, row)?.1));
    let nearest = |border: &mut dyn Iterator<Item = f64>| border.fold(f64::INFINITY, f64::min);
    let left = nearest(&mut columns(0).map(|x| -x));
    let right = nearest(&mut columns(right));
    let top = nearest(&mut rows(0).map(|y| -y));
    let bottom = nearest(&mut rows(bottom));
    let (width, cx) = scaled_side(stored.width, stored.cx, left, right);
    let (height, cy) = scaled_side(stored.height, stored.cy, top, bottom);
    Intrinsics { width, height, cx, cy, ..*stored }
}

/// The pixels of a side and the principal point on it, when the borders come to lie at distances
/// `before` and `after` from the principal point.
fn scaled_side(pixels: u32, centre: f64, before: f64, after: f64) -> (u32, f64) {
    let size = pixels as f64;
    // From the principal point to the edge of the image before it, and to the last pixel's centre.
    let (to_start, to_end) = (centre + 0.5, size - 1.0 - centre);
    let scale = 1.0 / (to_start / before).max(to_end / after);
    // A border that is nowhere in front of the camera is as good as one that is very far.
    let scale = if scale.is_nan() { 1.0 } else { scale.clamp(SCALES.0, SCALES.1) };
    let scaled = (scale * size).max(1.0).floor();
    (scaled as u32, (centre + 0.5) * scaled / size - 0.5)
}

/// The image of the camera `pinhole`, which stands where that of `stored` does; bilinear, black outside.
pub(crate) fn resampled(
    stored: &Raster<[u8; 3]>,
    k: &Intrinsics,
    distortion: &Distortion,
    pinhole: &Intrinsics,
) -> Raster<[u8; 3]> {
    let (width, height) = (pinhole.width as usize, pinhole.height as usize);
    let fold = distortion.fold_radius().powi(2);
    let mut pixels = vec![[0; 3]; width * height];
    pixels.par_chunks_mut(width).enumerate().for_each(|(row, line)| {
        let y = (row as f64 - pinhole.cy) / pinhole.fy;
        for (column, pixel) in line.iter_mut().enumerate() {
            let x = (column as f64 - pinhole.cx - pinhole.skew * y) / pinhole.fx;
            if x * x + y * y < fold {
                let (xd, yd) = distortion.distort(x, y);
                *pixel = bilinear(stored, k.fx * xd + k.skew * yd + k.cx, k.fy * yd + k.cy);
            }
        }
    });
    Raster::new(width, height, pixels).expect("the pixels were made for this size")
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::distortion::tests::lens;

    fn stored() -> Intrinsics {
        Intrinsics { width: 160, height: 120, fx: 140.0, fy: 144.0, skew: 0.0, cx: 77.0, cy: 63.5 }
    }

    #[test]
    fn without_a_lens_nothing_changes() {
        assert_eq!(undistorted_intrinsics(&stored(), &Distortion::None), stored());
    }

    #[test]
    fn what_has_no_border_gets_the_largest_field_of_view() {
        // Every border pixel of this fisheye lies behind the camera.
        let lens = Distortion::Fisheye { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 };
        let wide = Intrinsics { fx: 20.0, fy: 20.0, ..stored() };
        let pinhole = undistorted_intrinsics(&wide, &lens);
        assert_eq!((pinhole.width, pinhole.height), (320, 240));
    }

    proptest! {
        #[test]
        fn no_pixel_of_the_undistorted_image_is_blank(lens in lens()) {
            let (stored, pinhole) = (stored(), undistorted_intrinsics(&stored(), &lens));
            let clamped = pinhole.width == 320 || pinhole.height == 240;
            prop_assume!(!clamped);
            let (width, height) = (pinhole.width as f64, pinhole.height as f64);
            for k in 0..=100 {
                let t = k as f64 / 100.0;
                let (column, row) = (t * (width - 1.0), t * (height - 1.0));
                for (column, row) in [(column, 0.0), (column, height - 1.0), (0.0, row), (width - 1.0, row)] {
                    let (x, y) = ((column - pinhole.cx) / pinhole.fx, (row - pinhole.cy) / pinhole.fy);
                    let (x, y) = lens.distort(x, y);
                    let (x, y) = (stored.fx * x + stored.cx, stored.fy * y + stored.cy);
                    // The size is a whole number of pixels, and the principal point follows it.
                    prop_assert!(x > -1.0 && y > -1.0 && x < 160.0 && y < 120.0, "{x}, {y} of {lens:?}");
                }
            }
        }
    }
}
