//! The depths of one row that are put to the test.

use crate::kernel::{COUNTING, LANES, Lanes};

/// Depths that differ by less, relatively, from the surface seen last are taken for it; sixteen columns at once are
/// compared with the last depth of the surface before them.
const ONE_SURFACE: f32 = 0.02;
/// After as many in a row that lie apart from the surface before, the next one makes a surface; of sixteen columns at
/// once, when most of them do.
const NEXT_SURFACE: usize = 3;
/// From the first column of a block of one surface to the first that is no longer of it.
const MAX_COLUMNS: i32 = 28;

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
    /// Those of surfaces, by columns, and those that lie apart from them.
    near: List,
    apart: List,
    /// Where the blocks of each begin, and how many hypotheses they hold.
    blocks: Vec<Span>,
    /// How many of them are of those near each other.
    blocks_near: usize,
    /// Depth of the surface that was seen last, and how many were apart from it since.
    surface: f32,
    since: usize,
}

#[derive(Clone, Copy)]
struct Span {
    first: usize,
    count: usize,
}

/// Hypotheses, each property for itself. Behind the last one there is memory for as many as the kernel takes at a time.
#[derive(Default)]
struct List {
    columns: Vec<i32>,
    depths: Vec<f32>,
    own: Vec<f32>,
    count: usize,
}

/// As many hypotheses as the kernel takes at a time. Those beyond the count are others of the row or zeros.
#[derive(Clone, Copy)]
pub(crate) struct Block<'a> {
    pub columns: &'a [i32; LANES],
    pub depths: &'a [f32; LANES],
    /// As [`Hypothesis::own`].
    pub own: &'a [f32; LANES],
    /// How many hypotheses there are.
    pub count: usize,
}

impl List {
    /// Empties the list, and makes room for `width` hypotheses.
    fn clear(&mut self, width: usize) {
        let room = width + LANES;
        self.columns.resize(room, 0);
        self.depths.resize(room, 0.0);
        self.own.resize(room, 0.0);
        self.count = 0;
    }

    /// # Panics
    /// When there are more than the list has room for.
    #[inline]
    fn push(&mut self, Hypothesis { column, depth, own }: Hypothesis) {
        (self.columns[self.count], self.depths[self.count], self.own[self.count]) = (column, depth, own);
        self.count += 1;
    }

    /// Adds the first `count` of the lanes.
    ///
    /// # Panics
    /// As [`List::push`].
    #[inline]
    fn extend(&mut self, columns: &[i32; LANES], depths: &[f32; LANES], count: usize) {
        let lanes = self.count..self.count + LANES;
        self.columns[lanes.clone()].copy_from_slice(columns);
        self.depths[lanes.clone()].copy_from_slice(depths);
        self.own[lanes].copy_from_slice(depths);
        self.count += count;
    }

    /// Makes what lies behind the last one zeros.
    fn end(&mut self) {
        let behind = self.count..self.count + LANES;
        self.columns[behind.clone()].fill(0);
        self.depths[behind.clone()].fill(0.0);
        self.own[behind].fill(0.0);
    }

    fn block(&self, Span { first, count }: Span) -> Block<'_> {
        fn lanes<T>(values: &[T], first: usize) -> &[T; LANES] {
            values[first..].first_chunk().expect("there is room for a block behind the last hypothesis")
        }
        let (columns, depths) = (lanes(&self.columns, first), lanes(&self.depths, first));
        Block { columns, depths, own: lanes(&self.own, first), count }
    }
}

impl Block<'_> {
    /// Whether all hypotheses lie within so many columns.
    pub fn is_within(&self, columns: i32) -> bool {
        let last = self.columns[self.count.clamp(1, LANES) - 1];
        last - self.columns[0] < columns
    }
}

impl HypothesisRow {
    /// Empties the row, which has `width` columns.
    pub fn clear(&mut self, width: usize) {
        self.near.clear(width);
        self.apart.clear(width);
        self.blocks.clear();
        (self.surface, self.since) = (0.0, 0);
    }

