//! What an inference will cost, from its sizes alone.

use super::images;
use crate::input::SIZE_MULTIPLE;
use crate::kernels::slab::Shape;

/// Sizes of one inference.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct InferSize {
    /// Columns of the images.
    pub width: usize,
    /// Rows of the images.
    pub height: usize,
    /// Depth hypotheses.
    pub depths: usize,
    /// Views, the reference included.
    pub views: usize,
    /// Whether the weights have a refinement network.
    pub refined: bool,
}

/// Floating-point operations of each part, as the plain network counts them: a multiplication and an addition are
/// two.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Operations {
    /// Features of all views.
    pub features: f64,
    /// Warp and variance.
    pub warp: f64,
    /// The first layer of the 3D network.
    pub first_layer: f64,
    /// The 3D network without its first and its last layer.
    pub middle_layers: f64,
    /// The last layer of the 3D network.
    pub last_layer: f64,
    /// Refinement.
    pub refinement: f64,
}

/// What an inference will cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InferCost {
    /// The most memory that `CpuBackend` holds besides its input and the features of other images.
    pub bytes: u64,
    /// Its arithmetic.
    pub operations: Operations,
}

/// Weights, their packed forms, the threads' stacks and buffers too small to count: measured.
const FIXED_BYTES: usize = 3 << 20;
/// Transformed values and the ring of cost columns of one thread, for each depth.
const THREAD_BYTES_PER_DEPTH: usize = 7 * 32 * 4 + 8 * 36 + 16 * 4;
/// The same, whatever the depths.
const THREAD_BYTES: usize = 512 << 10;
/// Index and confidence of a pixel of the depth map, as they come and as they are handed on.
const PIXEL_BYTES: usize = 40;
/// Indices of a pixel on their way through refinement, and the image that guides them.
const REFINED_PIXEL_BYTES: usize = 3 * 8 + 3 * 4;

/// Operations of the features, for each pixel of an image: 3x3 layers 3-8 and 8-8; at half size a 5x5 layer 8-16 and
/// two of 16-16; at a quarter a 5x5 layer 16-32 and two of 32-32.
const FEATURE_OPERATIONS: f64 =
    432.0 + 1152.0 + (6400.0 + 2.0 * 4608.0) / 4.0 + (25600.0 + 2.0 * 18432.0) / 16.0;
/// Of warp and variance, for each voxel and source: bilinear weights, sums, squares in 32 channels.
const WARP_OPERATIONS: f64 = 32.0 * 11.0;
/// Of the 3D network's first layer, 32-8, for each voxel.
const FIRST_LAYER_OPERATIONS: f64 = 13824.0;
/// Of its other layers but the last, for each voxel: 8-16, 16-16, 16-8 at an eighth of the volume, and so on.
const MIDDLE_LAYER_OPERATIONS: f64 = (6912.0 + 13824.0 + 6912.0) / 8.0
    + (27648.0 + 55296.0 + 27648.0) / 64.0
    + (110592.0 + 221184.0 + 110592.0) / 512.0;
/// Of its last layer, 8-1, for each voxel.
const LAST_LAYER_OPERATIONS: f64 = 432.0;
/// Of the refinement, for each pixel of the depth map: 4-32, twice 32-32, 32-1.
const REFINEMENT_OPERATIONS: f64 = 2304.0 + 2.0 * 18432.0 + 576.0;

impl InferSize {
    /// The arithmetic of an inference on images padded to what the network takes.
    pub fn operations(self) -> Operations {
        let (width, height) = self.padded();
        let pixels = (width * height) as f64;
        let voxels = pixels / 16.0 * self.depths as f64;
        Operations {
            features: FEATURE_OPERATIONS * pixels * self.views as f64,
            warp: WARP_OPERATIONS * voxels * (self.views as f64 - 1.0),
            first_layer: FIRST_LAYER_OPERATIONS * voxels,
            middle_layers: MIDDLE_LAYER_OPERATIONS * voxels,
            last_layer: LAST_LAYER_OPERATIONS * voxels,
            refinement: if self.refined { REFINEMENT_OPERATIONS * pixels / 16.0 } else { 0.0 },
        }
    }

