//! A backend that knows the answer: the exact depth of a plane, without a network.

use nalgebra::{Point2, Vector3};
use planesweep_scene::{Camera, DepthMap, Raster};

use crate::backend::quarter;
use crate::{BackendInfo, DepthBackend, InferError, InferInput};

/// Gives every camera the exact depth of one plane of the world. It looks at no pixel, costs next to
/// nothing and is deterministic, so everything around the network can be tested with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AnalyticBackend {
    normal: Vector3<f64>,
    offset: f64,
}

impl AnalyticBackend {
    /// The plane of all world points `x` with `normal . x = offset`; the normal need not have unit length.
    pub fn new(normal: Vector3<f64>, offset: f64) -> Self {
        Self { normal, offset }
    }

    /// The depth at which the ray through a pixel meets the plane; `None` when it does not.
    fn depth_at(&self, camera: &Camera, x: usize, y: usize) -> Option<f64> {
        let centre = camera.pose.centre();
        let step = camera.unproject(&Point2::new(x as f64, y as f64), 1.0) - centre;
        let depth = (self.offset - self.normal.dot(&centre.coords)) / self.normal.dot(&step);
        (depth.is_finite() && depth > 0.0).then_some(depth)
    }
}

impl DepthBackend for AnalyticBackend {
    fn info(&self) -> BackendInfo {
        BackendInfo { name: "analytic".to_owned(), device: "cpu".to_owned() }
    }

    /// Confidence is 1 where the plane lies within the range of the hypotheses; elsewhere both depth and
    /// confidence are 0.
    fn infer(&mut self, input: InferInput<'_>) -> Result<DepthMap, InferError> {
        if input.sources.is_empty() {
            return Err(InferError::NoSources);
        }
        let (camera, color) = quarter(input.reference);
        let (width, height) = (color.width(), color.height());
        let range = input.hypotheses.min()..=input.hypotheses.max();
        let depth = Raster::from_fn(width, height, |x, y| {
            self.depth_at(&camera, x, y).filter(|depth| range.contains(depth)).unwrap_or(0.0) as f32
        });
        let confidence = depth.map(|depth| if *depth > 0.0 { 1.0 } else { 0.0 });
        Ok(DepthMap::new(camera, depth, confidence, color).expect("all parts have the quartered size"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::backend::conformance::{self, Images};
    use nalgebra::Point3;
    use planesweep_scene::Sampling;

    #[test]
    fn conforms() {
        conformance::check(&mut AnalyticBackend::new(Vector3::z(), 4.0));
    }

    #[test]
    fn depth_map_lies_on_the_plane() {
        let images = Images::new(90, 70, Sampling::Uniform);
        let normal = Vector3::new(0.2, -0.3, 1.0);
        let map = images.infer(&mut AnalyticBackend::new(normal, 4.0)).expect("a depth map");
        for (x, y) in [(0, 0), (22, 17), (11, 3)] {
            let world: Point3<f64> =
                map.camera.unproject(&Point2::new(x as f64, y as f64), map.depth.at(x, y) as f64);
            assert!((normal.dot(&world.coords) - 4.0).abs() < 1e-5);
            assert_eq!(map.confidence.at(x, y), 1.0);
        }
    }

    #[test]
    fn plane_out_of_range_or_behind_gives_no_depth() {
        let images = Images::new(64, 64, Sampling::Uniform);
        for offset in [100.0, -4.0] {
            let map = images.infer(&mut AnalyticBackend::new(Vector3::z(), offset)).expect("a depth map");
            assert!(map.depth.values().iter().chain(map.confidence.values()).all(|value| *value == 0.0));
        }
    }
}
