//! Points of the dense cloud.

use nalgebra::Point2;
use planesweep_scene::Raster;
use rayon::prelude::*;

use crate::filter::FilteredMap;
use crate::normals::Frame;

/// A point of the dense cloud.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Point {
    /// Position in the world, in scene units; `f64`, for world coordinates may be large.
    pub position: [f64; 3],
    /// Unit normal in the world, towards the camera that saw the point; zeros when unknown.
    pub normal: [f32; 3],
    /// RGB.
    pub color: [u8; 3],
    /// Mean confidence of the views that agree on it, in [0, 1]; 0 when unknown.
    pub confidence: f32,
    /// How many views agree on it, 255 meaning that or more; 0 when unknown.
    pub views: u8,
    /// Which neighbours of the view that emits it are among those: bit k is the one at index k.
    pub seen_by: u64,
}

/// The points of the pixels of a filtered depth map that `emitted` marks (of its size; see
/// [`emitted`](crate::emitted)), row by row from the top.
pub fn emit(map: &FilteredMap, emitted: &Raster<bool>) -> Vec<Point> {
    let frame = Frame { camera: &map.camera, depth: &map.depth };
    let columns = map.depth.width();
    let chosen = emitted.values().iter().enumerate().filter(|(_, emitted)| **emitted);
    let chosen: Vec<usize> = chosen.map(|(index, _)| index).collect();
    let point = |index: usize| {
        let (x, y) = (index % columns, index / columns);
        let pixel = Point2::new(x as f64, y as f64);
        let [r, g, b, confidence] = map.color.at(x, y);
        Point {
            position: map.camera.unproject(&pixel, map.depth.at(x, y) as f64).into(),
            normal: frame.world_normal(x, y),
            color: [r, g, b],
            confidence: confidence as f32 / 255.0,
            views: map.views.at(x, y),
            seen_by: map.agreeing.at(x, y),
        }
    };
    chosen.into_par_iter().with_min_len(1 << 10).map(point).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::analytic::{Surface, camera_at};
    use crate::filter::filter;
    use crate::options::FilterOptions;
    use crate::surface::emitted;

    #[test]
    fn kept_pixels_become_points_of_the_surface_in_row_order() {
        let slope = -0.3;
        let mut map = Surface::Plane { slope }.map(camera_at(0.2, 0.1, 12, 9));
        map.depth.values_mut()[5] = 0.0;
        let filtered = filter(&map, &[], &FilterOptions { min_views: 1, ..FilterOptions::default() });
        let kept = emitted(&filtered, &[], 0.01);
        let points = emit(&filtered, &kept);
        assert_eq!(points.len() as u64, filtered.funnel.geometric);
        assert_eq!(points.len(), 12 * 9 - 1);
        for point in &points {
            assert!((point.position[2] - slope * point.position[0]).abs() < 1e-6);
            assert!((point.normal[2] + 1.0 / (1.0 + slope * slope).sqrt() as f32).abs() < 1e-3);
        }
        let last = map.camera.unproject(&Point2::new(11.0, 8.0), map.depth.at(11, 8) as f64);
        assert!((last.x - points[106].position[0]).abs() < 1e-9);
        assert_eq!(points[5].color, map.rgb(6, 0));
        assert_eq!((points[5].confidence, points[5].views), (1.0, 1));
    }
}
