//! The photometric criterion: how sure the network was (paper, section 4.2).

use planesweep_scene::DepthMap;

use crate::hypotheses::{Hypothesis, HypothesisRow};

/// Makes the confident depths of row `y` of `map` its hypotheses; returns how many pixels of the row
/// have a depth, confident or not.
pub(crate) fn confident_depths(
    map: &DepthMap,
    y: usize,
    min_confidence: f32,
    row: &mut HypothesisRow,
) -> usize {
    row.clear();
    let mut with_depth = 0;
    for (x, (&depth, &confidence)) in map.depth.row(y).iter().zip(map.confidence.row(y)).enumerate() {
        let has_depth = depth > 0.0;
        with_depth += usize::from(has_depth);
        if has_depth && confidence >= min_confidence {
            row.push(Hypothesis { column: x as i32, depth, own: depth });
        }
    }
    row.end();
    with_depth
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use planesweep_scene::{Camera, Intrinsics, Pose, Raster};

    use super::*;

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
        confident_depths(&map, 0, 0.8, &mut row);
        assert_eq!(confident_depths(&map, 1, 0.8, &mut row), 3);
        let lanes =
            row.blocks().iter().map(|block| (block.count, block.columns[0], block.depths[0], block.own[0]));
        assert_eq!(lanes.collect::<Vec<_>>(), [(1, 0, 1.0, 1.0), (1, 3, 4.0, 4.0)]);
        assert_eq!(row.len(), 2);
    }
}
