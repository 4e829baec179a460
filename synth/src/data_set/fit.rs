//! From stored images and depth maps to the size of a sample.

use nalgebra::Point2;
use planesweep_scene::{Camera, DepthRange, Distortion, PrepareError, Raster, WorkingImage};

use super::{DepthGrid, SampleShape, ViewFiles};

/// A source sees a point when its map has the same depth there, to this share.
const SAME_DEPTH: f64 = 0.01;
/// Tails and margin of a range that follows from depth alone, as a plan takes them from sparse points.
const TAIL: f64 = 0.01;
const MARGIN: f64 = 0.05;
/// DTU's training images are halves of the photographs without this much left and on top, in pixels of
/// the halves.
const DTU_OFFSET: [f64; 2] = [80.0, 44.0];

/// How a stored image becomes one of the sample: resized, then cropped.
pub struct Fit {
    stored: Camera,
    resized: [u32; 2],
    offset: [u32; 2],
    size: [u32; 2],
}

impl Fit {
    /// The smallest size that covers the shape with the image's own aspect; `crop` from 0 to 1 along
    /// each axis.
    pub fn new(camera: &Camera, shape: &SampleShape, crop: [f64; 2]) -> Self {
        let stored = [camera.intrinsics.width, camera.intrinsics.height].map(f64::from);
        let size = [shape.width, shape.height];
        let scale = (f64::from(size[0]) / stored[0]).max(f64::from(size[1]) / stored[1]);
        let resized = [0, 1].map(|i| ((stored[i] * scale).round() as u32).max(size[i]));
        let offset = [0, 1].map(|i| (crop[i] * f64::from(resized[i] - size[i])).round() as u32);
        Self { stored: *camera, resized, offset, size }
    }

    /// The camera of the sample's image.
    pub fn camera(&self) -> Camera {
        let mut intrinsics = self.stored.intrinsics.resized(self.resized[0], self.resized[1]);
        intrinsics.cx -= f64::from(self.offset[0]);
        intrinsics.cy -= f64::from(self.offset[1]);
        Camera { intrinsics: intrinsics.with_size(self.size[0], self.size[1]), pose: self.stored.pose }
    }

    pub fn image(&self, stored: Raster<[u8; 3]>) -> Result<WorkingImage, PrepareError> {
        let [width, height] = self.resized;
        let whole = WorkingImage::prepare(stored, &self.stored, &Distortion::None, width, height)?;
        let [left, top] = self.offset.map(|o| o as usize);
        let [width, height] = self.size.map(|s| s as usize);
        let pixels = Raster::from_fn(width, height, |x, y| whole.pixels.at(x + left, y + top));
        Ok(WorkingImage { camera: self.camera(), pixels })
    }

    /// The depth at a position (pixels of the sample's image) in the view's own map, from the nearest
    /// pixel; `None` outside and where it is unknown.
    fn depth_at(&self, at: [f64; 2], grid: DepthGrid, map: &Raster<f32>) -> Option<f64> {
        let stored = [self.stored.intrinsics.width, self.stored.intrinsics.height].map(f64::from);
        let size = [map.width() as f64, map.height() as f64];
        let quarter = self.stored.intrinsics.quartered();
        let is_quarter = size == [quarter.width, quarter.height].map(f64::from);
        let [x, y] = [0, 1].map(|i| {
            let resized = at[i] + f64::from(self.offset[i]);
            let image = (resized + 0.5) * stored[i] / f64::from(self.resized[i]) - 0.5;
            match grid {
                DepthGrid::Image if is_quarter => (image / 4.0).round(),
                DepthGrid::Image => ((image + 0.5) * size[i] / stored[i] - 0.5).round(),
                // Halving took the first pixel of each two.
                DepthGrid::DtuRaw => 2.0 * (image + DTU_OFFSET[i]).round(),
            }
        });
        if x < 0.0 || y < 0.0 {
            return None;
        }
        map.get(x as usize, y as usize).filter(|depth| *depth > 0.0).map(f64::from)
    }
}

/// The first view's depth at the pixels of the network's map, where another view sees it.
pub fn depth(views: &[&ViewFiles], fits: &[Fit], maps: &[Option<Raster<f32>>]) -> Raster<f32> {
    let camera = fits[0].camera();
    let quarter = camera.intrinsics.quartered();
    Raster::from_fn(quarter.width as usize, quarter.height as usize, |x, y| {
        let at = [4.0 * x as f64, 4.0 * y as f64];
        let Some(map) = &maps[0] else { return 0.0 };
        let Some(depth) = fits[0].depth_at(at, views[0].grid, map) else { return 0.0 };
        let point = camera.unproject(&Point2::from(at), depth);
        let seen = (1..views.len()).any(|i| {
            let source = fits[i].camera();
            let Some((pixel, expected)) = source.project(&point) else { return false };
            let (right, bottom) = (f64::from(source.intrinsics.width), f64::from(source.intrinsics.height));
            let inside =
                pixel.x >= 0.0 && pixel.y >= 0.0 && pixel.x <= right - 1.0 && pixel.y <= bottom - 1.0;
            // Without a map nothing is known to hide it.
            inside
                && maps[i].as_ref().is_none_or(|map| {
                    let there = fits[i].depth_at([pixel.x, pixel.y], views[i].grid, map);
                    there.is_some_and(|there| (there - expected).abs() <= SAME_DEPTH * expected)
                })
        });
        if seen { depth as f32 } else { 0.0 }
    })
}

/// The range of known depths, as a plan would take it; `None` without any.
pub fn range(depth: &Raster<f32>) -> Option<DepthRange> {
    let mut known: Vec<f64> = depth.values().iter().filter(|d| **d > 0.0).map(|d| f64::from(*d)).collect();
    known.sort_by(f64::total_cmp);
    let at = |share: f64| known.get((share * known.len() as f64) as usize).copied();
    let (near, far) = (at(TAIL)?, at(1.0 - TAIL)?);
    let extent = (far - near).max(1e-3 * far);
    Some(DepthRange { min: near - MARGIN * extent.min(near), max: far + MARGIN * extent, count: None })
}
