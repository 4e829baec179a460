//! The geometric criterion: does a neighbour see the same depth (paper, section 4.2)?
//!
//! A pixel p of the reference is projected with its depth into the neighbour, the neighbour's depth
//! there is projected back, and both must come close: to p in the image, to its depth in space.
//!
//! The transfers between the cameras are made in `f64`, the pixels are moved in `f32`: some 1e-4 of a
//! pixel and 1e-6 of a depth, far below the thresholds.

#![allow(clippy::inline_always)] // all of it is compiled once per instruction set

use nalgebra::{Matrix3, Vector3};
use planesweep_scene::{Camera, DepthMap, Intrinsics, Raster};

use crate::dynamic;
use crate::hypotheses::HypothesisRow;
use crate::options::{DepthSampling, FilterOptions, FusionMethod};

/// Stands for a projection behind the camera: far enough outside every image to read nothing.
const OUTSIDE: f32 = -2.0;

/// What one neighbour says to the hypotheses of a row; index by index theirs.
#[derive(Default)]
pub(crate) struct Agreement {
    /// Column of the projection into the neighbour.
    pub u: Vec<f32>,
    /// Row of the projection into the neighbour.
    pub v: Vec<f32>,
    /// Depth of the reference that the neighbour's depth there amounts to; 0 where it disagrees.
    pub depth: Vec<f32>,
    /// With [`FusionMethod::Dynamic`], the least n whose thresholds the neighbour meets.
    pub level: Vec<f32>,
}

/// A neighbour as the criterion needs it.
pub(crate) struct Neighbour<'a> {
    /// Its depth map.
    pub map: &'a DepthMap,
    there: Transfer,
    back: Transfer,
}

/// From the pixels of one row of the reference to the pixels of a neighbour.
#[derive(Clone, Copy)]
pub(crate) struct RowTransfer {
    along: [f32; 3],
    start: [f32; 3],
    shift: [f32; 3],
}

impl RowTransfer {
    /// Column, row and depth in the neighbour of the pixel in column `x` with depth `d`; the first two
    /// are [`OUTSIDE`] when it lies behind.
    #[inline(always)]
    pub fn project(&self, x: f32, d: f32) -> (f32, f32, f32) {
        let Self { along, start, shift } = self;
        let z = (along[2] * x + start[2]) * d + shift[2];
        let scale = 1.0 / z;
        let u = ((along[0] * x + start[0]) * d + shift[0]) * scale;
        let v = ((along[1] * x + start[1]) * d + shift[1]) * scale;
        (if z > 0.0 { u } else { OUTSIDE }, if z > 0.0 { v } else { OUTSIDE }, z)
    }
}

impl<'a> Neighbour<'a> {
    /// Prepares `map` to be asked about pixels of `reference`.
    pub fn new(reference: &Camera, map: &'a DepthMap) -> Self {
        let there = Transfer::between(reference, &map.camera);
        let back = Transfer::between(&map.camera, reference);
        Self { map, there, back }
    }

    /// The projection of row `y` of the reference into the neighbour.
    #[inline(always)]
    pub fn row_transfer(&self, y: usize) -> RowTransfer {
        self.there.of_row(y)
    }

    /// The projection of row `y` of the neighbour into the reference.
    #[inline(always)]
    pub fn row_back(&self, y: usize) -> RowTransfer {
        self.back.of_row(y)
    }

    /// Asks about the hypotheses of row `y` of the reference.
    #[inline(always)]
    pub fn agreement(&self, row: &HypothesisRow, y: usize, options: &FilterOptions, out: &mut Agreement) {
        let count = row.columns.len();
        for values in [&mut out.u, &mut out.v, &mut out.depth] {
            values.resize(count, 0.0);
        }
        let (u, v, depth) = (&mut out.u[..count], &mut out.v[..count], &mut out.depth[..count]);
        self.project(row, y, u, v);
        let source = &self.map.depth;
        match options.sampling {
            DepthSampling::Bilinear => {
                for i in 0..count {
                    depth[i] = bilinear(source, u[i], v[i]);
                }
            }
            DepthSampling::Continuous => {
                for i in 0..count {
                    depth[i] = continuous(source, u[i], v[i], options.max_relative_depth);
                }
            }
        }
        if options.method == FusionMethod::Dynamic {
            out.level.resize(count, 0.0);
            self.levels(row, y, u, v, depth, &mut out.level);
        } else {
            self.keep_agreeing(row, y, options, u, v, depth);
        }
    }

