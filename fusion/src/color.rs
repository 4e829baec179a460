//! Colours between pixels.

use planesweep_scene::Raster;

/// A sum of colours, with a fourth lane that fills the register and means nothing.
pub(crate) type ColorSum = [f32; 4];

/// The sum that holds one colour.
#[inline]
pub(crate) fn color_sum([r, g, b]: [u8; 3]) -> ColorSum {
    [r as f32, g as f32, b as f32, 0.0]
}

/// Adds the colour of `image` at `(u, v)`, bilinear, continued outside by the nearest pixel.
#[inline(always)]
#[allow(clippy::inline_always)] // it is compiled once per instruction set
pub(crate) fn add_color(sum: &mut ColorSum, image: &Raster<[u8; 3]>, u: f32, v: f32) {
    let (width, height) = (image.width(), image.height());
    let (u, v) = (u.max(0.0).min(width as f32 - 1.0), v.max(0.0).min(height as f32 - 1.0));
    let (x, y) = (u as i32, v as i32);
    let (fx, fy) = (u - x as f32, v - y as f32);
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    let (x, y) = (x as usize, y as usize);
    let start = y * width + x;
    let bytes = image.values().as_flattened();
    // Four bytes of each pixel are read, one too many; the last pixels of the image lack it.
    let corners = match (
        bytes.get(3 * start..3 * start + 7),
        bytes.get(3 * (start + width)..).and_then(|b| b.get(..7)),
    ) {
        (Some(t), Some(b)) if x + 1 < width => [
            [t[0], t[1], t[2], t[3]],
            [t[3], t[4], t[5], t[6]],
            [b[0], b[1], b[2], b[3]],
            [b[3], b[4], b[5], b[6]],
        ],
        _ => corners_at_the_end(image, x, y),
    };
    for (corner, weight) in corners.into_iter().zip(weights) {
        for (sum, channel) in sum.iter_mut().zip(corner) {
            *sum += weight * channel as f32;
        }
    }
}

/// The four pixels from `(x, y)` on, continued outside by the nearest.
#[cold]
fn corners_at_the_end(image: &Raster<[u8; 3]>, x: usize, y: usize) -> [[u8; 4]; 4] {
    let (right, below) = ((x + 1).min(image.width() - 1), (y + 1).min(image.height() - 1));
    [(x, y), (right, y), (x, below), (right, below)].map(|(x, y)| {
        let [r, g, b] = image.at(x, y);
        [r, g, b, 0]
    })
}

/// The mean of `count` colours, rounded to nearest.
#[inline]
pub(crate) fn mean_color(sum: &ColorSum, count: u32) -> [u8; 3] {
    let [r, g, b, _] = sum.map(|sum| (sum / count as f32 + 0.5) as u8);
    [r, g, b]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn colors_are_bilinear_and_continued_outside() {
        let values = vec![[0, 0, 0], [100, 0, 0], [9, 9, 9], [0, 200, 0], [100, 200, 255], [9, 9, 9]];
        let image = Raster::new(3, 2, values).expect("3x2");
        let at = |u, v| {
            let mut sum = [0.0; 4];
            add_color(&mut sum, &image, u, v);
            mean_color(&sum, 1)
        };
        assert_eq!(at(0.25, 0.5), [25, 100, 32]);
        assert_eq!(at(1.0, 1.0), [100, 200, 255]);
        assert_eq!(at(-0.7, 0.0), [0, 0, 0]);
        assert_eq!(at(0.5, 7.0), [50, 200, 128]);
        assert_eq!(at(2.9, 0.3), [9, 9, 9]);
        assert_eq!(at(f32::NAN, 1.0), [0, 200, 0]);
    }

    #[test]
    fn the_mean_is_rounded() {
        let mut sum = color_sum([0, 0, 1]);
        add_color(&mut sum, &Raster::filled(1, 1, [255, 1, 0]), 0.0, 0.0);
        assert_eq!(mean_color(&sum, 2), [128, 1, 1]);
    }
}
