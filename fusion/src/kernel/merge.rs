//! What the views that agree make of a hypothesis: its colour, its confidence, and who owns the surface.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::lanes::{LANES, Lanes};
use super::{Answer, Input};
use crate::surface::EQUAL_FOOTPRINTS;

/// Eight hypotheses; those that are not kept mean nothing.
pub(super) struct Merged {
    /// Red, green and blue.
    pub color: [[i32; LANES]; 3],
    /// In 255ths.
    pub confidence: [i32; LANES],
    /// Which neighbours agree: the first 32, then the next.
    pub agreeing: [[i32; LANES]; 2],
    /// Whether the reference owns the surface, lane k as bit k.
    pub owns: u32,
}

/// Merges the hypotheses in columns `x` with depths `d` that are `kept`, with `own` being the reference's depths
/// where it agrees, and `count` views agreeing; the row of the reference has these colours and confidences.
///
/// Colours and confidences are those of the nearest pixel of each view. Agreeing views that are not confident
/// there will not emit the surface, so they do not compete for it.
///
/// # Safety
/// As [`Lanes`]; with vector instructions, a row of the reference and each neighbour have two pixels or more.
#[inline(always)]
pub(super) unsafe fn merge<L: Lanes>(
    input: &Input<'_>,
    (own_colors, own_confidences): (&[[u8; 3]], &[f32]),
    (x, d, own): (L::F, L::F, L::F),
    (kept, count): (L::M, L::F),
    answers: &[Answer],
) -> Merged {
    let Input { neighbours, options, .. } = *input;
    let zero = L::splat(0.0);
    let column = L::min_i(L::truncate(x), L::splat_i(own_colors.len() as i32 - 1));
    let has_own = L::and(kept, L::less(zero, own));
    let mut color = channels::<L>(L::only_i(has_own, L::gather_rgb(own_colors, column)));
    let mut confidence = L::only(has_own, L::gather(own_confidences, column));
    let mut agreeing = [L::splat_i(0); 2];
    let mut beaten = L::less(zero, zero);
    let min_confidence = L::splat(options.min_confidence);
    for (index, (neighbour, answer)) in neighbours.iter().zip(answers).enumerate() {
        let agrees = L::and(kept, L::less(zero, L::load(&answer.depth)));
        if L::bits(agrees) == 0 {
            continue;
        }
        let seen_color = channels::<L>(L::only_i(agrees, L::load_i(&answer.color)));
        for channel in 0..3 {
            color[channel] = L::add_i(color[channel], seen_color[channel]);
        }
        let seen_confidence = L::load(&answer.confidence);
        confidence = L::add(confidence, L::only(agrees, seen_confidence));
        if let Some(bits) = agreeing.get_mut(index / 32) {
            let bit = L::splat_i((1_u32 << (index % 32)) as i32);
            *bits = L::or_i(*bits, L::only_i(agrees, bit));
        }
        // Of views with one footprint the order of their places decides.
        let rival = &neighbour.rival;
        let footprint = L::mul(L::load(&answer.z), L::splat(rival.pixel_width));
        let others = L::mul(d, L::splat(rival.reference_pixel_width));
        let difference = L::abs(L::sub(footprint, others));
        let equal = L::less(difference, L::mul(L::splat(EQUAL_FOOTPRINTS), others));
        let smaller = L::less(footprint, others);
        let better = if rival.wins_ties { L::or(equal, smaller) } else { L::but_not(smaller, equal) };
        let better = L::but_not(better, L::less(seen_confidence, min_confidence));
        beaten = L::or(beaten, L::and(agrees, better));
    }
    Merged {
        color: [
            rounded::<L>(L::to_float(color[0]), count, 1.0),
            rounded::<L>(L::to_float(color[1]), count, 1.0),
            rounded::<L>(L::to_float(color[2]), count, 1.0),
        ],
        confidence: rounded::<L>(confidence, count, 255.0),
        agreeing: [L::store_i(agreeing[0]), L::store_i(agreeing[1])],
        owns: !L::bits(beaten),
    }
}

/// Red, green and blue of colours whose bytes they are, the lowest first.
#[inline(always)]
unsafe fn channels<L: Lanes>(color: L::I) -> [L::I; 3] {
    [L::byte::<0>(color), L::byte::<8>(color), L::byte::<16>(color)]
}

/// The mean, scaled, rounded to nearest.
#[inline(always)]
unsafe fn rounded<L: Lanes>(sum: L::F, count: L::F, scale: f32) -> [i32; LANES] {
    let mean = L::mul(L::div(sum, count), L::splat(scale));
    L::store_i(L::truncate(L::add(mean, L::splat(0.5))))
}
