//! The geometric criterion: does a neighbour see the same depth (paper, section 4.2)?
//!
//! A pixel p of the reference is projected with its depth into the neighbour, the neighbour's depth
//! there is projected back, and both must come close: to p in the image, to its depth in space.
//!
//! The way back needs no camera. The hypothesis, as a homogeneous pixel P = d (x, y, 1) of the reference, and
//! what the neighbour sees there lie on a line of sight of the neighbour, at the depths z and s. So the latter is
//! P + q (C - P), with C the neighbour's centre and q = 1 - s / z.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::lanes::{LANES, Lanes};
use super::places;
use super::window::Window;
use crate::dynamic::level;
use crate::geometric::{Neighbour, RowTransfer};
use crate::options::{DepthSampling, FilterOptions, FusionMethod};

/// Where a neighbour sees some hypotheses. The lanes come first, for they fill lines of the cache.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
pub(super) struct Place {
    /// Depth of the hypothesis in the neighbour, and its inverse.
    pub z: [f32; LANES],
    inverse: [f32; LANES],
    /// The upper left of the four pixels around, and how far the place lies from it; 0 and an `fx` that is no number
    /// where none of the four is of the map.
    pub column: [i32; LANES],
    pub row: [i32; LANES],
    fx: [f32; LANES],
    fy: [f32; LANES],
    /// Lanes of which all four pixels are of the map, lane k as bit k, and lanes of which some are.
    pub inside: u32,
    pub border: u32,
    /// Where all the places are, if they are close together.
    pub window: Option<Window>,
}

/// What a neighbour makes of some hypotheses. The lanes come first, for they fill lines of the cache.
#[derive(Clone, Copy, Default)]
#[repr(C, align(64))]
pub(crate) struct Answer {
    /// Depth of the reference that the neighbour's depth amounts to; 0 where it disagrees.
    pub depth: [f32; LANES],
    /// With [`FusionMethod::Dynamic`], the least n whose thresholds it meets.
    pub level: [f32; LANES],
    /// The neighbour's nearest pixel; where it disagrees, that or the first. What lies there is read all the same.
    pub column: [i32; LANES],
    pub row: [i32; LANES],
}

/// The options, as the comparison needs them.
#[derive(Clone, Copy)]
pub(super) struct Limits {
    sampling: DepthSampling,
    is_dynamic: bool,
    /// The reprojection error allowed, or with [`FusionMethod::Dynamic`] a pixel, both squared: in pixels of the map.
    squared_px: f32,
    relative_depth: f32,
}

impl Limits {
    /// Those of `options`.
    pub fn of(options: &FilterOptions) -> Self {
        let is_dynamic = options.method == FusionMethod::Dynamic;
        let px = if is_dynamic { 1.0 } else { options.max_reprojection_px } * options.network_pixel;
        let relative_depth = options.max_relative_depth;
        Self { sampling: options.sampling, is_dynamic, squared_px: px * px, relative_depth }
    }
}

/// Projects the hypotheses in columns `x` of a row with depths `d` into a neighbour.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
pub(super) unsafe fn project<L: Lanes>(
    neighbour: &Neighbour<'_>,
    transfer: &RowTransfer,
    (x, d): (L::F, L::F),
    place: &mut Place,
) {
    let z = transferred::<L>(transfer, 2, x, d);
    let inverse = L::div(L::splat(1.0), z);
    let u = L::mul(transferred::<L>(transfer, 0, x, d), inverse);
    let v = L::mul(transferred::<L>(transfer, 1, x, d), inverse);
    let (left, top) = (L::floor(u), L::floor(v));
    let (column, row) = (L::truncate(left), L::truncate(top));
    let (mut fx, fy) = (L::sub(u, left), L::sub(v, top));
    // A lane whose u or v is no number may be anywhere: so are fx or fy then, and it agrees with nothing.
    let in_front = L::less(L::splat(0.0), z);
    let [columns, rows] = neighbour.squares;
    let inside = L::and(in_front, L::and(L::below(column, columns), L::below(row, rows)));
    let mut somewhere = inside;
    place.inside = L::bits(inside);
    place.border = 0;
    if place.inside != (1 << LANES) - 1 {
        let one = L::splat_i(1);
        let (right, below) = (L::add_i(column, one), L::add_i(row, one));
        let [columns, rows] = neighbour.touching_squares;
        somewhere = L::and(in_front, L::and(L::below(right, columns), L::below(below, rows)));
        place.border = L::bits(L::but_not(somewhere, inside));
        // What is no number agrees with nothing.
        fx = L::select(somewhere, fx, L::splat(f32::NAN));
    }
    place.z = L::store(z);
    place.inverse = L::store(inverse);
    place.column = L::store_i(L::only_i(somewhere, column));
    place.row = L::store_i(L::only_i(somewhere, row));
    (place.fx, place.fy) = (L::store(fx), L::store(fy));
}

/// Has the processor fetch the rows of a neighbour that the next rows of the reference will ask for, about `place`: the
/// columns of a window, wherever lines of the cache begin.
///
/// It does not foresee that by itself for all rasters of all neighbours. Colours are fetched three rows ahead, depths
/// four, for they are read of the row below, too: where rows are slanted, or denser than those of the reference, two
/// were not enough.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
pub(super) unsafe fn fetch_ahead<L: Lanes>(neighbour: &Neighbour<'_>, place: &Place) {
    if place.inside | place.border == 0 {
        return;
    }
    let first = place.row[0] as isize * neighbour.size[0] as isize + place.column[0] as isize;
    let band = first - LANES as isize / 2 + 3 * neighbour.next_row;
    for ahead in [band, band + LANES as isize, band + 2 * LANES as isize] {
        L::prefetch(neighbour.depth.as_ptr().wrapping_offset(ahead + neighbour.next_row));
        L::prefetch(neighbour.color.as_ptr().wrapping_offset(ahead));
    }
}

