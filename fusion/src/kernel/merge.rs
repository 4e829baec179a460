//! What the views that agree make of a hypothesis: its depth, its colour, its confidence, and who owns the surface.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::Input;
use super::agree::{Answer, Place};
use super::lanes::{LANES, Lanes, WINDOW_COLUMNS};
use super::places;
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
    pub unsafe fn count(block: &Block, answers: &[Answer]) -> Self {
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        let mut count = L::only(L::less(zero, L::load(&block.own)), one);
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
    /// Red, green and blue.
    color: [L::I; 3],
    confidence: L::F,
    /// Whether another view owns the surface.
    beaten: L::M,
}

/// Sixteen hypotheses; those that are not kept mean nothing.
pub(super) struct Means {
    /// Of the reference's depths.
    pub depth: [f32; LANES],
    /// Red in the lowest byte, then green and blue.
    pub color: [i32; LANES],
    /// In 255ths.
    pub confidence: [i32; LANES],
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
    pub unsafe fn of_reference(input: &Input<'_>, y: usize, block: &Block) -> Self {
        let own = L::load(&block.own);
        let agrees = L::less(L::splat(0.0), own);
        let (colors, confidences) = (input.reference.color.row(y), input.reference.confidence.row(y));
        let columns = L::load_i(&block.columns);
        let first = block.columns[0].min(colors.len() as i32 - WINDOW_COLUMNS);
        let (color, confidence) = if L::PICKS && first >= 0 && block.is_within(WINDOW_COLUMNS) {
            let at = L::sub_i(columns, L::splat_i(first));
            let (colors, confidences) = (colors.as_ptr(), confidences.as_ptr());
            (L::pick_color(colors.add(first as usize), at), L::pick(confidences.add(first as usize), at))
        } else {
            (places::gather_color::<L>(colors, columns), L::gather(confidences.as_ptr(), columns))
        };
        Self {
            depth: own,
            color: channels::<L>(L::only_i(agrees, color)),
            confidence: L::only(agrees, confidence),
            beaten: L::less(own, own),
        }
    }

    /// With what a neighbour has at `place` for hypotheses of depth `d`, where it agrees.
    ///
    /// A view with a smaller footprint owns the surface, if it is confident: it will not emit it otherwise.
    ///
    /// # Safety
    /// As [`Lanes`]; `answer` is this neighbour's, to what is at `place`, and it agrees with something.
    #[inline(always)]
    pub unsafe fn and(
        self,
        neighbour: &Neighbour<'_>,
        min_confidence: f32,
        d: L::F,
        (place, answer): (&Place, &Answer),
    ) -> Self {
        let depth = L::load(&answer.depth);
        let agrees = L::less(L::splat(0.0), depth);
        let (color, confidence) = match place.window {
            Some(window) => window.pixels::<L>(neighbour, answer),
            None => places::pixels::<L>(neighbour, answer),
        };
        let [r, g, b] = channels::<L>(L::only_i(agrees, color));
        let smaller = L::less(L::load(&place.z), L::mul(L::splat(neighbour.rival.wins_below), d));
        let better = L::but_not(smaller, L::less(confidence, L::splat(min_confidence)));
        Self {
            depth: L::add(self.depth, depth),
            color: [L::add_i(self.color[0], r), L::add_i(self.color[1], g), L::add_i(self.color[2], b)],
            confidence: L::add(self.confidence, L::only(agrees, confidence)),
            beaten: L::or(self.beaten, L::and(agrees, better)),
        }
    }

    /// The means over the views that agree.
    ///
    /// # Safety
    /// As [`Lanes`].
    #[inline(always)]
    pub unsafe fn means(self, votes: &Votes<L>) -> Means {
        let scale = L::div(L::splat(1.0), votes.count);
        let [r, g, b] = self.color;
        let (r, g, b) = (L::to_float(r), L::to_float(g), L::to_float(b));
        let (r, g, b) = (rounded::<L>(r, scale), rounded::<L>(g, scale), rounded::<L>(b, scale));
        let color = L::add_i(L::add_i(r, L::mul_i(g, L::splat_i(1 << 8))), L::mul_i(b, L::splat_i(1 << 16)));
        let confidence = rounded::<L>(self.confidence, L::mul(scale, L::splat(255.0)));
        Means {
            depth: L::store(L::div(self.depth, votes.count)),
            color: L::store_i(color),
            confidence: L::store_i(confidence),
            agreeing: [L::store_i(votes.agreeing[0]), L::store_i(votes.agreeing[1])],
            owns: !L::bits(self.beaten),
        }
    }
}

/// Red, green and blue of colours whose bytes they are, the lowest first.
#[inline(always)]
unsafe fn channels<L: Lanes>(color: L::I) -> [L::I; 3] {
    let (byte, eight) = (L::splat_i(255), L::splat_i(8));
    let second = L::shift_down(color, eight);
    [L::and_i(color, byte), L::and_i(second, byte), L::and_i(L::shift_down(second, eight), byte)]
}

/// The product, rounded to nearest.
#[inline(always)]
unsafe fn rounded<L: Lanes>(sum: L::F, scale: L::F) -> L::I {
    L::truncate(L::mul_add(sum, scale, L::splat(0.5)))
}
