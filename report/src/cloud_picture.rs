//! A picture of a point cloud.

use nalgebra::Point3;
use planesweep_scene::{Camera, Raster};

/// Where no point is.
const BACKGROUND: [u8; 3] = [22, 24, 29];
/// Points are squares of this share of the picture's width, so that pictures of any size look alike.
const SPLAT_SHARE: f64 = 1.0 / 400.0;

/// Draws points (position in the world, colour) as `camera` would see them, in a picture of `width` by
/// `height`; the camera's image is stretched to that size. The nearest point hides those behind it.
pub fn render_cloud(
    points: impl IntoIterator<Item = ([f64; 3], [u8; 3])>,
    camera: &Camera,
    width: u32,
    height: u32,
) -> Raster<[u8; 3]> {
    let camera = Camera { intrinsics: camera.intrinsics.resized(width, height), pose: camera.pose };
    let (columns, rows) = (width as usize, height as usize);
    let mut picture = Raster::filled(columns, rows, BACKGROUND);
    let mut nearest = vec![f32::INFINITY; columns * rows];
    let side = (f64::from(width) * SPLAT_SHARE).round().max(1.0);
    let span = |centre: f64, length: usize| {
        let first = (centre - (side - 1.0) / 2.0).round();
        // A cast saturates, so what lies outside gives an empty range.
        first.max(0.0) as usize..((first + side).max(0.0) as usize).min(length)
    };
    for (position, color) in points {
        let Some((pixel, depth)) = camera.project(&Point3::from(position)) else { continue };
        let depth = depth as f32;
        for y in span(pixel.y, rows) {
            for x in span(pixel.x, columns) {
                let index = y * columns + x;
                if depth < nearest[index] {
                    nearest[index] = depth;
                    picture.values_mut()[index] = color;
                }
            }
        }
    }
    picture
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use planesweep_scene::{Intrinsics, Pose};

    use super::*;

    #[test]
    fn the_nearest_point_is_seen_where_it_projects() {
        let intrinsics =
            Intrinsics { width: 100, height: 80, fx: 100.0, fy: 100.0, skew: 0.0, cx: 49.5, cy: 39.5 };
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        let camera = Camera { intrinsics, pose };
        let (red, green, blue) = ([255, 0, 0], [0, 255, 0], [0, 0, 255]);
        let points = [
            ([0.005, 0.005, 1.0], red),
            ([0.01, 0.01, 2.0], green),
            ([0.205, -0.195, 1.0], blue),
            ([0.0, 0.0, -1.0], green),
            ([1e30, 0.0, 1.0], green),
            ([f64::NAN, 0.0, 1.0], green),
        ];
        let picture = render_cloud(points, &camera, 100, 80);
        assert_eq!((picture.at(50, 40), picture.at(70, 20)), (red, blue));
        let drawn = picture.values().iter().filter(|p| **p != BACKGROUND).count();
        assert_eq!(drawn, 2);
        let twice = render_cloud(points, &camera, 800, 640);
        assert_eq!(twice.at(404, 324), red);
        assert_eq!(twice.values().iter().filter(|p| **p == red).count(), 4);
    }
}
