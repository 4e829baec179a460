//! What one step learns from: a sample as the network sees it.

use nalgebra::Matrix3x4;
use planesweep_scene::{DepthHypotheses, Raster, Sampling, TrainingSample};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::{NetworkConfig, SampleConfig};
use crate::backend::quarter_camera;
use crate::confidence::spacing_px;
use crate::input::InputImage;

/// A surface this many steps outside of the hypotheses looks like none of them.
const ABSENT_FROM: f64 = 2.0;

/// Images, hypotheses and true depths of one reference view.
#[derive(Clone, Debug)]
pub struct Example {
    /// The reference, then its sources.
    pub(crate) images: Vec<InputImage>,
    /// `K [R | t]` of their feature maps.
    pub(crate) projections: Vec<Matrix3x4<f64>>,
    pub(crate) hypotheses: DepthHypotheses,
    /// The fractional index of the true depth among the hypotheses, of the size of the features; NaN where it is
    /// unknown, infinite where no hypothesis is right.
    pub(crate) truth: Raster<f32>,
    /// Spacing of the hypotheses in the middle of the reference, in pixels of the best source view.
    pub(crate) spacing_px: f64,
}

/// The shape of a sample that a source is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SampleShape {
    /// Columns of the images.
    pub width: usize,
    /// Rows of the images.
    pub height: usize,
    /// Images, the reference included; a source with fewer gives those it has.
    pub views: usize,
}

/// Why a sample teaches nothing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ExampleError {
    /// There is no source view, or sizes of views or depth do not agree.
    #[error("the sample has {views} views and a depth map of {width}x{height} that do not fit together")]
    Shape {
        /// Views.
        views: usize,
        /// Columns of the depth map.
        width: usize,
        /// Rows of the depth map.
        height: usize,
    },
    /// The depth range is no range.
    #[error("the depth range of the sample is empty")]
    Range,
    /// No pixel has a depth within the range.
    #[error("no pixel of the sample has a known depth within the range")]
    NoTruth,
}

/// What is drawn for a sample before it is made.
#[derive(Clone, Debug)]
pub struct Recipe {
    /// What the source is asked for.
    pub shape: SampleShape,
    /// The seed that the source is given.
    pub seed: u64,
    rng: ChaCha8Rng,
}

impl Recipe {
    /// Draws the recipe of the sample with this number of a run with this seed.
    pub fn draw(config: &SampleConfig, run_seed: u64, number: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(run_seed);
        rng.set_stream(number);
        let [width, height] = config.sizes[rng.random_range(0..config.sizes.len())];
        let views = config.views[rng.random_range(0..config.views.len())];
        let seed = rng.random();
        Self { shape: SampleShape { width, height, views }, seed, rng }
    }

    /// The example of the sample that was made: range, number and spacing of the hypotheses are drawn, and the
    /// views' colours changed.
    pub fn example(
        mut self,
        mut sample: TrainingSample,
        config: &SampleConfig,
        network: NetworkConfig,
    ) -> Result<Example, ExampleError> {
        let hypotheses = self.hypotheses(&sample, config)?;
        if config.photometric > 0.0 {
            for view in &mut sample.views {
                recolor(&mut view.pixels, config.photometric, &mut self.rng);
            }
        }
        Example::new(&sample, hypotheses, network)
    }