    /// Projects the hypotheses of row `y` into the neighbour.
    #[inline(always)]
    fn project(&self, row: &HypothesisRow, y: usize, u: &mut [f32], v: &mut [f32]) {
        let transfer = self.row_transfer(y);
        let count = u.len();
        let (columns, depths, v) = (&row.columns[..count], &row.depths[..count], &mut v[..count]);
        for i in 0..count {
            (u[i], v[i], _) = transfer.project(columns[i], depths[i]);
        }
    }

    /// Projects the neighbour's depths at `(u, v)` back and keeps those that agree.
    #[inline(always)]
    fn keep_agreeing(
        &self,
        row: &HypothesisRow,
        y: usize,
        options: &FilterOptions,
        u: &[f32],
        v: &[f32],
        depth: &mut [f32],
    ) {
        let back = Back::new(&self.back);
        let max_relative = options.max_relative_depth;
        let max_squared = options.max_reprojection_px * options.max_reprojection_px;
        let y = y as f32;
        let count = depth.len();
        let (columns, depths, u, v) = (&row.columns[..count], &row.depths[..count], &u[..count], &v[..count]);
        for i in 0..count {
            let (z, squared) = back.pixel((u[i], v[i]), depth[i], (columns[i], y));
            // Without branches, so that the loop runs in vector registers.
            let near = squared < max_squared;
            let alike = (z - depths[i]).abs() < max_relative * depths[i];
            let in_front = z.min(depth[i]) > 0.0;
            depth[i] = if in_front & near & alike { z } else { 0.0 };
        }
    }

    /// Projects the neighbour's depths at `(u, v)` back and says how well each agrees.
    #[inline(always)]
    fn levels(
        &self,
        row: &HypothesisRow,
        y: usize,
        u: &[f32],
        v: &[f32],
        depth: &mut [f32],
        level: &mut [f32],
    ) {
        let back = Back::new(&self.back);
        let y = y as f32;
        let count = depth.len();
        let (columns, depths, u, v) = (&row.columns[..count], &row.depths[..count], &u[..count], &v[..count]);
        let level = &mut level[..count];
        for i in 0..count {
            let (z, squared) = back.pixel((u[i], v[i]), depth[i], (columns[i], y));
            let in_front = z.min(depth[i]) > 0.0;
            level[i] = dynamic::level(squared, (z - depths[i]).abs() / depths[i]);
            depth[i] = if in_front { z } else { 0.0 };
        }
    }
}

/// From a pixel of the neighbour to the reference, in `f32`.
struct Back {
    /// By columns.
    matrix: [[f32; 3]; 3],
    shift: [f32; 3],
}

impl Back {
    fn new(transfer: &Transfer) -> Self {
        Self {
            matrix: transfer.matrix.map(|m| m as f32).into(),
            shift: transfer.vector.map(|m| m as f32).into(),
        }
    }

    /// Depth in the reference of the neighbour's pixel `(u, v)` with depth `seen`, and the square of
    /// the distance at which it projects from pixel `(x, y)`.
    #[inline(always)]
    fn pixel(&self, (u, v): (f32, f32), seen: f32, (x, y): (f32, f32)) -> (f32, f32) {
        let Self { matrix: m, shift } = self;
        let z = (m[0][2] * u + m[1][2] * v + m[2][2]) * seen + shift[2];
        let scale = 1.0 / z;
        let dx = ((m[0][0] * u + m[1][0] * v + m[2][0]) * seen + shift[0]) * scale - x;
        let dy = ((m[0][1] * u + m[1][1] * v + m[2][1]) * seen + shift[1]) * scale - y;
        (z, dx * dx + dy * dy)
    }
}

