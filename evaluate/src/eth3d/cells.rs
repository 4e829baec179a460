//! Means that do not depend on how densely a place is sampled.

use nalgebra::Point3;
use rayon::prelude::*;

/// Both grids are shifted against each other by half a cell along every axis.
const SHIFTS: [f64; 2] = [0.0, 0.5];

/// For each tolerance, the mean over all cells of both grids of the share of their points that hold. A
/// point for which `holds(point, tolerance)` is `None` does not count, nor does a cell without points
/// that count; 0 where there is no cell.
pub fn cell_means(
    points: &[Point3<f64>],
    cell: f64,
    tolerances: usize,
    holds: impl Fn(usize, usize) -> Option<bool> + Sync,
) -> Vec<f64> {
    let mut sums = vec![(0.0, 0_usize); tolerances];
    for shift in SHIFTS {
        let mut by_cell: Vec<([i64; 3], usize)> = points
            .par_iter()
            .enumerate()
            .map(|(index, point)| (point.coords.map(|v| (v / cell + shift).floor() as i64).into(), index))
            .collect();
        by_cell.par_sort_unstable();
        for members in by_cell.chunk_by(|a, b| a.0 == b.0) {
            for (tolerance, (sum, cells)) in sums.iter_mut().enumerate() {
                let held = members.iter().filter_map(|(_, index)| holds(*index, tolerance));
                let (count, good) =
                    held.fold((0_usize, 0_usize), |(n, good), held| (n + 1, good + usize::from(held)));
                if count > 0 {
                    *sum += good as f64 / count as f64;
                    *cells += 1;
                }
            }
        }
    }
    sums.into_iter().map(|(sum, cells)| sum / cells.max(1) as f64).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_weigh_the_same_and_those_that_do_not_count_nothing() {
        // Without shift: {0, 1}, {2}, {3}; shifted by half a cell: {0}, {1, 2}, {3}.
        let points = [-0.9, -0.2, 0.1, 5.0].map(|x| Point3::new(x, 0.0, 0.0));
        let holds = [Some(true), Some(false), Some(true), None];
        let means = cell_means(&points, 1.0, 1, |point, _| holds[point]);
        assert_eq!(means, [(0.5 + 1.0 + 1.0 + 0.5) / 4.0]);
        assert_eq!(cell_means(&points, 1.0, 2, |_, _| None), [0.0, 0.0]);
    }
}
