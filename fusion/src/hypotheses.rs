//! The depths of one row that are put to the test.

/// At most one depth for each pixel of a row, packed: what the geometric criterion runs over.
#[derive(Default)]
pub(crate) struct HypothesisRow {
    /// Columns, ascending.
    pub columns: Vec<f32>,
    /// The depth to be tested.
    pub depths: Vec<f32>,
    /// The reference's own depth where it agrees with that; else 0.
    pub own: Vec<f32>,
}

impl HypothesisRow {
    pub fn clear(&mut self) {
        self.columns.clear();
        self.depths.clear();
        self.own.clear();
    }

    pub fn push(&mut self, column: usize, depth: f32, own: f32) {
        self.columns.push(column as f32);
        self.depths.push(depth);
        self.own.push(own);
    }
}
