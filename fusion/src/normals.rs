//! Surface normals from the gradients of a depth map.

use nalgebra::{Point2, Vector3};
use planesweep_scene::{Camera, Raster};
use rayon::prelude::*;

/// Relative step of depth from one pixel to the next beyond which they lie on different surfaces. A
/// plane seen by a network's map (a pixel is some 1/200 of the depth) at 80 degrees makes steps of 3 %.
const MAX_RELATIVE_STEP: f32 = 0.05;

/// The unit normal at each pixel of a depth map, in the world frame, towards the camera; zeros where
/// there is no depth.
///
/// The surface's tangents are differences of the unprojected left and right, and upper and lower
/// neighbour pixels, or of one and the pixel itself where the other has no depth or lies on another
/// surface. A pixel with no such neighbour along an axis is taken to face the camera.
pub fn normals(camera: &Camera, depth: &Raster<f32>) -> Raster<[f32; 3]> {
    let mut normals = Raster::filled(depth.width(), depth.height(), [0.0; 3]);
    let frame = Frame { camera, depth };
    normals.values_mut().par_chunks_mut(depth.width().max(1)).enumerate().for_each(|(y, row)| {
        for (x, normal) in row.iter_mut().enumerate() {
            if depth.at(x, y) > 0.0 {
                *normal = frame.world_normal(x, y);
            }
        }
    });
    normals
}

/// A depth map as points of its camera's frame.
pub(crate) struct Frame<'a> {
    pub camera: &'a Camera,
    pub depth: &'a Raster<f32>,
}

impl Frame<'_> {
    /// What [`normals`] has at a pixel with a depth.
    pub fn world_normal(&self, x: usize, y: usize) -> [f32; 3] {
        let world = self.camera.pose.rotation.transpose() * self.normal(x, y);
        world.map(|n| n as f32).into()
    }

    fn point(&self, x: usize, y: usize) -> Vector3<f64> {
        let depth = self.depth.at(x, y) as f64;
        self.camera.intrinsics.unproject(&Point2::new(x as f64, y as f64), depth).coords
    }

    /// The normal at a pixel with a depth, in the camera frame.
    fn normal(&self, x: usize, y: usize) -> Vector3<f64> {
        let here = self.point(x, y);
        let towards_camera = -here.normalize();
        let right = self.tangent((x, y), (x.wrapping_sub(1), y), (x + 1, y));
        let down = self.tangent((x, y), (x, y.wrapping_sub(1)), (x, y + 1));
        let (Some(right), Some(down)) = (right, down) else { return towards_camera };
        // Right, down and the line of sight are right-handed, so this order faces the camera.
        let normal = down.cross(&right).try_normalize(0.0).unwrap_or(towards_camera);
        if normal.dot(&here) > 0.0 { -normal } else { normal }
    }

    /// From the pixel before to the pixel after, as far as they continue the surface at `here`.
    fn tangent(
        &self,
        here: (usize, usize),
        before: (usize, usize),
        after: (usize, usize),
    ) -> Option<Vector3<f64>> {
        let depth = self.depth.at(here.0, here.1);
        let continues = |(x, y): (usize, usize)| {
            self.depth
                .get(x, y)
                .is_some_and(|d| d > 0.0 && (d - depth).abs() < MAX_RELATIVE_STEP * depth.min(d))
        };
        let first = if continues(before) { before } else { here };
        let last = if continues(after) { after } else { here };
        (first != last).then(|| self.point(last.0, last.1) - self.point(first.0, first.1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::analytic::{Surface, camera_at};

    #[test]
    fn the_normals_of_a_plane_are_its_own_everywhere() {
        let slope = 0.4;
        let map = Surface::Plane { slope }.map(camera_at(0.5, -0.3, 30, 24));
        let truth = Vector3::new(slope, 0.0, -1.0).normalize();
        for normal in normals(&map.camera, &map.depth).values() {
            assert!((Vector3::from(normal.map(f64::from)) - truth).norm() < 1e-3, "{normal:?}");
        }
    }

    #[test]
    fn the_normals_of_a_ball_point_outwards_and_stop_at_its_edge() {
        let map = Surface::BallBeforePlane.map(camera_at(0.0, 0.2, 120, 90));
        let (mut on_ball, mut on_plane) = (0, 0);
        let normals = normals(&map.camera, &map.depth);
        for y in 0..90 {
            for x in 0..120 {
                let pixel = Point2::new(x as f64, y as f64);
                let point = map.camera.unproject(&pixel, map.depth.at(x, y) as f64);
                let normal = Vector3::from(normals.at(x, y).map(f64::from));
                assert!((normal.norm() - 1.0).abs() < 1e-6);
                let to_camera = (map.camera.pose.centre() - point).normalize();
                assert!(normal.dot(&to_camera) > 0.0);
                if point.z > 0.99 {
                    on_plane += 1;
                    assert!((normal + Vector3::z()).norm() < 1e-3, "{normal:?} at {x}, {y}");
                } else if point.coords.normalize().dot(&to_camera) > 0.5 {
                    on_ball += 1;
                    assert!(normal.dot(&point.coords.normalize()) > 0.99, "{normal:?} at {x}, {y}");
                }
            }
        }
        assert!(on_ball > 500 && on_plane > 5000, "{on_ball} and {on_plane}");
    }

    #[test]
    fn lone_pixels_face_the_camera_and_holes_have_none() {
        let camera = camera_at(0.0, 0.0, 5, 3);
        let depth = Raster::from_fn(5, 3, |x, y| if (x, y) == (4, 0) { 2.0 } else { 0.0 });
        let normals = normals(&camera, &depth);
        assert_eq!(normals.at(3, 0), [0.0; 3]);
        let point = camera.unproject(&Point2::new(4.0, 0.0), 2.0);
        let to_camera = (camera.pose.centre() - point).normalize();
        assert!((Vector3::from(normals.at(4, 0).map(f64::from)) - to_camera).norm() < 1e-6);
    }
}
