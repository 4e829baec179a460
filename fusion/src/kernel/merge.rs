//! What the views that agree make of a hypothesis: its depth, its colour, its confidence, and who owns the surface.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::agree::{Answer, Place};
use super::lanes::{LANES, Lanes, WINDOW_COLUMNS};
use super::places;
use super::{Input, first_lanes};
use crate::geometric::Neighbour;
use crate::hypotheses::Block;

/// Who agrees with some hypotheses.
pub(super) struct Votes<L: Lanes> {
    /// How many views, the reference included.
    pub count: L::F,
    /// Which neighbours: the first 32, then the next.
    agreeing: [L::I; 2],
}

impl<L: Lanes> Votes<L> {
    /// Counts the answers of all neighbours to the hypotheses of `block`.
    ///
    /// # Safety
    /// As [`Lanes`].
    #[inline(always)]
    pub unsafe fn count(block: &Block<'_>, answers: &[Answer]) -> Self {
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        let own = L::and(first_lanes::<L>(block.count), L::less(zero, L::load(block.own)));
        let mut count = L::only(own, one);
        let mut agreeing = [L::splat_i(0); 2];
        for (index, answer) in answers.iter().enumerate() {
            let agrees = L::less(zero, L::load(&answer.depth));
            count = L::add(count, L::only(agrees, one));
            if let Some(bits) = agreeing.get_mut(index / 32) {
                let bit = L::splat_i((1_u32 << (index % 32)) as i32);
                *bits = L::or_i(*bits, L::only_i(agrees, bit));
            }
        }
        Self { count, agreeing }
    }
}

/// Sums over the views that agree with some hypotheses.
pub(super) struct Sums<L: Lanes> {
    depth: L::F,
    /// Red, green, blue and confidence.
    color: [L::I; 4],
    /// Whether another view owns the surface.
    beaten: L::M,
}

/// Of sixteen hypotheses; zeros where they are not kept.
pub(super) struct Means {
    /// Of the reference's depths.
    pub depth: [f32; LANES],
    /// Red in the lowest byte, then green, blue and the confidence.
    pub color: [i32; LANES],
    /// Which neighbours agree: the first 32, then the next.
    pub agreeing: [[i32; LANES]; 2],
    /// Whether the reference owns the surface, lane k as bit k.
    pub owns: u32,
}

impl<L: Lanes> Sums<L> {
    /// The reference's own, where it agrees with the hypotheses of `block` in row `y`.
    ///
    /// # Safety
    /// As [`Lanes`]; the columns are of the reference, whose rasters have one size.
    #[inline(always)]
    pub unsafe fn of_reference(input: &Input<'_>, y: usize, block: &Block<'_>) -> Self {
        let own = L::load(block.own);
        let agrees = L::less(L::splat(0.0), own);
        let colors = input.reference.color.row(y);
        let columns = L::load_i(block.columns);
        let first = block.columns[0].min(colors.len() as i32 - WINDOW_COLUMNS);
        let color = if L::PICKS && first >= 0 && block.is_within(WINDOW_COLUMNS) {
            L::pick_words(colors.as_ptr().add(first as usize), L::sub_i(columns, L::splat_i(first)))
        } else {
            L::gather_words(colors.as_ptr(), columns)
        };
        Self { depth: own, color: channels::<L>(L::only_i(agrees, color)), beaten: L::less(own, own) }
    }

    /// With what a neighbour has at `place` for hypotheses of depth `d`, where it agrees.
    ///
    /// A view with a smaller footprint owns the surface, if it is confident, to a 255th: it will not emit it otherwise.
    ///
    /// # Safety
    /// As [`Lanes`]; `answer` is this neighbour's, to what is at `place`, and it agrees with something.
    #[inline(always)]
    pub unsafe fn and(
        self,
        neighbour: &Neighbour<'_>,
        min_confidence: u8,
        d: L::F,
        (place, answer): (&Place, &Answer),
    ) -> Self {
        let depth = L::load(&answer.depth);
        let agrees = L::less(L::splat(0.0), depth);
        let color = match place.window {
            Some(window) => window.colors::<L>(neighbour, answer, agrees),
            None => places::colors::<L>(neighbour, answer),
        };
        let [r, g, b, confidence] = channels::<L>(L::only_i(agrees, color));
        let smaller = L::less(L::load(&place.z), L::mul(L::splat(neighbour.rival.wins_below), d));
        let better = L::but_not(smaller, L::below(confidence, min_confidence.into()));
        Self {
            depth: L::add(self.depth, depth),
            color: [
                L::add_i(self.color[0], r),
                L::add_i(self.color[1], g),
                L::add_i(self.color[2], b),
                L::add_i(self.color[3], confidence),
            ],
            beaten: L::or(self.beaten, L::and(agrees, better)),
        }
    }

    /// The means over the views that agree, for hypotheses that are kept.
    ///
    /// # Safety
    /// As [`Lanes`].
    #[inline(always)]
    pub unsafe fn means(self, votes: &Votes<L>, is_kept: L::M) -> Means {
        let scale = L::div(L::splat(1.0), votes.count);
        let [r, g, b, confidence] = self.color;
        let low = L::or_i(mean::<L>(r, scale), L::mul_i(mean::<L>(g, scale), L::splat_i(1 << 8)));
        let high = L::or_i(mean::<L>(b, scale), L::mul_i(mean::<L>(confidence, scale), L::splat_i(1 << 8)));
        let color = L::or_i(low, L::mul_i(high, L::splat_i(1 << 16)));
        Means {
            depth: L::store(L::only(is_kept, L::div(self.depth, votes.count))),
            color: L::store_i(L::only_i(is_kept, color)),
            agreeing: [
                L::store_i(L::only_i(is_kept, votes.agreeing[0])),
                L::store_i(L::only_i(is_kept, votes.agreeing[1])),
            ],
            owns: L::bits(L::but_not(is_kept, self.beaten)),
        }
    }
}

/// The bytes, the lowest first.
#[inline(always)]
unsafe fn channels<L: Lanes>(color: L::I) -> [L::I; 4] {
    let (byte, eight) = (L::splat_i(255), L::splat_i(8));
    let second = L::shift_down(color, eight);
    let third = L::shift_down(second, eight);
    [L::and_i(color, byte), L::and_i(second, byte), L::and_i(third, byte), L::shift_down(third, eight)]
}

/// The sum times `scale`, rounded to nearest.
#[inline(always)]
unsafe fn mean<L: Lanes>(sum: L::I, scale: L::F) -> L::I {
    L::truncate(L::mul_add(L::to_float(sum), scale, L::splat(0.5)))
}
