//! The network of training without a tensor library: forward and backward by kernels of our own.
//!
//! Layers have the layouts of inference, so kernels of both are the same: what a gradient does to its way back is a
//! convolution again. The gradient of the cost volume meets features that are warped a second time, so that no
//! warped feature is ever stored.

mod convolution;
mod cost;
mod kernel_gradient;
mod layers;
mod normalization;
mod regression;
mod stack;

use std::sync::Arc;

use rayon::prelude::*;
use rayon::{ThreadPool, ThreadPoolBuilder};

use self::convolution::Sizes;
use self::cost::CostGradient;
use self::layers::{Biased, Normalized, Step};
use self::regression::{Regression, loss};
use self::stack::{Stack, Tools};
use super::Example;
use super::engine::{EngineError, Gradient, GradientEngine, GradientOptions, IntervalErrors};
use super::parameters::Tensors;
use crate::bands::Row;
use crate::blocks::blocks;
use crate::input::InputImage;
use crate::kernels::cost::{CostInput, FeatureMap};
use crate::kernels::simd::Level;
use crate::kernels::slab::{Pool, Shape};
use crate::{FeatureNetwork, Refinement};

/// Memory that is kept for the next step, at most: samples of other sizes need slabs of other shapes.
const MOST_KEPT_BYTES: usize = 4 << 30;
/// The layer of a feature network that has one, and the last of one that has eight.
const SINGLE: &str = "feature.feature";

/// Gradients by kernels of our own. The number of threads changes no bit of them.
#[derive(Debug)]
pub struct KernelEngine {
    tools: Tools,
    threads: ThreadPool,
}

impl KernelEngine {
    /// With this many threads, at least one.
    pub fn new(threads: usize) -> Result<Self, EngineError> {
        let pool = ThreadPoolBuilder::new().num_threads(threads.max(1)).build();
        let threads =
            pool.map_err(|error| EngineError::Device { device: "cpu".to_owned(), why: error.to_string() })?;
        Ok(Self { tools: Tools { pool: Arc::<Pool>::default(), level: Level::detect() }, threads })
    }
}

impl GradientEngine for KernelEngine {
    fn gradient(
        &mut self,
        weights: &Tensors,
        example: &Example,
        options: &GradientOptions,
    ) -> Result<Gradient, EngineError> {
        let step = Step {
            tools: self.tools.clone(),
            weights,
            statistics: options.statistics,
            gradients: Tensors::new(),
            measured: Tensors::new(),
        };
        let gradient = self.threads.install(|| run(step, example, options));
        if self.tools.pool.bytes() > MOST_KEPT_BYTES {
            self.tools.pool = Arc::default();
        }
        Ok(gradient)
    }
}

fn run(mut step: Step<'_>, example: &Example, options: &GradientOptions) -> Gradient {
    let tools = step.tools.clone();
    let (feature_layers, features) = features(&mut step, &example.images, options.network.features);
    let maps: Vec<FeatureMap> = features.slabs.par_iter().map(|slab| FeatureMap::new(slab)).collect();
    let shape = features.shape;
    drop(features);
    let input = cost::input(&maps, example, options);
    let (regularization, regression) = regularized(&mut step, &input);

    let (mut total, mut index_gradient) = loss(&regression.index, &example.truth, options.loss, 1.0);
    let errors =
        |index: &[f64]| IntervalErrors::of(index.iter().map(|index| *index as f32), example.truth.values());
    let mut refined = None;
    if options.network.refinement != Refinement::None {
        let (indices, gradient, refined_loss) = refine(&mut step, &regression.index, example, options);
        total += refined_loss;
        refined = Some(errors(&indices));
        index_gradient.iter_mut().zip(gradient).for_each(|(to, more)| *to += more);
    }
    let absent = options.loss.absent_weight;
    if absent > 0.0 {
        total += absent * regression.absent_loss(&example.truth);
    }
    let gradient = regression.gradient(&tools, &index_gradient, &example.truth, absent);
    let mut cost_gradient = CostGradient::new(&tools, &input);
    back_regularized(&mut step, regularization, &gradient, |rows| cost_gradient.take(rows));
    back_features(&mut step, feature_layers, &cost_gradient.features(shape));
    Gradient {
        loss: total,
        initial: errors(&regression.index),
        refined,
        weights: step.gradients,
        statistics: step.measured,
    }
}

