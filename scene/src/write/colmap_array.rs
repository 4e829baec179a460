//! Depth and normal maps as COLMAP's dense reconstruction keeps them.
//!
//! ```text
//! WIDTH&HEIGHT&CHANNELS& in text | of each channel: rows from the top of f32, little-endian
//! ```

use std::path::Path;

use super::{WriteError, create_folder, write_file};
use crate::Raster;

/// Writes a raster of one or more channels, and the folders that the file lies in.
pub fn write_colmap_array<const CHANNELS: usize>(
    path: &Path,
    raster: &Raster<[f32; CHANNELS]>,
) -> Result<(), WriteError> {
    if let Some(folder) = path.parent() {
        create_folder(folder)?;
    }
    write_file(path, &encode(raster))
}

fn encode<const CHANNELS: usize>(raster: &Raster<[f32; CHANNELS]>) -> Vec<u8> {
    let mut bytes = format!("{}&{}&{CHANNELS}&", raster.width(), raster.height()).into_bytes();
    for channel in 0..CHANNELS {
        bytes.extend(raster.values().iter().flat_map(|values| values[channel].to_le_bytes()));
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_follow_each_other() {
        let bytes = encode(&Raster::from_fn(2, 1, |x, _| [x as f32, 5.0]));
        let (head, values) = bytes.split_at(6);
        assert_eq!(head, b"2&1&2&");
        let values: Vec<f32> = values.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        assert_eq!(values, [0.0, 1.0, 5.0, 5.0]);
    }
}
