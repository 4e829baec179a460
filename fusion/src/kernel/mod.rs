//! The inner loop of the filter: one row of the reference against all neighbours.
//!
//! Sixteen hypotheses at a time are put to each neighbour ([`agree`]), and what those say that agree is summed
//! ([`merge`]). What is in between fits into the processor's first cache. The loop, and others like it, are written
//! over [`lanes`] and compiled for AVX-512, AVX2 and every other processor; the [`level`] is chosen when the program
//! runs, and changes no bit.
#![allow(
    clippy::inline_always,
    reason = "instructions are enabled by the function that a kernel is inlined into"
)]
#![allow(clippy::needless_range_loop, reason = "indices name registers, and loops over them must unroll")]
#![allow(unsafe_code, reason = "vector instructions need a check of the processor")]

mod agree;
#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod lanes;
mod level;
mod merge;
mod places;
mod window;

use planesweep_scene::{DepthMap, in_255ths};

use crate::dynamic::settle;
use crate::geometric::{Neighbour, RowTransfer};
use crate::hypotheses::{Block, HypothesisRow};
use crate::options::{FilterOptions, FusionMethod};
pub(crate) use agree::{Answer, transferred};
use agree::{Limits, Place, compare, fetch_ahead, project};
#[cfg(test)]
pub(crate) use lanes::Portable;
use lanes::WINDOW_COLUMNS;
pub(crate) use lanes::{COUNTING, LANES, Lanes};
pub(crate) use level::{Kernel, Level};
use merge::{Means, Sums, Votes};
use window::Window;

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
    pub color: &'a mut [[u8; 4]],
    pub views: &'a mut [u8],
    pub agreeing: &'a mut [u64],
    pub owns: &'a mut [bool],
}

/// Memory that rows share.
#[derive(Default)]
pub(crate) struct Scratch {
    transfers: Vec<RowTransfer>,
    /// Of each neighbour, for the block at hand and for the next.
    places: Vec<Place>,
    answers: Vec<Answer>,
    /// How many neighbours have each level of [`Answer::level`].
    having: Vec<u32>,
}

/// A row of the reference, and what its filter works with.
struct Row<'a, 'b> {
    input: &'a Input<'a>,
    y: usize,
    hypotheses: &'a HypothesisRow,
    scratch: &'a mut Scratch,
    out: &'a mut OutputRow<'b>,
}

/// Tests the hypotheses of row `y`, writes what is left, and returns how many are kept.
pub(crate) fn filter_row(
    input: &Input<'_>,
    y: usize,
    hypotheses: &HypothesisRow,
    scratch: &mut Scratch,
    out: &mut OutputRow<'_>,
) -> usize {
    scratch.transfers.clear();
    scratch.transfers.extend(input.neighbours.iter().map(|neighbour| neighbour.row_transfer(y)));
    input.level.run(Row { input, y, hypotheses, scratch, out })
}

impl Kernel for Row<'_, '_> {
    type Output = usize;

    #[inline(always)]
    unsafe fn run<L: Lanes>(self) -> usize {
        // SAFETY: the caller vouches for the processor.
        unsafe { blocks::<L>(self) }
    }
}

