//! Ground: heights on a grid, two triangles per cell.

use nalgebra::{Point3, Vector3};

use super::{Bounds, Ray, Span};

/// A triangulated surface over a rectangle around the origin of the xy plane.
#[derive(Clone, Debug)]
pub struct Heightfield {
    columns: usize,
    rows: usize,
    half: [f64; 2],
    heights: Vec<f64>,
    bounds: Bounds,
    /// Lowest and highest corner of each block of `BLOCK` by `BLOCK` cells.
    blocks: Vec<[f64; 2]>,
}

/// Cells along the side of a block.
const BLOCK: usize = 8;

impl Heightfield {
    /// Samples `height(x, y)` at `columns` by `rows` grid points over `[-half, half]`.
    ///
    /// # Panics
    /// With fewer than two columns or rows.
    pub fn new(columns: usize, rows: usize, half: [f64; 2], height: impl Fn(f64, f64) -> f64) -> Self {
        assert!(columns >= 2 && rows >= 2, "a heightfield needs at least one cell");
        let mut heights = Vec::with_capacity(columns * rows);
        for row in 0..rows {
            let y = half[1] * (2.0 * row as f64 / (rows - 1) as f64 - 1.0);
            for column in 0..columns {
                let x = half[0] * (2.0 * column as f64 / (columns - 1) as f64 - 1.0);
                heights.push(height(x, y));
            }
        }
        let mut blocks = Vec::new();
        for top in (0..rows - 1).step_by(BLOCK) {
            for left in (0..columns - 1).step_by(BLOCK) {
                let right = (left + BLOCK).min(columns - 1);
                let grid_rows = top..=(top + BLOCK).min(rows - 1);
                blocks.push(extent(
                    grid_rows.flat_map(|row| &heights[row * columns + left..=row * columns + right]),
                ));
            }
        }
        let [low, high] = extent(&heights);
        let bounds =
            Bounds { min: Point3::new(-half[0], -half[1], low), max: Point3::new(half[0], half[1], high) };
        Self { columns, rows, half, heights, bounds, blocks }
    }

    /// The height of the triangles above a point, held constant outside the rectangle.
    pub fn height(&self, x: f64, y: f64) -> f64 {
        let (u, v) = self.grid(x, y);
        let (column, row) = self.cell(u, v);
        interpolate(self.corners(column, row), u - column as f64, v - row as f64)
    }

    /// The normal, upwards: from differences between neighbouring grid points, interpolated, so that
    /// shading does not show the triangles.
    pub fn normal(&self, x: f64, y: f64) -> Vector3<f64> {
        let (u, v) = self.grid(x, y);
        let (column, row) = self.cell(u, v);
        let (fu, fv) = (u - column as f64, v - row as f64);
        let mut slope = [0.0; 2];
        for (dc, dr, weight) in [
            (0, 0, (1.0 - fu) * (1.0 - fv)),
            (1, 0, fu * (1.0 - fv)),
            (0, 1, (1.0 - fu) * fv),
            (1, 1, fu * fv),
        ] {
            let [sx, sy] = self.slope(column + dc, row + dr);
            slope[0] += weight * sx;
            slope[1] += weight * sy;
        }
        Vector3::new(-slope[0], -slope[1], 1.0).normalize()
    }

    /// A box that holds it.
    pub fn bounds(&self) -> Bounds {
        self.bounds
    }

    /// Along a ray, its height above the triangles is continuous and linear between grid lines and
    /// diagonals: a change of sign between two of these is a hit, and none can slip through. Blocks
    /// of cells that lie wholly above or below the ray are passed in one step.
    pub fn intersect(&self, ray: &Ray, span: Span) -> Option<f64> {
        let span = self.bounds.crossing(&ray.origin, &ray.direction.map(f64::recip), span)?;
        let (scale_u, scale_v) = self.cells_per_unit();
        let fine = Track {
            start: [(ray.origin.x + self.half[0]) * scale_u, (ray.origin.y + self.half[1]) * scale_v],
            step: [ray.direction.x * scale_u, ray.direction.y * scale_v],
        };
        let coarse =
            Track { start: fine.start.map(|v| v / BLOCK as f64), step: fine.step.map(|v| v / BLOCK as f64) };
        let cells = [self.columns - 1, self.rows - 1];
        coarse.walk(cells.map(|n| n.div_ceil(BLOCK)), span, |block, within| {
            let [low, high] = self.blocks[block[1] * (self.columns - 1).div_ceil(BLOCK) + block[0]];
            let (a, b) = (ray.at(within.min).z, ray.at(within.max).z);
            if a.min(b) > high || a.max(b) < low {
                return None;
            }
            fine.walk(cells, within, |cell, within| self.intersect_cell(ray, &fine, cell, within))
        })
    }

    #[inline]
    fn intersect_cell(
        &self,
        ray: &Ray,
        track: &Track,
        [column, row]: [usize; 2],
        within: Span,
    ) -> Option<f64> {
        let corners = self.corners(column, row);
        let Span { min: start, max: end } = within;
        let z = |t: f64| ray.origin.z + ray.direction.z * t;
        let (low, high) = (z(start).min(z(end)), z(start).max(z(end)));
        if corners.iter().all(|h| *h < low) || corners.iter().all(|h| *h > high) {
            return None;
        }
        let ([u0, v0], [du, dv]) = (track.start, track.step);
        let (u0, v0) = (u0 - column as f64, v0 - row as f64);
        let gap = |t: f64| z(t) - interpolate(corners, u0 + du * t, v0 + dv * t);
        let diagonal = (v0 - u0) / (du - dv);
        let middle = if diagonal > start && diagonal < end { diagonal } else { end };
        for [a, b] in [[start, middle], [middle, end]] {
            let (gap_a, gap_b) = (gap(a), gap(b));
            if gap_a != gap_b && (gap_a >= 0.0) != (gap_b >= 0.0) {
                return Some(a + (b - a) * gap_a / (gap_a - gap_b));
            }
        }
        None
    }

