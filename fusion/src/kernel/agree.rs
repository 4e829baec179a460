//! The geometric criterion: does a neighbour see the same depth (paper, section 4.2)?
//!
//! A pixel p of the reference is projected with its depth into the neighbour, the neighbour's depth
//! there is projected back, and both must come close: to p in the image, to its depth in space.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use planesweep_scene::Raster;

use super::Answer;
use super::lanes::{LANES, Lanes, Portable};
use crate::dynamic;
use crate::geometric::{Back, Neighbour, RowTransfer};
use crate::options::{DepthSampling, FilterOptions, FusionMethod};

/// Asks a neighbour about the hypotheses in columns `x` of row `y` with depths `d`.
///
/// # Safety
/// As [`Lanes`]; with vector instructions, the neighbour has two pixels or more.
#[inline(always)]
pub(super) unsafe fn ask<L: Lanes>(
    neighbour: &Neighbour<'_>,
    transfer: &RowTransfer,
    options: &FilterOptions,
    (x, y, d): (L::F, f32, L::F),
    answer: &mut Answer,
) {
    let zero = L::splat(0.0);
    let RowTransfer { along, start, shift } = transfer;
    let from_pixel = [
        L::add(L::mul(L::splat(along[0]), x), L::splat(start[0])),
        L::add(L::mul(L::splat(along[1]), x), L::splat(start[1])),
        L::add(L::mul(L::splat(along[2]), x), L::splat(start[2])),
    ];
    let [u, v, z] = transferred::<L>(from_pixel, d, shift);
    // All four pixels around are pixels of the map, or some are. At 0 exactly it is the border's turn.
    let in_front = L::less(zero, z);
    let inside = L::and(in_front, within::<L>([u, v], 0.0, neighbour.size, -1.0));
    let seen = if L::bits(inside) == (1 << LANES) - 1 {
        sample::<L>(neighbour, options, [u, v], inside)
    } else {
        let touching = L::and(in_front, within::<L>([u, v], -1.0, neighbour.size, 0.0));
        if L::bits(touching) == 0 {
            answer.depth = [0.0; LANES];
            return;
        }
        let sampled = sample::<L>(neighbour, options, [u, v], inside);
        let border = L::but_not(touching, inside);
        if L::bits(border) == 0 {
            sampled
        } else {
            let at_border =
                sample_border(&neighbour.map.depth, options, L::store(u), L::store(v), L::bits(border));
            L::select(border, L::load(&at_border), sampled)
        }
    };
    let Back { matrix, shift } = &neighbour.back;
    let from_pixel =
        [combined::<L>(&matrix[0], u, v), combined::<L>(&matrix[1], u, v), combined::<L>(&matrix[2], u, v)];
    let [back_x, back_y, depth] = transferred::<L>(from_pixel, seen, shift);
    let (dx, dy) = (L::sub(back_x, x), L::sub(back_y, L::splat(y)));
    let squared = L::add(L::mul(dx, dx), L::mul(dy, dy));
    let pixel = options.network_pixel;
    let difference = L::abs(L::sub(depth, d));
    let in_front = L::and(L::less(zero, depth), L::less(zero, seen));
    let agrees = if options.method == FusionMethod::Dynamic {
        answer.level = L::store(dynamic::level::<L>(
            L::mul(squared, L::splat(1.0 / (pixel * pixel))),
            L::div(difference, d),
        ));
        in_front
    } else {
        let most = options.max_reprojection_px * pixel;
        let near = L::less(squared, L::splat(most * most));
        let alike = L::less(difference, L::mul(L::splat(options.max_relative_depth), d));
        L::and(in_front, L::and(near, alike))
    };
    answer.depth = L::store(L::only(agrees, depth));
    if L::bits(agrees) == 0 {
        return;
    }
    answer.z = L::store(z);
    // Whether it agrees or not, so that the processor need not wait for that.
    let (column, row) = (nearest::<L>(u, neighbour.size[0]), nearest::<L>(v, neighbour.size[1]));
    let pixel = L::add_i(L::mul_i(row, L::splat_i(neighbour.size[0])), column);
    answer.color = L::store_i(L::gather_rgb(neighbour.color, pixel));
    answer.confidence = L::store(L::gather(neighbour.confidence, pixel));
}

// Closures are not compiled for the instructions of the function around them; these are.