    fn padded(self) -> (usize, usize) {
        (self.width.next_multiple_of(SIZE_MULTIPLE), self.height.next_multiple_of(SIZE_MULTIPLE))
    }
}

impl Operations {
    /// Of the whole inference.
    pub fn total(&self) -> f64 {
        let Self { features, warp, first_layer, middle_layers, last_layer, refinement } = self;
        features + warp + first_layer + middle_layers + last_layer + refinement
    }
}

/// Rows of the volume that are taken at a time where the memory allows it.
pub(crate) const STEP_ROWS: usize = 8;

impl InferCost {
    /// What an inference by `CpuBackend` with this many threads, bounded by this memory, will cost.
    pub fn predict(size: InferSize, threads: usize, memory_bytes: Option<u64>) -> Self {
        predict(size, threads, step_rows(size, threads, memory_bytes, STEP_ROWS))
    }
}

/// Bytes of features that are kept for later inferences, of the memory that an inference may hold.
pub(crate) fn cache_bytes(memory_bytes: u64) -> u64 {
    memory_bytes / 4
}

/// As many rows at a time as the memory allows, at most `most`, at least one. Features of earlier inferences may
/// lie beside those of this one.
pub(crate) fn step_rows(size: InferSize, threads: usize, memory_bytes: Option<u64>, most: usize) -> usize {
    let fits = |rows| {
        memory_bytes.is_none_or(|limit| {
            let others = cache_bytes(limit).saturating_sub(map_bytes(size) as u64);
            predict(size, threads, rows).bytes + others <= limit
        })
    };
    (1..=most).rev().find(|rows| fits(*rows)).unwrap_or(1)
}

/// The cost of an inference with all its rows, `step_rows` rows of the volume at a time.
pub(crate) fn predict(size: InferSize, threads: usize, step_rows: usize) -> InferCost {
    let depths = size.depths;
    let (width, height) = size.padded();
    let pixels = width * height;
    let map_pixels = pixels / 16;
    let maps = map_bytes(size);
    let input = 3 * pixels * 4;
    let features = images::features_bytes(width, height) + input;
    let volume = volume_bytes(width / 4, height / 4, depths, step_rows) + map_pixels * PIXEL_BYTES;
    let refinement = if size.refined {
        let indices = map_pixels * (PIXEL_BYTES + REFINED_PIXEL_BYTES);
        indices + input.max(images::refined_bytes(width / 4, height / 4))
    } else {
        0
    };
    let threads = threads * (THREAD_BYTES + THREAD_BYTES_PER_DEPTH * depths);
    let bytes = FIXED_BYTES + threads + maps + features.max(volume).max(refinement);
    InferCost { bytes: bytes as u64, operations: size.operations() }
}

/// Bytes of the feature maps of all views.
fn map_bytes(size: InferSize) -> usize {
    let (width, height) = size.padded();
    size.views * (width / 4 + 2) * (height / 4 + 2) * 32 * 4
}