/// From a pixel with a depth to the homogeneous pixel of another camera,
/// `z (u, v, 1)^T = matrix (x, y, 1)^T d + vector`; z is the depth there.
struct Transfer {
    matrix: Matrix3<f64>,
    vector: Vector3<f64>,
}

impl Transfer {
    fn between(from: &Camera, to: &Camera) -> Self {
        let rotation = to.pose.rotation * from.pose.rotation.transpose();
        let k = to.intrinsics.matrix();
        Self {
            matrix: k * rotation * inverse(&from.intrinsics),
            vector: k * (to.pose.translation - rotation * from.pose.translation),
        }
    }

    fn of_row(&self, y: usize) -> RowTransfer {
        let Self { matrix, vector } = self;
        RowTransfer {
            along: matrix.column(0).map(|m| m as f32).into(),
            start: (matrix.column(1) * y as f64 + matrix.column(2)).map(|m| m as f32).into(),
            shift: vector.map(|m| m as f32).into(),
        }
    }
}

/// `K^-1`.
fn inverse(k: &Intrinsics) -> Matrix3<f64> {
    let (ix, iy) = (1.0 / k.fx, 1.0 / k.fy);
    let slant = -k.skew * ix * iy;
    Matrix3::new(ix, slant, -k.cx * ix - k.cy * slant, 0.0, iy, -k.cy * iy, 0.0, 0.0, 1.0)
}

/// The depth at `(u, v)`, bilinear with zeros outside and where there is no depth.
#[inline(always)]
fn bilinear(depth: &Raster<f32>, u: f32, v: f32) -> f32 {
    let Some(([a, b, c, d], fx, fy)) = corners(depth, u, v) else { return 0.0 };
    let (top, bottom) = (a + fx * (b - a), c + fx * (d - c));
    top + fy * (bottom - top)
}

/// The depth at `(u, v)`, bilinear over the corners that continue the surface of the nearest one.
#[inline(always)]
fn continuous(depth: &Raster<f32>, u: f32, v: f32, max_relative: f32) -> f32 {
    let Some((corners, fx, fy)) = corners(depth, u, v) else { return 0.0 };
    let nearest = corners[usize::from(fx >= 0.5) + 2 * usize::from(fy >= 0.5)];
    let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
    let (mut sum, mut total) = (0.0, 0.0);
    for (corner, weight) in corners.into_iter().zip(weights) {
        if corner > 0.0 && (corner - nearest).abs() < max_relative * nearest {
            sum += weight * corner;
            total += weight;
        }
    }
    // The nearest corner alone weighs a quarter or more.
    if total > 0.0 { sum / total } else { 0.0 }
}

/// The values of the four pixels around `(u, v)`, row by row and 0 outside, and the fractions of the
/// way from the first to the last; `None` where all four are outside.
#[inline(always)]
fn corners(depth: &Raster<f32>, u: f32, v: f32) -> Option<([f32; 4], f32, f32)> {
    let (width, height) = (depth.width(), depth.height());
    if u >= 0.0 && v >= 0.0 && u < width as f32 - 1.0 && v < height as f32 - 1.0 {
        let (x, y) = (u as i32, v as i32);
        let start = y as usize * width + x as usize;
        let top = &depth.values()[start..start + 2];
        let bottom = &depth.values()[start + width..start + width + 2];
        Some(([top[0], top[1], bottom[0], bottom[1]], u - x as f32, v - y as f32))
    } else if u > -1.0 && v > -1.0 && u < width as f32 && v < height as f32 {
        let (x, y) = (u.floor(), v.floor());
        // A negative index wraps to one that no raster has.
        let at =
            |dx: i64, dy: i64| depth.get((x as i64 + dx) as usize, (y as i64 + dy) as usize).unwrap_or(0.0);
        Some(([at(0, 0), at(1, 0), at(0, 1), at(1, 1)], u - x, v - y))
    } else {
        None
    }
}
