//! The geometric criterion: does a neighbour see the same depth (paper, section 4.2)?
//!
//! A pixel p of the reference is projected with its depth into the neighbour, the neighbour's depth
//! there is projected back, and both must come close: to p in the image, to its depth in space.
//!
//! The way back needs no camera. The hypothesis, as a homogeneous pixel P = d (x, y, 1) of the reference, and
//! what the neighbour sees there lie on a line of sight of the neighbour, at the depths z and s. So the latter is
//! P + q (C - P), with C the neighbour's centre and q = 1 - s / z.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::lanes::{LANES, Lanes, Pairs, pair_of_lane};
use crate::dynamic::level;
use crate::geometric::{Neighbour, RowTransfer};
use crate::options::{DepthSampling, FilterOptions, FusionMethod};

/// Where a neighbour sees some hypotheses, and what it has there: the first two steps.
#[derive(Clone, Copy, Default)]
#[repr(align(64))]
pub(super) struct Place {
    /// Depth of the hypothesis in the neighbour, and its inverse.
    pub z: [f32; LANES],
    inverse: [f32; LANES],
    /// The upper left of the four pixels around, and how far the place lies from it.
    corner: [i32; LANES],
    fx: [f32; LANES],
    fy: [f32; LANES],
    /// The depths of the two upper and the two lower ones of the four pixels.
    upper: Pairs,
    lower: Pairs,
    /// Lanes of which all four pixels are of the map, lane k as bit k, and lanes of which some are.
    inside: u32,
    border: u32,
}

/// What a neighbour makes of some hypotheses, and its pixels there: the next two steps.
#[derive(Clone, Copy, Default)]
#[repr(align(64))]
pub(crate) struct Pixel {
    /// Depth of the reference that the neighbour's depth amounts to; 0 where it disagrees.
    pub depth: [f32; LANES],
    /// With [`FusionMethod::Dynamic`], the least n whose thresholds it meets.
    pub level: [f32; LANES],
    /// The neighbour's nearest pixel.
    pub index: [i32; LANES],
    /// Four bytes with its colour are read from here on; they move down by so many bits.
    pub color_at: [i32; LANES],
    pub color_shift: [i32; LANES],
    pub color: [i32; LANES],
    pub confidence: [f32; LANES],
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
    let zero = L::splat(0.0);
    let z = transferred::<L>(transfer, 2, x, d);
    let inverse = L::div(L::splat(1.0), z);
    let u = L::mul(transferred::<L>(transfer, 0, x, d), inverse);
    let v = L::mul(transferred::<L>(transfer, 1, x, d), inverse);
    // All four pixels around are pixels of the map, or some are. At 0 exactly it is the border's turn.
    let in_front = L::less(zero, z);
    let inside = L::and(in_front, within::<L>([u, v], 0.0, neighbour.size, -1.0));
    let (column, row) = (L::truncate(u), L::truncate(v));
    let corner = L::add_i(L::mul_i(row, L::splat_i(neighbour.size[0])), column);
    let (mut fx, mut fy) = (L::sub(u, L::to_float(column)), L::sub(v, L::to_float(row)));
    place.inside = L::bits(inside);
    place.border = 0;
    if place.inside != (1 << LANES) - 1 {
        let touching = L::and(in_front, within::<L>([u, v], -1.0, neighbour.size, 0.0));
        place.border = L::bits(L::but_not(touching, inside));
        // The border's turn comes later; what is no number agrees with nothing.
        fx = L::select(inside, fx, L::select(touching, u, L::splat(f32::NAN)));
        fy = L::select(inside, fy, v);
    }
    place.z = L::store(z);
    place.inverse = L::store(inverse);
    place.corner = L::store_i(L::only_i(inside, corner));
    (place.fx, place.fy) = (L::store(fx), L::store(fy));
}

