//! Drawing into pictures, and turning them into files.

use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, ImageError};
use planesweep_scene::Raster;
use thiserror::Error;

use crate::font::{ADVANCE, GLYPH_WIDTH, glyph};

/// Why a picture did not become a file.
#[derive(Debug, Error)]
pub enum PictureError {
    /// The encoder refused it.
    #[error("cannot encode a picture of {width}x{height} as {format}")]
    Encode {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// "PNG" or "JPEG".
        format: &'static str,
        /// Why.
        #[source]
        source: ImageError,
    },
}

/// Encodes a picture as PNG.
pub fn encode_png(picture: &Raster<[u8; 3]>) -> Result<Vec<u8>, PictureError> {
    let mut bytes = Vec::new();
    write(picture, PngEncoder::new(&mut bytes), "PNG")?;
    Ok(bytes)
}

/// Encodes a picture as JPEG of a quality at which drawn text stays clean.
pub(crate) fn encode_jpeg(picture: &Raster<[u8; 3]>) -> Result<Vec<u8>, PictureError> {
    let mut bytes = Vec::new();
    write(picture, JpegEncoder::new_with_quality(&mut bytes, 85), "JPEG")?;
    Ok(bytes)
}

fn write(
    picture: &Raster<[u8; 3]>,
    encoder: impl ImageEncoder,
    format: &'static str,
) -> Result<(), PictureError> {
    let (width, height) = (picture.width(), picture.height());
    encoder
        .write_image(picture.values().as_flattened(), width as u32, height as u32, ExtendedColorType::Rgb8)
        .map_err(|source| PictureError::Encode { width, height, format, source })
}

/// The mean over squares of `factor` by `factor` pixels; what remains right and bottom is dropped.
pub(crate) fn shrunk(picture: &Raster<[u8; 3]>, factor: usize) -> Raster<[u8; 3]> {
    let (width, height) = (picture.width() / factor, picture.height() / factor);
    let count = (factor * factor) as u32;
    Raster::from_fn(width, height, |x, y| {
        let mut sum = [0_u32; 3];
        for row in y * factor..(y + 1) * factor {
            for pixel in &picture.row(row)[x * factor..(x + 1) * factor] {
                for (total, value) in sum.iter_mut().zip(pixel) {
                    *total += u32::from(*value);
                }
            }
        }
        sum.map(|total| ((total + count / 2) / count) as u8)
    })
}

/// Sets a pixel; outside the picture nothing happens.
pub(crate) fn set(picture: &mut Raster<[u8; 3]>, x: usize, y: usize, color: [u8; 3]) {
    let width = picture.width();
    if x < width && y < picture.height() {
        picture.values_mut()[y * width + x] = color;
    }
}

/// Writes a line of text; (`x`, `y`) is its top left.
pub(crate) fn draw_text(
    picture: &mut Raster<[u8; 3]>,
    [x, y]: [usize; 2],
    scale: usize,
    color: [u8; 3],
    text: &str,
) {
    for (place, character) in text.chars().enumerate() {
        for (row, bits) in glyph(character).into_iter().enumerate() {
            for column in (0..GLYPH_WIDTH).filter(|column| bits >> (GLYPH_WIDTH - 1 - column) & 1 == 1) {
                let (left, top) = (x + (place * ADVANCE + column) * scale, y + row * scale);
                for (dx, dy) in (0..scale).flat_map(|dy| (0..scale).map(move |dx| (dx, dy))) {
                    set(picture, left + dx, top + dy, color);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_png_decodes_to_what_was_encoded() {
        let picture = Raster::from_fn(7, 5, |x, y| [x as u8 * 30, y as u8 * 40, 9]);
        let bytes = encode_png(&picture).expect("encoded");
        let decoded = image::load_from_memory(&bytes).expect("a PNG").to_rgb8();
        assert_eq!(decoded.dimensions(), (7, 5));
        assert_eq!(decoded.as_raw(), picture.values().as_flattened());
    }

    #[test]
    fn an_empty_picture_is_an_error_or_a_file_but_no_panic() {
        let error = encode_jpeg(&Raster::filled(70000, 1, [0; 3])).expect_err("JPEG ends at 65535");
        assert_eq!(error.to_string(), "cannot encode a picture of 70000x1 as JPEG");
    }

    #[test]
    fn shrinking_takes_means() {
        let picture = Raster::from_fn(5, 2, |x, y| [(x * 10 + y * 20) as u8; 3]);
        assert_eq!(shrunk(&picture, 2).values(), [[15; 3], [35; 3]]);
    }

    #[test]
    fn text_at_the_edge_is_cut_off() {
        let mut picture = Raster::filled(8, 7, [0; 3]);
        draw_text(&mut picture, [0, 0], 1, [255; 3], "11");
        let lit = picture.values().iter().filter(|p| p[0] == 255).count();
        // The first glyph whole, of the second its two left columns.
        assert_eq!(lit, 13 + 4);
    }
}