/// The feature network's layers, in the order they ran.
enum FeatureLayers {
    Paper(Vec<Normalized>, Biased),
    /// The blocks of the images.
    Single(Stack),
}

/// Features of all views, one slab each.
fn features(step: &mut Step<'_>, images: &[InputImage], network: FeatureNetwork) -> (FeatureLayers, Stack) {
    if network == FeatureNetwork::SingleLayer {
        let pool = &step.tools.pool;
        let input = Stack::new(images.iter().map(|image| Arc::new(blocks(pool, image))).collect());
        let output = step.over_blocks(SINGLE, &input);
        return (FeatureLayers::Single(input), output);
    }
    let (width, height) = (images[0].width, images[0].height);
    let shape = Shape { columns: height, channels: 3, length: width };
    let mut x = Stack::compute(&step.tools, images.len(), shape, |view, slab| {
        for (channel, plane) in images[view].planes.chunks_exact(width * height).enumerate() {
            for (y, row) in plane.chunks_exact(width).enumerate() {
                slab.channel_mut(y, channel).copy_from_slice(row);
            }
        }
    });
    let mut layers = Vec::new();
    for i in 0..7 {
        let sizes = if i == 2 || i == 5 { Sizes::Halved } else { Sizes::Same };
        let (convolution, batch_norm) = (format!("feature.conv{i}.conv"), format!("feature.conv{i}.bn"));
        let (layer, output) = step.normalized(&convolution, &batch_norm, sizes, x, None);
        layers.push(layer);
        x = output;
    }
    let (last, features) = step.biased(SINGLE, x);
    (FeatureLayers::Paper(layers, last), features)
}

fn back_features(step: &mut Step<'_>, layers: FeatureLayers, gradient: &Stack) {
    let (layers, last) = match layers {
        FeatureLayers::Paper(layers, last) => (layers, last),
        FeatureLayers::Single(input) => return step.back_over_blocks(SINGLE, &input, gradient),
    };
    let mut gradient = Some(step.back_biased(last, gradient));
    for (i, layer) in layers.into_iter().enumerate().rev() {
        // Images learn nothing.
        gradient = gradient.and_then(|gradient| step.back_normalized(layer, &gradient, i > 0, None));
    }
}

/// The layers of the regularisation, in the order they ran.
struct Regularization {
    /// Whose input is the cost volume.
    first: Normalized,
    /// conv1 to conv6.
    down: Vec<Normalized>,
    /// conv7, conv9 and conv11.
    up: Vec<Normalized>,
    prob: Biased,
}

fn regularized(step: &mut Step<'_>, cost: &CostInput<'_>) -> (Regularization, Regression) {
    let tools = step.tools.clone();
    let name = "cost_regularization.conv0";
    let (convolution, batch_norm) = (format!("{name}.conv"), format!("{name}.bn"));
    let height = cost.reference.height();
    let rows = |rows| cost::rows(&tools, cost, rows);
    let (first, mut x) = step.normalized_by_bands(&convolution, &batch_norm, height, cost::BAND, rows);
    let mut down = Vec::new();
    let mut skips = Vec::new();
    for i in 1..7 {
        let name = format!("cost_regularization.conv{i}");
        let sizes = if i % 2 == 1 { Sizes::Halved } else { Sizes::Same };
        if sizes == Sizes::Halved {
            skips.push(x.clone());
        }
        let (layer, output) = step.normalized(&format!("{name}.conv"), &format!("{name}.bn"), sizes, x, None);
        down.push(layer);
        x = output;
    }
    let mut up = Vec::new();
    for i in [7, 9, 11] {
        let name = format!("cost_regularization.conv{i}");
        let skip = skips.pop().expect("one skip for each step down");
        let (convolution, batch_norm) = (format!("{name}.0"), format!("{name}.1"));
        let (layer, output) = step.normalized(&convolution, &batch_norm, Sizes::Doubled, x, Some(&skip));
        up.push(layer);
        x = output;
    }
    let (prob, regression) = step.regressed("cost_regularization.prob", x);
    (Regularization { first, down, up, prob }, regression)
}