/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn blocks<L: Lanes>(row: Row<'_, '_>) -> usize {
    let Row { input, y, hypotheses: row, scratch, out } = row;
    let Input { neighbours, options, .. } = *input;
    let Scratch { transfers, places, answers, having } = scratch;
    places.resize(2 * neighbours.len(), Place::default());
    answers.resize(neighbours.len(), Answer::default());
    let (mut places, mut next_places) = places.split_at_mut(neighbours.len());
    let limits = Limits::of(options);
    let min_confidence = in_255ths(options.min_confidence);
    let mut kept = 0;
    let mut blocks = row.blocks().peekable();
    if let Some(first) = blocks.peek() {
        // SAFETY: as below.
        unsafe { project_block::<L>(neighbours, transfers, first, places) };
    }
    while let Some(block) = &blocks.next() {
        // SAFETY: the caller vouches for the processor; places and answers are those of their neighbours; rasters of a
        // map have one size: the filter and `Neighbour::new` made sure; and all columns of a block, those behind its
        // hypotheses included, are columns of the reference.
        kept += unsafe {
            // A block ahead, so that nothing waits for the places; and each step for all neighbours, so that the
            // processor works on several of them at once.
            if let Some(next) = blocks.peek() {
                project_block::<L>(neighbours, transfers, next, next_places);
            }
            let (x, d) = hypotheses::<L>(block);
            for (((neighbour, transfer), place), answer) in
                neighbours.iter().zip(&*transfers).zip(&*places).zip(&mut *answers)
            {
                compare::<L>(neighbour, transfer, limits, (x, d), place, answer);
            }
            if options.method == FusionMethod::Dynamic {
                settle(answers, having, options.min_views.saturating_sub(1));
            }
            let votes = Votes::<L>::count(block, answers);
            write_views(block, &L::store_i(L::min_i(L::truncate(votes.count), L::splat_i(255))), out.views);
            // Without any view there is no mean. Beyond the end of a block nothing agrees.
            let least = options.min_views.max(1) as f32;
            let is_kept = L::less(L::splat(least - 0.5), votes.count);
            let kept_here = L::bits(is_kept);
            if kept_here != 0 {
                let mut sums = Sums::<L>::of_reference(input, y, block);
                for (neighbour, (place, answer)) in neighbours.iter().zip(places.iter().zip(&*answers)) {
                    let agrees = L::less(L::splat(0.0), L::load(&answer.depth));
                    // So its map has pixels to ask for.
                    if L::bits(agrees) & kept_here != 0 {
                        sums = sums.and(neighbour, min_confidence, d, (place, answer));
                    }
                }
                write_means(block, &sums.means(&votes, is_kept), out);
            }
            kept_here.count_ones() as usize
        };
        std::mem::swap(&mut places, &mut next_places);
    }
    kept
}

/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn project_block<L: Lanes>(
    neighbours: &[Neighbour<'_>],
    transfers: &[RowTransfer],
    block: &Block<'_>,
    places: &mut [Place],
) {
    // SAFETY: the caller vouches for the processor.
    unsafe {
        let is_together = block.is_within(WINDOW_COLUMNS);
        let hypotheses = hypotheses::<L>(block);
        for ((neighbour, transfer), place) in neighbours.iter().zip(transfers).zip(&mut *places) {
            project::<L>(neighbour, transfer, hypotheses, place);
        }
        for (neighbour, place) in neighbours.iter().zip(places) {
            place.window = Window::around::<L>(neighbour, place);
            // What outliers ask for is not what the next row will.
            if is_together {
                fetch_ahead::<L>(neighbour, place);
            }
        }
    }
}

/// Columns and depths of a block; what lies behind its hypotheses is no number.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn hypotheses<L: Lanes>(block: &Block<'_>) -> (L::F, L::F) {
    // SAFETY: the caller vouches for the processor.
    unsafe {
        let depths = L::select(first_lanes::<L>(block.count), L::load(block.depths), L::splat(f32::NAN));
        (L::to_float(L::load_i(block.columns)), depths)
    }
}

/// The first `count` lanes.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn first_lanes<L: Lanes>(count: usize) -> L::M {
    // SAFETY: the caller vouches for the processor.
    unsafe { L::below(L::load_i(&COUNTING), count as i32) }
}

/// Writes how many views agree with a block's hypotheses.
#[inline(always)]
fn write_views(block: &Block<'_>, count: &[i32; LANES], views: &mut [u8]) {
    for (x, count) in block.columns.iter().zip(count).take(block.count) {
        views[*x as usize] = *count as u8;
    }
}

/// Writes what the hypotheses of a block come to; the means of those that are not kept are zeros.
#[inline(always)]
fn write_means(block: &Block<'_>, means: &Means, out: &mut OutputRow<'_>) {
    // The limit spares a check of each index.
    for k in 0..block.count.min(LANES) {
        let x = block.columns[k] as usize;
        out.depth[x] = means.depth[k];
        out.color[x] = means.color[k].to_le_bytes();
        let [low, high] = [means.agreeing[0][k], means.agreeing[1][k]];
        out.agreeing[x] = u64::from(low as u32) | u64::from(high as u32) << 32;
        out.owns[x] = means.owns >> k & 1 == 1;
    }
}
