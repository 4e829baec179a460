//! The network on processors: bounded memory, own kernels, no libtorch.

use std::ops::Range;
use std::sync::Arc;
use std::time::{Duration, Instant};

use planesweep_scene::{DepthMap, Raster, WorkingImage};
use rayon::{ThreadPool, ThreadPoolBuildError, ThreadPoolBuilder};
use thiserror::Error;

use crate::backend::{check_rows, quarter, quarter_camera};
use crate::bands::{
    FeatureLayers, InferCost, InferSize, Regularization, RegularizationLayers, STEP_ROWS, VolumeTimes,
    cache_bytes, features, predict, refined, refinement_layers, rows_for_depth, rows_for_refinement,
    step_rows,
};
use crate::confidence;
use crate::feature_cache::FeatureCache;
use crate::input::InputImage;
use crate::kernels::cost::{CostInput, FeatureMap, PixelSweep};
use crate::kernels::regress::Regressed;
use crate::kernels::simd::Level;
use crate::kernels::slab::Pool;
use crate::kernels::winograd::WinogradLayer;
use crate::{BackendInfo, CostMetric, DepthBackend, InferError, InferInput, Normalization, Weights};

/// Bytes of features that are kept for later inferences, unless memory is short.
const CACHE_BYTES: usize = 256 << 20;

/// Why a backend could not be made.
#[derive(Debug, Error)]
pub enum CpuBackendError {
    /// The threads could not be started.
    #[error("cannot start {threads} threads for inference")]
    Threads {
        /// How many.
        threads: usize,
        /// Why.
        #[source]
        source: ThreadPoolBuildError,
    },
}

/// Where the time of one inference went.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct InferTimes {
    /// Features of images that were not known yet.
    pub features: Duration,
    /// Warp, variance and the first layer of the 3D network.
    pub cost: Duration,
    /// The other layers of the 3D network.
    pub regularization: Duration,
    /// The last layer, softmax, expectation and confidence.
    pub regression: Duration,
    /// Refinement.
    pub refinement: Duration,
}

/// MVSNet in kernels of its own, for x86-64 with AVX-512 or AVX2 and, slower, any other processor.
///
/// Memory does not grow with the height of the image but for the features; the result has the same bits
/// for any number of threads and any memory.
#[derive(Debug)]
pub struct CpuBackend {
    level: Level,
    features: FeatureLayers,
    regularization: RegularizationLayers,
    refinement: Option<[WinogradLayer; 4]>,
    normalization: Normalization,
    metric: CostMetric,
    trained_spacing_px: Option<f64>,
    threads: ThreadPool,
    memory_bytes: Option<u64>,
    /// Rows of the volume taken at a time, at most.
    step_rows: usize,
    cache: FeatureCache,
    times: InferTimes,
}

impl CpuBackend {
    /// Packs the weights for this processor and starts `threads` threads, at least one.
    ///
    /// `memory_bytes` bounds what an inference may hold besides its input; where it is not enough for the
    /// smallest step, the smallest step is taken all the same.
    pub fn new(
        weights: &Weights,
        threads: usize,
        memory_bytes: Option<u64>,
    ) -> Result<Self, CpuBackendError> {
        Self::with_level(weights, threads, memory_bytes, Level::detect())
    }

    fn with_level(
        weights: &Weights,
        threads: usize,
        memory_bytes: Option<u64>,
        level: Level,
    ) -> Result<Self, CpuBackendError> {
        let threads = threads.max(1);
        let pool =
            ThreadPoolBuilder::new().num_threads(threads).thread_name(|i| format!("infer-{i}")).build();
        let metadata = weights.metadata();
        Ok(Self {
            level,
            features: FeatureLayers::new(weights, level),
            regularization: RegularizationLayers::new(weights, level),
            refinement: refinement_layers(weights, level),
            normalization: metadata.normalization,
            metric: metadata.metric,
            trained_spacing_px: metadata.spacing_px,
            threads: pool.map_err(|source| CpuBackendError::Threads { threads, source })?,
            memory_bytes,
            step_rows: STEP_ROWS,
            cache: FeatureCache::new(memory_bytes.map_or(CACHE_BYTES, |bytes| cache_bytes(bytes) as usize)),
            times: InferTimes::default(),
        })
    }

    /// How many hypotheses make the confidence for this input: four, or more when the hypotheses are finer than
    /// those of the training.
    pub fn confidence_window(&self, input: InferInput<'_>) -> u32 {
        confidence::window_of(self.trained_spacing_px, input)
    }

