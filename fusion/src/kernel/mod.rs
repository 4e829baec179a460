//! The inner loop of the filter: one row of the reference against all neighbours.
//!
//! Eight hypotheses at a time are put to each neighbour ([`agree`]); those that enough views agree with are
//! merged ([`merge`]). What is in between fits into the processor's first cache. The loop is compiled for AVX2
//! and for every other processor; the level is chosen when the program runs, and changes no bit.
#![allow(
    clippy::inline_always,
    reason = "instructions are enabled by the function that a kernel is inlined into"
)]
#![allow(clippy::needless_range_loop, reason = "indices name registers, and loops over them must unroll")]
#![allow(unsafe_code, reason = "vector instructions need a check of the processor")]

mod agree;
#[cfg(target_arch = "x86_64")]
mod avx2;
mod lanes;
mod merge;

use planesweep_scene::DepthMap;

use crate::dynamic::settle;
use crate::geometric::{Neighbour, RowTransfer};
use crate::hypotheses::{Block, HypothesisRow};
use crate::options::{FilterOptions, FusionMethod};
use agree::ask;
pub(crate) use lanes::{LANES, Lanes, Portable};
use merge::merge;

/// The instructions that the kernel may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Level {
    /// 256-bit registers.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// What every target has.
    Portable,
}

impl Level {
    /// The best for these maps: vector instructions read the last pixel with the one before.
    pub fn detect(reference: &DepthMap, neighbours: &[Neighbour<'_>]) -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            let has_two_pixels = |neighbour: &Neighbour<'_>| neighbour.map.color.values().len() >= 2;
            let is_wide = (2..1 << 24).contains(&reference.width());
            if is_x86_feature_detected!("avx2") && is_wide && neighbours.iter().all(has_two_pixels) {
                return Self::Avx2;
            }
        }
        let _ = (reference, neighbours);
        Self::Portable
    }
}

/// What all rows have in common.
#[derive(Clone, Copy)]
pub(crate) struct Input<'a> {
    pub reference: &'a DepthMap,
    pub neighbours: &'a [Neighbour<'a>],
    pub options: &'a FilterOptions,
    pub level: Level,
}

/// A row of each raster of the result, all zeros at first.
pub(crate) struct OutputRow<'a> {
    pub depth: &'a mut [f32],
    pub color: &'a mut [[u8; 3]],
    pub views: &'a mut [u8],
    pub confidence: &'a mut [u8],
    pub agreeing: &'a mut [u64],
    pub owns: &'a mut [bool],
}

/// What one neighbour says to eight hypotheses.
#[derive(Clone, Copy, Default)]
pub(crate) struct Answer {
    /// Depth of the reference that the neighbour's depth there amounts to; 0 where it disagrees.
    pub depth: [f32; LANES],
    /// With [`FusionMethod::Dynamic`], the least n whose thresholds the neighbour meets.
    pub level: [f32; LANES],
    /// Depth of the hypothesis in the neighbour.
    pub z: [f32; LANES],
    /// Colour of the neighbour's nearest pixel: red in the lowest byte, then green and blue.
    pub color: [i32; LANES],
    /// Its confidence.
    pub confidence: [f32; LANES],
}

/// Blocks that are put to one neighbour after the other: the processor fetches the rows of one map ahead, not those
/// of ten, and the answers stay in its first caches.
const RUN: usize = 16;

/// Memory that rows share.
#[derive(Default)]
pub(crate) struct Scratch {
    transfers: Vec<RowTransfer>,
    /// By block of a run, then by neighbour.
    answers: Vec<Answer>,
    /// How many neighbours have each level of [`Answer::level`].
    having: Vec<u32>,
}

/// Tests the hypotheses of row `y`, writes what is left, and returns how many are kept.
pub(crate) fn filter_row(
    input: &Input<'_>,
    y: usize,
    row: &HypothesisRow,
    scratch: &mut Scratch,
    out: &mut OutputRow<'_>,
) -> usize {
    scratch.transfers.clear();
    scratch.transfers.extend(input.neighbours.iter().map(|neighbour| neighbour.row_transfer(y)));
    scratch.answers.resize(RUN * input.neighbours.len(), Answer::default());
    #[cfg(target_arch = "x86_64")]
    if input.level == Level::Avx2 {
        #[target_feature(enable = "avx2")]
        fn wide(
            input: &Input<'_>,
            y: usize,
            row: &HypothesisRow,
            scratch: &mut Scratch,
            out: &mut OutputRow<'_>,
        ) -> usize {
            // SAFETY: this function has the instructions; rows have the width of the reference, and neighbours
            // two pixels or more, as `Level::detect` says.
            unsafe { blocks::<avx2::Avx2>(input, y, row, scratch, out) }
        }
        // SAFETY: this level comes from `Level::detect`, which asked the processor.
        return unsafe { wide(input, y, row, scratch, out) };
    }
    // SAFETY: the portable lanes need nothing of the processor, and check indices.
    unsafe { blocks::<Portable>(input, y, row, scratch, out) }
}

