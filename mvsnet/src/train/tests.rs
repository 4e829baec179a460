//! Gradients against finite differences and against libtorch in 64 bits.

use planesweep_scene::{DepthHypotheses, DepthRange, Raster, Sampling, TrainingSample};

use super::parameters::{Tensors, initial};
use super::*;
use crate::backend::conformance::Images;
use crate::{CostMetric, FeatureNetwork, Normalization, Refinement};

const ALL_NETWORKS: [NetworkConfig; 4] = [
    NetworkConfig {
        normalization: Normalization::PerImage,
        refinement: Refinement::None,
        metric: CostMetric::Variance,
        features: FeatureNetwork::Paper,
    },
    NetworkConfig {
        normalization: Normalization::UnitRange,
        refinement: Refinement::Paper,
        metric: CostMetric::Variance,
        features: FeatureNetwork::Paper,
    },
    NetworkConfig {
        normalization: Normalization::PerImage,
        refinement: Refinement::WithBnRelu,
        metric: CostMetric::Mean,
        features: FeatureNetwork::Paper,
    },
    NetworkConfig {
        normalization: Normalization::PerImage,
        refinement: Refinement::None,
        metric: CostMetric::Variance,
        features: FeatureNetwork::SingleLayer,
    },
];

/// A smooth surface before three cameras, unknown in one corner and absent in two.
fn example(network: NetworkConfig, depths: u32) -> Example {
    let images = Images::new(96, 64, Sampling::Uniform);
    let mut views = vec![images.reference, images.sources[0].clone(), images.sources[1].clone()];
    views[2].pixels = views[2].pixels.cropped(96, 64);
    let depth = Raster::from_fn(24, 16, |x, y| {
        if x + y < 6 {
            0.0
        } else if x + y > 34 {
            f32::INFINITY
        } else if x < 3 {
            0.5
        } else {
            3.0 + 0.15 * x as f32 + 0.1 * y as f32 + f32::from(x > 14)
        }
    });
    let sample = TrainingSample { views, depth, range: DepthRange { min: 2.0, max: 8.0, count: None } };
    let hypotheses = DepthHypotheses::new(Sampling::Inverse, 2.0, 9.0, depths).expect("a valid range");
    Example::new(&sample, hypotheses, network).expect("a fine example")
}

#[test]
fn surfaces_at_no_hypothesis_are_told_from_unknown_ones() {
    let example = example(ALL_NETWORKS[0], 16);
    let truth = &example.truth;
    assert!(truth.at(0, 0).is_nan(), "unknown");
    assert!(truth.at(23, 15).is_infinite(), "the sky");
    assert!(truth.at(0, 10).is_infinite(), "far before the first hypothesis");
    let index = example.hypotheses.index_of(3.0 + 0.15 * 10.0 + 0.1 * 5.0);
    assert!((f64::from(truth.at(10, 5)) - index).abs() < 1e-5);
}

fn options(network: NetworkConfig, statistics: BatchStatistics) -> GradientOptions {
    let loss = LossConfig { refined_weight: 0.7, clamp: Some(6.0), absent_weight: 0.8 };
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
        assert!(gradient.statistics.len() >= 20 && gradient.loss > 0.1);
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

#[test]
fn kernels_agree_with_autograd() {
    for (network, statistics, depths) in [
        (ALL_NETWORKS[0], BatchStatistics::Own, 32),
        (ALL_NETWORKS[1], BatchStatistics::Own, 24),
        (ALL_NETWORKS[2], BatchStatistics::Own, 40),
        (ALL_NETWORKS[1], BatchStatistics::Running, 8),
        (ALL_NETWORKS[3], BatchStatistics::Own, 16),
    ] {
        let (example, weights) = (example(network, depths), weights(network));
        let options = options(network, statistics);
        let exact = TorchEngine::exact().gradient(&weights, &example, &options).expect("a gradient");
        let ours = KernelEngine::new(2).expect("threads").gradient(&weights, &example, &options);
        let ours = ours.expect("a gradient");
        assert!((ours.loss / exact.loss - 1.0).abs() < 1e-4, "loss {} and {}", ours.loss, exact.loss);
        assert_eq!(ours.initial.pixels, exact.initial.pixels);
        assert_eq!(ours.refined.is_some(), exact.refined.is_some());
        for (kind, ours, exact) in
            [("gradient", &ours.weights, &exact.weights), ("statistic", &ours.statistics, &exact.statistics)]
        {
            assert!(ours.keys().eq(exact.keys()), "{kind}: {:?}, {:?}", ours.keys(), exact.keys());
            for (name, exact) in exact {
                let difference = norm(exact.values.iter().zip(&ours[name].values).map(|(a, b)| a - b));
                let scale = norm(exact.values.iter().copied());
                assert_eq!(ours[name].shape, exact.shape);
                assert!(
                    difference <= 0.01 * scale + 1e-5,
                    "{kind} of {name}: {difference} of {scale}, {network:?}"
                );
            }
        }
    }
}

fn norm(values: impl Iterator<Item = f32>) -> f64 {
    values.map(|value| f64::from(value).powi(2)).sum::<f64>().sqrt()
}

#[test]
fn threads_change_no_bit_of_a_gradient() {
    let network = ALL_NETWORKS[1];
    let (example, weights) = (example(network, 32), weights(network));
    let options = options(network, BatchStatistics::Own);
    let [one, three] = [1, 3].map(|threads| {
        let mut engine = KernelEngine::new(threads).expect("threads");
        let first = engine.gradient(&weights, &example, &options).expect("a gradient");
        // Memory that was used before changes nothing either.
        assert_eq!(engine.gradient(&weights, &example, &options).expect("a gradient"), first);
        first
    });
    assert_eq!(one, three);
}