/// Bytes of the slabs that the 3D network takes from its pool.
///
/// Follows how many rows each stage has taken and given: a row is held from when it begins to when the
/// transposed layer has added it to its output.
fn volume_bytes(width: usize, height: usize, depths: usize, step_rows: usize) -> usize {
    let plain = |taken: usize, height: usize| if taken == height { taken } else { taken.saturating_sub(1) };
    let up = |taken: usize, height: usize| {
        if taken == height { 2 * taken } else { (2 * taken).saturating_sub(1) }
    };
    let begun = |taken: usize, height: usize| if taken == 0 { 0 } else { (taken + 1).min(height) };
    let heights = [height, height / 2, height / 4, height / 8];
    let mut most = [0; 4];
    // Rows taken by the plain layer of each scale, and rows given by the layer that comes back to it.
    let (mut taken, mut given) = ([0; 4], [0; 4]);
    while taken[0] < height {
        let (taken_before, given_before) = (taken, given);
        taken[0] = (taken[0] + step_rows).min(height);
        for scale in 1..4 {
            taken[scale] = plain(taken[scale - 1], heights[scale - 1]) / 2;
        }
        given[3] = plain(taken[3], heights[3]);
        for scale in (0..3).rev() {
            given[scale] = up(given[scale + 1], heights[scale + 1]);
        }
        for scale in 0..4 {
            let held = begun(taken[scale], heights[scale]) - given_before[scale];
            // What the strided layer gave is held until the plain layer has taken it, and what the
            // transposed layer gives is held beside its skips, with what the next stage keeps.
            let coming = if scale == 0 { 0 } else { taken[scale] - taken_before[scale] };
            let going = if scale == 3 { 0 } else { given[scale] - given_before[scale] };
            let kept = if scale == 0 { 2 } else { 1 };
            most[scale] = most[scale].max(held + coming.max(going) + kept.min(given_before[scale]));
        }
    }
    let shape = |scale: usize| Shape {
        columns: width >> scale,
        channels: 8 << scale,
        length: (0..scale).fold(depths, |depths, _| depths.div_ceil(2)),
    };
    (0..4).map(|scale| most[scale] * shape(scale).bytes()).sum()
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::bands::{FeatureLayers, Regularization, RegularizationLayers, features};
    use crate::input::InputImage;
    use crate::kernels::cost::{CostInput, PixelSweep};
    use crate::kernels::simd::Level;
    use crate::kernels::slab::Pool;
    use crate::{CostMetric, Refinement, Weights, WeightsMetadata};

    #[test]
    fn steps_and_kept_features_fit_the_memory_together() {
        let size = InferSize { width: 640, height: 480, depths: 128, views: 3, refined: false };
        let smallest = predict(size, 2, 1).bytes;
        let whole = predict(size, 2, STEP_ROWS).bytes;
        assert_eq!(step_rows(size, 2, Some(2 * whole), STEP_ROWS), STEP_ROWS);
        for limit in (smallest * 4 / 3..whole).step_by(1 << 20) {
            let rows = step_rows(size, 2, Some(limit), STEP_ROWS);
            let kept = cache_bytes(limit).max(map_bytes(size) as u64);
            let total = predict(size, 2, rows).bytes - map_bytes(size) as u64 + kept;
            assert!(total <= limit, "{rows} rows and the cache take {total} of {limit}");
        }
    }

    #[test]
    fn operations_are_those_of_the_layers() {
        let size = InferSize { width: 1152, height: 864, depths: 192, views: 5, refined: false };
        let Operations { features, warp, first_layer, middle_layers, last_layer, .. } = size.operations();
        // As counted for the public port, in units of 1e9.
        assert!((features / 1e9 - 46.7).abs() < 0.1 && (warp / 1e9 - 18.1).abs() < 1.5);
        assert!(((first_layer + middle_layers + last_layer) / 1e9 - 242.5).abs() < 0.1);
        let refined = InferSize { refined: true, ..size }.operations();
        assert!(refined.total() > size.operations().total());
    }

    #[test]
    fn predicted_slabs_are_those_that_are_taken() {
        let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::None), 1);
        let level = Level::detect();
        let image = InputImage { width: 64, height: 448, planes: vec![0.5; 3 * 64 * 448] };
        let pool = Arc::<Pool>::default();
        let map = features(&pool, &FeatureLayers::new(&weights, level), &image);
        assert_eq!(pool.bytes(), images::features_bytes(64, 448));

        let layers = RegularizationLayers::new(&weights, level);
        let camera = nalgebra::Matrix3x4::identity();
        let sweep = PixelSweep::new(&camera, &camera).expect("an invertible camera");
        let cost = CostInput {
            reference: &map,
            sources: vec![(&map, sweep)],
            inverse_depths: (1..=21).map(|depth| 1.0 / f64::from(depth)).collect(),
            metric: CostMetric::Variance,
        };
        for step_rows in [1, 2, 3, 5, 8, 11] {
            let pool = Arc::<Pool>::default();
            let mut volume = Regularization::new(&pool, &layers, level, (16, 112, 21), 4);
            let steps = (0..112).step_by(step_rows);
            let rows: usize = steps.map(|y| volume.push(&cost, 0, step_rows.min(112 - y)).len() / 16).sum();
            assert_eq!(rows, 112);
            let (taken, predicted) = (pool.bytes(), volume_bytes(16, 112, 21, step_rows));
            assert!(taken <= predicted, "{step_rows} rows: {taken} bytes, predicted were {predicted}");
            assert!(predicted as f64 <= 1.1 * taken as f64, "{step_rows} rows: {taken} of {predicted}");
        }
    }
}
