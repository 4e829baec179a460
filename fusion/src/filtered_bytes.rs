//! Filtered maps as bytes: what the store keeps, and what is spilled to disk.
//!
//! ```text
//! magic 8 | width u32 | height u32 | fx fy skew cx cy f64 | R 9 x f64 (by columns) | t 3 x f64
//!         | funnel 6 x u64 | views u8 each | kept: bits
//!         | of the kept pixels: depth f32 each | RGB and confidence u8 each | agreeing u64 each | owns: bits
//! ```
//!
//! Pixels go row by row from the top, bits from the lowest on; all is little-endian.

use nalgebra::{Matrix3, Vector3};
use planesweep_scene::{Camera, CameraError, Intrinsics, Pose, Raster};
use thiserror::Error;

use crate::filter::FilteredMap;
use crate::funnel::Funnel;

const MAGIC: [u8; 8] = *b"PSFILTR3";
/// Longest side of a map that is read; a header that says more is damaged.
const MAX_SIDE: u32 = 1 << 17;
/// Bytes of a kept pixel, less its bits.
const KEPT_BYTES: usize = 4 + 4 + 8;

/// Why bytes are no filtered map.
#[derive(Debug, Error, PartialEq)]
pub enum FilteredMapError {
    /// The first bytes are not those of a filtered map.
    #[error("the bytes are no filtered map")]
    Kind,
    /// There are fewer or more bytes than the header says.
    #[error("a filtered map has {got} bytes where its header says {expected}")]
    Length {
        /// By the header.
        expected: u64,
        /// There are.
        got: u64,
    },
    /// The camera in the header is none.
    #[error("a filtered map has no valid camera")]
    Camera(#[from] CameraError),
}

/// A filtered map as bytes.
pub fn encode_filtered_map(map: &FilteredMap) -> Vec<u8> {
    let (depths, colors, agreeing) = (map.depth.values(), map.color.values(), map.agreeing.values());
    let kept = kept_pixels(depths);
    let mut bytes = Vec::with_capacity(256 + 2 * depths.len() + (KEPT_BYTES + 1) * kept.len());
    bytes.extend_from_slice(&MAGIC);
    let k = &map.camera.intrinsics;
    bytes.extend_from_slice(&k.width.to_le_bytes());
    bytes.extend_from_slice(&k.height.to_le_bytes());
    let Pose { rotation, translation } = &map.camera.pose;
    let inner = [k.fx, k.fy, k.skew, k.cx, k.cy];
    for value in inner.iter().chain(rotation.iter()).chain(translation.iter()) {
        bytes.extend_from_slice(&value.to_le_bytes());
    }
    let Funnel { pixels: all, with_depth, photometric, visible, geometric, emitted } = map.funnel;
    for count in [all, with_depth, photometric, visible, geometric, emitted] {
        bytes.extend_from_slice(&count.to_le_bytes());
    }
    bytes.extend_from_slice(map.views.values());
    put_bits(&mut bytes, depths.len(), |i| depths[i] > 0.0);
    put_each(&mut bytes, &kept, |i| depths[i].to_le_bytes());
    put_each(&mut bytes, &kept, |i| colors[i]);
    put_each(&mut bytes, &kept, |i| agreeing[i].to_le_bytes());
    let owns = map.owns.values();
    put_bits(&mut bytes, kept.len(), |slot| owns[kept[slot]]);
    bytes
}

/// Indices of the pixels that have a depth.
fn kept_pixels(depths: &[f32]) -> Vec<usize> {
    // Written for each pixel, and kept where it counts: there is no branch to be guessed.
    let mut kept = vec![0; depths.len()];
    let mut count = 0;
    for (i, depth) in depths.iter().enumerate() {
        kept[count] = i;
        count += usize::from(*depth > 0.0);
    }
    kept.truncate(count);
    kept
}

/// A filtered map from [`encode_filtered_map`]'s bytes.
pub fn decode_filtered_map(bytes: &[u8]) -> Result<FilteredMap, FilteredMapError> {
    let mut reader = Reader { rest: bytes, total: bytes.len() };
    if reader.rest.get(..8) != Some(&MAGIC) {
        return Err(FilteredMapError::Kind);
    }
    reader.take(8)?;
    let (width, height) = (u32::from_le_bytes(reader.array()?), u32::from_le_bytes(reader.array()?));
    let mut numbers = [0.0; 17];
    for number in &mut numbers {
        *number = f64::from_le_bytes(reader.array()?);
    }
    let [fx, fy, skew, cx, cy, pose @ ..] = numbers;
    let intrinsics = Intrinsics { width, height, fx, fy, skew, cx, cy }.checked()?;
    let rotation = Matrix3::from_column_slice(&pose[..9]);
    let pose = Pose::new(rotation, Vector3::from_column_slice(&pose[9..]))?;
    let mut counts = [0; 6];
    for count in &mut counts {
        *count = u64::from_le_bytes(reader.array()?);
    }
    let [all, with_depth, photometric, visible, geometric, emitted] = counts;
    let funnel = Funnel { pixels: all, with_depth, photometric, visible, geometric, emitted };

    let pixels = width.min(MAX_SIDE) as usize * height.min(MAX_SIDE) as usize;
    if width > MAX_SIDE || height > MAX_SIDE {
        return Err(reader.wrong_length(pixels));
    }
    let views = reader.take(pixels)?;
    let kept_bits = reader.take(pixels.div_ceil(8))?;
    let kept = set_bits(kept_bits, pixels);
    let expected = kept.len() * KEPT_BYTES + kept.len().div_ceil(8);
    if reader.rest.len() != expected {
        return Err(reader.wrong_length(expected));
    }
    let (depths, _) = reader.take(4 * kept.len())?.as_chunks::<4>();
    let (colors, _) = reader.take(4 * kept.len())?.as_chunks::<4>();
    let (agreeing, _) = reader.take(8 * kept.len())?.as_chunks::<8>();
    let owns = reader.rest;
    let (columns, rows) = (width as usize, height as usize);
    let mut map = FilteredMap {
        camera: Camera { intrinsics, pose },
        depth: Raster::filled(columns, rows, 0.0),
        color: Raster::filled(columns, rows, [0; 4]),
        views: Raster::filled(columns, rows, 0),
        agreeing: Raster::filled(columns, rows, 0),
        owns: Raster::filled(columns, rows, false),
        funnel,
    };
    map.views.values_mut().copy_from_slice(views);
    put_at(map.depth.values_mut(), &kept, |slot| f32::from_le_bytes(depths[slot]));
    put_at(map.color.values_mut(), &kept, |slot| colors[slot]);
    put_at(map.agreeing.values_mut(), &kept, |slot| u64::from_le_bytes(agreeing[slot]));
    put_at(map.owns.values_mut(), &kept, |slot| bit(owns, slot));
    Ok(map)
}

/// `count` bits, the last byte filled up with zeros.
fn put_bits(bytes: &mut Vec<u8>, count: usize, bit: impl Fn(usize) -> bool) {
    let whole = count / 8;
    let byte = |first: usize, bits: usize| {
        (0..bits).fold(0, |byte, shift| byte | u8::from(bit(first + shift)) << shift)
    };
    bytes.extend((0..whole).map(|index| byte(8 * index, 8)));
    bytes.extend((count > 8 * whole).then(|| byte(8 * whole, count - 8 * whole)));
}

/// What `of` says of each of the pixels, in their order.
fn put_each<const N: usize>(bytes: &mut Vec<u8>, pixels: &[usize], of: impl Fn(usize) -> [u8; N]) {
    let start = bytes.len();
    bytes.resize(start + N * pixels.len(), 0);
    let (slots, _) = bytes[start..].as_chunks_mut::<N>();
    for (slot, pixel) in slots.iter_mut().zip(pixels) {
        *slot = of(*pixel);
    }
}

/// Gives each of the pixels what is in its slot.
fn put_at<T>(values: &mut [T], pixels: &[usize], slot: impl Fn(usize) -> T) {
    for (index, pixel) in pixels.iter().enumerate() {
        values[*pixel] = slot(index);
    }
}

/// Indices of the bits that are set, of the first `count`.
fn set_bits(bytes: &[u8], count: usize) -> Vec<usize> {
    let mut set = Vec::with_capacity(bytes.iter().map(|byte| byte.count_ones() as usize).sum());
    for (index, byte) in bytes.iter().enumerate() {
        let mut left = *byte;
        while left != 0 {
            set.push(8 * index + left.trailing_zeros() as usize);
            left &= left - 1;
        }
    }
    // Bits that fill up the last byte are zeros, unless it is damaged.
    set.truncate(set.partition_point(|index| *index < count));
    set
}

fn bit(bytes: &[u8], index: usize) -> bool {
    bytes[index / 8] >> (index % 8) & 1 == 1
}

struct Reader<'a> {
    rest: &'a [u8],
    total: usize,
}

