//! The network as a backend: images and cameras in, a depth map out.

use std::time::{Duration, Instant};

use planesweep_scene::{DepthMap, Raster, WorkingImage};
use tch::{Cuda, Device, Kind, TchError, Tensor};
use thiserror::Error;

use crate::backend::{quarter, quarter_camera};
use crate::confidence;
use crate::input::InputImage;
use crate::network::{FeatureView, Inference, Network, StepError};
use crate::{BackendInfo, DepthBackend, InferError, InferInput, Normalization, Weights};

/// Why a backend could not be made.
#[derive(Debug, Error)]
pub enum TorchBackendError {
    /// The name means no device.
    #[error("\"{device}\" is no device, use \"cpu\" or \"cuda:0\"")]
    UnknownDevice {
        /// The name.
        device: String,
    },
    /// The device is not there.
    #[error("device {device} is not there, libtorch sees {cuda_devices} CUDA devices")]
    NoSuchDevice {
        /// The name.
        device: String,
        /// How many there are.
        cuda_devices: usize,
    },
    /// The weights could not be put on the device.
    #[error("cannot load weights onto {device}")]
    Load {
        /// The device.
        device: String,
        /// Why.
        #[source]
        source: TchError,
    },
}

/// Where the time of one inference on the processor went; on a GPU the work is only ordered here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PlainTimes {
    /// Features of all images.
    pub features: Duration,
    /// Warp and variance.
    pub cost: Duration,
    /// The 3D network.
    pub regularization: Duration,
    /// Softmax, expectation, confidence and refinement.
    pub regression: Duration,
}

/// MVSNet in libtorch.
///
/// It belongs to one OS thread: libtorch keeps thread counts and memory per calling thread.
#[derive(Debug)]
pub struct TorchBackend {
    network: Network,
    normalization: Normalization,
    trained_spacing_px: Option<f64>,
    device: String,
    threads: usize,
    /// For convolutions that libtorch makes of matrix products.
    product_threads: usize,
    times: PlainTimes,
}

impl TorchBackend {
    /// Puts the weights on a device, "cpu" or "cuda:N". `threads` is the number of threads of one inference on
    /// the CPU, at least one.
    ///
    /// It changes no bit of the result: what follows the cost volume runs on one thread. There libtorch makes
    /// convolutions of MKL's matrix products, which on processors of Intel add in an order that depends on the number of
    /// threads.
    pub fn new(weights: &Weights, device: &str, threads: usize) -> Result<Self, TorchBackendError> {
        let torch_device = parse_device(device)?;
        let network = Network::new(weights, (Kind::Float, torch_device))
            .map_err(|source| TorchBackendError::Load { device: device.to_owned(), source })?;
        let metadata = weights.metadata();
        Ok(Self {
            network,
            normalization: metadata.normalization,
            trained_spacing_px: metadata.spacing_px,
            device: device.to_owned(),
            threads: threads.max(1),
            product_threads: 1,
            times: PlainTimes::default(),
        })
    }

    /// The network on the processor as the public implementations run it: the features of each source are warped
    /// onto all planes before the next one's, channels are outermost, and all of it runs on all threads, whose number may
    /// change the last bits. What ours is measured against.
    pub fn as_published(weights: &Weights, threads: usize) -> Result<Self, TorchBackendError> {
        let backend = Self::new(weights, "cpu", threads)?;
        Ok(Self { network: backend.network.building_at_once(), product_threads: backend.threads, ..backend })
    }

    /// Where the time of the last inference went.
    pub fn times(&self) -> PlainTimes {
        self.times
    }

    /// How many hypotheses make the confidence for this input: four, or more when the hypotheses are finer than
    /// those of the training.
    pub fn confidence_window(&self, input: InferInput<'_>) -> u32 {
        confidence::window_of(self.trained_spacing_px, input)
    }

    /// The probability of each hypothesis, nearest first, at a pixel of the depth map (paper figure 3c).
    pub fn probability(&mut self, input: InferInput<'_>, x: usize, y: usize) -> Result<Vec<f32>, InferError> {
        let (width, height) =
            (input.reference.pixels.width().div_ceil(4), input.reference.pixels.height().div_ceil(4));
        if x >= width || y >= height {
            return Err(InferError::PixelOutside { x, y, width, height });
        }
        let inference = self.run(input)?;
        let pixel = || inference.probability.f_select(2, x as i64)?.f_select(1, y as i64);
        pixel().and_then(|pixel| values(&pixel)).map_err(|source| self.error("reading the result", &source))
    }