/// # Safety
/// As [`Lanes`]; with vector instructions, each neighbour has two pixels or more, and so has a row of the
/// reference.
#[inline(always)]
unsafe fn blocks<L: Lanes>(
    input: &Input<'_>,
    y: usize,
    row: &HypothesisRow,
    scratch: &mut Scratch,
    out: &mut OutputRow<'_>,
) -> usize {
    let Input { reference, neighbours, options, .. } = *input;
    let own_row = (reference.color.row(y), reference.confidence.row(y));
    let Scratch { transfers, answers, having } = scratch;
    let mut kept_hypotheses = 0;
    for first in (0..row.blocks()).step_by(RUN) {
        let run = first..row.blocks().min(first + RUN);
        for (index, (neighbour, transfer)) in neighbours.iter().zip(&*transfers).enumerate() {
            for (block, answers) in run.clone().zip(answers.chunks_exact_mut(neighbours.len())) {
                let Block { columns, depths, .. } = row.block(block);
                // SAFETY: the caller vouches for processor and sizes.
                unsafe {
                    let pixel = (L::load(columns), y as f32, L::load(depths));
                    ask::<L>(neighbour, transfer, options, pixel, &mut answers[index]);
                }
            }
        }
        for (place, block) in run.enumerate() {
            let answers = &mut answers[place * neighbours.len()..][..neighbours.len()];
            if options.method == FusionMethod::Dynamic {
                settle(answers, having, options.min_views.saturating_sub(1));
            }
            // SAFETY: the caller vouches for processor and sizes.
            kept_hypotheses += unsafe { write_block::<L>(input, own_row, &row.block(block), answers, out) };
        }
    }
    kept_hypotheses
}

/// Counts the views that agree with a block's hypotheses, and writes what enough views agree with; returns how many
/// those are.
///
/// # Safety
/// As for [`blocks`].
#[inline(always)]
unsafe fn write_block<L: Lanes>(
    input: &Input<'_>,
    own_row: (&[[u8; 3]], &[f32]),
    block: &Block<'_>,
    answers: &[Answer],
    out: &mut OutputRow<'_>,
) -> usize {
    // Without any view there is no mean.
    let least = input.options.min_views.max(1) as f32;
    // SAFETY: the caller vouches for processor and sizes.
    unsafe {
        let (zero, one) = (L::splat(0.0), L::splat(1.0));
        let own = L::load(block.own);
        let (mut sum, mut count) = (own, L::only(L::less(zero, own), one));
        for answer in answers {
            let depth = L::load(&answer.depth);
            sum = L::add(sum, depth);
            count = L::add(count, L::only(L::less(zero, depth), one));
        }
        let columns = &block.columns[..block.count];
        for (x, count) in columns.iter().zip(L::store(count)) {
            out.views[*x as usize] = count.min(255.0) as u8;
        }
        // Beyond the end of a row nothing agrees.
        let kept = L::less(L::splat(least - 0.5), count);
        let bits = L::bits(kept);
        if bits == 0 {
            return 0;
        }
        let pixels = (L::load(block.columns), L::load(block.depths), own);
        let merged = merge::<L>(input, own_row, pixels, (kept, count), answers);
        let depths = L::store(L::div(sum, count));
        for (k, x) in columns.iter().enumerate().filter(|(k, _)| bits >> k & 1 == 1) {
            let x = *x as usize;
            out.depth[x] = depths[k];
            out.color[x] = merged.color.map(|channel| channel[k] as u8);
            out.confidence[x] = merged.confidence[k] as u8;
            let [low, high] = merged.agreeing.map(|bits| u64::from(bits[k] as u32));
            out.agreeing[x] = low | high << 32;
            out.owns[x] = merged.owns >> k & 1 == 1;
        }
        bits.count_ones() as usize
    }
}
