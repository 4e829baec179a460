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
}

/// What it will cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InferCost {
    /// The most memory that `CpuBackend` holds besides its input and the features of other images.
    pub bytes: u64,
    /// Floating-point operations, features of all views included, as the plain network counts them.
    pub operations: f64,
}

/// Weights, their packed forms, the threads' stacks and buffers too small to count: measured.
const FIXED_BYTES: usize = 8 << 20;
/// Transformed values and the ring of cost columns of one thread, for each depth.
const THREAD_BYTES_PER_DEPTH: usize = 7 * 32 * 4 + 8 * 36 + 16 * 4;
/// The same, whatever the depths.
const THREAD_BYTES: usize = 512 << 10;
/// Operations of the features, for each pixel of an image.
const FEATURE_OPERATIONS: f64 = 9248.0;
/// Operations of warp and variance, for each voxel and source: bilinear weights, sums, squares in 32 channels.
const WARP_OPERATIONS: f64 = 32.0 * 11.0;
/// Operations of the 3D network, for each voxel.
const VOLUME_OPERATIONS: f64 = 20_304.0;

/// Rows of the volume that are taken at a time where the memory allows it.
pub(crate) const STEP_ROWS: usize = 8;

impl InferCost {
    /// What an inference by `CpuBackend` with this many threads, bounded by this memory, will cost.
    pub fn predict(size: InferSize, threads: usize, memory_bytes: Option<u64>) -> Self {
        predict(size, threads, step_rows(size, threads, memory_bytes, STEP_ROWS))
    }
}

/// As many rows at a time as the memory allows, at most `most`, at least one.
pub(crate) fn step_rows(size: InferSize, threads: usize, memory_bytes: Option<u64>, most: usize) -> usize {
    let fits = |rows| memory_bytes.is_none_or(|limit| predict(size, threads, rows).bytes <= limit);
    (1..=most).rev().find(|rows| fits(*rows)).unwrap_or(1)
}

/// The cost of an inference with all its rows, `step_rows` rows of the volume at a time.
pub(crate) fn predict(size: InferSize, threads: usize, step_rows: usize) -> InferCost {
    let InferSize { depths, views, .. } = size;
    let (width, height) =
        (size.width.next_multiple_of(SIZE_MULTIPLE), size.height.next_multiple_of(SIZE_MULTIPLE));
    let pixels = width * height;
    let maps = views * (width / 4 + 2) * (height / 4 + 2) * 32 * 4;
    let images = images::features_bytes(width, height) + 3 * pixels * 4;
    let volume = volume_bytes(width / 4, height / 4, depths, step_rows);
    let pixel_bytes = pixels / 16 * 40;
    let threads = threads * (THREAD_BYTES + THREAD_BYTES_PER_DEPTH * depths);
    let bytes = FIXED_BYTES + threads + maps + images.max(volume + pixel_bytes);
    let voxels = (pixels / 16 * depths) as f64;
    let operations = FEATURE_OPERATIONS * (pixels * views) as f64
        + voxels * (VOLUME_OPERATIONS + WARP_OPERATIONS * (views as f64 - 1.0));
    InferCost { bytes: bytes as u64, operations }
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