    fn run(&mut self, input: InferInput<'_>) -> Result<Inference, InferError> {
        if input.sources.is_empty() {
            return Err(InferError::NoSources);
        }
        // Both are properties of the calling thread.
        let _guard = tch::no_grad_guard();
        tch::set_num_threads(self.threads as i32);
        let mut clock = Instant::now();
        let mut lap = || {
            let begun = std::mem::replace(&mut clock, Instant::now());
            clock - begun
        };
        let mut infer = || {
            let image = self.image(input.reference)?;
            let reference = self.view(input.reference, &image)?;
            let mut sources = Vec::with_capacity(input.sources.len());
            for source in input.sources {
                sources.push(self.view(source, &self.image(source)?)?);
            }
            let features = lap();
            let volume = self.network.cost(&reference, &sources, &input.hypotheses.depths())?;
            drop((reference, sources));
            let cost = lap();
            tch::set_num_threads(self.product_threads as i32);
            let logits = self.network.logits(volume)?;
            let regularization = lap();
            let window = self.confidence_window(input);
            let inference = self.network.regress(logits, input.hypotheses, &image, window)?;
            Ok((inference, PlainTimes { features, cost, regularization, regression: lap() }))
        };
        let (inference, times) = infer().map_err(|error| match error {
            StepError::SingularCamera => InferError::SingularCamera,
            StepError::Library { doing, source } => self.error(doing, &source),
        })?;
        self.times = times;
        Ok(inference)
    }

    fn image(&self, image: &WorkingImage) -> Result<Tensor, StepError> {
        let InputImage { width, height, planes } = InputImage::new(&image.pixels, self.normalization);
        self.network.image(&planes, width, height)
    }

    fn view(&self, image: &WorkingImage, pixels: &Tensor) -> Result<FeatureView, StepError> {
        let features = self.network.features(pixels)?;
        Ok(FeatureView { features, projection: quarter_camera(image).projection() })
    }

    fn error(&self, doing: &'static str, error: &TchError) -> InferError {
        let (device, message) = (self.device.clone(), error.to_string());
        // libtorch has no type for it: "CUDA out of memory", "not enough memory" (Windows), "can't allocate".
        let lower = message.to_lowercase();
        if ["out of memory", "not enough memory", "can't allocate memory"].iter().any(|m| lower.contains(m)) {
            InferError::OutOfMemory { device, doing }
        } else {
            // Only the first line; a trace of libtorch's own calls follows.
            let message = message.lines().next().unwrap_or_default().to_owned();
            InferError::Library { doing, device, message }
        }
    }
}

impl DepthBackend for TorchBackend {
    fn info(&self) -> BackendInfo {
        BackendInfo { name: "torch".to_owned(), device: self.device.clone() }
    }

    fn infer(&mut self, input: InferInput<'_>) -> Result<DepthMap, InferError> {
        let (camera, color) = quarter(input.reference);
        let (width, height) = (color.width(), color.height());
        let inference = self.run(input)?;
        let raster = |map: &Tensor| {
            let cropped = map.f_narrow(0, 0, height as i64)?.f_narrow(1, 0, width as i64)?;
            values(&cropped).map(|values| Raster::new(width, height, values).expect("a value for each pixel"))
        };
        let read = |map| raster(map).map_err(|source| self.error("reading the result", &source));
        let (depth, confidence) = (read(&inference.depth)?, read(&inference.confidence)?);
        Ok(DepthMap::new(camera, depth, confidence, color).expect("all parts have the quartered size"))
    }
}

fn parse_device(name: &str) -> Result<Device, TorchBackendError> {
    let index = match name {
        "cpu" => return Ok(Device::Cpu),
        "cuda" => Some(0),
        _ => name.strip_prefix("cuda:").and_then(|index| index.parse::<usize>().ok()),
    };
    let index = index.ok_or_else(|| TorchBackendError::UnknownDevice { device: name.to_owned() })?;
    let cuda_devices = Cuda::device_count().max(0) as usize;
    if index < cuda_devices {
        Ok(Device::Cuda(index))
    } else {
        Err(TorchBackendError::NoSuchDevice { device: name.to_owned(), cuda_devices })
    }
}

/// All values of a tensor as f32, on the host.
fn values(tensor: &Tensor) -> Result<Vec<f32>, TchError> {
    let tensor = tensor.f_to_kind(Kind::Float)?.f_to_device(Device::Cpu)?.f_contiguous()?;
    let mut values = vec![0.0; tensor.numel()];
    tensor.f_copy_data(&mut values, tensor.numel())?;
    Ok(values)
}

#[cfg(test)]
mod tests {
    use planesweep_scene::Sampling;