/// Compares what a neighbour sees with the hypotheses in columns `x` with depths `d`.
///
/// # Safety
/// As [`Lanes`]; `place` comes from [`project`] into this neighbour, and its window is around it.
#[inline(always)]
pub(super) unsafe fn compare<L: Lanes>(
    neighbour: &Neighbour<'_>,
    transfer: &RowTransfer,
    limits: Limits,
    (x, d): (L::F, L::F),
    place: &Place,
    answer: &mut Answer,
) {
    let (zero, half, one) = (L::splat(0.0), L::splat(0.5), L::splat_i(1));
    let corners = match place.window {
        Some(window) => window.corners::<L>(neighbour, place),
        None => places::corners::<L>(neighbour, place),
    };
    let (fx, fy) = (L::load(&place.fx), L::load(&place.fy));
    let seen = match limits.sampling {
        DepthSampling::Bilinear => bilinear::<L>(corners, fx, fy),
        DepthSampling::Continuous => continuous::<L>(corners, fx, fy, limits.relative_depth),
    };
    let q = L::mul_sub_from(seen, L::load(&place.inverse), L::splat(1.0));
    let difference = L::mul(q, L::sub(L::splat(transfer.centre[1]), d));
    let depth = L::add(d, difference);
    // Pixels of the reference, times its depth there, squared.
    let beside = L::mul_sub_from(x, L::splat(transfer.centre[1]), L::splat(transfer.centre[0]));
    let squared_distance = L::mul_add(beside, beside, L::splat(transfer.squared_beside_row));
    let squared = L::mul(L::mul(q, q), squared_distance);
    let squared_depth = L::mul(depth, depth);
    let in_front = L::and(L::less(zero, depth), L::less(zero, seen));
    let agrees = if limits.is_dynamic {
        let squared_px = L::div(squared, L::mul(squared_depth, L::splat(limits.squared_px)));
        answer.level = L::store(level::<L>(squared_px, L::div(L::abs(difference), d)));
        in_front
    } else {
        let near = L::less(squared, L::mul(squared_depth, L::splat(limits.squared_px)));
        let alike = L::less(L::abs(difference), L::mul(d, L::splat(limits.relative_depth)));
        L::and(in_front, L::and(near, alike))
    };
    answer.depth = L::store(L::only(agrees, depth));
    // The nearest pixel; lanes that disagree are read, too, and so must be of the map.
    let column = L::add_i(L::load_i(&place.column), L::only_i(L::less(half, fx), one));
    let row = L::add_i(L::load_i(&place.row), L::only_i(L::less(half, fy), one));
    let (column, row) = if place.border == 0 {
        (column, row)
    } else {
        let [last_column, last_row] = [L::splat_i(neighbour.size[0] - 1), L::splat_i(neighbour.size[1] - 1)];
        let zero = L::splat_i(0);
        (L::max_i(zero, L::min_i(column, last_column)), L::max_i(zero, L::min_i(row, last_row)))
    };
    answer.column = L::store_i(L::only_i(agrees, column));
    answer.row = L::store_i(L::only_i(agrees, row));
}

// Closures need not be compiled for the instructions of the function around them; these are.

/// A coordinate of the homogeneous pixel in the neighbour.
#[inline(always)]
pub(crate) unsafe fn transferred<L: Lanes>(transfer: &RowTransfer, axis: usize, x: L::F, d: L::F) -> L::F {
    let RowTransfer { along, start, shift, .. } = transfer;
    let at_depth_1 = L::mul_add(x, L::splat(along[axis]), L::splat(start[axis]));
    L::mul_add(at_depth_1, d, L::splat(shift[axis]))
}

/// Bilinear over the four corners, whatever they hold.
#[inline(always)]
unsafe fn bilinear<L: Lanes>([a, b, c, d]: [L::F; 4], fx: L::F, fy: L::F) -> L::F {
    let top = L::mul_add(fx, L::sub(b, a), a);
    let bottom = L::mul_add(fx, L::sub(d, c), c);
    L::mul_add(fy, L::sub(bottom, top), top)
}

/// Bilinear over the corners that continue the surface of the nearest one.
#[inline(always)]
unsafe fn continuous<L: Lanes>(corners: [L::F; 4], fx: L::F, fy: L::F, max_relative: f32) -> L::F {
    let (zero, one, half) = (L::splat(0.0), L::splat(1.0), L::splat(0.5));
    let [a, b, c, d] = corners;
    let (left, upper) = (L::less(fx, half), L::less(fy, half));
    let nearest = L::select(upper, L::select(left, a, b), L::select(left, c, d));
    let allowed = L::mul(L::splat(max_relative), nearest);
    let (rest_x, rest_y) = (L::sub(one, fx), L::sub(one, fy));
    let weights = [L::mul(rest_x, rest_y), L::mul(fx, rest_y), L::mul(rest_x, fy), L::mul(fx, fy)];
    let (mut sum, mut total) = (zero, zero);
    for (corner, weight) in corners.into_iter().zip(weights) {
        let alike = L::less(L::abs(L::sub(corner, nearest)), allowed);
        let weight = L::only(L::and(alike, L::less(zero, corner)), weight);
        sum = L::add(sum, L::mul(weight, corner));
        total = L::add(total, weight);
    }
    // The nearest corner alone weighs a quarter or more.
    L::only(L::less(zero, total), L::div(sum, total))
}
