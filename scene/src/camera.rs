//! Pinhole cameras and their poses.

use nalgebra::{Matrix3, Matrix3x4, Point2, Point3, Vector3};
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// How far a rotation may be from orthonormal: text files often keep six digits only.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// Why a camera is refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum CameraError {
    /// A number is NaN or infinite.
    #[error("{field} is not finite")]
    NotFinite {
        /// Which part of the camera.
        field: &'static str,
    },
    /// A focal length is zero or negative.
    #[error("focal length {value} is not positive")]
    FocalLength {
        /// The focal length, in pixels.
        value: f64,
    },
    /// The matrix is not a rotation.
    #[error("rotation is not orthonormal with determinant 1 (off by {by:.3e})")]
    NotARotation {
        /// The largest entry of `R R^T - I`, or the distance of the determinant from 1.
        by: f64,
    },
    /// The image has no pixels.
    #[error("image size {width}x{height} is empty")]
    EmptyImage {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
}

/// The inner geometry of a pinhole camera, in pixels of an image of `width` by `height`.
///
/// Pixel centres are at integers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Intrinsics {
    /// Columns of the image.
    pub width: u32,
    /// Rows of the image.
    pub height: u32,
    /// Horizontal focal length.
    pub fx: f64,
    /// Vertical focal length.
    pub fy: f64,
    /// Skew, the entry (0, 1) of `K`; zero for nearly every camera.
    pub skew: f64,
    /// Column of the principal point.
    pub cx: f64,
    /// Row of the principal point.
    pub cy: f64,
}

impl Intrinsics {
    /// Checks that the numbers are finite, the focal lengths positive and the image not empty.
    pub fn checked(self) -> Result<Self, CameraError> {
        let Self { width, height, fx, fy, skew, cx, cy } = self;
        if ![fx, fy, skew, cx, cy].iter().all(|v| v.is_finite()) {
            return Err(CameraError::NotFinite { field: "intrinsics" });
        }
        if let Some(value) = [fx, fy].into_iter().find(|f| *f <= 0.0) {
            return Err(CameraError::FocalLength { value });
        }
        if width == 0 || height == 0 {
            return Err(CameraError::EmptyImage { width, height });
        }
        Ok(self)
    }

    /// The matrix `K`.
    pub fn matrix(&self) -> Matrix3<f64> {
        Matrix3::new(self.fx, self.skew, self.cx, 0.0, self.fy, self.cy, 0.0, 0.0, 1.0)
    }

    /// The intrinsics after the image was resized to `width` by `height`: `x' = s (x + 0.5) - 0.5`.
    #[must_use]
    pub fn resized(&self, width: u32, height: u32) -> Self {
        let (sx, sy) = (width as f64 / self.width as f64, height as f64 / self.height as f64);
        Self {
            width,
            height,
            fx: self.fx * sx,
            fy: self.fy * sy,
            skew: self.skew * sx,
            cx: (self.cx + 0.5) * sx - 0.5,
            cy: (self.cy + 0.5) * sy - 0.5,
        }
    }

    /// The intrinsics after rows and columns were added or removed right and bottom: `K` stays.
    #[must_use]
    pub fn with_size(&self, width: u32, height: u32) -> Self {
        Self { width, height, ..*self }
    }

    /// The intrinsics of the network's maps: the first two rows of `K` divided by four, and a
    /// quarter of the size, rounded up (two layers of stride two, padded).
    #[must_use]
    pub fn quartered(&self) -> Self {
        Self {
            width: self.width.div_ceil(4),
            height: self.height.div_ceil(4),
            fx: self.fx / 4.0,
            fy: self.fy / 4.0,
            skew: self.skew / 4.0,
            cx: self.cx / 4.0,
            cy: self.cy / 4.0,
        }
    }

    /// Projects a point of the camera frame; `None` at or behind the camera plane.
    #[inline]
    pub fn project(&self, point: &Point3<f64>) -> Option<Point2<f64>> {
        if point.z <= 0.0 {
            return None;
        }
        let (x, y) = (point.x / point.z, point.y / point.z);
        Some(Point2::new(self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy))
    }

    /// The point of the camera frame at `depth` (z) behind a pixel.
    #[inline]
    pub fn unproject(&self, pixel: &Point2<f64>, depth: f64) -> Point3<f64> {
        let y = (pixel.y - self.cy) / self.fy;
        let x = (pixel.x - self.cx - self.skew * y) / self.fx;
        Point3::new(x * depth, y * depth, depth)
    }
}

/// A rigid motion from the world to the camera: `x_cam = R x_world + t`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Pose {
    /// `R`.
    pub rotation: Matrix3<f64>,
    /// `t`, in scene units.
    pub translation: Vector3<f64>,
}

impl Pose {
    /// Makes a pose of a world-to-camera rotation and translation, refusing what is no rotation.
    pub fn new(rotation: Matrix3<f64>, translation: Vector3<f64>) -> Result<Self, CameraError> {
        if !rotation.iter().all(|v| v.is_finite()) {
            return Err(CameraError::NotFinite { field: "rotation" });
        }
        if !translation.iter().all(|v| v.is_finite()) {
            return Err(CameraError::NotFinite { field: "translation" });
        }
        let skewness = (rotation * rotation.transpose() - Matrix3::identity()).amax();
        let by = skewness.max((rotation.determinant() - 1.0).abs());
        if by > ROTATION_TOLERANCE {
            return Err(CameraError::NotARotation { by });
        }
        Ok(Self { rotation, translation })
    }