    fn hypotheses(
        &mut self,
        sample: &TrainingSample,
        config: &SampleConfig,
    ) -> Result<DepthHypotheses, ExampleError> {
        let rng = &mut self.rng;
        let inverse = rng.random_bool(config.inverse_share);
        let sampling = if inverse { Sampling::Inverse } else { Sampling::Uniform };
        let mut jitter = || rng.random_range(-1.0..=1.0) * config.range_jitter;
        let (at_near, at_far) = (jitter(), jitter());
        let wanted_px = rng.random_range(config.spacing_px[0]..=config.spacing_px[1]);
        // Ends move by shares of the range: of depth, or of inverse depth when sampled so.
        let range = sample.range;
        let moved = |near: f64, far: f64| (near + at_near * (far - near), far + at_far * (far - near));
        let (min, max) = match sampling {
            Sampling::Uniform => {
                let (min, max) = moved(range.min, range.max);
                (min.max(0.25 * range.min), max)
            }
            Sampling::Inverse => {
                let (near, far) = moved(1.0 / range.min, 1.0 / range.max);
                (1.0 / near, 1.0 / far.max(0.25 / range.max))
            }
        };
        let [fewest, most] = config.depths;
        let make = |count| DepthHypotheses::new(sampling, min, max, count).map_err(|_| ExampleError::Range);
        let coarse = make(fewest)?;
        let count = match sample.views.as_slice() {
            [reference, source, ..] => {
                let px = spacing_px(&reference.camera, &source.camera, &coarse);
                let count = px / wanted_px * f64::from(fewest - 1) + 1.0;
                (count / 8.0).round().clamp(f64::from(fewest / 8), f64::from(most / 8)) as u32 * 8
            }
            _ => fewest,
        };
        make(count)
    }
}

impl Example {
    /// Prepares a sample for these hypotheses.
    pub fn new(
        sample: &TrainingSample,
        hypotheses: DepthHypotheses,
        network: NetworkConfig,
    ) -> Result<Self, ExampleError> {
        let TrainingSample { views, depth, .. } = sample;
        let mut images = Vec::with_capacity(views.len());
        let mut projections = Vec::with_capacity(views.len());
        for view in views {
            images.push(InputImage::new(&view.pixels, network.normalization));
            projections.push(quarter_camera(view).projection());
        }
        let fits = views.len() >= 2
            && images.iter().all(|image| (image.width, image.height) == (images[0].width, images[0].height))
            && depth.width() == views[0].pixels.width().div_ceil(4)
            && depth.height() == views[0].pixels.height().div_ceil(4)
            && projections[0].fixed_view::<3, 3>(0, 0).into_owned().is_invertible();
        if !fits {
            let (width, height) = (depth.width(), depth.height());
            return Err(ExampleError::Shape { views: views.len(), width, height });
        }
        let last = f64::from(hypotheses.count() - 1);
        let truth = Raster::from_fn(images[0].width / 4, images[0].height / 4, |x, y| {
            let depth = f64::from(depth.get(x, y).unwrap_or(0.0));
            let index = match depth {
                f64::INFINITY => depth,
                _ if depth > 0.0 => hypotheses.index_of(depth),
                _ => f64::NAN,
            };
            if (0.0..=last).contains(&index) {
                index as f32
            } else if (-ABSENT_FROM..=last + ABSENT_FROM).contains(&index) || index.is_nan() {
                f32::NAN
            } else {
                f32::INFINITY
            }
        });
        if !truth.values().iter().any(|index| index.is_finite()) {
            return Err(ExampleError::NoTruth);
        }
        let spacing_px = spacing_px(&views[0].camera, &views[1].camera, &hypotheses);
        Ok(Self { images, projections, hypotheses, truth, spacing_px })
    }

    /// Pixels whose true depth is known and within the hypotheses.
    pub fn valid_pixels(&self) -> usize {
        self.truth.values().iter().filter(|index| index.is_finite()).count()
    }
}

/// Changes exposure, contrast (a gamma) and white balance of a view.
fn recolor(pixels: &mut Raster<[u8; 3]>, strength: f64, rng: &mut ChaCha8Rng) {
    let mut draw = |half: f64| rng.random_range(-half..=half) * strength;
    let (gain, gamma) = (draw(0.4).exp(), draw(0.35).exp());
    let tables: [[u8; 256]; 3] = std::array::from_fn(|_| {
        let channel = gain * draw(0.12).exp();
        std::array::from_fn(|value| {
            let light = (value as f64 / 255.0).powf(gamma) * channel;
            (255.0 * light).round().clamp(0.0, 255.0) as u8
        })
    });
    for pixel in pixels.values_mut() {
        for (value, table) in pixel.iter_mut().zip(&tables) {
            *value = table[*value as usize];
        }
    }
}
