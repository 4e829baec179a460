//! Colours between pixels, and their mean.

use planesweep_scene::Raster;

/// Parts of a pixel that a bilinear weight distinguishes.
const PARTS: u32 = 256;

/// A running mean of colours in integers, so that the order of adding changes nothing.
#[derive(Clone, Copy)]
pub(crate) struct ColorMean {
    sums: [u32; 3],
    count: u32,
}

impl ColorMean {
    /// Starts with one colour.
    #[inline]
    pub fn new(color: [u8; 3]) -> Self {
        Self { sums: color.map(|c| c as u32 * PARTS * PARTS), count: 1 }
    }

    /// Adds the colour at `(u, v)`, bilinear, continued outside by the nearest pixel.
    ///
    /// Holds 250 colours and more before a sum overflows; further ones are ignored.
    #[inline]
    pub fn add(&mut self, image: &Raster<[u8; 3]>, u: f32, v: f32) {
        if self.count == 250 {
            return;
        }
        let (x, fx) = split(u, image.width());
        let (y, fy) = split(v, image.height());
        let (right, below) = (usize::from(fx > 0), image.width() * usize::from(fy > 0));
        let start = y * image.width() + x;
        let pixels = image.values();
        let (a, b) = (pixels[start], pixels[start + right]);
        let (c, d) = (pixels[start + below], pixels[start + below + right]);
        for k in 0..3 {
            let top = a[k] as u32 * (PARTS - fx) + b[k] as u32 * fx;
            let bottom = c[k] as u32 * (PARTS - fx) + d[k] as u32 * fx;
            self.sums[k] += top * (PARTS - fy) + bottom * fy;
        }
        self.count += 1;
    }

    /// The mean, rounded to nearest.
    #[inline]
    pub fn color(&self) -> [u8; 3] {
        let whole = self.count * PARTS * PARTS;
        self.sums.map(|sum| ((sum + whole / 2) / whole) as u8)
    }
}

/// The pixel at or before `position` and how many parts of a pixel further it is; 0 at the last pixel.
#[inline]
fn split(position: f32, size: usize) -> (usize, u32) {
    let parts = ((position * PARTS as f32 + 0.5) as u32).min((size as u32 - 1) * PARTS);
    ((parts / PARTS) as usize, parts % PARTS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_are_bilinear_and_continued_outside() {
        let image =
            Raster::new(2, 2, vec![[0, 0, 0], [100, 0, 0], [0, 200, 0], [100, 200, 255]]).expect("2x2");
        let at = |u, v| {
            // A mean of black and the sample, doubled, is the sample.
            let mut mean = ColorMean { sums: [0; 3], count: 0 };
            mean.add(&image, u, v);
            mean.color()
        };
        assert_eq!(at(0.25, 0.5), [25, 100, 32]);
        assert_eq!(at(1.0, 1.0), [100, 200, 255]);
        assert_eq!(at(-0.7, 0.0), [0, 0, 0]);
        assert_eq!(at(1.9, 7.0), [100, 200, 255]);
        assert_eq!(at(f32::NAN, 1.0), [0, 200, 0]);
    }

    #[test]
    fn the_mean_is_rounded_and_never_overflows() {
        let white = Raster::filled(1, 1, [255, 1, 0]);
        let mut mean = ColorMean::new([0, 0, 1]);
        mean.add(&white, 0.0, 0.0);
        assert_eq!(mean.color(), [128, 1, 1]);
        for _ in 0..1000 {
            mean.add(&white, 0.0, 0.0);
        }
        assert_eq!(mean.color(), [254, 1, 0]);
    }
}
