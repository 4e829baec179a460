//! From pixels to what the network reads.

use planesweep_scene::Raster;

use crate::Normalization;

/// The network halves its input five times (twice in the features, three times in the regularisation).
pub(crate) const SIZE_MULTIPLE: usize = 32;

/// A normalised image: three planes (red, green, blue), padded right and bottom with zeros to multiples of
/// [`SIZE_MULTIPLE`].
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct InputImage {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) planes: Vec<f32>,
}

impl InputImage {
    /// Normalises with the statistics of the image itself, then pads.
    pub(crate) fn new(pixels: &Raster<[u8; 3]>, normalization: Normalization) -> Self {
        let width = pixels.width().next_multiple_of(SIZE_MULTIPLE);
        let height = pixels.height().next_multiple_of(SIZE_MULTIPLE);
        let mut planes = vec![0.0; 3 * width * height];
        for channel in 0..3 {
            // A byte has 256 values, so normalisation is a table.
            let table = match normalization {
                Normalization::UnitRange => std::array::from_fn(|value| (value as f64 / 255.0) as f32),
                Normalization::PerImage => standardized(pixels, channel),
            };
            let plane = &mut planes[channel * width * height..(channel + 1) * width * height];
            for (y, row) in plane.chunks_exact_mut(width).take(pixels.height()).enumerate() {
                for (value, pixel) in row.iter_mut().zip(pixels.row(y)) {
                    *value = table[pixel[channel] as usize];
                }
            }
        }
        Self { width, height, planes }
    }
}

/// Zero mean and unit variance over one channel; all zeros when it has one value only. The sums are of
/// integers, so they are exact and know no order.
fn standardized(pixels: &Raster<[u8; 3]>, channel: usize) -> [f32; 256] {
    let mut histogram = [0u64; 256];
    for pixel in pixels.values() {
        histogram[pixel[channel] as usize] += 1;
    }
    let count = pixels.values().len().max(1) as f64;
    let moment = |power: u32| {
        let sum: u64 = histogram.iter().zip(0u64..).map(|(n, value)| n * value.pow(power)).sum();
        sum as f64 / count
    };
    let mean = moment(1);
    let variance = moment(2) - mean * mean;
    // The smallest variance that two different bytes can have is far above this.
    let scale = if variance > 1e-9 { 1.0 / variance.sqrt() } else { 0.0 };
    std::array::from_fn(|value| ((value as f64 - mean) * scale) as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn statistics_come_from_the_unpadded_image_and_padding_is_zero() {
        let pixels = Raster::from_fn(33, 5, |x, y| [(7 * x + y) as u8, 9, (x * x) as u8]);
        let input = InputImage::new(&pixels, Normalization::PerImage);
        assert_eq!((input.width, input.height), (64, 32));
        let red = &input.planes[..64 * 32];
        let inside: Vec<f64> = (0..5).flat_map(|y| &red[y * 64..y * 64 + 33]).map(|v| *v as f64).collect();
        let mean = inside.iter().sum::<f64>() / inside.len() as f64;
        let variance = inside.iter().map(|v| v * v).sum::<f64>() / inside.len() as f64 - mean * mean;
        assert!(mean.abs() < 1e-6 && (variance - 1.0).abs() < 1e-6);
        assert!(red[33..64].iter().chain(&red[5 * 64..]).all(|v| *v == 0.0));
        // A channel of one value has no scale.
        assert!(input.planes[64 * 32..2 * 64 * 32].iter().all(|v| *v == 0.0));
    }

    #[test]
    fn unit_range_divides_by_255() {
        let pixels = Raster::from_fn(32, 32, |x, _| [255, 0, x as u8]);
        let input = InputImage::new(&pixels, Normalization::UnitRange);
        assert_eq!((input.planes[0], input.planes[1024], input.planes[2048 + 3]), (1.0, 0.0, 3.0 / 255.0));
    }
}
