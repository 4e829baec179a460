//! What the views that agree make of a hypothesis: its depth, its colour, its confidence, and who owns the surface.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::agree::{Pixel, Place};
use super::lanes::{LANES, Lanes};
use super::{Block, Input};
use crate::geometric::Neighbour;

/// Sums over the views that agree with some hypotheses.
pub(super) struct Sums<L: Lanes> {
    count: L::F,
    depth: L::F,
    /// Red, green and blue.
    color: [L::I; 3],
    confidence: L::F,
    /// Which neighbours agree: the first 32, then the next.
    agreeing: [L::I; 2],
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
    /// As [`Lanes`].
    #[inline(always)]
    pub unsafe fn of_reference(input: &Input<'_>, y: usize, block: &Block<'_>) -> Self {
        let reference = input.reference;
        let own = L::load(block.own);
        let agrees = L::less(L::splat(0.0), own);
        let (color_row, confidence_row) = (reference.color.row(y), reference.confidence.row(y));
        let (mut color, mut confidence) = ([0; LANES], [0.0; LANES]);
        for ((x, color), confidence) in block.columns.iter().zip(&mut color).zip(&mut confidence) {
            let x = *x as usize;
            let [r, g, b] = color_row[x];
            *color = i32::from_le_bytes([r, g, b, 0]);
            *confidence = confidence_row[x];
        }
        Self {
            count: L::only(agrees, L::splat(1.0)),
            depth: own,
            color: channels::<L>(L::only_i(agrees, L::load_i(&color))),
            confidence: L::only(agrees, L::load(&confidence)),
            agreeing: [L::splat_i(0); 2],
            beaten: L::less(own, own),
        }
    }

    /// Adds what the neighbour at `index` sees of the hypotheses of depth `d`, where it `agrees`.
    ///
    /// A view with a smaller footprint owns the surface, if it is confident: it will not emit it otherwise.
    ///
    /// # Safety
    /// As [`Lanes`].
    #[inline(always)]
    pub unsafe fn add(
        &mut self,
        (index, neighbour): (usize, &Neighbour<'_>),
        min_confidence: f32,
        (d, agrees): (L::F, L::M),
        (place, pixel): (&Place, &Pixel),
    ) {
        let confidence = L::load(&pixel.confidence);
        let color = L::shift_down(L::load_i(&pixel.color), L::load_i(&pixel.color_shift));
        self.count = L::add(self.count, L::only(agrees, L::splat(1.0)));
        self.depth = L::add(self.depth, L::only(agrees, L::load(&pixel.depth)));
        for (sum, channel) in self.color.iter_mut().zip(channels::<L>(L::only_i(agrees, color))) {
            *sum = L::add_i(*sum, channel);
        }
        self.confidence = L::add(self.confidence, L::only(agrees, confidence));
        if let Some(bits) = self.agreeing.get_mut(index / 32) {
            let bit = L::splat_i((1_u32 << (index % 32)) as i32);
            *bits = L::or_i(*bits, L::only_i(agrees, bit));
        }
        let smaller = L::less(L::load(&place.z), L::mul(L::splat(neighbour.rival.wins_below), d));
        let better = L::but_not(smaller, L::less(confidence, L::splat(min_confidence)));
        self.beaten = L::or(self.beaten, L::and(agrees, better));
    }

    /// How many views agree, the reference included.
    pub fn count(&self) -> L::F {
        self.count
    }

    /// The means.
    ///
    /// # Safety
    /// As [`Lanes`].
    #[inline(always)]
    pub unsafe fn means(&self) -> Means {
        let scale = L::div(L::splat(1.0), self.count);
        let [r, g, b] = self.color;
        let (r, g, b) = (L::to_float(r), L::to_float(g), L::to_float(b));
        let (r, g, b) = (rounded::<L>(r, scale), rounded::<L>(g, scale), rounded::<L>(b, scale));
        let color = L::add_i(L::add_i(r, L::mul_i(g, L::splat_i(1 << 8))), L::mul_i(b, L::splat_i(1 << 16)));
        let confidence = rounded::<L>(self.confidence, L::mul(scale, L::splat(255.0)));
        Means {
            depth: L::store(L::div(self.depth, self.count)),
            color: L::store_i(color),
            confidence: L::store_i(confidence),
            agreeing: [L::store_i(self.agreeing[0]), L::store_i(self.agreeing[1])],
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
