//! What a neighbour has at the places of some hypotheses, wherever they lie: one by one.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each function covers its body as a whole")]

use super::agree::{Answer, Place};
use super::lanes::{LANES, Lanes};
use crate::geometric::Neighbour;

/// The depths of the four pixels around the places: the upper left, the upper right, then the lower ones.
///
/// # Safety
/// As [`Lanes`]; `place` comes from the projection into this neighbour.
#[inline(always)]
pub(super) unsafe fn corners<L: Lanes>(neighbour: &Neighbour<'_>, place: &Place) -> [L::F; 4] {
    if place.border != 0 {
        let [a, b, c, d] = corners_with_border(neighbour, place);
        return [L::load(&a), L::load(&b), L::load(&c), L::load(&d)];
    }
    if place.inside == 0 {
        return [L::splat(0.0); 4];
    }
    // SAFETY: the upper left is inside, so the next pixel and those below are of the map; or it is the first, and the
    // map has two rows and columns, since some lane is inside.
    let at = indices::<L>(neighbour, &place.column, &place.row);
    let upper = neighbour.depth.as_ptr();
    let ((a, b), (c, d)) = (L::pairs(upper, at), L::pairs(upper.add(neighbour.size[0] as usize), at));
    [a, b, c, d]
}

/// The same where some of the four lie outside: these count as 0.
#[cold]
fn corners_with_border(neighbour: &Neighbour<'_>, place: &Place) -> [[f32; LANES]; 4] {
    let mut corners = [[0.0; LANES]; 4];
    for k in (0..LANES).filter(|k| (place.inside | place.border) >> k & 1 == 1) {
        for (corner, [dx, dy]) in corners.iter_mut().zip([[0, 0], [1, 0], [0, 1], [1, 1]]) {
            // A negative index wraps to one that no raster has.
            let (x, y) = ((place.column[k] + dx) as usize, (place.row[k] + dy) as usize);
            corner[k] = neighbour.map.depth.get(x, y).unwrap_or(0.0);
        }
    }
    corners
}

/// Colours, their bytes the lowest three, and confidences of the neighbour's pixels.
///
/// # Safety
/// As [`Lanes`]; `answer` is this neighbour's, and it agrees with something: so its map has a pixel.
#[inline(always)]
pub(super) unsafe fn pixels<L: Lanes>(neighbour: &Neighbour<'_>, answer: &Answer) -> (L::I, L::F) {
    // SAFETY: the pixels are of the map, the first one in lanes that disagree; its rasters have one size.
    let at = indices::<L>(neighbour, &answer.column, &answer.row);
    (gather_color::<L>(neighbour.color, at), L::gather(neighbour.confidence.as_ptr(), at))
}

/// Colours of a raster, their bytes the lowest three.
///
/// # Safety
/// As [`Lanes`]; `at` are indices of the raster.
#[inline(always)]
pub(super) unsafe fn gather_color<L: Lanes>(colors: &[[u8; 3]], at: L::I) -> L::I {
    if let [[r, g, b]] = colors {
        return L::splat_i(i32::from_le_bytes([*r, *g, *b, 0]));
    }
    let first = L::add_i(L::add_i(at, at), at);
    // Four bytes are read: those of the last pixel with one before; there are two pixels.
    let start = L::min_i(first, L::splat_i(3 * colors.len() as i32 - 4));
    let beyond = L::mul_i(L::sub_i(first, start), L::splat_i(8));
    L::shift_down(L::gather_bytes(colors.as_ptr().cast(), start), beyond)
}

/// Indices of a neighbour's pixels.
#[inline(always)]
unsafe fn indices<L: Lanes>(neighbour: &Neighbour<'_>, columns: &[i32; LANES], rows: &[i32; LANES]) -> L::I {
    let start = L::mul_i(L::load_i(rows), L::splat_i(neighbour.size[0]));
    L::add_i(start, L::load_i(columns))
}