/// Hands out the gradient of the volume, a few rows at a time.
fn back_regularized(step: &mut Step<'_>, layers: Regularization, logits: &Stack, take: impl FnMut(&[Row])) {
    let Regularization { first, down, up, prob } = layers;
    let wanted = "inner layers have gradients";
    let mut gradient = step.back_biased(prob, logits);
    // What each skip connection brings back, the largest volume first.
    let mut skips = Vec::new();
    for layer in up.into_iter().rev() {
        let input = step.back_normalized(layer, &gradient, true, None).expect(wanted);
        skips.push(gradient);
        gradient = input;
    }
    for (i, layer) in down.into_iter().enumerate().rev() {
        // Layers that halve had the skip's volume as input.
        let skip = if i % 2 == 0 { skips.pop() } else { None };
        gradient = step.back_normalized(layer, &gradient, true, skip.as_ref()).expect(wanted);
    }
    step.back_normalized_by_bands(first, &gradient, cost::BAND, take);
}

/// Refined indices, the gradient of the initial ones, and the loss of the refined ones.
fn refine(
    step: &mut Step<'_>,
    index: &[f64],
    example: &Example,
    options: &GradientOptions,
) -> (Vec<f64>, Vec<f64>, f64) {
    let steps = f64::from(example.hypotheses.count() - 1);
    let image = &example.images[0];
    let (width, height) = (image.width / 4, image.height / 4);
    let shape = Shape { columns: height, channels: 4, length: width };
    let mut x = Stack::compute(&step.tools, 1, shape, |_, slab| {
        for y in 0..height {
            for (channel, plane) in image.planes.chunks_exact(image.width * image.height).enumerate() {
                let row = &plane[4 * y * image.width..];
                for (to, from) in slab.channel_mut(y, channel).iter_mut().zip(row.iter().step_by(4)) {
                    *to = *from;
                }
            }
            for (to, index) in slab.channel_mut(y, 3).iter_mut().zip(&index[y * width..]) {
                *to = (index / steps) as f32;
            }
        }
    });
    let mut layers = Vec::new();
    for i in 1..4 {
        let name = format!("refine_network.conv{i}");
        let (layer, output) =
            step.normalized(&format!("{name}.conv"), &format!("{name}.bn"), Sizes::Same, x, None);
        layers.push(layer);
        x = output;
    }
    let (last, residual) = if options.network.refinement == Refinement::WithBnRelu {
        let names = ("refine_network.res.conv", "refine_network.res.bn");
        let (layer, residual) = step.normalized(names.0, names.1, Sizes::Same, x, None);
        (Err(layer), residual)
    } else {
        let (layer, residual) = step.biased("refine_network.res", x);
        (Ok(layer), residual)
    };
    let residuals = (0..height).flat_map(|y| residual.slabs[0].channel(y, 0));
    let refined: Vec<f64> =
        index.iter().zip(residuals).map(|(index, residual)| index + f64::from(*residual) * steps).collect();
    let (loss, refined_gradient) = loss(&refined, &example.truth, options.loss, options.loss.refined_weight);

    let gradient = Stack::compute(&step.tools, 1, Shape { channels: 1, ..shape }, |_, slab| {
        for y in 0..height {
            let row = slab.channel_mut(y, 0).iter_mut().zip(&refined_gradient[y * width..]);
            row.for_each(|(to, from)| *to = (from * steps) as f32);
        }
    });
    let mut gradient = match last {
        Ok(layer) => step.back_biased(layer, &gradient),
        Err(layer) => step.back_normalized(layer, &gradient, true, None).expect("it is wanted"),
    };
    for layer in layers.into_iter().rev() {
        gradient = step.back_normalized(layer, &gradient, true, None).expect("it is wanted");
    }
    let through = (0..height).flat_map(|y| gradient.slabs[0].channel(y, 3));
    let through = through.map(|value| f64::from(*value) / steps);
    let index_gradient = refined_gradient.iter().zip(through).map(|(direct, through)| direct + through);
    let index_gradient = index_gradient.collect();
    (refined, index_gradient, loss)
}