    /// What an inference of this size will cost with these threads and this memory.
    pub fn predict(&self, size: InferSize) -> InferCost {
        predict(size, self.threads.current_num_threads(), self.step_rows(size))
    }

    /// As many rows at a time as the memory allows.
    fn step_rows(&self, size: InferSize) -> usize {
        step_rows(size, self.threads.current_num_threads(), self.memory_bytes, self.step_rows)
    }

    /// Where the time of the last inference went.
    pub fn times(&self) -> InferTimes {
        self.times
    }

    /// The probability of each hypothesis, nearest first, at a pixel of the depth map (paper figure 3c).
    pub fn probability(&mut self, input: InferInput<'_>, x: usize, y: usize) -> Result<Vec<f32>, InferError> {
        let intrinsics = quarter_camera(input.reference).intrinsics;
        let (width, height) = (intrinsics.width as usize, intrinsics.height as usize);
        if x >= width || y >= height {
            return Err(InferError::PixelOutside { x, y, width, height });
        }
        let maps = self.feature_maps(input)?;
        let window = self.confidence_window(input);
        let swept = self.sweep(&self.cost(&maps, input)?, y..y + 1, window, Some((x, y)));
        Ok(swept.probability)
    }

    fn run(&mut self, input: InferInput<'_>, rows: &Range<usize>) -> Result<Maps, InferError> {
        let begin = Instant::now();
        let maps = self.feature_maps(input)?;
        let features = begin.elapsed();
        let (width, height) = (maps[0].width(), maps[0].height());
        let unrefined = match &self.refinement {
            Some(_) => rows_for_refinement(rows, height),
            None => rows.clone(),
        };
        let window = self.confidence_window(input);
        let Swept { pixels, times, .. } =
            self.sweep(&self.cost(&maps, input)?, unrefined.clone(), window, None);

        let begin = Instant::now();
        let own = (rows.start - unrefined.start) * width..(rows.end - unrefined.start) * width;
        let indices = pixels.iter().map(|pixel| pixel.index);
        let indices: Vec<f64> = match &self.refinement {
            None => indices.collect(),
            Some(layers) => {
                // Indices are linear in depth (in inverse depth when sampled so), so they scale to [0, 1].
                let steps = f64::from(input.hypotheses.count() - 1);
                let scaled: Vec<f64> = indices.map(|index| index / steps).collect();
                let guide = self.guide(input.reference, &unrefined);
                let scaled = self.threads.install(|| refined(layers, width, &scaled, &guide));
                scaled.into_iter().map(|value| value * steps).collect()
            }
        };
        let depth =
            indices[own.clone()].iter().map(|index| input.hypotheses.depth_at(*index) as f32).collect();
        let confidence = pixels[own].iter().map(|pixel| pixel.confidence).collect();
        let VolumeTimes { cost, regularization, regression } = times;
        let refinement = begin.elapsed();
        self.times = InferTimes { features, cost, regularization, regression, refinement };
        Ok(Maps { depth, confidence })
    }

    /// The features of the reference, then of the sources.
    fn feature_maps(&mut self, input: InferInput<'_>) -> Result<Vec<Arc<FeatureMap>>, InferError> {
        if input.sources.is_empty() {
            return Err(InferError::NoSources);
        }
        let pool = Arc::default();
        let images = std::iter::once(input.reference).chain(input.sources.iter().copied());
        Ok(images.map(|image| self.feature_map(&pool, image)).collect())
    }

