//! Where the cameras stand: an arc around the scene, walked by hand.

use nalgebra::{Point3, Rotation3, Vector3};
use planesweep_scene::{Camera, Intrinsics, Pose};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// An arc of cameras that look at one place.
#[derive(Clone, Debug)]
pub struct CameraPath {
    /// What they look at, world; z is up.
    pub target: Point3<f64>,
    /// Distance to the target along the ground, in scene units.
    pub radius: f64,
    /// Height of the cameras over the target, in scene units.
    pub height: f64,
    /// The angle at the target between neighbours, in degrees.
    pub step_degrees: f64,
}

impl CameraPath {
    /// `count` cameras from left to right, the middle of the arc at -y of the target. No two are
    /// alike: distance, height, aim and roll vary as those of a person with a camera do.
    pub fn cameras(&self, count: usize, intrinsics: &Intrinsics, rng: &mut ChaCha8Rng) -> Vec<Camera> {
        let middle = (count as f64 - 1.0) / 2.0;
        let mut draw = |half: f64| rng.random_range(-half..=half);
        (0..count)
            .map(|i| {
                let degrees = self.step_degrees * (i as f64 - middle + draw(0.15));
                let (sin, cos) = degrees.to_radians().sin_cos();
                let radius = self.radius * (1.0 + draw(0.05));
                let up = self.height * (1.0 + draw(0.15));
                let centre = self.target + Vector3::new(radius * sin, -radius * cos, up);
                let aim = self.target + Vector3::new(draw(0.25), draw(0.25), draw(0.15));
                let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), draw(2.0_f64).to_radians());
                let level = Pose::look_at(&centre, &aim, &Vector3::z());
                let pose = Pose { rotation: roll * level.rotation, translation: roll * level.translation };
                Camera { intrinsics: *intrinsics, pose }
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use rand::SeedableRng;

    use super::*;

    #[test]
    fn neighbours_see_the_target_under_angles_that_stereo_needs() {
        let path =
            CameraPath { target: Point3::new(0.0, 0.5, 0.6), radius: 6.0, height: 1.2, step_degrees: 7.0 };
        let intrinsics =
            Intrinsics { width: 640, height: 480, fx: 560.0, fy: 560.0, skew: 0.0, cx: 319.5, cy: 239.5 };
        let cameras = path.cameras(10, &intrinsics, &mut ChaCha8Rng::seed_from_u64(5));
        for pair in cameras.windows(2) {
            let rays = [&pair[0], &pair[1]].map(|c| path.target - c.pose.centre());
            let angle = rays[0].angle(&rays[1]).to_degrees();
            assert!((4.0..12.0).contains(&angle), "{angle} degrees");
        }
        for camera in &cameras {
            Pose::new(camera.pose.rotation, camera.pose.translation).expect("a rotation");
            let (pixel, _) = camera.project(&path.target).expect("the target is in front");
            assert!((pixel.x - 319.5).abs() < 60.0 && (pixel.y - 239.5).abs() < 60.0, "{pixel}");
        }
    }
}
