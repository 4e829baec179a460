//! Bands of rows: one view's depth map for several workers.
//!
//! The network's result at a row depends on rows nearby only, and `mvsnet` computes any rows of a depth map
//! with the bits that the whole has there. So a band names the rows it owns; the halo it must compute
//! besides follows from the layers and is the network's business.

use std::ops::Range;

/// Rows of the depth map at which bands may meet: the 3D network halves its volume three times, so a band
/// that begins elsewhere computes rows for nothing.
const PHASE: u32 = 8;
/// Rows of the image for each row of the depth map.
const IMAGE_ROWS: u32 = 4;

/// The bands of a depth map of `rows` rows, from the top, which cover it exactly; none when it stays whole.
///
/// Each band owns at least `band_image_rows` rows of the image (rounded up to a multiple of 32), and all own
/// nearly the same.
pub(crate) fn bands(rows: u32, band_image_rows: Option<u32>) -> Vec<Range<u32>> {
    let Some(wanted) = band_image_rows else { return Vec::new() };
    let least = wanted.max(1).div_ceil(IMAGE_ROWS).next_multiple_of(PHASE);
    let count = rows / least;
    if count < 2 {
        return Vec::new();
    }
    let begin = |band: u32| match band {
        last if last == count => rows,
        _ => (u64::from(rows / PHASE) * u64::from(band) / u64::from(count)) as u32 * PHASE,
    };
    (0..count).map(|band| begin(band)..begin(band + 1)).collect()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_large_image_is_divided_evenly_and_a_small_one_not_at_all() {
        assert_eq!(bands(264, Some(512)), [0..128, 128..264]);
        assert_eq!(bands(264, None), []);
        assert_eq!(bands(255, Some(512)), []);
        assert_eq!(bands(1000, Some(1000)), [0..328, 328..664, 664..1000]);
    }

    proptest! {
        #[test]
        fn bands_cover_the_map_and_own_enough(rows in 1..20_000_u32, wanted in 1..3000_u32) {
            let bands = bands(rows, Some(wanted));
            prop_assert_ne!(bands.len(), 1);
            let mut next = 0;
            for band in &bands {
                prop_assert_eq!(band.start, next);
                prop_assert_eq!(band.start % PHASE, 0);
                prop_assert!((band.end - band.start) * IMAGE_ROWS >= wanted);
                next = band.end;
            }
            if bands.is_empty() {
                prop_assert!(rows / PHASE * PHASE * IMAGE_ROWS < 2 * wanted.next_multiple_of(32));
            } else {
                prop_assert_eq!(next, rows);
                let sizes = bands.iter().map(|band| band.end - band.start);
                prop_assert!(sizes.clone().max().unwrap_or(0) - sizes.min().unwrap_or(0) < 2 * PHASE);
            }
        }
    }
}