    use super::*;
    use crate::backend::conformance::{self, Images};
    use crate::{Refinement, WeightsMetadata};

    fn backend(metadata: WeightsMetadata) -> TorchBackend {
        TorchBackend::new(&Weights::seeded(metadata, 3), "cpu", 1).expect("the CPU is there")
    }

    #[test]
    fn conforms() {
        conformance::check(&mut backend(WeightsMetadata::untrained(Refinement::None)));
    }

    #[test]
    fn conforms_with_normalisation_per_image_and_the_mean_metric() {
        conformance::check(&mut backend(WeightsMetadata {
            normalization: Normalization::PerImage,
            metric: crate::CostMetric::Mean,
            ..WeightsMetadata::untrained(Refinement::None)
        }));
    }

    #[test]
    fn as_published_it_gives_the_same_depths_to_rounding() {
        let images = Images::new(96, 64, Sampling::Uniform);
        let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::Paper), 3);
        let mut published = TorchBackend::as_published(&weights, 1).expect("the CPU is there");
        let map = images.infer(&mut published).expect("a depth map");
        let expected = images.infer(&mut backend(weights.metadata().clone())).expect("a depth map");
        let differs = |(a, b): (&f32, &f32)| ((a - b) / b).abs() > 1e-4;
        assert!(!map.depth.values().iter().zip(expected.depth.values()).any(differs));
        let PlainTimes { features, cost, regularization, regression } = published.times();
        assert!([features, cost, regularization, regression].iter().all(|time| !time.is_zero()));
    }

    #[test]
    fn number_of_threads_changes_no_bit() {
        let images = Images::new(320, 256, Sampling::Uniform);
        let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::Paper), 3);
        let infer = |threads| {
            let mut backend = TorchBackend::new(&weights, "cpu", threads).expect("the CPU is there");
            images.infer(&mut backend).expect("a depth map")
        };
        let one = infer(1);
        for threads in 2..5 {
            assert!(infer(threads) == one, "{threads} threads");
        }
    }

    #[test]
    fn probability_at_a_pixel_sums_to_one() {
        let images = Images::new(64, 40, Sampling::Uniform);
        let sources: Vec<_> = images.sources.iter().collect();
        let input =
            InferInput { reference: &images.reference, sources: &sources, hypotheses: &images.hypotheses };
        let mut backend = backend(WeightsMetadata::untrained(Refinement::None));
        let probability = backend.probability(input, 15, 9).expect("a pixel of the map");
        assert_eq!(probability.len(), 16);
        assert!((probability.iter().sum::<f32>() - 1.0).abs() < 1e-5);
        let map = backend.infer(input).expect("a depth map");
        let index: f64 = probability.iter().zip(0..).map(|(p, k)| f64::from(*p) * f64::from(k)).sum();
        assert!((images.hypotheses.depth_at(index) - f64::from(map.depth.at(15, 9))).abs() < 1e-5);
        assert!(matches!(
            backend.probability(input, 15, 10),
            Err(InferError::PixelOutside { height: 10, .. })
        ));
    }

    #[test]
    fn any_number_of_hypotheses_will_do() {
        let mut images = Images::new(64, 64, Sampling::Uniform);
        let mut backend = backend(WeightsMetadata::untrained(Refinement::None));
        for count in [2, 3, 13] {
            images.hypotheses = planesweep_scene::DepthHypotheses::new(Sampling::Inverse, 2.0, 8.0, count)
                .expect("a valid range");
            assert!(images.infer(&mut backend).is_ok(), "{count} hypotheses");
        }
    }

    #[test]
    fn devices_that_are_not_there_are_refused() {
        let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::None), 3);
        let error = TorchBackend::new(&weights, "cuda:99", 1).expect_err("nobody has a hundred");
        assert!(matches!(error, TorchBackendError::NoSuchDevice { .. }));
        let error = TorchBackend::new(&weights, "tpu", 1).expect_err("no device");
        assert!(matches!(error, TorchBackendError::UnknownDevice { device } if device == "tpu"));
    }

    #[test]
    fn running_out_of_memory_is_told_apart() {
        let backend = backend(WeightsMetadata::untrained(Refinement::None));
        // 2^60 bytes: no machine has them.
        let error = Tensor::f_zeros([1 << 58], (Kind::Float, Device::Cpu)).expect_err("an exbibyte");
        let error = backend.error("regularising the cost volume", &error);
        assert!(
            matches!(error, InferError::OutOfMemory { doing: "regularising the cost volume", .. }),
            "{error}"
        );
    }
}