    /// A camera at `centre` (world) that looks at `target` (world) with `up` (world) upwards.
    ///
    /// # Panics
    /// When `up` is parallel to the line of sight or `target` equals `centre`.
    pub fn look_at(centre: &Point3<f64>, target: &Point3<f64>, up: &Vector3<f64>) -> Self {
        let forward = (target - centre).normalize();
        let right = forward.cross(up).normalize();
        assert!(right.iter().all(|v| v.is_finite()), "up is parallel to the line of sight");
        let down = forward.cross(&right);
        let rotation = Matrix3::from_rows(&[right.transpose(), down.transpose(), forward.transpose()]);
        Self { rotation, translation: -(rotation * centre.coords) }
    }

    /// The camera centre in the world, `-R^T t`.
    pub fn centre(&self) -> Point3<f64> {
        Point3::from(-(self.rotation.transpose() * self.translation))
    }

    /// From world to camera frame.
    #[inline]
    pub fn to_camera(&self, world: &Point3<f64>) -> Point3<f64> {
        Point3::from(self.rotation * world.coords + self.translation)
    }

    /// From camera frame to world.
    #[inline]
    pub fn to_world(&self, camera: &Point3<f64>) -> Point3<f64> {
        Point3::from(self.rotation.transpose() * (camera.coords - self.translation))
    }
}

/// A pinhole camera in the world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// Inner geometry and image size.
    pub intrinsics: Intrinsics,
    /// World to camera.
    pub pose: Pose,
}

impl Camera {
    /// Projects a world point to pixel and depth; `None` at or behind the camera plane.
    #[inline]
    pub fn project(&self, world: &Point3<f64>) -> Option<(Point2<f64>, f64)> {
        let point = self.pose.to_camera(world);
        self.intrinsics.project(&point).map(|pixel| (pixel, point.z))
    }

    /// The world point at `depth` (z) behind a pixel.
    #[inline]
    pub fn unproject(&self, pixel: &Point2<f64>, depth: f64) -> Point3<f64> {
        self.pose.to_world(&self.intrinsics.unproject(pixel, depth))
    }

    /// `K [R | t]`.
    pub fn projection(&self) -> Matrix3x4<f64> {
        let mut extrinsic = Matrix3x4::zeros();
        extrinsic.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.pose.rotation);
        extrinsic.set_column(3, &self.pose.translation);
        self.intrinsics.matrix() * extrinsic
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> Camera {
        let intrinsics =
            Intrinsics { width: 640, height: 480, fx: 500.0, fy: 510.0, skew: 0.5, cx: 320.0, cy: 240.0 };
        let pose = Pose::look_at(&Point3::new(1.0, 2.0, -3.0), &Point3::new(0.2, 0.1, 4.0), &Vector3::y());
        Camera { intrinsics, pose }
    }

    #[test]
    fn projection_inverts_unprojection() {
        let camera = camera();
        let pixel = Point2::new(123.0, 45.0);
        let world = camera.unproject(&pixel, 2.5);
        let (back, depth) = camera.project(&world).expect("in front of the camera");
        assert!((back - pixel).norm() < 1e-9 && (depth - 2.5).abs() < 1e-12);
        let h = camera.projection() * world.to_homogeneous();
        assert!((h.x / h.z - 123.0).abs() < 1e-9 && (h.z - 2.5).abs() < 1e-12);
    }

    #[test]
    fn looking_at_a_point_centres_it() {
        let camera = camera();
        let (pixel, depth) = camera.project(&Point3::new(0.2, 0.1, 4.0)).expect("in front");
        assert!((pixel - Point2::new(320.0, 240.0)).norm() < 1e-9);
        assert!((depth - (Point3::new(0.2, 0.1, 4.0) - camera.pose.centre()).norm()).abs() < 1e-12);
        assert!(Pose::new(camera.pose.rotation, camera.pose.translation).is_ok());
    }

    #[test]
    fn resizing_moves_pixel_corners_to_pixel_corners() {
        let half = camera().intrinsics.resized(320, 240);
        // The corner (-0.5, -0.5) stays a corner: cx + 0.5 halves.
        assert_eq!((half.cx, half.cy), (159.75, 119.75));
        assert_eq!((half.fx, half.fy, half.skew), (250.0, 255.0, 0.25));
    }

    #[test]
    fn quartering_divides_two_rows_by_four_and_rounds_the_size_up() {
        let k = Intrinsics { height: 866, ..camera().intrinsics }.quartered();
        assert_eq!((k.width, k.height, k.cx, k.fx), (160, 217, 80.0, 125.0));
    }

    #[test]
    fn bad_cameras_are_named() {
        let good = camera();
        let mut rotation = good.pose.rotation;
        rotation[(0, 0)] = f64::NAN;
        assert_eq!(Pose::new(rotation, Vector3::zeros()), Err(CameraError::NotFinite { field: "rotation" }));
        assert!(matches!(
            Pose::new(2.0 * good.pose.rotation, Vector3::zeros()),
            Err(CameraError::NotARotation { .. })
        ));
        let mirrored = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, -1.0));
        assert!(matches!(Pose::new(mirrored, Vector3::zeros()), Err(CameraError::NotARotation { .. })));
        let flat = Intrinsics { fy: 0.0, ..good.intrinsics };
        assert_eq!(flat.checked(), Err(CameraError::FocalLength { value: 0.0 }));
        let empty = Intrinsics { width: 0, ..good.intrinsics };
        assert_eq!(empty.checked(), Err(CameraError::EmptyImage { width: 0, height: 480 }));
    }

    #[test]
    fn points_behind_the_camera_do_not_project() {
        assert!(camera().intrinsics.project(&Point3::new(0.0, 0.0, 0.0)).is_none());
        assert!(camera().intrinsics.project(&Point3::new(0.1, 0.0, -1.0)).is_none());
    }
}
