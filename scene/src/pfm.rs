//! PFM, the float image that depth and confidence maps are kept in (bottom row first).

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use crate::Raster;
use crate::depth_map::clear_what_is_no_depth;
use crate::write::write_atomically;

/// Why a PFM could not be read or written.
#[derive(Debug, Error)]
pub enum PfmError {
    /// The file could not be read.
    #[error("could not read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The file is no PFM of one channel.
    #[error("could not decode {}", path.display())]
    Decode {
        /// The file.
        path: PathBuf,
        /// What is wrong with its bytes.
        #[source]
        source: PfmFormatError,
    },
    /// The file could not be written.
    #[error("could not write {}", path.display())]
    Write {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
}

/// Why bytes are no PFM of one channel.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum PfmFormatError {
    /// The magic is `PF`.
    #[error("it has three channels (PF), a map of one channel (Pf) is needed")]
    ThreeChannels,
    /// The magic is neither.
    #[error("it does not start with Pf")]
    Magic,
    /// A field of the header is missing or no number of its kind.
    #[error("its header has no valid {field}")]
    Header {
        /// "width", "height" or "scale".
        field: &'static str,
    },
    /// The bytes after the header do not fill the image.
    #[error("{width}x{height} values need {} bytes, {got} follow the header", needed_text(*width, *height))]
    Length {
        /// Columns, as the header says.
        width: usize,
        /// Rows, as the header says.
        height: usize,
        /// Bytes after the header.
        got: usize,
    },
}

fn needed_text(width: usize, height: usize) -> String {
    byte_count(width, height).map_or_else(|| "too many".to_owned(), |n| n.to_string())
}

fn byte_count(width: usize, height: usize) -> Option<usize> {
    width.checked_mul(height)?.checked_mul(size_of::<f32>())
}

/// Decodes a PFM of one channel and either byte order; values are taken as they are, and the
/// header's scale counts for its sign only.
pub fn decode_pfm(bytes: &[u8]) -> Result<Raster<f32>, PfmFormatError> {
    if bytes.starts_with(b"PF") {
        return Err(PfmFormatError::ThreeChannels);
    }
    let mut rest = bytes.strip_prefix(b"Pf").ok_or(PfmFormatError::Magic)?;
    let width: usize = next_number(&mut rest, "width")?;
    let height: usize = next_number(&mut rest, "height")?;
    let scale: f64 = next_number(&mut rest, "scale")?;
    if scale == 0.0 || !scale.is_finite() {
        return Err(PfmFormatError::Header { field: "scale" });
    }
    // Exactly one byte of white space follows the scale: the next may already be data.
    let data = rest.get(1..).unwrap_or_default();
    let wrong_length = PfmFormatError::Length { width, height, got: data.len() };
    if byte_count(width, height) != Some(data.len()) {
        return Err(wrong_length);
    }
    let from_bytes = if scale < 0.0 { f32::from_le_bytes } else { f32::from_be_bytes };
    let (numbers, _) = data.as_chunks::<4>();
    let values = (0..height).rev().flat_map(|y| &numbers[y * width..(y + 1) * width]);
    Raster::new(width, height, values.map(|b| from_bytes(*b)).collect()).map_err(|_| wrong_length)
}

fn next_number<T: std::str::FromStr>(rest: &mut &[u8], field: &'static str) -> Result<T, PfmFormatError> {
    let trimmed = rest.trim_ascii_start();
    // A number needs white space before it and after it.
    let end = trimmed.iter().position(u8::is_ascii_whitespace).unwrap_or(trimmed.len());
    let number = if trimmed.len() < rest.len() { std::str::from_utf8(&trimmed[..end]).ok() } else { None };
    *rest = &trimmed[end..];
    number.and_then(|text| text.parse().ok()).ok_or(PfmFormatError::Header { field })
}

