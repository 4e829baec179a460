//! From the pixels of one camera to those of another: what the geometric criterion is made of (paper,
//! section 4.2).
//!
//! The transfers between the cameras are made in `f64`, the pixels are moved in `f32`: some 1e-4 of a
//! pixel and 1e-6 of a depth, far below the thresholds.

#![allow(clippy::inline_always)] // compiled once per instruction set, with the loops that use it

use nalgebra::{Matrix3, Vector3};
use planesweep_scene::{Camera, DepthMap, Intrinsics};

use crate::surface::Rival;

/// Stands for a projection behind the camera: far enough outside every image to read nothing.
const OUTSIDE: f32 = -2.0;
/// Sides from which on `f32` does not tell columns apart; no hypothesis is put to larger maps.
const MAX_SIDE: usize = 1 << 24;
/// Pixels from which on an index of 32 bits does not do for all arithmetic with them; as above.
const MAX_PIXELS: usize = 1 << 29;

/// A neighbour as the criterion needs it.
pub(crate) struct Neighbour<'a> {
    /// Its depth map.
    pub map: &'a DepthMap,
    /// The map's rasters, all of its size.
    pub depth: &'a [f32],
    pub color: &'a [[u8; 4]],
    /// Columns and rows; 0 where the map is too large for hypotheses to be put to it.
    pub size: [i32; 2],
    /// Columns and rows of pixels that have others to the right and below: of the squares between four pixels.
    pub squares: [i32; 2],
    /// The same with the squares that only touch the map, one more at each side.
    pub touching_squares: [i32; 2],
    /// From one of its pixels to about where the next row of the reference lies: a row, as far as that goes.
    pub next_row: isize,
    /// How it competes with the reference for a surface.
    pub rival: Rival,
    there: Transfer,
    back: Transfer,
}

impl<'a> Neighbour<'a> {
    /// Prepares `map` to be asked about pixels of `reference`.
    ///
    /// # Panics
    /// When the map's rasters differ in size, for they are read without a check of each index, or it has 2^29 columns or
    /// more.
    pub fn new(reference: &Camera, map: &'a DepthMap) -> Self {
        let there = Transfer::between(reference, &map.camera);
        let (width, height) = (map.width(), map.height());
        let size = [width, height];
        assert_rasters_match(map);
        let extent = readable_size(size);
        Self {
            map,
            depth: map.depth.values(),
            color: map.color.values(),
            size: extent,
            squares: extent.map(|side| (side - 1).max(0)),
            touching_squares: extent.map(|side| if side > 0 { side + 1 } else { 0 }),
            next_row: there.next_row(width),
            rival: Rival::new(&map.camera, reference),
            there,
            back: Transfer::between(&map.camera, reference),
        }
    }

    /// The projection of row `y` of the reference into the neighbour.
    #[inline(always)]
    pub fn row_transfer(&self, y: usize) -> RowTransfer {
        self.there.of_row(y, &self.back)
    }

    /// The projection of row `y` of the neighbour into the reference.
    #[inline(always)]
    pub fn row_back(&self, y: usize) -> RowTransfer {
        self.back.of_row(y, &self.there)
    }
}

/// Columns and rows of a map; 0 where it is too large for an index of it.
pub(crate) fn readable_size([width, height]: [usize; 2]) -> [i32; 2] {
    let is_small = width < MAX_SIDE && height < MAX_SIDE && width * height < MAX_PIXELS;
    if is_small { [width as i32, height as i32] } else { [0; 2] }
}

/// Makes sure of what the kernel does not check for each pixel.
///
/// # Panics
/// When the map's rasters differ in size, or a row has [`MAX_PIXELS`] or more.
pub(crate) fn assert_rasters_match(map: &DepthMap) {
    let size = [map.width(), map.height()];
    assert_eq!([map.confidence.width(), map.confidence.height()], size, "confidences of a map");
    assert_eq!([map.color.width(), map.color.height()], size, "colours of a map");
    assert!(map.width() < MAX_PIXELS, "columns of a map");
}

/// From the pixels of one row of the reference to the pixels of a neighbour: the homogeneous pixel of column x
/// with depth d is `(along x + start) d + shift`.
#[derive(Clone, Copy)]
pub(crate) struct RowTransfer {
    pub along: [f32; 3],
    pub start: [f32; 3],
    pub shift: [f32; 3],
    /// Column and depth of the other camera's centre as a homogeneous pixel `(x, y, z)` of this camera.
    pub centre: [f32; 2],
    /// How far that lies beside the row, `y - row z`, squared.
    pub squared_beside_row: f32,
}

impl RowTransfer {
    /// Column, row and depth in the neighbour of the pixel in column `x` with depth `d`; the first two
    /// are [`OUTSIDE`] when it lies behind.
    #[inline(always)]
    pub fn project(&self, x: f32, d: f32) -> (f32, f32, f32) {
        let Self { along, start, shift, .. } = self;
        let z = (along[2] * x + start[2]) * d + shift[2];
        let scale = 1.0 / z;
        let u = ((along[0] * x + start[0]) * d + shift[0]) * scale;
        let v = ((along[1] * x + start[1]) * d + shift[1]) * scale;
        (if z > 0.0 { u } else { OUTSIDE }, if z > 0.0 { v } else { OUTSIDE }, z)
    }
}

/// From a pixel with a depth to the homogeneous pixel of another camera,
/// `z (u, v, 1)^T = matrix (x, y, 1)^T d + vector`; z is the depth there.
pub(crate) struct Transfer {
    matrix: Matrix3<f64>,
    vector: Vector3<f64>,
}

impl Transfer {
    /// The transfer from the pixels of one camera to those of another.
    pub fn between(from: &Camera, to: &Camera) -> Self {
        let rotation = to.pose.rotation * from.pose.rotation.transpose();
        let k = to.intrinsics.matrix();
        Self {
            matrix: k * rotation * inverse(&from.intrinsics),
            vector: k * (to.pose.translation - rotation * from.pose.translation),
        }
    }

    /// From a pixel of a map `width` wide to where about it shows the next row: a row of its own, up or down.
    pub fn next_row(&self, width: usize) -> isize {
        if self.matrix[(1, 1)] < 0.0 { -(width as isize) } else { width as isize }
    }

    /// Of row `y`, with the transfer `back`.
    pub fn of_row(&self, y: usize, back: &Self) -> RowTransfer {
        let Self { matrix, vector } = self;
        let centre = &back.vector;
        RowTransfer {
            along: matrix.column(0).map(|m| m as f32).into(),
            start: (matrix.column(1) * y as f64 + matrix.column(2)).map(|m| m as f32).into(),
            shift: vector.map(|m| m as f32).into(),
            centre: [centre.x as f32, centre.z as f32],
            squared_beside_row: (centre.y - y as f64 * centre.z).powi(2) as f32,
        }
    }
}

/// `K^-1`.
fn inverse(k: &Intrinsics) -> Matrix3<f64> {
    let (ix, iy) = (1.0 / k.fx, 1.0 / k.fy);
    let slant = -k.skew * ix * iy;
    Matrix3::new(ix, slant, -k.cx * ix - k.cy * slant, 0.0, iy, -k.cy * iy, 0.0, 0.0, 1.0)
}
