//! Scenes whose depth is known by formula, for the tests of this crate.

use nalgebra::{Point2, Point3, Vector3};
use planesweep_scene::{Camera, DepthMap, Intrinsics, Pose, Raster, in_255ths};

/// A surface that a ray meets, or not.
#[derive(Clone, Copy)]
pub(crate) enum Surface {
    /// The plane `z = slope x`.
    Plane { slope: f64 },
    /// The ball of radius 0.5 about the origin before the plane `z = 1`.
    BallBeforePlane,
}

impl Surface {
    /// Depth of the nearest hit behind a pixel; 0 when there is none.
    pub fn depth(self, camera: &Camera, pixel: &Point2<f64>) -> f64 {
        let centre = camera.pose.centre();
        let ray = camera.unproject(pixel, 1.0) - centre; // one unit of depth
        let meets = |depth: f64| if depth > 0.0 { depth } else { 0.0 };
        match self {
            Self::Plane { slope } => meets((slope * centre.x - centre.z) / (ray.z - slope * ray.x)),
            Self::BallBeforePlane => {
                let (a, b) = (ray.norm_squared(), ray.dot(&centre.coords));
                let discriminant = b * b - a * (centre.coords.norm_squared() - 0.25);
                let ball = if discriminant > 0.0 { (-b - discriminant.sqrt()) / a } else { 0.0 };
                if ball > 0.0 { ball } else { meets((1.0 - centre.z) / ray.z) }
            }
        }
    }

    /// The exact depth map, fully confident, coloured by the place in the world.
    pub fn map(self, camera: Camera) -> DepthMap {
        let (width, height) = (camera.intrinsics.width as usize, camera.intrinsics.height as usize);
        let pixel = |x: usize, y: usize| Point2::new(x as f64, y as f64);
        let depth = Raster::from_fn(width, height, |x, y| self.depth(&camera, &pixel(x, y)) as f32);
        let color = Raster::from_fn(width, height, |x, y| {
            let point = camera.unproject(&pixel(x, y), depth.at(x, y) as f64);
            [point.x, point.y, point.z].map(|w| (128.0 + 40.0 * w) as u8)
        });
        DepthMap::new(camera, depth, Raster::filled(width, height, 1.0), color).expect("sizes agree")
    }
}

/// Changes how sure a map is of a pixel.
pub(crate) fn set_confidence(map: &mut DepthMap, x: usize, y: usize, confidence: f32) {
    let index = y * map.width() + x;
    map.confidence.values_mut()[index] = confidence;
    map.color.values_mut()[index][3] = in_255ths(confidence);
}

/// A camera of `width` by `height` at `(x, y, -3)` that looks at the origin.
pub(crate) fn camera_at(x: f64, y: f64, width: u32, height: u32) -> Camera {
    let (cx, cy) = ((width - 1) as f64 / 2.0, (height - 1) as f64 / 2.0);
    let f = width as f64;
    let intrinsics = Intrinsics { width, height, fx: f, fy: 1.05 * f, skew: 0.3, cx, cy };
    let pose = Pose::look_at(&Point3::new(x, y, -3.0), &Point3::origin(), &-Vector3::y());
    Camera { intrinsics, pose }
}
