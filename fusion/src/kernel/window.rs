//! A window of a neighbour's rasters around the places where it sees some hypotheses.
//!
//! Hypotheses of one surface that lie side by side in the reference mostly do so in a neighbour, too: what it has there
//! is then picked by permutations from a few whole registers, instead of being copied pixel by pixel.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::agree::{Answer, Place};
use super::lanes::{LANES, Lanes, WINDOW_COLUMNS};
use crate::geometric::Neighbour;

/// From the row of the first place to that of the last; of more, each would have to be read for itself.
const MAX_ROWS: i32 = 6;

/// The first of [`WINDOW_COLUMNS`] columns, all of them of the map, in which places lie with the columns behind them.
#[derive(Clone, Copy)]
pub(super) struct Window {
    column: i32,
}

impl Window {
    /// The window in which all four pixels around each of the places lie, if there is one.
    ///
    /// # Safety
    /// As [`Lanes`]; `place` is of this neighbour.
    #[inline(always)]
    pub unsafe fn around<L: Lanes>(neighbour: &Neighbour<'_>, place: &Place) -> Option<Self> {
        let columns = neighbour.size[0];
        if !L::PICKS || place.inside == 0 || place.border != 0 || columns < WINDOW_COLUMNS {
            return None;
        }
        let [first, last] = ends(place.inside);
        // In the middle between the first place and the last, and within the map.
        let spare = WINDOW_COLUMNS - 2;
        let column = (place.column[first] + place.column[last] - spare) >> 1;
        let column = column.min(columns - WINDOW_COLUMNS).max(0);
        let fits = L::below(L::sub_i(L::load_i(&place.column), L::splat_i(column)), WINDOW_COLUMNS - 1);
        let is_level = (place.row[last] - place.row[first]).abs() <= MAX_ROWS;
        (is_level && place.inside & !L::bits(fits) == 0).then_some(Self { column })
    }

    /// The depths of the four pixels around the places: the upper left, the upper right, then the lower ones.
    ///
    /// # Safety
    /// As [`Lanes`]; the window is around `place` in this neighbour.
    #[inline(always)]
    pub unsafe fn corners<L: Lanes>(self, neighbour: &Neighbour<'_>, place: &Place) -> [L::F; 4] {
        let at = L::sub_i(L::load_i(&place.column), L::splat_i(self.column));
        let next = L::add_i(at, L::splat_i(1));
        let rows = L::load_i(&place.row);
        let mut corners = [L::splat(0.0); 4];
        let mut left = place.inside;
        while left != 0 {
            for row in ends(left).map(|lane| place.row[lane]) {
                let is_there = L::equal(rows, L::splat_i(row));
                left &= !L::bits(is_there);
                let upper = neighbour.depth.as_ptr().add(self.offset(neighbour, row));
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

    /// Colours and confidences of the neighbour's pixels in lanes that agree.
    ///
    /// # Safety
    /// As [`Lanes`]; the window is around the places that `answer` is for in this neighbour, and `agrees` are the lanes
    /// in which that agrees.
    #[inline(always)]
    pub unsafe fn colors<L: Lanes>(self, neighbour: &Neighbour<'_>, answer: &Answer, agrees: L::M) -> L::I {
        let at = L::sub_i(L::load_i(&answer.column), L::splat_i(self.column));
        let rows = L::load_i(&answer.row);
        let mut colors = L::splat_i(0);
        let mut left = L::bits(agrees);
        while left != 0 {
            for row in ends(left).map(|lane| answer.row[lane]) {
                let is_there = L::equal(rows, L::splat_i(row));
                left &= !L::bits(is_there);
                let first = neighbour.color.as_ptr().add(self.offset(neighbour, row));
                colors = L::select_i(is_there, L::pick_words(first, at), colors);
            }
        }
        colors
    }

    /// Index of the window's first pixel in a row.
    #[inline(always)]
    fn offset(self, neighbour: &Neighbour<'_>, row: i32) -> usize {
        row as usize * neighbour.size[0] as usize + self.column as usize
    }
}

/// The first lane and the last of those whose bits are set; some are.
///
/// Mostly all places lie in one row or two, so in those of the ends: taking both each time spares the processor a guess
/// at how many there are.
#[inline(always)]
fn ends(lanes: u32) -> [usize; 2] {
    // The remainders spare a check of the index.
    [lanes.trailing_zeros() as usize % LANES, lanes.ilog2() as usize % LANES]
}