    fn cost<'a>(
        &self,
        maps: &'a [Arc<FeatureMap>],
        input: InferInput<'_>,
    ) -> Result<CostInput<'a>, InferError> {
        let projection = |image| quarter_camera(image).projection();
        let own = projection(input.reference);
        let mut sources = Vec::with_capacity(input.sources.len());
        for (map, source) in maps[1..].iter().zip(input.sources) {
            let sweep = PixelSweep::new(&own, &projection(source)).ok_or(InferError::SingularCamera)?;
            sources.push((map.as_ref(), sweep));
        }
        let inverse_depths = input.hypotheses.depths().iter().map(|depth| 1.0 / depth).collect();
        Ok(CostInput { reference: &maps[0], sources, inverse_depths, metric: self.metric })
    }

    /// Some rows of the unrefined depth map, and the probabilities of one of their pixels.
    fn sweep(
        &self,
        cost: &CostInput<'_>,
        rows: Range<usize>,
        window: u32,
        probe: Option<(usize, usize)>,
    ) -> Swept {
        let (width, height) = (cost.reference.width(), cost.reference.height());
        let (depths, views) = (cost.inverse_depths.len(), cost.sources.len() + 1);
        let refined = self.refinement.is_some();
        let size = InferSize { width: 4 * width, height: 4 * height, depths, views, refined };
        let step_rows = self.step_rows(size);
        let needed = rows_for_depth(&rows, height);
        let mut volume = Regularization::new(
            &Arc::default(),
            &self.regularization,
            self.level,
            (width, needed.len(), depths),
            window,
        );
        if let Some((x, y)) = probe {
            volume.regression.probe(x, y - needed.start);
        }
        let mut pixels = Vec::with_capacity(needed.len() * width);
        self.threads.install(|| {
            for begin in needed.clone().step_by(step_rows) {
                let count = step_rows.min(needed.end - begin);
                pixels.extend(volume.push(cost, needed.start, count));
            }
        });
        let own = (rows.start - needed.start) * width..(rows.end - needed.start) * width;
        let probability = volume.regression.probability().unwrap_or_default().to_vec();
        Swept { pixels: pixels[own].to_vec(), probability, times: volume.times }
    }

    fn feature_map(&mut self, pool: &Arc<Pool>, image: &WorkingImage) -> Arc<FeatureMap> {
        let Self { cache, threads, features: layers, normalization, .. } = self;
        cache.get(image, || {
            let input = InputImage::new(&image.pixels, *normalization);
            threads.install(|| features(pool, layers, &input))
        })
    }

    /// The reference image at the size of the depth map, `[channel][row][x]`, for some rows.
    fn guide(&self, image: &WorkingImage, rows: &Range<usize>) -> Vec<f32> {
        let InputImage { width, height, planes } = InputImage::new(&image.pixels, self.normalization);
        let mut guide = Vec::with_capacity(3 * rows.len() * width / 4);
        for plane in planes.chunks_exact(width * height) {
            for y in rows.clone() {
                guide.extend(plane[4 * y * width..][..width].iter().step_by(4));
            }
        }
        guide
    }
}

/// What a sweep gives.
struct Swept {
    pixels: Vec<Regressed>,
    /// Of the pixel that was asked for.
    probability: Vec<f32>,
    times: VolumeTimes,
}

/// Depth and confidence of some rows, of the width of the features.
struct Maps {
    depth: Vec<f32>,
    confidence: Vec<f32>,
}

impl DepthBackend for CpuBackend {
    fn info(&self) -> BackendInfo {
        BackendInfo { name: "bands".to_owned(), device: "cpu".to_owned() }
    }

    fn infer(&mut self, input: InferInput<'_>) -> Result<DepthMap, InferError> {
        let height = input.reference.pixels.height().div_ceil(4);
        self.infer_rows(input, 0..height)
    }

    fn infer_rows(&mut self, input: InferInput<'_>, rows: Range<usize>) -> Result<DepthMap, InferError> {
        check_rows(input, &rows)?;
        let (camera, color) = quarter(input.reference);
        let width = color.width();
        let Maps { depth, confidence } = self.run(input, &rows)?;
        // What is inferred is padded, and of the wanted rows only.
        let padded = depth.len() / rows.len();
        let cropped = |values: &[f32]| Raster::from_fn(width, rows.len(), |x, y| values[y * padded + x]);
        let color = Raster::from_fn(width, rows.len(), |x, y| color.at(x, rows.start + y));
        let map = DepthMap::new(camera.rows(&rows), cropped(&depth), cropped(&confidence), color);
        Ok(map.expect("all parts have the size of the rows"))
    }
}

#[cfg(all(test, feature = "torch"))]
mod against_plain;

#[cfg(test)]
mod tests {
    use planesweep_scene::{DepthHypotheses, Sampling};

    use super::*;
    use crate::backend::conformance::{self, Images};
    use crate::{Refinement, WeightsMetadata};

    fn backend(metadata: WeightsMetadata, threads: usize) -> CpuBackend {
        CpuBackend::new(&Weights::seeded(metadata, 3), threads, None).expect("threads")
    }

    #[test]
    fn conforms() {
        conformance::check(&mut backend(WeightsMetadata::untrained(Refinement::None), 1));
    }

    #[test]
    fn conforms_with_normalisation_per_image_and_the_mean_metric() {
        let metadata = WeightsMetadata {
            normalization: Normalization::PerImage,
            metric: CostMetric::Mean,
            ..WeightsMetadata::untrained(Refinement::None)
        };
        conformance::check(&mut backend(metadata, 2));
    }

