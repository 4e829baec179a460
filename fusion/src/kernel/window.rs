//! A window of a neighbour's rasters around the places where it sees some hypotheses.
//!
//! Hypotheses of one surface that lie side by side in the reference mostly do so in a neighbour, too: what it has there
//! is then picked by permutations from a few whole registers, instead of being copied pixel by pixel.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::agree::{Answer, Place};
use super::lanes::{LANES, Lanes, WINDOW_COLUMNS};
use crate::geometric::Neighbour;

/// Rows of a window: those above the places lie in the first three.
const ROWS: i32 = 4;

/// The upper left of [`WINDOW_COLUMNS`] columns and [`ROWS`] rows, all of them of the map.
#[derive(Clone, Copy)]
pub(super) struct Window {
    column: i32,
    row: i32,
}

impl Window {
    /// The window in which all four pixels around each of the places lie, if there is one.
    ///
    /// # Safety
    /// As [`Lanes`]; `place` is of this neighbour.
    #[inline(always)]
    pub unsafe fn around<L: Lanes>(neighbour: &Neighbour<'_>, place: &Place) -> Option<Self> {
        let [columns, rows] = neighbour.size;
        if !L::PICKS || place.inside == 0 || place.border != 0 || columns < WINDOW_COLUMNS || rows < ROWS {
            return None;
        }
        // The remainders spare a check of the index.
        let first = place.inside.trailing_zeros() as usize % LANES;
        let last = place.inside.ilog2() as usize % LANES;
        // In the middle between the first place and the last, and within the map.
        let spare = WINDOW_COLUMNS - 2;
        let column = (place.column[first] + place.column[last] - spare) >> 1;
        let row = (place.row[first] + place.row[last] - 1) >> 1;
        let column = column.min(columns - WINDOW_COLUMNS).max(0);
        let row = row.min(rows - ROWS).max(0);
        let fits = L::and(
            L::below(L::sub_i(L::load_i(&place.column), L::splat_i(column)), WINDOW_COLUMNS - 1),
            L::below(L::sub_i(L::load_i(&place.row), L::splat_i(row)), ROWS - 1),
        );
        (place.inside & !L::bits(fits) == 0).then_some(Self { column, row })
    }

    /// The depths of the four pixels around the places: the upper left, the upper right, then the lower ones.
    ///
    /// # Safety
    /// As [`Lanes`]; the window is around `place` in this neighbour.
    #[inline(always)]
    pub unsafe fn corners<L: Lanes>(self, neighbour: &Neighbour<'_>, place: &Place) -> [L::F; 4] {
        let (at, row) = self.within::<L>(&place.column, &place.row);
        let next = L::add_i(at, L::splat_i(1));
        let mut corners = [L::splat(0.0); 4];
        // Mostly all places lie in one row or two; what is not needed may not be in the cache.
        for k in 0..ROWS - 1 {
            let is_there = L::equal(row, L::splat_i(k));
            if L::bits(is_there) != 0 {
                let upper = neighbour.depth.as_ptr().add(self.offset(neighbour, k));
                let lower = upper.add(neighbour.size[0] as usize);
                let depths =
                    [L::pick(upper, at), L::pick(upper, next), L::pick(lower, at), L::pick(lower, next)];
                for (corner, depth) in corners.iter_mut().zip(depths) {
                    *corner = L::select(is_there, depth, *corner);
                }
            }
        }
        corners
    }

    /// Colours, their bytes the lowest three, and confidences of the neighbour's pixels; anything for those that disagree.
    ///
    /// # Safety
    /// As [`Lanes`]; the window is around the places that `answer` is for in this neighbour.
    #[inline(always)]
    pub unsafe fn pixels<L: Lanes>(self, neighbour: &Neighbour<'_>, answer: &Answer) -> (L::I, L::F) {
        let (at, row) = self.within::<L>(&answer.column, &answer.row);
        let color = neighbour.color.as_ptr();
        let confidence = neighbour.confidence.as_ptr();
        let mut pixels = (L::splat_i(0), L::splat(0.0));
        for k in 0..ROWS {
            let is_there = L::equal(row, L::splat_i(k));
            if L::bits(is_there) != 0 {
                let first = self.offset(neighbour, k);
                pixels.0 = L::select_i(is_there, L::pick_color(color.add(first), at), pixels.0);
                pixels.1 = L::select(is_there, L::pick(confidence.add(first), at), pixels.1);
            }
        }
        pixels
    }

    /// Columns and rows of the window.
    #[inline(always)]
    unsafe fn within<L: Lanes>(self, columns: &[i32; LANES], rows: &[i32; LANES]) -> (L::I, L::I) {
        let column = L::sub_i(L::load_i(columns), L::splat_i(self.column));
        (column, L::sub_i(L::load_i(rows), L::splat_i(self.row)))
    }

    /// Index of the first pixel of a row.
    #[inline(always)]
    fn offset(self, neighbour: &Neighbour<'_>, row: i32) -> usize {
        (self.row + row) as usize * neighbour.size[0] as usize + self.column as usize
    }
}
