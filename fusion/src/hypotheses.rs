//! The depths of one row that are put to the test.

use crate::kernel::LANES;

/// Depths of neighbouring pixels that differ by less, relatively, are taken for one surface.
const ONE_SURFACE: f32 = 0.02;
/// After as many in a row that lie apart from the surface before, the next one makes a surface.
const NEXT_SURFACE: usize = 3;
/// From the first column of a block of one surface to the first that is no longer of it.
const MAX_COLUMNS: i32 = 24;

/// One of them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Hypothesis {
    pub column: i32,
    /// The depth to be tested.
    pub depth: f32,
    /// The reference's own depth where it agrees with that; else 0.
    pub own: f32,
}

/// At most one depth for each pixel of a row, in blocks: what the kernel runs over.
///
/// Neighbouring pixels of one surface come together, for they lie close together in other views, too. Those that lie
/// apart, outliers above all, come at the end.
#[derive(Default)]
pub(crate) struct HypothesisRow {
    blocks: Vec<Block>,
    /// The block that is not full yet, and what lies apart, till the end.
    near: Block,
    apart: Vec<Hypothesis>,
    /// How many there are.
    count: usize,
    /// Depth of the surface that was seen last, and how many were apart from it since.
    surface: f32,
    since: usize,
}

/// As many hypotheses as the kernel takes at a time; columns of 0 and depths that are no numbers fill up the rest.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
pub(crate) struct Block {
    pub columns: [i32; LANES],
    pub depths: [f32; LANES],
    /// As [`Hypothesis::own`].
    pub own: [f32; LANES],
    /// How many hypotheses there are.
    pub count: usize,
}

impl Default for Block {
    fn default() -> Self {
        Self { columns: [0; LANES], depths: [f32::NAN; LANES], own: [0.0; LANES], count: 0 }
    }
}

impl Block {
    /// Whether a hypothesis in that column may be added to those of one surface.
    #[inline]
    fn takes(&self, column: i32) -> bool {
        self.count == 0 || self.count < LANES && column - self.columns[0] < MAX_COLUMNS
    }

    /// Fills the next lane; there is one.
    #[inline]
    fn push(&mut self, Hypothesis { column, depth, own }: Hypothesis) {
        let lane = self.count % LANES;
        (self.columns[lane], self.depths[lane], self.own[lane]) = (column, depth, own);
        self.count += 1;
    }

    /// Whether all hypotheses lie within so many columns.
    pub fn is_within(&self, columns: i32) -> bool {
        let last = self.columns[self.count.clamp(1, LANES) - 1];
        last - self.columns[0] < columns
    }
}

impl HypothesisRow {
    /// Empties the row.
    pub fn clear(&mut self) {
        self.blocks.clear();
        self.apart.clear();
        (self.near, self.count) = (Block::default(), 0);
    }

    /// Adds a hypothesis in a column behind all others.
    #[inline]
    pub fn push(&mut self, hypothesis: Hypothesis) {
        let depth = hypothesis.depth;
        let is_apart = (depth - self.surface).abs() >= ONE_SURFACE * depth;
        if is_apart && self.count > 0 && self.since < NEXT_SURFACE {
            self.since += 1;
            self.apart.push(hypothesis);
        } else {
            (self.surface, self.since) = (depth, 0);
            if !self.near.takes(hypothesis.column) {
                self.blocks.push(std::mem::take(&mut self.near));
            }
            self.near.push(hypothesis);
        }
        self.count += 1;
    }

    /// Ends the last block, and adds those that lie apart.
    pub fn end(&mut self) {
        self.blocks.extend((self.near.count > 0).then(|| std::mem::take(&mut self.near)));
        self.blocks.extend(self.apart.chunks(LANES).map(|apart| {
            let mut block = Block::default();
            for hypothesis in apart {
                block.push(*hypothesis);
            }
            block
        }));
    }

    /// How many hypotheses there are.
    pub fn len(&self) -> usize {
        self.count
    }

    /// All of them, after [`HypothesisRow::end`].
    pub fn blocks(&self) -> &[Block] {
        &self.blocks
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(hypotheses: &[(i32, f32)]) -> HypothesisRow {
        let mut row = HypothesisRow::default();
        // What was in it before plays no part.
        for depth in [7.0, 70.0] {
            row.push(Hypothesis { column: 0, depth, own: 0.0 });
        }
        row.end();
        row.clear();
        for (column, depth) in hypotheses.iter().copied() {
            row.push(Hypothesis { column, depth, own: -depth });
        }
        row.end();
        row
    }

    /// Columns and depths of each block.
    fn blocks(row: &HypothesisRow) -> Vec<Vec<(i32, f32)>> {
        let lanes = |block: &Block| {
            assert!(block.own.iter().zip(block.depths).take(block.count).all(|(own, depth)| *own == -depth));
            assert!(block.depths[block.count..].iter().all(|depth| depth.is_nan()));
            block.columns.into_iter().zip(block.depths).take(block.count).collect()
        };
        row.blocks().iter().map(lanes).collect()
    }

    #[test]
    fn outliers_come_last() {
        let row = row(&[(0, 1.0), (1, 1.01), (2, 1.5), (3, 1.02), (4, 0.5), (5, 1.03)]);
        let surface = vec![(0, 1.0), (1, 1.01), (3, 1.02), (5, 1.03)];
        assert_eq!(blocks(&row), [surface, vec![(2, 1.5), (4, 0.5)]]);
        assert_eq!(row.len(), 6);
    }

    #[test]
    fn another_surface_is_noticed_soon() {
        let row = row(&[(0, 1.0), (1, 2.0), (2, 2.0), (3, 2.0), (4, 2.0), (5, 2.0), (6, 1.0)]);
        let apart = vec![(1, 2.0), (2, 2.0), (3, 2.0), (6, 1.0)];
        assert_eq!(blocks(&row), [vec![(0, 1.0), (4, 2.0), (5, 2.0)], apart]);
    }

    #[test]
    fn blocks_are_full_unless_their_columns_are_far_apart() {
        let row = row(&(0..40).map(|x| (if x < 20 { x } else { x + 30 }, 3.0)).collect::<Vec<_>>());
        let counts: Vec<_> = row.blocks().iter().map(|block| block.count).collect();
        assert_eq!(counts, [16, 4, 16, 4]);
        assert!(self::row(&[]).blocks().is_empty());
    }
}
