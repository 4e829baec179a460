//! Once per surface: of all views that see a place, which one emits it.
//!
//! Every view sees the place with pixels of some *footprint*, their width there in scene units. Pass one
//! (part of the filter) lets a pixel *own* its place when no view that agrees with it sees the place
//! with a smaller footprint. Pass two (before points are made) drops a pixel that owns nothing when
//! a pixel of another view that does covers it.
//!
//! Owners are always emitted, and only what an owner covers is dropped: so no hole can appear, whatever
//! the chain of views that defer to each other, and whatever the filters did to the best view. Where
//! the best view's own pixel was dropped, the others emit theirs.

#![allow(
    unsafe_code,
    clippy::inline_always,
    reason = "compiled for the instructions of the processor, as the kernel"
)]

use planesweep_scene::{Camera, Raster};
use rayon::prelude::*;

use crate::filter::FilteredMap;
use crate::geometric::{RowTransfer, Transfer, readable_size};
use crate::kernel::{COUNTING, Kernel, LANES, Lanes, Level, transferred};

/// Relative difference below which footprints are equal, so that both views see them so.
const EQUAL_FOOTPRINTS: f64 = 1e-4;

/// How a neighbour competes with the reference for a place: the smaller footprint wins, width of a pixel times
/// depth; of equal ones the first by the coordinates of the camera centres, which stay the same when views are
/// numbered anew. Of two views in different places one wins.
pub(crate) struct Rival {
    /// It wins where its depth is less than the reference's times this.
    pub wins_below: f32,
}

impl Rival {
    pub fn new(neighbour: &Camera, reference: &Camera) -> Self {
        let pixel_width = |camera: &Camera| {
            let k = &camera.intrinsics;
            1.0 / (k.fx * k.fy).sqrt()
        };
        let centre = |camera: &Camera| {
            let centre = camera.pose.centre();
            (centre.x, centre.y, centre.z)
        };
        let wins_ties = centre(neighbour) < centre(reference);
        let tolerance = if wins_ties { EQUAL_FOOTPRINTS } else { -EQUAL_FOOTPRINTS };
        let wins_below = pixel_width(reference) / pixel_width(neighbour) * (1.0 + tolerance);
        Self { wins_below: wins_below as f32 }
    }
}

/// Which kept pixels of a map are to become points.
///
/// With `others`, the filtered maps of all views that may emit the same surface, a pixel is left out
/// when it owns nothing and an owner among the others covers it: its surface point lies in the owner's
/// pixel, and the depths there differ by less than `max_relative_depth`. Without, all kept pixels are
/// emitted.
///
/// # Panics
/// When depths and owners of one of the maps differ in size, which those of [`filter`](crate::filter) do not.
pub fn emitted(map: &FilteredMap, others: &[&FilteredMap], max_relative_depth: f32) -> Raster<bool> {
    emitted_with(Level::detect(), map, others, max_relative_depth)
}

/// The same with the instructions of `level`.
pub(crate) fn emitted_with(
    level: Level,
    map: &FilteredMap,
    others: &[&FilteredMap],
    max_relative_depth: f32,
) -> Raster<bool> {
    assert_sizes_match(map);
    let others: Vec<_> = others.iter().map(|other| Other::new(&map.camera, other)).collect();
    let (width, height) = (map.depth.width(), map.depth.height());
    let mut emitted = Raster::filled(width, height, false);
    emitted.values_mut().par_chunks_mut(width.max(1)).enumerate().for_each_init(
        Vec::new,
        |transfers, (y, out)| {
            transfers.clear();
            transfers.extend(others.iter().map(|other| other.there.of_row(y, &other.back)));
            let (depths, owns) = (map.depth.row(y), map.owns.row(y));
            let asked = Asked { others: &others, transfers, max_relative_depth };
            level.run(Row { depths, owns, asked, out });
        },
    );
    emitted
}

fn assert_sizes_match(map: &FilteredMap) {
    let size = [map.depth.width(), map.depth.height()];
    assert_eq!([map.owns.width(), map.owns.height()], size, "owners of a map");
}

/// A view that may emit what the map at hand shows.
struct Other<'a> {
    depth: &'a [f32],
    owns: &'a [bool],
    /// Columns and rows; 0 where the map is too large to be asked.
    size: [i32; 2],
    /// From one of its pixels to about where the next row of the map at hand lies.
    next_row: isize,
    there: Transfer,
    /// The transfers of rows want it, though nothing is projected back.
    back: Transfer,
}

