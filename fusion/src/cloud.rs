//! Points of the dense cloud.

use nalgebra::Point2;
use rayon::prelude::*;

use crate::filter::FilteredMap;
use crate::normals::normals;

/// A point of the dense cloud.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// Position in the world, in scene units; `f64`, for world coordinates may be large.
    pub position: [f64; 3],
    /// Unit normal in the world, towards the camera that saw the point; zeros when unknown.
    pub normal: [f32; 3],
    /// RGB.
    pub color: [u8; 3],
}

/// The points of a filtered depth map, row by row from the top.
pub fn emit(map: &FilteredMap) -> Vec<Point> {
    let normals = normals(&map.camera, &map.depth);
    let rows: Vec<Vec<Point>> = (0..map.depth.height())
        .into_par_iter()
        .map(|y| {
            let pixels = map.depth.row(y).iter().zip(normals.row(y)).zip(map.color.row(y)).enumerate();
            pixels
                .filter(|(_, ((depth, _), _))| **depth > 0.0)
                .map(|(x, ((depth, normal), color))| {
                    let pixel = Point2::new(x as f64, y as f64);
                    let position = map.camera.unproject(&pixel, *depth as f64).into();
                    Point { position, normal: *normal, color: *color }
                })
                .collect()
        })
        .collect();
    rows.concat()
}