    fn cells_per_unit(&self) -> (f64, f64) {
        ((self.columns - 1) as f64 / (2.0 * self.half[0]), (self.rows - 1) as f64 / (2.0 * self.half[1]))
    }

    fn grid(&self, x: f64, y: f64) -> (f64, f64) {
        let (scale_u, scale_v) = self.cells_per_unit();
        let u = ((x + self.half[0]) * scale_u).clamp(0.0, (self.columns - 1) as f64);
        let v = ((y + self.half[1]) * scale_v).clamp(0.0, (self.rows - 1) as f64);
        (u, v)
    }

    /// The cell that holds a grid position, the nearest one outside (a cast saturates at 0).
    fn cell(&self, u: f64, v: f64) -> (usize, usize) {
        ((u as usize).min(self.columns - 2), (v as usize).min(self.rows - 2))
    }

    /// Heights at (0, 0), (1, 0), (0, 1), (1, 1) of a cell.
    #[inline]
    fn corners(&self, column: usize, row: usize) -> [f64; 4] {
        let i = row * self.columns + column;
        let j = i + self.columns;
        [self.heights[i], self.heights[i + 1], self.heights[j], self.heights[j + 1]]
    }

    fn slope(&self, column: usize, row: usize) -> [f64; 2] {
        let at = |c: usize, r: usize| self.heights[r * self.columns + c];
        let (left, right) = (column.saturating_sub(1), (column + 1).min(self.columns - 1));
        let (low, high) = (row.saturating_sub(1), (row + 1).min(self.rows - 1));
        let (scale_u, scale_v) = self.cells_per_unit();
        [
            (at(right, row) - at(left, row)) * scale_u / (right - left) as f64,
            (at(column, high) - at(column, low)) * scale_v / (high - low) as f64,
        ]
    }
}

/// The way of a ray over a grid: at `t` it is at `start + step t`, in cells.
struct Track {
    start: [f64; 2],
    step: [f64; 2],
}

impl Track {
    /// Visits the cells of a grid of `count` cells along `span` in order, each with the part of the
    /// span inside it, until `visit` finds something.
    #[inline]
    fn walk<T>(
        &self,
        count: [usize; 2],
        span: Span,
        mut visit: impl FnMut([usize; 2], Span) -> Option<T>,
    ) -> Option<T> {
        // A cast saturates at 0, and rounding may leave the grid by a hair.
        let enter = |i: usize| ((self.start[i] + self.step[i] * span.min) as usize).min(count[i] - 1);
        let mut cell = [enter(0), enter(1)];
        let mut t = span.min;
        while t < span.max {
            let leave = [0, 1].map(|i| match self.step[i] {
                0.0 => f64::INFINITY,
                step => (cell[i] as f64 + if step > 0.0 { 1.0 } else { 0.0 } - self.start[i]) / step,
            });
            let end = leave[0].min(leave[1]).min(span.max).max(t);
            if let Some(found) = visit(cell, Span { min: t, max: end }) {
                return Some(found);
            }
            let across = usize::from(leave[1] < leave[0]);
            if self.step[across] > 0.0 {
                cell[across] += 1;
                if cell[across] == count[across] {
                    return None;
                }
            } else {
                cell[across] = cell[across].checked_sub(1)?;
            }
            t = end;
        }
        None
    }
}

fn extent<'a>(heights: impl IntoIterator<Item = &'a f64>) -> [f64; 2] {
    heights.into_iter().fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], h| [low.min(*h), high.max(*h)])
}

/// The height within a cell, split along its diagonal from (0, 0) to (1, 1).
#[inline]
fn interpolate([h00, h10, h01, h11]: [f64; 4], u: f64, v: f64) -> f64 {
    if u >= v { h00 + (h10 - h00) * u + (h11 - h10) * v } else { h00 + (h01 - h00) * v + (h11 - h01) * u }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_is_met_exactly_and_has_its_normal() {
        let field = Heightfield::new(17, 9, [2.0, 1.0], |x, y| 0.5 * x - 0.25 * y);
        let ray = Ray { origin: Point3::new(0.3, -0.2, 5.0), direction: Vector3::new(0.1, 0.05, -1.0) };
        let t = field.intersect(&ray, Span { min: 0.0, max: 100.0 }).expect("the slope is below");
        let p = ray.at(t);
        assert!((p.z - (0.5 * p.x - 0.25 * p.y)).abs() < 1e-12);
        let expected = Vector3::new(-0.5, 0.25, 1.0).normalize();
        assert!((field.normal(p.x, p.y) - expected).norm() < 1e-12);
    }

    #[test]
    fn a_vertical_ray_meets_its_cell() {
        let field = Heightfield::new(5, 5, [1.0, 1.0], |x, y| x * y);
        let ray = Ray { origin: Point3::new(0.26, 0.61, 3.0), direction: -Vector3::z() };
        let t = field.intersect(&ray, Span { min: 0.0, max: 100.0 }).expect("the field is below");
        assert!((3.0 - t - field.height(0.26, 0.61)).abs() < 1e-12);
        let beside = Ray { origin: Point3::new(1.26, 0.61, 3.0), direction: -Vector3::z() };
        assert!(field.intersect(&beside, Span { min: 0.0, max: 100.0 }).is_none());
    }
}
