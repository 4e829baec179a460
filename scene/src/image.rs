//! Photographs from JPEG, PNG and TIFF, with every size checked before memory is taken for it.

use std::fs::{self, File};
use std::io::{self, BufReader, Cursor, Seek};
use std::path::{Path, PathBuf};

use image::{ColorType, DynamicImage, ExtendedColorType, ImageDecoder, ImageReader, Limits};
use thiserror::Error;

use crate::{Intrinsics, Raster, jpeg};

/// The most pixels an image may have: 2^28, far above any photograph and 800 MB as RGB.
pub const MAX_PIXELS: u64 = 1 << 28;

/// How far the aspect ratios of image and camera may differ: rounding of a resize, not a crop.
const ASPECT_TOLERANCE: f64 = 0.01;

/// Why an image could not be read.
#[derive(Debug, Error)]
pub enum ImageError {
    /// The file could not be read.
    #[error("could not read image {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The header is of no known format, or damaged.
    #[error("could not read the header of image {}", path.display())]
    Header {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        #[source]
        source: image::ImageError,
    },
    /// The header promises more pixels than are allowed.
    #[error("image {} is {width}x{height}, more than {limit} pixels are refused", path.display())]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// Pixels allowed.
        limit: u64,
    },
    /// The pixels are of a kind that is not converted.
    #[error("image {} has {what}, which is not supported", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The kind of pixels.
        what: &'static str,
    },
    /// The file ends in the middle of the picture.
    #[error("image {} is truncated", path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
    },
    /// The data after the header is damaged.
    #[error("could not decode image {}", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// What the decoder said.
        #[source]
        source: image::ImageError,
    },
}

/// An image whose shape is not that of its camera, so that scaling cannot make them agree.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error(
    "image is {image_width}x{image_height}, but its camera is for {camera_width}x{camera_height}, another aspect ratio"
)]
pub struct SizeMismatch {
    /// Columns of the image.
    pub image_width: u32,
    /// Rows of the image.
    pub image_height: u32,
    /// Columns the camera was made for.
    pub camera_width: u32,
    /// Rows the camera was made for.
    pub camera_height: u32,
}

/// The columns and rows of the image in a file, from its header alone.
///
/// More than [`MAX_PIXELS`] are refused.
pub fn image_size(path: &Path) -> Result<(u32, u32), ImageError> {
    let read_error = |source| ImageError::Read { path: path.to_owned(), source };
    let mut reader = BufReader::new(File::open(path).map_err(read_error)?);
    // The general decoder reads a JPEG to its end before it tells the size.
    let frame = jpeg::frame(&mut reader).map_err(read_error)?;
    let (width, height) = if let Some(frame) = frame {
        (frame.width, frame.height)
    } else {
        reader.rewind().map_err(read_error)?;
        ImageReader::new(reader)
            .with_guessed_format()
            .map_err(read_error)?
            .into_dimensions()
            .map_err(|source| ImageError::Header { path: path.to_owned(), source })?
    };
    check_size(path, width, height)?;
    Ok((width, height))
}

/// Reads an image as RGB of 8 bits; see [`decode_image`].
pub fn read_image(path: &Path) -> Result<Raster<[u8; 3]>, ImageError> {
    let bytes = fs::read(path).map_err(|source| ImageError::Read { path: path.to_owned(), source })?;
    decode_image(path, &bytes)
}

/// Decodes the bytes of a JPEG, PNG or TIFF as RGB of 8 bits; `path` is for messages only.
///
/// 16 bits are rounded to 8, grey becomes RGB, alpha is dropped. An orientation in the EXIF data is
/// not applied: cameras are solved for the pixels as they are stored. CMYK and floating-point
/// pixels are refused, as are more than [`MAX_PIXELS`] and JPEGs without their end, which decoders
/// would fill with grey.
pub fn decode_image(path: &Path, bytes: &[u8]) -> Result<Raster<[u8; 3]>, ImageError> {
    let header_error = |source| ImageError::Header { path: path.to_owned(), source };
    let unsupported = |what| Err(ImageError::Unsupported { path: path.to_owned(), what });
    let read_error = |source| ImageError::Read { path: path.to_owned(), source };

    let frame = jpeg::frame(&mut Cursor::new(bytes)).map_err(read_error)?;
    if let Some(frame) = frame {
        check_size(path, frame.width, frame.height)?;
        if frame.components == 4 {
            return unsupported("CMYK pixels");
        }
        if !jpeg::is_complete(bytes) {
            return Err(ImageError::Truncated { path: path.to_owned() });
        }
    }
    let mut reader = ImageReader::new(Cursor::new(bytes)).with_guessed_format().map_err(read_error)?;
    let mut limits = Limits::no_limits();
    // 16-bit RGBA is the largest pixel that is decoded.
    limits.max_alloc = Some(MAX_PIXELS * 8);
    reader.limits(limits);
    let decoder = reader.into_decoder().map_err(header_error)?;
    let (width, height) = decoder.dimensions();
    check_size(path, width, height)?;
    if matches!(decoder.original_color_type(), ExtendedColorType::Cmyk8 | ExtendedColorType::Cmyk16) {
        return unsupported("CMYK pixels");
    }
    if matches!(decoder.color_type(), ColorType::Rgb32F | ColorType::Rgba32F) {
        return unsupported("floating-point pixels");
    }
    rgb8(decoder).map_err(|source| ImageError::Decode { path: path.to_owned(), source })
}

