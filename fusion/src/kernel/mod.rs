//! The inner loop of the filter: one row of the reference against all neighbours.
//!
//! Sixteen hypotheses at a time are put to each neighbour ([`agree`]), and what those say that agree is summed
//! ([`merge`]). What is in between fits into the processor's first cache. The loop is compiled for AVX-512, AVX2 and
//! every other processor; the level is chosen when the program runs, and changes no bit.
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
mod merge;

use planesweep_scene::DepthMap;

use crate::dynamic::settle;
use crate::geometric::{Neighbour, RowTransfer};
use crate::hypotheses::{Block, HypothesisRow};
use crate::options::{FilterOptions, FusionMethod};
pub(crate) use agree::Pixel;
use agree::{Place, compare, fetch_depths, fetch_pixels, project};
pub(crate) use lanes::{LANES, Lanes, Portable};
use merge::Sums;

/// The instructions that the kernel may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Level {
    /// 512-bit registers.
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// 256-bit registers.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// What every target has.
    Portable,
}

impl Level {
    /// The best that the processor has.
    pub fn detect() -> Self {
        *Self::available().last().expect("every processor has the portable level")
    }

    /// All that the processor has, the best last.
    pub fn available() -> Vec<Self> {
        let mut levels = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                levels.push(Self::Avx2);
            }
            if is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("fma")
            {
                levels.push(Self::Avx512);
            }
        }
        levels
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

/// Memory that rows share.
#[derive(Default)]
pub(crate) struct Scratch {
    transfers: Vec<RowTransfer>,
    /// Of each neighbour, for this block and for the next.
    places: Vec<Place>,
    pixels: Vec<Pixel>,
    /// How many neighbours have each level of [`Pixel::level`].
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
    match input.level {
        // SAFETY: levels come from `Level::available`, which asked the processor.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { with_avx512(input, y, row, scratch, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { with_avx2(input, y, row, scratch, out) },
        // SAFETY: the portable lanes need nothing of the processor.
        Level::Portable => unsafe { blocks::<Portable>(input, y, row, scratch, out) },
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,fma")]
fn with_avx512(
    input: &Input<'_>,
    y: usize,
    row: &HypothesisRow,
    scratch: &mut Scratch,
    out: &mut OutputRow<'_>,
) -> usize {
    // SAFETY: this function has the instructions.
    unsafe { blocks::<avx512::Avx512>(input, y, row, scratch, out) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn with_avx2(
    input: &Input<'_>,
    y: usize,
    row: &HypothesisRow,
    scratch: &mut Scratch,
    out: &mut OutputRow<'_>,
) -> usize {
    // SAFETY: as above.
    unsafe { blocks::<avx2::Avx2>(input, y, row, scratch, out) }
}

/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn blocks<L: Lanes>(
    input: &Input<'_>,
    y: usize,
    row: &HypothesisRow,
    scratch: &mut Scratch,
    out: &mut OutputRow<'_>,
) -> usize {
    let Input { neighbours, options, .. } = *input;
    let Scratch { transfers, places, pixels, having } = scratch;
    places.resize(2 * neighbours.len(), Place::default());
    pixels.resize(neighbours.len(), Pixel::default());
    let (mut places, mut next_places) = places.split_at_mut(neighbours.len());
    let mut kept = 0;
    for block in 0..row.blocks() {
        // SAFETY: the caller vouches for the processor; places and pixels come from their neighbours.
        kept += unsafe {
            // A block ahead, so that nothing waits for the places; and each step for all neighbours, so that the
            // processor works on several of them at once.
            if block == 0 {
                project_block::<L>(neighbours, transfers, &row.block(0), places);
            }
            if block + 1 < row.blocks() {
                project_block::<L>(neighbours, transfers, &row.block(block + 1), next_places);
            }
            let block = row.block(block);
            let (x, d) = (L::load(block.columns), L::load(block.depths));
            for (neighbour, place) in neighbours.iter().zip(&mut *places) {
                fetch_depths::<L>(neighbour, place);
            }
            for (((neighbour, transfer), place), pixel) in
                neighbours.iter().zip(&*transfers).zip(&*places).zip(&mut *pixels)
            {
                compare::<L>(neighbour, transfer, options, (x, d), place, pixel);
            }
            if options.method == FusionMethod::Dynamic {
                settle(pixels, having, options.min_views.saturating_sub(1));
            }
            for (neighbour, pixel) in neighbours.iter().zip(&mut *pixels) {
                fetch_pixels(neighbour, pixel);
            }
            let mut sums = Sums::<L>::of_reference(input, y, &block);
            for ((index, neighbour), (place, pixel)) in
                neighbours.iter().enumerate().zip(places.iter().zip(&*pixels))
            {
                let agrees = L::less(L::splat(0.0), L::load(&pixel.depth));
                sums.add((index, neighbour), options.min_confidence, (d, agrees), (place, pixel));
            }
            write::<L>(&sums, &block, options, out)
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
        let hypotheses = (L::load(block.columns), L::load(block.depths));
        for ((neighbour, transfer), place) in neighbours.iter().zip(transfers).zip(places) {
            project::<L>(neighbour, transfer, hypotheses, place);
        }
    }
}

/// Writes how many views agree with a block's hypotheses, and what enough views agree with; returns how many
/// those are.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn write<L: Lanes>(
    sums: &Sums<L>,
    block: &Block<'_>,
    options: &FilterOptions,
    out: &mut OutputRow<'_>,
) -> usize {
    // Without any view there is no mean.
    let least = options.min_views.max(1) as f32;
    // SAFETY: the caller vouches for the processor.
    let (bits, means) = unsafe {
        let columns = &block.columns[..block.count];
        for (x, count) in columns.iter().zip(L::store(sums.count())) {
            out.views[*x as usize] = count.min(255.0) as u8;
        }
        // Beyond the end of a row nothing agrees.
        let kept = L::bits(L::less(L::splat(least - 0.5), sums.count()));
        if kept == 0 {
            return 0;
        }
        (kept, sums.means())
    };
    let columns = &block.columns[..block.count];
    for (k, x) in columns.iter().enumerate().filter(|(k, _)| bits >> k & 1 == 1) {
        let x = *x as usize;
        out.depth[x] = means.depth[k];
        let [r, g, b, _] = means.color[k].to_le_bytes();
        out.color[x] = [r, g, b];
        out.confidence[x] = means.confidence[k] as u8;
        let [low, high] = means.agreeing.map(|bits| u64::from(bits[k] as u32));
        out.agreeing[x] = low | high << 32;
        out.owns[x] = means.owns >> k & 1 == 1;
    }
    bits.count_ones() as usize
}
