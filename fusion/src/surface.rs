//! Once per surface: of all views that see a place, which one emits it.
//!
//! Every view sees the place with pixels of some *footprint*, their width there in scene units. Pass one
//! (part of the filter) lets a pixel *own* its place when no view that agrees with it sees the place
//! with a smaller footprint. Pass two (before points are made) drops a pixel that owns nothing when
//! a pixel of another view that does covers it.
//!
//! Owners are always emitted, and only what an owner covers is dropped: so no hole can appear, whatever
//! the chain of views that defer to each other, and whatever the filters did to the best view. Where
//! the best view's own pixel was dropped, the others emit theirs.

use nalgebra::{Point2, Point3};
use planesweep_scene::{Camera, Raster};
use rayon::prelude::*;

use crate::filter::FilteredMap;

/// Relative difference below which footprints are equal, so that both views see them so.
const EQUAL_FOOTPRINTS: f64 = 1e-4;

/// How a neighbour competes with the reference for a place: the smaller footprint wins, width of a pixel times
/// depth; of equal ones the first by the coordinates of the camera centres, which stay the same when views are
/// numbered anew. Of two views in different places one wins.
pub(crate) struct Rival {
    /// It wins where its depth is less than the reference's times this.
    pub wins_below: f32,
}

impl Rival {
    pub fn new(neighbour: &Camera, reference: &Camera) -> Self {
        let pixel_width = |camera: &Camera| {
            let k = &camera.intrinsics;
            1.0 / (k.fx * k.fy).sqrt()
        };
        let centre = |camera: &Camera| {
            let centre = camera.pose.centre();
            (centre.x, centre.y, centre.z)
        };
        let wins_ties = centre(neighbour) < centre(reference);
        let tolerance = if wins_ties { EQUAL_FOOTPRINTS } else { -EQUAL_FOOTPRINTS };
        let wins_below = pixel_width(reference) / pixel_width(neighbour) * (1.0 + tolerance);
        Self { wins_below: wins_below as f32 }
    }
}

/// Which kept pixels of a map are to become points.
///
/// With `others`, the filtered maps of all views that may emit the same surface, a pixel is left out
/// when it owns nothing and an owner among the others covers it: its surface point lies in the owner's
/// pixel, and the depths there differ by less than `max_relative_depth`. Without, all kept pixels are
/// emitted.
pub fn emitted(map: &FilteredMap, others: &[&FilteredMap], max_relative_depth: f32) -> Raster<bool> {
    let (width, height) = (map.depth.width(), map.depth.height());
    let mut emitted = Raster::filled(width, height, false);
    emitted.values_mut().par_chunks_mut(width.max(1)).enumerate().for_each(|(y, row)| {
        for (x, emitted) in row.iter_mut().enumerate() {
            let depth = map.depth.at(x, y);
            *emitted = depth > 0.0
                && (map.owns.at(x, y) || {
                    let point = map.camera.unproject(&Point2::new(x as f64, y as f64), depth as f64);
                    !others.iter().any(|other| covers(other, &point, max_relative_depth))
                });
        }
    });
    emitted
}

/// Whether a pixel of `map` that owns its surface has the point in it.
fn covers(map: &FilteredMap, point: &Point3<f64>, max_relative_depth: f32) -> bool {
    let Some((pixel, depth)) = map.camera.project(point) else { return false };
    if !(pixel.x > -0.5 && pixel.y > -0.5) {
        return false;
    }
    let (x, y) = ((pixel.x + 0.5) as usize, (pixel.y + 0.5) as usize);
    let Some(seen) = map.depth.get(x, y) else { return false };
    let difference = (seen as f64 - depth).abs();
    map.owns.at(x, y) && seen > 0.0 && difference < max_relative_depth as f64 * depth
}

#[cfg(test)]
mod tests;
