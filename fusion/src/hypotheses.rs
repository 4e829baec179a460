//! The depths of one row that are put to the test.

use crate::kernel::LANES;

/// At most one depth for each pixel of a row, packed: what the kernel runs over.
#[derive(Default)]
pub(crate) struct HypothesisRow {
    /// Columns, ascending.
    columns: Vec<f32>,
    /// The depth to be tested.
    depths: Vec<f32>,
    /// The reference's own depth where it agrees with that; else 0.
    own: Vec<f32>,
    count: usize,
}

/// As many hypotheses as the kernel takes at a time; depths of 0 fill up the last ones.
pub(crate) struct Block<'a> {
    pub columns: &'a [f32; LANES],
    pub depths: &'a [f32; LANES],
    pub own: &'a [f32; LANES],
    /// How many of them there are.
    pub count: usize,
}

impl HypothesisRow {
    /// Empties the row, and makes room for `width` hypotheses.
    pub fn clear(&mut self, width: usize) {
        let padded = width.next_multiple_of(LANES) + LANES;
        for values in [&mut self.columns, &mut self.depths, &mut self.own] {
            values.resize(padded, 0.0);
        }
        self.count = 0;
    }

    /// Adds a hypothesis if it `counts`; without a branch.
    ///
    /// # Panics
    /// When there is no room for it.
    #[inline]
    pub fn push_if(&mut self, counts: bool, column: usize, depth: f32, own: f32) {
        self.columns[self.count] = column as f32;
        self.depths[self.count] = depth;
        self.own[self.count] = own;
        self.count += usize::from(counts);
    }

    /// How many hypotheses there are.
    pub fn len(&self) -> usize {
        self.count
    }

    /// Fills up the last block.
    pub fn end(&mut self) {
        let end = self.count.next_multiple_of(LANES);
        for values in [&mut self.columns, &mut self.depths, &mut self.own] {
            values[self.count..end].fill(0.0);
        }
    }

    /// How many blocks there are, after [`HypothesisRow::end`].
    pub fn blocks(&self) -> usize {
        self.count.div_ceil(LANES)
    }

    /// One of them.
    ///
    /// # Panics
    /// When there are fewer.
    #[inline]
    pub fn block(&self, index: usize) -> Block<'_> {
        Block {
            columns: &self.columns.as_chunks().0[index],
            depths: &self.depths.as_chunks().0[index],
            own: &self.own.as_chunks().0[index],
            count: LANES.min(self.count - LANES * index),
        }
    }

    /// The depths by column.
    #[cfg(test)]
    pub fn iter(&self) -> impl Iterator<Item = (usize, f32, f32)> {
        let values = self.columns.iter().zip(self.depths.iter().zip(&self.own)).take(self.count);
        values.map(|(x, (depth, own))| (*x as usize, *depth, *own))
    }
}
