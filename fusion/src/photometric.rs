//! The photometric criterion: how sure the network was (paper, section 4.2).

use planesweep_scene::DepthMap;

/// The pixels of one row that hold a confident depth, packed: what the geometric criterion runs over.
#[derive(Default)]
pub(crate) struct ConfidentRow {
    /// Columns.
    pub columns: Vec<f32>,
    /// Their depths.
    pub depths: Vec<f32>,
    /// Pixels of the row with a depth, confident or not.
    pub with_depth: usize,
}

impl ConfidentRow {
    /// Packs row `y` of `map`, dropping what it held before.
    pub fn select(&mut self, map: &DepthMap, y: usize, min_confidence: f32) {
        self.columns.clear();
        self.depths.clear();
        self.with_depth = 0;
        for (x, (&depth, &confidence)) in map.depth.row(y).iter().zip(map.confidence.row(y)).enumerate() {
            let has_depth = depth > 0.0;
            self.with_depth += usize::from(has_depth);
            if has_depth && confidence >= min_confidence {
                self.columns.push(x as f32);
                self.depths.push(depth);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use planesweep_scene::{Camera, Intrinsics, Pose, Raster};

    use super::*;

    #[test]
    fn confident_depths_are_packed_in_order() {
        let intrinsics = Intrinsics { width: 5, height: 2, fx: 1.0, fy: 1.0, skew: 0.0, cx: 0.0, cy: 0.0 };
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        let map = DepthMap::new(
            Camera { intrinsics, pose },
            Raster::new(5, 2, vec![9.0, 9.0, 9.0, 9.0, 9.0, 1.0, 2.0, 0.0, 4.0, f32::NAN]).expect("5x2"),
            Raster::new(5, 2, vec![1.0, 1.0, 1.0, 1.0, 1.0, 0.8, 0.79, 1.0, 0.9, 1.0]).expect("5x2"),
            Raster::filled(5, 2, [0; 3]),
        )
        .expect("sizes agree");
        let mut row = ConfidentRow::default();
        row.select(&map, 0, 0.8);
        row.select(&map, 1, 0.8);
        assert_eq!((row.columns, row.depths, row.with_depth), (vec![0.0, 3.0], vec![1.0, 4.0], 3));
    }
}