fn rgb8(decoder: impl ImageDecoder) -> Result<Raster<[u8; 3]>, image::ImageError> {
    let (width, height) = decoder.dimensions();
    let pixels = if decoder.color_type() == ColorType::Rgb8 {
        let mut pixels = vec![[0; 3]; width as usize * height as usize];
        decoder.read_image(pixels.as_flattened_mut())?;
        pixels
    } else {
        DynamicImage::from_decoder(decoder)?.into_rgb8().as_raw().as_chunks::<3>().0.to_vec()
    };
    Ok(Raster::new(width as usize, height as usize, pixels).expect("the decoder fills the size it states"))
}

fn check_size(path: &Path, width: u32, height: u32) -> Result<(), ImageError> {
    if width == 0 || height == 0 {
        return Err(ImageError::Unsupported { path: path.to_owned(), what: "no pixels" });
    }
    if width as u64 * height as u64 > MAX_PIXELS {
        return Err(ImageError::TooLarge { path: path.to_owned(), width, height, limit: MAX_PIXELS });
    }
    Ok(())
}

/// The intrinsics for an image of the size found, and whether they had to be scaled to it.
///
/// Sizes whose aspect ratios differ by more than one per cent are refused.
pub fn fit_to_image(
    intrinsics: &Intrinsics,
    width: u32,
    height: u32,
) -> Result<(Intrinsics, bool), SizeMismatch> {
    if (width, height) == (intrinsics.width, intrinsics.height) {
        return Ok((*intrinsics, false));
    }
    let scale_x = width as f64 / intrinsics.width as f64;
    let scale_y = height as f64 / intrinsics.height as f64;
    if (scale_x / scale_y - 1.0).abs() > ASPECT_TOLERANCE {
        return Err(SizeMismatch {
            image_width: width,
            image_height: height,
            camera_width: intrinsics.width,
            camera_height: intrinsics.height,
        });
    }
    Ok((intrinsics.resized(width, height), true))
}

#[cfg(test)]
mod tests {
    use image::{ImageBuffer, ImageFormat, Luma, Rgb, Rgba};

    use super::*;

    fn encoded(image: impl Into<DynamicImage>, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.into().write_to(&mut bytes, format).expect("encoded");
        bytes.into_inner()
    }

    fn decoded(bytes: &[u8]) -> Result<Raster<[u8; 3]>, ImageError> {
        decode_image(Path::new("a/photo"), bytes)
    }

    fn jpeg() -> Vec<u8> {
        let noise = ImageBuffer::from_fn(64, 48, |x, y| Rgb([((x * 37) ^ (y * 11)) as u8, x as u8, y as u8]));
        encoded(noise, ImageFormat::Jpeg)
    }

    /// The marker segments before the quantisation tables, with an EXIF "rotate by 90" put in.
    fn rotated(jpeg: &[u8]) -> Vec<u8> {
        let tiff = [b"II*\0\x08\0\0\0\x01\0".as_slice(), b"\x12\x01\x03\0\x01\0\0\0\x06\0\0\0", b"\0\0\0\0"];
        let exif = [b"Exif\0\0".as_slice(), &tiff.concat()].concat();
        let length = (exif.len() + 2) as u16;
        [&jpeg[..2], &[0xff, 0xe1], &length.to_be_bytes(), &exif, &jpeg[2..]].concat()
    }

    #[test]
    fn sixteen_bit_grey_and_alpha_are_read_right() {
        let wide = ImageBuffer::from_pixel(2, 1, Rgb([65535_u16, 257 * 100, 0]));
        let grey = ImageBuffer::from_pixel(2, 1, Luma([77_u8]));
        let alpha = ImageBuffer::from_pixel(2, 1, Rgba([10_u8, 20, 30, 0]));
        for format in [ImageFormat::Png, ImageFormat::Tiff] {
            assert_eq!(decoded(&encoded(wide.clone(), format)).expect("16 bit").at(1, 0), [255, 100, 0]);
            assert_eq!(decoded(&encoded(grey.clone(), format)).expect("grey").at(1, 0), [77; 3]);
            assert_eq!(decoded(&encoded(alpha.clone(), format)).expect("alpha").at(1, 0), [10, 20, 30]);
        }
    }

