//! The photometric criterion: how sure the network was (paper, section 4.2).

#![allow(
    unsafe_code,
    clippy::inline_always,
    reason = "compiled for the instructions of the processor, as the kernel"
)]

use planesweep_scene::DepthMap;

use crate::hypotheses::HypothesisRow;
use crate::kernel::{Kernel, LANES, Lanes, Level};

/// Makes the confident depths of row `y` of `map` its hypotheses; returns how many pixels of the row
/// have a depth, confident or not.
pub(crate) fn confident_depths(
    level: Level,
    map: &DepthMap,
    y: usize,
    min_confidence: f32,
    row: &mut HypothesisRow,
) -> usize {
    row.clear(map.width());
    let (depths, confidences) = (map.depth.row(y), map.confidence.row(y));
    let with_depth = level.run(Confident { depths, confidences, min_confidence, row });
    row.end();
    with_depth
}

/// A row of depths with their confidences.
struct Confident<'a> {
    depths: &'a [f32],
    confidences: &'a [f32],
    min_confidence: f32,
    row: &'a mut HypothesisRow,
}

impl Kernel for Confident<'_> {
    type Output = usize;

    #[inline(always)]
    unsafe fn run<L: Lanes>(self) -> usize {
        let (depths, last_depths) = self.depths.as_chunks::<LANES>();
        let (confidences, last_confidences) = self.confidences.as_chunks::<LANES>();
        // Zeros, which are no depths, fill up the last lanes.
        let (mut more_depths, mut more_confidences) = ([0.0; LANES], [0.0; LANES]);
        more_depths[..last_depths.len()].copy_from_slice(last_depths);
        more_confidences[..last_confidences.len()].copy_from_slice(last_confidences);
        let depths = depths.iter().chain([&more_depths]);
        let confidences = confidences.iter().chain([&more_confidences]);
        let mut with_depth = 0;
        for ((depths, confidences), first) in depths.zip(confidences).zip((0..).step_by(LANES)) {
            // SAFETY: the caller vouches for the processor.
            unsafe {
                let has_depth = L::less(L::splat(0.0), L::load(depths));
                // At least the least: `>=`, said with `<`.
                let is_sure = L::less(L::splat(self.min_confidence.next_down()), L::load(confidences));
                with_depth += L::bits(has_depth).count_ones() as usize;
                self.row.push_own::<L>(first, depths, L::and(has_depth, is_sure));
            }
        }
        with_depth
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use planesweep_scene::{Camera, Intrinsics, Pose, Raster};

    use super::*;

    #[test]
    fn every_level_finds_the_confident_depths_of_rows_of_any_width() {
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        for width in [1, 2, 15, 16, 17, 31, 32, 33, 100] {
            let intrinsics = Intrinsics { width, height: 1, fx: 1.0, fy: 1.0, skew: 0.0, cx: 0.0, cy: 0.0 };
            let columns = width as usize;
            // Two surfaces with outliers, holes and doubts.
            let depth = Raster::from_fn(columns, 1, |x, _| match x % 11 {
                3 => 0.0,
                7 => 9.0,
                _ => {
                    if x < 40 {
                        2.0
                    } else {
                        3.0
                    }
                }
            });
            let confidence = Raster::from_fn(columns, 1, |x, _| if x % 5 == 4 { 0.5 } else { 0.75 });
            let map = DepthMap::new(
                Camera { intrinsics, pose },
                depth,
                confidence,
                Raster::filled(columns, 1, [0; 3]),
            )
            .expect("sizes agree");
            let expected: Vec<_> = (0..columns)
                .filter(|x| map.depth.at(*x, 0) > 0.0 && map.confidence.at(*x, 0) >= 0.75)
                .map(|x| (x as i32, map.depth.at(x, 0)))
                .collect();
            for level in Level::available() {
                let mut row = HypothesisRow::default();
                let with_depth = confident_depths(level, &map, 0, 0.75, &mut row);
                assert_eq!(with_depth, map.depth.values().iter().filter(|depth| **depth > 0.0).count());
                assert_eq!(row.len(), expected.len());
                let mut found = Vec::new();
                for block in row.blocks() {
                    assert_eq!(block.own[..block.count], block.depths[..block.count]);
                    found.extend((0..block.count).map(|k| (block.columns[k], block.depths[k])));
                }
                found.sort_unstable_by_key(|(column, _)| *column);
                assert_eq!(found, expected, "{level:?}, {width} columns");
            }
        }
    }

    #[test]
    fn confident_depths_are_packed() {
        let intrinsics = Intrinsics { width: 5, height: 2, fx: 1.0, fy: 1.0, skew: 0.0, cx: 0.0, cy: 0.0 };
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        let map = DepthMap::new(
            Camera { intrinsics, pose },
            Raster::new(5, 2, vec![9.0, 9.0, 9.0, 9.0, 9.0, 1.0, 2.0, 0.0, 4.0, f32::NAN]).expect("5x2"),
            Raster::new(5, 2, vec![1.0, 1.0, 1.0, 1.0, 1.0, 0.8, 0.79, 1.0, 0.9, 1.0]).expect("5x2"),
            Raster::filled(5, 2, [0; 3]),
        )
        .expect("sizes agree");
        let mut row = HypothesisRow::default();
        for level in Level::available() {
            confident_depths(level, &map, 0, 0.8, &mut row);
            assert_eq!(confident_depths(level, &map, 1, 0.8, &mut row), 3);
            let lanes =
                row.blocks().map(|block| (block.count, block.columns[0], block.depths[0], block.own[0]));
            assert_eq!(lanes.collect::<Vec<_>>(), [(1, 0, 1.0, 1.0), (1, 3, 4.0, 4.0)], "{level:?}");
            assert_eq!(row.len(), 2);
        }
    }
}