/// Encodes a raster as PFM, little endian.
pub fn encode_pfm(raster: &Raster<f32>) -> Vec<u8> {
    let header = format!("Pf\n{} {}\n-1.0\n", raster.width(), raster.height());
    let mut bytes = Vec::with_capacity(header.len() + size_of_val(raster.values()));
    bytes.extend_from_slice(header.as_bytes());
    for y in (0..raster.height()).rev() {
        for value in raster.row(y) {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
    }
    bytes
}

/// Reads a PFM of one channel, its values as they are.
pub fn read_pfm(path: &Path) -> Result<Raster<f32>, PfmError> {
    let bytes = fs::read(path).map_err(|source| PfmError::Read { path: path.to_owned(), source })?;
    decode_pfm(&bytes).map_err(|source| PfmError::Decode { path: path.to_owned(), source })
}

/// Reads a depth map: what is not between 1e-15 and 1e15 becomes 0, which is "no depth".
pub fn read_depth_pfm(path: &Path) -> Result<Raster<f32>, PfmError> {
    let mut depth = read_pfm(path)?;
    clear_what_is_no_depth(&mut depth);
    Ok(depth)
}

/// Writes a PFM, little endian; the file appears whole or not at all.
pub fn write_pfm(path: &Path, raster: &Raster<f32>) -> Result<(), PfmError> {
    write_atomically(path, &encode_pfm(raster))
        .map_err(|source| PfmError::Write { path: path.to_owned(), source })
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn reading_inverts_writing(width in 0_usize..9, height in 0_usize..9, seed in any::<u32>()) {
            // Any bits, NaN and infinity among them, must survive.
            let raster = Raster::from_fn(width, height, |x, y| {
                f32::from_bits(seed ^ ((y * width + x) as u32).wrapping_mul(0x9e37_79b9))
            });
            let back = decode_pfm(&encode_pfm(&raster)).expect("own bytes");
            prop_assert_eq!(back.map(|v| v.to_bits()), raster.map(|v| v.to_bits()));
        }

        #[test]
        fn no_bytes_panic(bytes in proptest::collection::vec(any::<u8>(), 0..64)) {
            let _ = decode_pfm(&bytes);
            let _ = decode_pfm(&[b"Pf\n", bytes.as_slice()].concat());
        }
    }

    #[test]
    fn rows_are_stored_bottom_first_in_either_byte_order() {
        let raster = Raster::new(1, 2, vec![1.0_f32, 2.0]).expect("1x2");
        let bytes = encode_pfm(&raster);
        assert_eq!(&bytes[..14], b"Pf\n1 2\n-1.0\n\0\0");
        assert_eq!(bytes[12..16], 2.0_f32.to_le_bytes());
        let mut big = b"Pf 1\r\n  2 \n1\n".to_vec();
        big.extend([2.0_f32.to_be_bytes(), 1.0_f32.to_be_bytes()].concat());
        assert_eq!(decode_pfm(&big), Ok(raster));
    }

    #[test]
    fn wrong_sizes_are_refused_before_allocation() {
        let huge = b"Pf\n4294967295 4294967295\n-1\n";
        let error = decode_pfm(huge).expect_err("no data");
        assert_eq!(error, PfmFormatError::Length { width: 4294967295, height: 4294967295, got: 0 });
        assert!(error.to_string().contains("0 follow the header"), "{error}");
        let mut long = encode_pfm(&Raster::filled(2, 2, 1.0));
        long.push(0);
        assert_eq!(decode_pfm(&long), Err(PfmFormatError::Length { width: 2, height: 2, got: 17 }));
        assert_eq!(
            decode_pfm(&long[..20]).expect_err("truncated").to_string(),
            "2x2 values need 16 bytes, 8 follow the header"
        );
    }

    #[test]
    fn what_is_no_pfm_is_named() {
        assert_eq!(decode_pfm(b"PF\n1 1\n-1\n"), Err(PfmFormatError::ThreeChannels));
        assert_eq!(decode_pfm(b"P6\n"), Err(PfmFormatError::Magic));
        assert_eq!(decode_pfm(b"Pf\n1 x\n-1\n"), Err(PfmFormatError::Header { field: "height" }));
        assert_eq!(decode_pfm(b"Pf1 1\n-1\n"), Err(PfmFormatError::Header { field: "width" }));
        assert_eq!(decode_pfm(b"Pf\n1 1\n0\n1234"), Err(PfmFormatError::Header { field: "scale" }));
    }

    #[test]
    fn nan_infinite_and_negative_depths_are_invalid() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("depth.pfm");
        let raster = Raster::new(5, 1, vec![1.5, f32::NAN, f32::INFINITY, -2.0, f32::MAX]).expect("5x1");
        write_pfm(&path, &raster).expect("written");
        assert_eq!(read_depth_pfm(&path).expect("read").values(), [1.5, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(read_pfm(&path).expect("read").at(3, 0), -2.0);
        assert_eq!(fs::read_dir(folder.path()).expect("listed").count(), 1, "no temporary file stays");
    }

    #[test]
    fn errors_name_the_file() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let missing = folder.path().join("none.pfm");
        assert!(read_pfm(&missing).expect_err("missing").to_string().contains("none.pfm"));
        let unwritable = folder.path().join("no/such/folder.pfm");
        let error = write_pfm(&unwritable, &Raster::filled(1, 1, 0.0)).expect_err("no folder");
        assert!(error.to_string().contains("folder.pfm"));
    }
}