/// Fetches the depths of a neighbour at the places of hypotheses.
///
/// # Safety
/// As [`Lanes`]; `place` comes from [`project`] into this neighbour, and its depths were not fetched yet.
#[inline(always)]
pub(super) unsafe fn fetch_depths<L: Lanes>(neighbour: &Neighbour<'_>, place: &mut Place) {
    if place.inside != 0 {
        let columns = neighbour.size[0] as usize;
        let (from, to) = (neighbour.depth.as_ptr(), (&raw mut place.upper, &raw mut place.lower));
        for k in 0..LANES {
            // SAFETY: the corner is inside, so the next pixel and those below are of the map; or it is 0, and the map
            // has two rows and columns, since some lane is inside. Pairs hold as many as there are lanes.
            debug_assert!(place.corner[k] as u32 as usize + columns + 1 < neighbour.depth.len());
            let upper = from.add(place.corner[k] as u32 as usize);
            copy_pair(upper, to.0.cast::<u64>().add(pair_of_lane(k)));
            copy_pair(upper.add(columns), to.1.cast::<u64>().add(pair_of_lane(k)));
        }
        // The rows of the reference that come will ask for what lies in the rows beyond these here, which the processor
        // does not foresee for all neighbours by itself: confidences and colours are fetched two rows ahead, depths
        // a row more, for they are read of the row below, too.
        let band = place.corner[0] as isize + 2 * neighbour.next_row;
        for ahead in [band, band + LANES as isize] {
            L::prefetch(from.wrapping_offset(ahead + neighbour.next_row));
            L::prefetch(neighbour.confidence.as_ptr().wrapping_offset(ahead));
            L::prefetch(neighbour.color.as_ptr().wrapping_offset(ahead));
        }
    }
    if place.border != 0 {
        fetch_border(neighbour, place);
    }
}

/// Volatile, lest the compiler make hardware's gathers of many copies: they take longer.
///
/// # Safety
/// Two floats can be read, and written.
#[inline(always)]
unsafe fn copy_pair(from: *const f32, to: *mut u64) {
    to.write_volatile(from.cast::<u64>().read_unaligned());
}

/// The same for lanes at the border: pixels outside count as 0.
#[cold]
fn fetch_border(neighbour: &Neighbour<'_>, place: &mut Place) {
    for k in (0..LANES).filter(|k| place.border >> k & 1 == 1) {
        let (x, y) = (place.fx[k].floor(), place.fy[k].floor());
        (place.fx[k], place.fy[k]) = (place.fx[k] - x, place.fy[k] - y);
        // A negative index wraps to one that no raster has.
        let depth = |dx: i64, dy: i64| {
            neighbour.map.depth.get((x as i64 + dx) as usize, (y as i64 + dy) as usize).unwrap_or(0.0)
        };
        place.upper.0[pair_of_lane(k)] = [depth(0, 0), depth(1, 0)];
        place.lower.0[pair_of_lane(k)] = [depth(0, 1), depth(1, 1)];
        // The corner from which the nearest pixel of the map is reached as from any other.
        let [columns, rows] = neighbour.size;
        let (right, down) = (i32::from(place.fx[k] > 0.5), i32::from(place.fy[k] > 0.5));
        let nearest = |position: i32, size: i32| position.min(size - 1).max(0);
        let pixel = nearest(y as i32 + down, rows) * columns + nearest(x as i32 + right, columns);
        place.corner[k] = pixel - right - down * columns;
    }
}

/// Compares what a neighbour sees with the hypotheses in columns `x` with depths `d`.
///
/// # Safety
/// As [`Lanes`]; `place` comes from [`fetch_depths`] with this neighbour.
#[inline(always)]
pub(super) unsafe fn compare<L: Lanes>(
    neighbour: &Neighbour<'_>,
    transfer: &RowTransfer,
    options: &FilterOptions,
    (x, d): (L::F, L::F),
    place: &Place,
    pixel: &mut Pixel,
) {
    let (zero, half) = (L::splat(0.0), L::splat(0.5));
    let ((a, b), (c, e)) = (L::load_pairs(&place.upper), L::load_pairs(&place.lower));
    let (fx, fy) = (L::load(&place.fx), L::load(&place.fy));
    let seen = match options.sampling {
        DepthSampling::Bilinear => bilinear::<L>([a, b, c, e], fx, fy),
        DepthSampling::Continuous => continuous::<L>([a, b, c, e], fx, fy, options.max_relative_depth),
    };
    let q = L::mul_sub_from(seen, L::load(&place.inverse), L::splat(1.0));
    let [centre_x, centre_z] = transfer.centre;
    let difference = L::mul(q, L::sub(L::splat(centre_z), d));
    let depth = L::add(d, difference);
    // Pixels of the reference, times its depth there.
    let across = L::mul(q, L::mul_sub_from(x, L::splat(centre_z), L::splat(centre_x)));
    let along = L::mul(q, L::splat(transfer.centre_beside_row));
    let squared = L::mul_add(across, across, L::mul(along, along));
    let in_front = L::and(L::less(zero, depth), L::less(zero, seen));
    let agrees = if options.method == FusionMethod::Dynamic {
        let most = L::mul(L::splat(options.network_pixel), depth);
        let squared = L::div(squared, L::mul(most, most));
        pixel.level = L::store(level::<L>(squared, L::div(L::abs(difference), d)));
        in_front
    } else {
        let most = L::mul(L::splat(options.max_reprojection_px * options.network_pixel), depth);
        let near = L::less(squared, L::mul(most, most));
        let alike = L::less(L::abs(difference), L::mul(L::splat(options.max_relative_depth), d));
        L::and(in_front, L::and(near, alike))
    };
    pixel.depth = L::store(L::only(agrees, depth));
    let columns = L::splat_i(neighbour.size[0]);
    let right = L::only_i(L::less(half, fx), L::splat_i(1));
    let down = L::only_i(L::less(half, fy), columns);
    // Of lanes that disagree nothing will be asked.
    let index = L::only_i(agrees, L::add_i(L::add_i(L::load_i(&place.corner), right), down));
    let color = L::add_i(L::add_i(index, index), index);
    // Four bytes are read: those of the last pixel with the one before.
    let color_at = L::min_i(color, L::splat_i((3 * neighbour.color.len() as i32 - 4).max(-1)));
    let beyond = L::sub_i(color, color_at);
    pixel.index = L::store_i(index);
    pixel.color_at = L::store_i(color_at);
    pixel.color_shift = L::store_i(L::mul_i(beyond, L::splat_i(8)));
}

