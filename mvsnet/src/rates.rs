//! How fast this machine infers, from a small inference, and so how long a large one will take.

use std::time::Duration;

use nalgebra::{Point3, Vector3};
use planesweep_scene::{Camera, DepthHypotheses, Intrinsics, Pose, Raster, Sampling, WorkingImage};

use crate::{
    CpuBackend, CpuBackendError, DepthBackend, InferInput, InferSize, InferTimes, Operations, Refinement,
    Weights, WeightsMetadata,
};

/// Rows of a volume are as long as those of common images, since caches care; a few of them are enough.
const TRIAL: InferSize = InferSize { width: 960, height: 64, depths: 64, views: 5, refined: true };
/// Trials of which the fastest counts, part by part.
const TRIALS: usize = 3;

/// Seconds that `CpuBackend` needs for each operation of its parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InferRates {
    features: f64,
    warp: f64,
    first_layer: f64,
    middle_layers: f64,
    last_layer: f64,
    refinement: f64,
}

impl InferRates {
    /// Measures them with this many threads on small images; takes some tenths of a second.
    pub fn measure(threads: usize) -> Result<Self, CpuBackendError> {
        let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::Paper), 1);
        let (many, few) = (TRIAL, InferSize { views: 2, ..TRIAL });
        let never = Duration::MAX;
        let forever = InferTimes {
            features: never,
            cost: never,
            regularization: never,
            regression: never,
            refinement: never,
        };
        let (mut times, mut times_of_few) = (forever, forever);
        for _ in 0..TRIALS {
            // A new backend knows no features.
            let mut backend = CpuBackend::new(&weights, threads, None)?;
            for (size, fastest) in [(few, &mut times_of_few), (many, &mut times)] {
                *fastest = faster(*fastest, trial(&mut backend, size));
            }
        }
        Ok(Self::from_times(many, times, few, times_of_few))
    }

    /// From the times of two sizes that differ in the number of views, where the features of the fewer views are known
    /// when the more are inferred.
    fn from_times(many: InferSize, times: InferTimes, few: InferSize, times_of_few: InferTimes) -> Self {
        let (operations, operations_of_few) = (many.operations(), few.operations());
        let per = |time: Duration, operations: f64| time.as_secs_f64() / operations;
        let warp = times.cost.saturating_sub(times_of_few.cost).as_secs_f64()
            / (operations.warp - operations_of_few.warp);
        let first_layer = times_of_few.cost.as_secs_f64() - warp * operations_of_few.warp;
        Self {
            features: per(times_of_few.features, operations_of_few.features),
            warp,
            first_layer: first_layer.max(0.0) / operations.first_layer,
            middle_layers: per(times.regularization, operations.middle_layers),
            last_layer: per(times.regression, operations.last_layer),
            refinement: per(times.refinement, operations.refinement),
        }
    }

    /// Seconds of one inference of this size whose views have this many images that no earlier one of the same
    /// process had.
    pub fn seconds(&self, size: InferSize, new_images: usize) -> f64 {
        let Operations { features, warp, first_layer, middle_layers, last_layer, refinement } =
            size.operations();
        self.features * features * new_images as f64 / size.views as f64
            + self.warp * warp
            + self.first_layer * first_layer
            + self.middle_layers * middle_layers
            + self.last_layer * last_layer
            + self.refinement * refinement
    }
}

/// Where the time of one inference of this size goes.
fn trial(backend: &mut CpuBackend, size: InferSize) -> InferTimes {
    let images: Vec<WorkingImage> = (0..size.views).map(|view| image(size, view)).collect();
    let sources: Vec<&WorkingImage> = images[1..].iter().collect();
    let hypotheses = DepthHypotheses::new(Sampling::Inverse, 2.0, 8.0, size.depths as u32);
    let hypotheses = hypotheses.expect("the range is valid");
    let input = InferInput { reference: &images[0], sources: &sources, hypotheses: &hypotheses };
    backend.infer(input).expect("there are sources, and the camera has an inverse");
    backend.times()
}

fn faster(a: InferTimes, b: InferTimes) -> InferTimes {
    InferTimes {
        features: a.features.min(b.features),
        cost: a.cost.min(b.cost),
        regularization: a.regularization.min(b.regularization),
        regression: a.regression.min(b.regression),
        refinement: a.refinement.min(b.refinement),
    }
}

/// A view of something, the first from the middle and the others from beside it.
fn image(size: InferSize, view: usize) -> WorkingImage {
    let InferSize { width, height, .. } = size;
    let (fx, cx, cy) = (width as f64, width as f64 / 2.0, height as f64 / 2.0);
    let intrinsics = Intrinsics { width: width as u32, height: height as u32, fx, fy: fx, skew: 0.0, cx, cy };
    let x = 0.15 * view as f64;
    let pose = Pose::look_at(&Point3::new(x, 0.05 * x, 0.0), &Point3::new(0.0, 0.0, 4.0), &-Vector3::y());
    let pixels = Raster::from_fn(width, height, |u, v| {
        [(u * u / 7 + v + view) as u8, ((u * 5) ^ (v * 3)) as u8, (v * v / 5 + 2 * u) as u8]
    });
    WorkingImage { camera: Camera { intrinsics, pose }, pixels }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_give_back_the_times_they_come_from() {
        let seconds = Duration::from_secs_f64;
        let few = InferSize { views: 2, ..TRIAL };
        let (of_few, of_many) = (few.operations(), TRIAL.operations());
        // A machine that needs a nanosecond for an operation of a warp and two for any other.
        let cost = |operations: Operations| seconds(1e-9 * operations.warp + 2e-9 * operations.first_layer);
        let times = |operations: Operations, features: f64| InferTimes {
            features: seconds(2e-9 * features),
            cost: cost(operations),
            regularization: seconds(2e-9 * operations.middle_layers),
            regression: seconds(2e-9 * operations.last_layer),
            refinement: seconds(2e-9 * operations.refinement),
        };
        let rates = InferRates::from_times(
            TRIAL,
            times(of_many, of_many.features - of_few.features),
            few,
            times(of_few, of_few.features),
        );
        let size = InferSize { width: 640, height: 512, depths: 64, views: 3, refined: false };
        let operations = size.operations();
        let expected = 2e-9 * operations.total() - 1e-9 * operations.warp;
        assert!((rates.seconds(size, 3) / expected - 1.0).abs() < 1e-5);
        let saved = 2e-9 * operations.features * 2.0 / 3.0;
        assert!((rates.seconds(size, 1) / (expected - saved) - 1.0).abs() < 1e-5);
    }

    #[test]
    fn measured_rates_are_those_of_a_processor() {
        let rates = InferRates::measure(1).expect("a thread");
        let size = InferSize { width: 64, height: 64, depths: 16, views: 3, refined: true };
        let rate = size.operations().total() / rates.seconds(size, 3);
        assert!((1e7..1e13).contains(&rate), "{rate} operations per second");
    }
}