    #[test]
    fn exif_rotation_is_not_applied() {
        let plain = decoded(&jpeg()).expect("decoded");
        assert_eq!((plain.width(), plain.height()), (64, 48));
        assert_eq!(decoded(&rotated(&jpeg())).expect("decoded"), plain);
    }

    #[test]
    fn cmyk_and_float_are_refused_by_name() {
        // A frame header of four components.
        let cmyk = b"\xff\xd8\xff\xc0\x00\x14\x08\x00\x10\x00\x10\x04aaabbbcccddd";
        assert_eq!(
            decoded(cmyk).expect_err("CMYK").to_string(),
            "image a/photo has CMYK pixels, which is not supported"
        );
        let float = ImageBuffer::from_pixel(2, 1, Rgb([0.5_f32; 3]));
        assert!(matches!(
            decoded(&encoded(float, ImageFormat::Tiff)),
            Err(ImageError::Unsupported { what: "floating-point pixels", .. })
        ));
    }

    #[test]
    fn a_bomb_is_refused_from_its_header() {
        let mut png = encoded(ImageBuffer::from_pixel(1, 1, Luma([0_u8])), ImageFormat::Png);
        png[16..20].copy_from_slice(&60000_u32.to_be_bytes());
        png[20..24].copy_from_slice(&60000_u32.to_be_bytes());
        let crc = crc32(&png[12..29]).to_be_bytes();
        png[29..33].copy_from_slice(&crc);
        let mut jpeg = jpeg();
        let frame = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).expect("a baseline frame");
        jpeg[frame + 5..frame + 9].copy_from_slice(&[0xea, 0x60, 0xea, 0x60]);
        let folder = tempfile::tempdir().expect("a temporary folder");
        for bytes in [png, jpeg] {
            let error = decoded(&bytes).expect_err("a bomb");
            assert!(error.to_string().starts_with("image a/photo is 60000x60000"), "{error}");
            let path = folder.path().join("bomb");
            fs::write(&path, &bytes).expect("written");
            assert!(matches!(image_size(&path), Err(ImageError::TooLarge { width: 60000, .. })));
        }
    }

    fn crc32(bytes: &[u8]) -> u32 {
        !bytes.iter().fold(!0, |crc, byte| {
            (0..8).fold(crc ^ *byte as u32, |c, _| if c & 1 == 1 { (c >> 1) ^ 0xedb8_8320 } else { c >> 1 })
        })
    }

    #[test]
    fn truncated_images_are_refused() {
        let noise = ImageBuffer::from_fn(64, 48, |x, y| Rgb([((x * 37) ^ (y * 11)) as u8, x as u8, y as u8]));
        for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff] {
            let bytes = encoded(noise.clone(), format);
            assert!(decoded(&bytes).is_ok());
            for part in [bytes.len() / 3, bytes.len() / 2, bytes.len() - bytes.len() / 8] {
                let error = decoded(&bytes[..part]).expect_err("truncated");
                assert!(error.to_string().contains("a/photo"), "{error}");
            }
        }
        assert!(matches!(decoded(b""), Err(ImageError::Header { .. })));
        assert!(matches!(decoded(b"no image at all"), Err(ImageError::Header { .. })));
    }

    #[test]
    fn sizes_come_from_headers() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("photo");
        let grey = ImageBuffer::from_pixel(7, 5, Luma([77_u8]));
        for bytes in [
            encoded(grey.clone(), ImageFormat::Png),
            encoded(grey.clone(), ImageFormat::Tiff),
            rotated(&encoded(grey, ImageFormat::Jpeg)),
        ] {
            fs::write(&path, &bytes).expect("written");
            assert_eq!(image_size(&path).expect("a header"), (7, 5));
        }
        fs::remove_file(&path).expect("removed");
        assert!(image_size(&path).expect_err("missing").to_string().ends_with("photo"));
    }

    #[test]
    fn intrinsics_follow_the_image_when_the_aspect_agrees() {
        let camera =
            Intrinsics { width: 640, height: 480, fx: 500.0, fy: 500.0, skew: 0.0, cx: 319.5, cy: 239.5 };
        assert_eq!(fit_to_image(&camera, 640, 480), Ok((camera, false)));
        let (half, scaled) = fit_to_image(&camera, 320, 241).expect("within one per cent");
        assert!(scaled);
        assert_eq!((half.width, half.height, half.fx), (320, 241, 250.0));
        assert_eq!(
            fit_to_image(&camera, 480, 640).expect_err("turned").to_string(),
            "image is 480x640, but its camera is for 640x480, another aspect ratio"
        );
    }
}
