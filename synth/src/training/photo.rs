//! Photographs as textures, at all sizes.

use std::sync::OnceLock;

use planesweep_scene::Raster;

use crate::noise::lerp;
use crate::texture::Rgb;

/// A photograph with its reductions by two, four and so on, for sampling without aliasing.
#[derive(Clone, Debug, PartialEq)]
pub struct Photo {
    /// The largest first; each is half the one before.
    levels: Vec<Raster<[u8; 3]>>,
}

impl Photo {
    /// Reduces the image until one side is a pixel.
    ///
    /// # Panics
    /// When the image is empty.
    pub fn new(image: Raster<[u8; 3]>) -> Self {
        assert!(image.width() > 0 && image.height() > 0, "a photograph has pixels");
        let mut levels = vec![image];
        loop {
            let last = &levels[levels.len() - 1];
            let (width, height) = (last.width() / 2, last.height() / 2);
            if width == 0 || height == 0 {
                return Self { levels };
            }
            let half = Raster::from_fn(width, height, |x, y| {
                let four = [(0, 0), (1, 0), (0, 1), (1, 1)].map(|(dx, dy)| last.at(2 * x + dx, 2 * y + dy));
                std::array::from_fn(|c| (four.iter().map(|p| u32::from(p[c])).sum::<u32>() / 4) as u8)
            });
            levels.push(half);
        }
    }

    /// Rows over columns.
    pub fn aspect(&self) -> f32 {
        self.levels[0].height() as f32 / self.levels[0].width() as f32
    }

    /// The mean colour, linear.
    pub fn mean(&self) -> Rgb {
        self.levels[self.levels.len() - 1].at(0, 0).map(linear)
    }

    /// The linear colour at (u, v), both 0 to 1 over the photograph with v upwards, where a pixel covers
    /// `footprint` of its width. Beyond its borders the photograph repeats, mirrored or not.
    pub fn color(&self, u: f32, v: f32, footprint: f32, mirrored: bool) -> Rgb {
        let texels = footprint * self.levels[0].width() as f32;
        let level = texels.max(1.0).log2().round() as usize;
        let level = &self.levels[level.min(self.levels.len() - 1)];
        let (width, height) = (level.width(), level.height());
        let wrap = |t: f32| {
            let t = if t.is_finite() { t } else { 0.0 };
            if mirrored { 1.0 - (t.rem_euclid(2.0) - 1.0).abs() } else { t.rem_euclid(1.0) }
        };
        let x = (wrap(u) * width as f32 - 0.5).clamp(0.0, (width - 1) as f32);
        let y = ((1.0 - wrap(v)) * height as f32 - 0.5).clamp(0.0, (height - 1) as f32);
        let (left, top) = (x as usize, y as usize);
        let (right, bottom) = ((left + 1).min(width - 1), (top + 1).min(height - 1));
        let (fx, fy) = (x - left as f32, y - top as f32);
        let [a, b, c, d] = [(left, top), (right, top), (left, bottom), (right, bottom)]
            .map(|(x, y)| level.at(x, y).map(linear));
        std::array::from_fn(|i| lerp(lerp(a[i], b[i], fx), lerp(c[i], d[i], fx), fy))
    }
}

/// Undoes the sRGB curve.
fn linear(byte: u8) -> f32 {
    static TABLE: OnceLock<[f32; 256]> = OnceLock::new();
    let table = TABLE.get_or_init(|| {
        std::array::from_fn(|i| {
            let srgb = i as f32 / 255.0;
            if srgb <= 0.04045 { srgb / 12.92 } else { ((srgb + 0.055) / 1.055).powf(2.4) }
        })
    });
    table[byte as usize]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_found_and_borders_repeat() {
        let photo = Photo::new(Raster::from_fn(4, 4, |x, y| [(60 * x) as u8, (60 * y) as u8, 0]));
        let at = |u: f32, v: f32, mirrored| photo.color(u, v, 0.0, mirrored);
        // The middle of the second column and, v being upwards, of the top row.
        assert_eq!(at(0.375, 0.875, false), [linear(60), linear(0), 0.0]);
        assert_eq!(at(1.375, -0.125, false), [linear(60), linear(0), 0.0]);
        assert_eq!(at(1.625, 0.875, true), [linear(60), linear(0), 0.0]);
        assert_eq!(photo.color(0.2, 0.3, 9.0, false), photo.mean());
    }
}