    /// Adds a hypothesis in a column behind all others.
    #[inline]
    pub fn push(&mut self, hypothesis: Hypothesis) {
        let depth = hypothesis.depth;
        let is_apart = (depth - self.surface).abs() >= ONE_SURFACE * depth;
        if is_apart && self.surface > 0.0 && self.since < NEXT_SURFACE {
            self.since += 1;
            self.apart.push(hypothesis);
        } else {
            (self.surface, self.since) = (depth, 0);
            self.near.push(hypothesis);
        }
    }

    /// Adds the reference's own depths in sixteen columns from `first` on, as far as `sure` says so, behind all others.
    ///
    /// # Safety
    /// As [`Lanes`].
    #[inline(always)]
    #[allow(unsafe_code, clippy::inline_always, reason = "part of the kernel")]
    pub unsafe fn push_own<L: Lanes>(&mut self, first: i32, depths: &[f32; LANES], sure: L::M) {
        // SAFETY: the caller vouches for the processor.
        unsafe {
            let d = L::load(depths);
            let columns = L::add_i(L::load_i(&COUNTING), L::splat_i(first));
            let difference = L::abs(L::sub(d, L::splat(self.surface)));
            let near = L::and(sure, L::less(difference, L::mul(d, L::splat(ONE_SURFACE))));
            let apart = L::but_not(sure, near);
            let count_near = L::bits(near).count_ones() as usize;
            let count_apart = L::bits(apart).count_ones() as usize;
            if count_apart <= count_near {
                let near_depths = L::store(L::compress(near, d));
                self.near.extend(&L::store_i(L::compress_i(near, columns)), &near_depths, count_near);
                if count_near > 0 {
                    self.surface = near_depths[count_near - 1];
                }
                if count_apart > 0 {
                    let columns = L::store_i(L::compress_i(apart, columns));
                    self.apart.extend(&columns, &L::store(L::compress(apart, d)), count_apart);
                }
            } else {
                // Another surface begins, or none is there.
                let sure = L::bits(sure);
                for k in (0..LANES).filter(|k| sure >> k & 1 == 1) {
                    self.push(Hypothesis { column: first + k as i32, depth: depths[k], own: depths[k] });
                }
            }
            self.since = 0;
        }
    }

    /// Divides the hypotheses into blocks.
    pub fn end(&mut self) {
        self.near.end();
        self.apart.end();
        let mut first = 0;
        while first < self.near.count {
            let most = LANES.min(self.near.count - first);
            let columns = &self.near.columns[first..first + most];
            let count = columns.partition_point(|column| *column - columns[0] < MAX_COLUMNS);
            self.blocks.push(Span { first, count });
            first += count;
        }
        self.blocks_near = self.blocks.len();
        let apart = self.apart.count;
        self.blocks
            .extend((0..apart).step_by(LANES).map(|first| Span { first, count: LANES.min(apart - first) }));
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.near.count + self.apart.count
    }

    /// All of them, after [`HypothesisRow::end`].
    pub fn blocks(&self) -> impl Iterator<Item = Block<'_>> {
        let (near, apart) = self.blocks.split_at(self.blocks_near);
        near.iter().map(|span| self.near.block(*span)).chain(apart.iter().map(|span| self.apart.block(*span)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(hypotheses: &[(i32, f32)]) -> HypothesisRow {
        let mut row = HypothesisRow::default();
        row.clear(100);
        // What was in it before plays no part.
        for depth in [7.0, 70.0] {
            row.push(Hypothesis { column: 0, depth, own: 0.0 });
        }
        row.end();
        row.clear(100);
        for (column, depth) in hypotheses.iter().copied() {
            row.push(Hypothesis { column, depth, own: -depth });
        }
        row.end();
        row
    }

    /// Columns and depths of each block.
    fn blocks(row: &HypothesisRow) -> Vec<Vec<(i32, f32)>> {
        let lanes = |block: &Block<'_>| -> Vec<(i32, f32)> {
            assert!(block.own.iter().zip(block.depths).take(block.count).all(|(own, depth)| *own == -depth));
            block.columns.iter().copied().zip(block.depths.iter().copied()).take(block.count).collect()
        };
        row.blocks().map(|block| lanes(&block)).collect()
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
        let counts: Vec<_> = row.blocks().map(|block| block.count).collect();
        assert_eq!(counts, [16, 4, 16, 4]);
        assert_eq!(self::row(&[]).blocks().count(), 0);
    }
}
