//! Fewer points for the same surface.

use nalgebra::Point3;
use rayon::prelude::*;

/// One point for each occupied cell of a grid: the mean of the points in it.
///
/// The grid begins half a cell below the least coordinates, as Open3D's does, and means are summed in
/// the order of the points, so that both give the same numbers; the cells come in the order of their
/// coordinates. A cell of no size, or a coordinate that is not finite, leaves the points as they are.
pub fn voxel_down_sample(points: &[Point3<f64>], cell: f64) -> Vec<Point3<f64>> {
    let Some(first) = points.first() else { return Vec::new() };
    let least = points.iter().fold(*first, |least, point| least.inf(point));
    let origin = least.map(|v| v - 0.5 * cell);
    let is_grid = cell > 0.0 && points.iter().all(|p| p.iter().all(|v| v.is_finite()));
    if !is_grid {
        return points.to_vec();
    }
    let mut by_cell: Vec<([i64; 3], usize)> = points
        .par_iter()
        .enumerate()
        .map(|(index, point)| {
            let place = ((point - origin) / cell).map(|v| v.floor() as i64);
            (place.into(), index)
        })
        .collect();
    by_cell.par_sort_unstable();
    by_cell
        .chunk_by(|a, b| a.0 == b.0)
        .map(|cell| {
            let sum =
                cell.iter().fold(nalgebra::Vector3::zeros(), |sum, (_, index)| sum + points[*index].coords);
            Point3::from(sum / cell.len() as f64)
        })
        .collect()
}

/// Every `k`-th point where there are more than `most`, with `k` the rounded ratio.
pub fn uniform_down_sample(points: Vec<Point3<f64>>, most: usize) -> Vec<Point3<f64>> {
    if points.len() <= most {
        return points;
    }
    let step = (points.len() as f64 / most as f64).round() as usize;
    points.into_iter().step_by(step.max(1)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_begin_half_a_cell_below_the_least_point() {
        let points = [[0.0, 0.0, 0.0], [0.4, 0.0, 0.0], [0.6, 0.0, 0.0], [0.0, 5.0, 0.2], [1.0, 0.0, 0.0]]
            .map(Point3::from);
        // Along x the cells are [-0.5, 0.5), [0.5, 1.5).
        let cells = voxel_down_sample(&points, 1.0);
        assert_eq!(cells, [[0.2, 0.0, 0.0], [0.0, 5.0, 0.2], [0.8, 0.0, 0.0]].map(Point3::from));
        assert_eq!(voxel_down_sample(&points, 0.0), points);
        assert!(voxel_down_sample(&[], 1.0).is_empty());
    }

    #[test]
    fn large_clouds_keep_every_kth_point() {
        let points: Vec<Point3<f64>> = (0..10).map(|i| Point3::new(f64::from(i), 0.0, 0.0)).collect();
        let kept = |most| uniform_down_sample(points.clone(), most).iter().map(|p| p.x).collect::<Vec<_>>();
        assert_eq!(kept(10).len(), 10);
        assert_eq!(kept(4), [0.0, 3.0, 6.0, 9.0]);
        assert_eq!(kept(9).len(), 10);
    }
}
