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

/// Colours and confidences of the neighbour's pixels.
///
/// # Safety
/// As [`Lanes`]; `answer` is this neighbour's, and it agrees with something: so its map has a pixel.
#[inline(always)]
pub(super) unsafe fn colors<L: Lanes>(neighbour: &Neighbour<'_>, answer: &Answer) -> L::I {
    // SAFETY: the pixels are of the map, whether their lanes agree or not; its rasters have one size.
    L::gather_words(neighbour.color.as_ptr(), indices::<L>(neighbour, &answer.column, &answer.row))
}

/// Indices of a neighbour's pixels.
#[inline(always)]
unsafe fn indices<L: Lanes>(neighbour: &Neighbour<'_>, columns: &[i32; LANES], rows: &[i32; LANES]) -> L::I {
    let start = L::mul_i(L::load_i(rows), L::splat_i(neighbour.size[0]));
    L::add_i(start, L::load_i(columns))
}