impl<'a> Other<'a> {
    fn new(camera: &Camera, map: &'a FilteredMap) -> Self {
        assert_sizes_match(map);
        let size = [map.depth.width(), map.depth.height()];
        let there = Transfer::between(camera, &map.camera);
        Self {
            depth: map.depth.values(),
            owns: map.owns.values(),
            size: readable_size(size),
            next_row: there.next_row(size[0]),
            there,
            back: Transfer::between(&map.camera, camera),
        }
    }
}

/// A row of the map at hand, and what of it is to be emitted.
struct Row<'a> {
    depths: &'a [f32],
    owns: &'a [bool],
    asked: Asked<'a>,
    out: &'a mut [bool],
}

/// The other views, and the way from a row to each.
struct Asked<'a> {
    others: &'a [Other<'a>],
    transfers: &'a [RowTransfer],
    max_relative_depth: f32,
}

impl Kernel for Row<'_> {
    type Output = ();

    #[inline(always)]
    unsafe fn run<L: Lanes>(self) {
        let lanes = self.depths.chunks(LANES).zip(self.owns.chunks(LANES)).zip(self.out.chunks_mut(LANES));
        for (((depths, owns), out), first) in lanes.zip((0..).step_by(LANES)) {
            let mut d = [0.0; LANES];
            d[..depths.len()].copy_from_slice(depths);
            let kept = bits(&d, |depth| *depth > 0.0);
            let owns = bits(owns, |owns| *owns);
            // SAFETY: the caller vouches for the processor.
            let covered = unsafe { covered::<L>(&self.asked, first, &d, kept & !owns) };
            for (k, out) in out.iter_mut().enumerate() {
                *out = (kept & !covered) >> k & 1 == 1;
            }
        }
    }
}

/// Which values `holds` is true of, value k as bit k.
#[inline(always)]
fn bits<T>(values: &[T], holds: impl Fn(&T) -> bool) -> u32 {
    values.iter().rev().fold(0, |bits, value| bits << 1 | u32::from(holds(value)))
}

/// Which of the pixels in question, lanes of depth `d` in the columns from `first` on, lie in a pixel of another view
/// that owns its surface.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn covered<L: Lanes>(asked: &Asked<'_>, first: i32, d: &[f32; LANES], question: u32) -> u32 {
    let mut covered = 0;
    // SAFETY: the caller vouches for the processor; what is read lies within a map, or is its first pixel where some lane
    // is within: so there is one.
    unsafe {
        let x = L::to_float(L::add_i(L::load_i(&COUNTING), L::splat_i(first)));
        let d = L::load(d);
        for (other, transfer) in asked.others.iter().zip(asked.transfers) {
            let open = question & !covered;
            if open == 0 {
                break;
            }
            let z = transferred::<L>(transfer, 2, x, d);
            let inverse = L::div(L::splat(1.0), z);
            let [u, v] = [transferred::<L>(transfer, 0, x, d), transferred::<L>(transfer, 1, x, d)];
            let left = L::floor(L::mul_add(u, inverse, L::splat(0.5)));
            let top = L::floor(L::mul_add(v, inverse, L::splat(0.5)));
            let (column, line) = (L::truncate(left), L::truncate(top));
            let within = L::and(L::below(column, other.size[0]), L::below(line, other.size[1]));
            let within = L::and(within, L::less(L::splat(0.0), z));
            // What is no number may be any integer.
            let within = L::and(within, L::less(L::splat(-1.0), L::add(left, top)));
            if L::bits(within) & open == 0 {
                continue;
            }
            let at = L::only_i(within, L::add_i(L::mul_i(line, L::splat_i(other.size[0])), column));
            let seen = L::gather(other.depth.as_ptr(), at);
            let at = L::store_i(at);
            fetch_ahead::<L>(other, at[LANES / 2]);
            let near = L::less(L::abs(L::sub(seen, z)), L::mul(z, L::splat(asked.max_relative_depth)));
            let mut near = L::bits(L::and(within, L::and(L::less(L::splat(0.0), seen), near))) & open;
            while near != 0 {
                let lane = near.trailing_zeros() as usize % LANES;
                near &= near - 1;
                covered |= u32::from(other.owns[at[lane] as usize]) << lane;
            }
        }
    }
    covered
}

/// Has the processor fetch what the lanes will ask for three rows later, if `at` is the pixel of the middle one.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
unsafe fn fetch_ahead<L: Lanes>(other: &Other<'_>, at: i32) {
    let ahead = at as isize + 3 * other.next_row;
    // SAFETY: the caller vouches for the processor.
    unsafe {
        for along in [-(LANES as isize) / 2, LANES as isize / 2] {
            L::prefetch(other.depth.as_ptr().wrapping_offset(ahead + along));
        }
        L::prefetch(other.owns.as_ptr().wrapping_offset(ahead));
    }
}

#[cfg(test)]
mod tests;