    #[test]
    fn threads_and_rows_at_a_time_change_no_bit() {
        let images = Images::new(190, 130, Sampling::Inverse);
        let weights = WeightsMetadata::untrained(Refinement::Paper);
        let expected = images.infer(&mut backend(weights.clone(), 1)).expect("a depth map");
        for (threads, step_rows) in [(1, 1), (2, 3), (2, 8), (1, 1000)] {
            let mut backend = backend(weights.clone(), threads);
            backend.step_rows = step_rows;
            assert_eq!(images.infer(&mut backend).expect("a depth map"), expected);
        }
    }

    #[test]
    fn bands_make_the_whole_to_the_bit() {
        for refinement in [Refinement::None, Refinement::WithBnRelu] {
            let images = Images::new(96, 500, Sampling::Uniform);
            let sources: Vec<_> = images.sources.iter().collect();
            let input = InferInput {
                reference: &images.reference,
                sources: &sources,
                hypotheses: &images.hypotheses,
            };
            let mut backend = backend(WeightsMetadata::untrained(refinement), 2);
            let whole = backend.infer(input).expect("a depth map");
            let mut depth = Vec::new();
            let mut confidence = Vec::new();
            for rows in [0..23, 23..60, 60..64, 64..125] {
                let band = backend.infer_rows(input, rows.clone()).expect("a band");
                assert_eq!((band.width(), band.height()), (24, rows.len()));
                assert_eq!(band.color.at(5, 1), whole.color.at(5, rows.start + 1));
                assert_eq!(band.camera.intrinsics.cy, whole.camera.intrinsics.cy - rows.start as f64);
                depth.extend_from_slice(band.depth.values());
                confidence.extend_from_slice(band.confidence.values());
            }
            assert_eq!(depth, whole.depth.values());
            assert_eq!(confidence, whole.confidence.values());
            assert!(matches!(
                backend.infer_rows(input, 100..126),
                Err(InferError::PixelOutside { y: 125, height: 125, .. })
            ));
        }
    }

    #[test]
    fn any_number_of_hypotheses_will_do() {
        let mut images = Images::new(64, 64, Sampling::Uniform);
        let mut backend = backend(WeightsMetadata::untrained(Refinement::None), 1);
        for count in [2, 3, 13, 70] {
            images.hypotheses =
                DepthHypotheses::new(Sampling::Inverse, 2.0, 8.0, count).expect("a valid range");
            assert!(images.infer(&mut backend).is_ok(), "{count} hypotheses");
        }
    }

    #[test]
    fn probability_at_a_pixel_sums_to_one_and_makes_its_depth() {
        let images = Images::new(64, 140, Sampling::Uniform);
        let sources: Vec<_> = images.sources.iter().collect();
        let input =
            InferInput { reference: &images.reference, sources: &sources, hypotheses: &images.hypotheses };
        let mut backend = backend(WeightsMetadata::untrained(Refinement::None), 1);
        let map = backend.infer(input).expect("a depth map");
        for (x, y) in [(15, 34), (0, 0), (6, 20)] {
            let probability = backend.probability(input, x, y).expect("a pixel of the map");
            assert_eq!(probability.len(), 16);
            assert!((probability.iter().sum::<f32>() - 1.0).abs() < 1e-5);
            let index: f64 = probability.iter().zip(0..).map(|(p, k)| f64::from(*p) * f64::from(k)).sum();
            assert!((images.hypotheses.depth_at(index) - f64::from(map.depth.at(x, y))).abs() < 1e-5);
        }
        let outside = backend.probability(input, 15, 35);
        assert!(matches!(outside, Err(InferError::PixelOutside { height: 35, .. })));
    }

    #[test]
    fn little_memory_makes_smaller_steps_and_the_same_map() {
        let images = Images::new(128, 128, Sampling::Uniform);
        let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::None), 3);
        let size = InferSize { width: 128, height: 128, depths: 16, views: 3, refined: false };
        let roomy = CpuBackend::new(&weights, 1, None).expect("threads").predict(size);
        let mut tight = CpuBackend::new(&weights, 1, Some(roomy.bytes - 1)).expect("threads");
        assert!(tight.step_rows(size) < STEP_ROWS);
        assert!(tight.predict(size).bytes < roomy.bytes);
        assert_eq!(tight.predict(size).operations, roomy.operations);
        let expected =
            images.infer(&mut backend(WeightsMetadata::untrained(Refinement::None), 1)).expect("a depth map");
        assert_eq!(images.infer(&mut tight).expect("a depth map"), expected);
    }

    #[test]
    fn features_of_an_image_are_computed_once() {
        let images = Images::new(64, 64, Sampling::Uniform);
        let mut backend = backend(WeightsMetadata::untrained(Refinement::None), 1);
        let first = images.infer(&mut backend).expect("a depth map");
        assert_eq!(images.infer(&mut backend).expect("a depth map"), first);
    }
}