/// Fetches colours and confidences of a neighbour's nearest pixels.
///
/// # Safety
/// `pixel` comes from [`compare`] with this neighbour.
#[inline(always)]
#[expect(clippy::cast_ptr_alignment, reason = "they are read as what they are")]
pub(super) unsafe fn fetch_pixels(neighbour: &Neighbour<'_>, pixel: &mut Pixel) {
    if neighbour.color.len() < 2 {
        return fetch_only_pixel(neighbour, pixel);
    }
    let (color, confidence) = (neighbour.color.as_ptr().cast::<u8>(), neighbour.confidence.as_ptr());
    for k in 0..LANES {
        // SAFETY: the index is a pixel of the map, whose rasters have one size, and its colour is among four bytes that
        // are, for there are two pixels. Volatile as pairs are.
        debug_assert!((pixel.index[k] as u32 as usize) < neighbour.confidence.len());
        debug_assert!(pixel.color_at[k] as u32 as usize + 4 <= 3 * neighbour.color.len());
        let color = color.add(pixel.color_at[k] as u32 as usize).cast::<i32>();
        (&raw mut pixel.color[k]).write_volatile(i32::from_le(color.read_unaligned()));
        let confidence = confidence.add(pixel.index[k] as u32 as usize);
        (&raw mut pixel.confidence[k]).write_volatile(confidence.read());
    }
}

/// The same of a map with a single pixel: it has one byte less than are read.
#[cold]
fn fetch_only_pixel(neighbour: &Neighbour<'_>, pixel: &mut Pixel) {
    let [r, g, b] = neighbour.color.first().copied().unwrap_or_default();
    pixel.color = [i32::from_le_bytes([0, r, g, b]); LANES];
    pixel.confidence = [neighbour.confidence.first().copied().unwrap_or_default(); LANES];
}

// Closures are not compiled for the instructions of the function around them; these are.

/// A coordinate of the homogeneous pixel in the neighbour.
#[inline(always)]
unsafe fn transferred<L: Lanes>(transfer: &RowTransfer, axis: usize, x: L::F, d: L::F) -> L::F {
    let RowTransfer { along, start, shift, .. } = transfer;
    let at_depth_1 = L::mul_add(x, L::splat(along[axis]), L::splat(start[axis]));
    L::mul_add(at_depth_1, d, L::splat(shift[axis]))
}

/// Whether column and row lie beyond `least` and before the size plus `beyond`.
#[inline(always)]
unsafe fn within<L: Lanes>([u, v]: [L::F; 2], least: f32, size: [i32; 2], beyond: f32) -> L::M {
    let least = L::splat(least);
    let columns = L::and(L::less(least, u), L::less(u, L::splat(size[0] as f32 + beyond)));
    let rows = L::and(L::less(least, v), L::less(v, L::splat(size[1] as f32 + beyond)));
    L::and(columns, rows)
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
