//! Gradients against finite differences and against libtorch in 64 bits.

use planesweep_scene::{DepthHypotheses, DepthRange, Raster, Sampling, TrainingSample};

use super::parameters::{Tensors, initial};
use super::*;
use crate::backend::conformance::Images;
use crate::{CostMetric, Normalization, Refinement};

const ALL_NETWORKS: [NetworkConfig; 3] = [
    NetworkConfig {
        normalization: Normalization::PerImage,
        refinement: Refinement::None,
        metric: CostMetric::Variance,
    },
    NetworkConfig {
        normalization: Normalization::UnitRange,
        refinement: Refinement::Paper,
        metric: CostMetric::Variance,
    },
    NetworkConfig {
        normalization: Normalization::PerImage,
        refinement: Refinement::WithBnRelu,
        metric: CostMetric::Mean,
    },
];

/// A smooth surface before three cameras, unknown in one corner.
fn example(network: NetworkConfig, depths: u32) -> Example {
    let images = Images::new(96, 64, Sampling::Uniform);
    let mut views = vec![images.reference, images.sources[0].clone(), images.sources[1].clone()];
    views[2].pixels = views[2].pixels.cropped(96, 64);
    let depth = Raster::from_fn(24, 16, |x, y| {
        if x + y < 6 { 0.0 } else { 3.0 + 0.15 * x as f32 + 0.1 * y as f32 + f32::from(x > 14) }
    });
    let sample = TrainingSample { views, depth, range: DepthRange { min: 2.0, max: 8.0, count: None } };
    let hypotheses = DepthHypotheses::new(Sampling::Inverse, 2.0, 9.0, depths).expect("a valid range");
    Example::new(&sample, hypotheses, network).expect("a fine example")
}

fn options(network: NetworkConfig, statistics: BatchStatistics) -> GradientOptions {
    let loss = LossConfig { refined_weight: 0.7, clamp: Some(6.0) };
    GradientOptions { network, loss, statistics }
}

/// Weights with affine parts and statistics that are no identities.
fn weights(network: NetworkConfig) -> Tensors {
    let mut weights = initial(network, 11);
    for (i, (name, tensor)) in weights.iter_mut().enumerate() {
        if tensor.shape.len() == 1 {
            for (k, value) in tensor.values.iter_mut().enumerate() {
                let change = 0.2 * ((i * 7 + k * 3) % 11) as f32 / 11.0;
                *value += if name.ends_with("running_var") { change } else { change - 0.1 };
            }
        }
    }
    weights
}

#[test]
fn autograd_agrees_with_finite_differences() {
    for network in ALL_NETWORKS {
        let (example, weights) = (example(network, 16), weights(network));
        let options = options(network, BatchStatistics::Own);
        let mut engine = TorchEngine::exact();
        let gradient = engine.gradient(&weights, &example, &options).expect("a gradient");
        assert!(gradient.statistics.len() > 30 && gradient.loss > 0.1);
        // A step along the gradient changes the loss by its squared norm.
        let squared: f64 = gradient.weights.values().flat_map(|t| &t.values).map(|g| f64::from(g * g)).sum();
        let mut loss_at = |h: f64| {
            let mut moved = weights.clone();
            let mut made = 0.0;
            for (name, gradient) in &gradient.weights {
                let values = &mut moved.get_mut(name).expect("a weight").values;
                for (value, gradient) in values.iter_mut().zip(&gradient.values) {
                    let before = *value;
                    *value += (h * f64::from(*gradient) / squared.sqrt()) as f32;
                    made += f64::from(*value - before) * f64::from(*gradient);
                }
            }
            (engine.gradient(&moved, &example, &options).expect("a gradient").loss, made)
        };
        let ((ahead, there), (behind, back)) = (loss_at(1e-4), loss_at(-1e-4));
        let (measured, expected) = (ahead - behind, there - back);
        assert!((measured / expected - 1.0).abs() < 0.03, "{network:?}: {measured} instead of {expected}");
    }
}