/// Column, row and depth of a homogeneous pixel at depth 1, moved to depth `d`, in the other camera.
#[inline(always)]
unsafe fn transferred<L: Lanes>(at_depth_1: [L::F; 3], d: L::F, shift: &[f32; 3]) -> [L::F; 3] {
    let [x, y, z] = at_depth_1;
    let z = L::add(L::mul(z, d), L::splat(shift[2]));
    let scale = L::div(L::splat(1.0), z);
    let u = L::mul(L::add(L::mul(x, d), L::splat(shift[0])), scale);
    let v = L::mul(L::add(L::mul(y, d), L::splat(shift[1])), scale);
    [u, v, z]
}

/// A row of a matrix times `(u, v, 1)`.
#[inline(always)]
unsafe fn combined<L: Lanes>([a, b, c]: &[f32; 3], u: L::F, v: L::F) -> L::F {
    L::add(L::add(L::mul(L::splat(*a), u), L::mul(L::splat(*b), v)), L::splat(*c))
}

/// The pixel that a column or row lies in, or the nearest of the map.
#[inline(always)]
unsafe fn nearest<L: Lanes>(position: L::F, size: i32) -> L::I {
    let rounded = L::truncate(L::add(position, L::splat(0.5)));
    L::max_i(L::splat_i(0), L::min_i(rounded, L::splat_i(size - 1)))
}

/// Whether column and row lie beyond `least` and before the size plus `beyond`.
#[inline(always)]
unsafe fn within<L: Lanes>([u, v]: [L::F; 2], least: f32, size: [i32; 2], beyond: f32) -> L::M {
    let least = L::splat(least);
    let columns = L::and(L::less(least, u), L::less(u, L::splat(size[0] as f32 + beyond)));
    let rows = L::and(L::less(least, v), L::less(v, L::splat(size[1] as f32 + beyond)));
    L::and(columns, rows)
}

/// The depth at `(u, v)`, as the options say, where all four pixels around are of the map; else 0.
#[inline(always)]
unsafe fn sample<L: Lanes>(
    neighbour: &Neighbour<'_>,
    options: &FilterOptions,
    [u, v]: [L::F; 2],
    inside: L::M,
) -> L::F {
    if L::bits(inside) == 0 {
        return L::splat(0.0);
    }
    let (column, row) = (L::only_i(inside, L::truncate(u)), L::only_i(inside, L::truncate(v)));
    let (fx, fy) = (L::sub(u, L::to_float(column)), L::sub(v, L::to_float(row)));
    let index = L::add_i(L::mul_i(row, L::splat_i(neighbour.size[0])), column);
    // Index 0 stands for what is not inside; where anything is, there are two rows and columns.
    let (a, b) = L::gather_pairs(neighbour.depth, index);
    let (c, d) = L::gather_pairs(&neighbour.depth[neighbour.size[0] as usize..], index);
    let depth = match options.sampling {
        DepthSampling::Bilinear => bilinear::<L>([a, b, c, d], fx, fy),
        DepthSampling::Continuous => continuous::<L>([a, b, c, d], fx, fy, options.max_relative_depth),
    };
    L::only(inside, depth)
}

/// The same in the lanes of `border`, where some of the four pixels are outside, which is rare: those count as 0.
#[cold]
fn sample_border(
    map: &Raster<f32>,
    options: &FilterOptions,
    u: [f32; LANES],
    v: [f32; LANES],
    border: u32,
) -> [f32; LANES] {
    let mut corners = [[0.0; LANES]; 4];
    let (mut fx, mut fy) = ([0.0; LANES], [0.0; LANES]);
    for k in (0..LANES).filter(|k| border >> k & 1 == 1) {
        let (x, y) = (u[k].floor(), v[k].floor());
        (fx[k], fy[k]) = (u[k] - x, v[k] - y);
        for (corner, (dx, dy)) in corners.iter_mut().zip([(0, 0), (1, 0), (0, 1), (1, 1)]) {
            // A negative index wraps to one that no raster has.
            let depth = map.get((x as i64 + dx) as usize, (y as i64 + dy) as usize);
            corner[k] = depth.unwrap_or(0.0);
        }
    }
    // SAFETY: the portable lanes need nothing of the processor.
    unsafe {
        match options.sampling {
            DepthSampling::Bilinear => bilinear::<Portable>(corners, fx, fy),
            DepthSampling::Continuous => continuous::<Portable>(corners, fx, fy, options.max_relative_depth),
        }
    }
}

/// Bilinear over the four corners, whatever they hold.
#[inline(always)]
unsafe fn bilinear<L: Lanes>([a, b, c, d]: [L::F; 4], fx: L::F, fy: L::F) -> L::F {
    let top = L::add(a, L::mul(fx, L::sub(b, a)));
    let bottom = L::add(c, L::mul(fx, L::sub(d, c)));
    L::add(top, L::mul(fy, L::sub(bottom, top)))
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