impl<'a> Reader<'a> {
    /// The error of bytes of which `length` more are needed.
    fn wrong_length(&self, length: usize) -> FilteredMapError {
        let expected = (self.total - self.rest.len() + length) as u64;
        FilteredMapError::Length { expected, got: self.total as u64 }
    }

    fn take(&mut self, length: usize) -> Result<&'a [u8], FilteredMapError> {
        let (taken, rest) = self.rest.split_at_checked(length).ok_or_else(|| self.wrong_length(length))?;
        self.rest = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], FilteredMapError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::analytic::{Surface, camera_at};
    use crate::filter::filter;
    use crate::options::FilterOptions;

    fn map() -> FilteredMap {
        let [one, mut other] = [0.0, 0.3].map(|x| Surface::BallBeforePlane.map(camera_at(x, 0.0, 13, 7)));
        other.depth.values_mut()[40] = 0.0;
        filter(&one, &[&other], &FilterOptions { min_views: 2, ..FilterOptions::default() })
    }

    #[test]
    fn maps_survive_the_bytes() {
        let map = map();
        assert!(map.funnel.geometric > 20 && map.funnel.geometric < 91);
        assert!(map.owns.values().contains(&true) && map.owns.values().contains(&false));
        assert_eq!(decode_filtered_map(&encode_filtered_map(&map)), Ok(map));
    }

    #[test]
    fn a_header_that_promises_too_much_is_refused_before_allocation() {
        let mut bytes = encode_filtered_map(&map());
        bytes[8..16].fill(0xff);
        assert!(matches!(decode_filtered_map(&bytes), Err(FilteredMapError::Length { .. })));
        assert_eq!(decode_filtered_map(b"PSDEPTH1"), Err(FilteredMapError::Kind));
    }

    proptest! {
        #[test]
        fn truncation_and_damage_never_panic(cut in 0_usize..700, at in 0_usize..700, value: u8) {
            let mut bytes = encode_filtered_map(&map());
            let at = at % bytes.len();
            bytes[at] = value;
            let whole = bytes.len();
            bytes.truncate(whole - cut.min(whole));
            prop_assert!(decode_filtered_map(&bytes).is_err() || cut == 0);
        }
    }
}
