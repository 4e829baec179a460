//! The network's weights in the order the kernels use them.

use crate::kernels::regress::RegressionLayer;
use crate::kernels::simd::Level;
use crate::kernels::strided::StridedLayer;
use crate::kernels::transposed::TransposedLayer;
use crate::kernels::winograd::WinogradLayer;
use crate::weights::{FoldedConvolution, KernelOrder};
use crate::{FeatureNetwork, Refinement, Weights, blocks};

/// Image features (paper section 3.1).
#[derive(Debug)]
pub(crate) enum FeatureLayers {
    /// Eight layers.
    Paper(Box<PaperLayers>),
    /// One layer, over blocks of pixels.
    Single(WinogradLayer),
}

/// The paper's layers in their order.
#[derive(Debug)]
pub(crate) struct PaperLayers {
    pub(crate) full: [WinogradLayer; 2],
    pub(crate) to_half: StridedLayer,
    pub(crate) half: [WinogradLayer; 2],
    pub(crate) to_quarter: StridedLayer,
    pub(crate) quarter: [WinogradLayer; 2],
}

/// Cost volume regularisation (paper section 3.2).
#[derive(Debug)]
pub(crate) struct RegularizationLayers {
    /// conv0, conv2, conv4 and conv6.
    pub(crate) plain: [WinogradLayer; 4],
    /// conv1, conv3 and conv5.
    pub(crate) down: [StridedLayer; 3],
    /// conv7, conv9 and conv11.
    pub(crate) up: [TransposedLayer; 3],
    pub(crate) prob: RegressionLayer,
}

impl FeatureLayers {
    pub(crate) fn new(weights: &Weights, level: Level) -> Self {
        let last = weights.biased("feature.feature");
        if weights.metadata().features == FeatureNetwork::SingleLayer {
            let kernel = |o, c, _, row, k| blocks::tap(o, c, row, k).map_or(0.0, |tap| last.weight[tap]);
            let sizes = [blocks::CHANNELS, last.shape[0], 1];
            return Self::Single(WinogradLayer::new(level, sizes, kernel, &last.bias, false));
        }
        let folded = |i: usize| {
            let (convolution, batch_norm) = (format!("feature.conv{i}.conv"), format!("feature.conv{i}.bn"));
            weights.normalised(&convolution, &batch_norm, KernelOrder::OutputFirst)
        };
        let plain = |i| image_layer(level, &folded(i), true);
        let strided = |i| {
            let FoldedConvolution { shape, weight, bias } = folded(i);
            let inputs = shape[1];
            let kernel = |o, c, row, k| weight[(o * inputs + c) * 25 + row * 5 + k];
            StridedLayer::new(level, [inputs, shape[0], 5, 5], kernel, &bias, true)
        };
        Self::Paper(Box::new(PaperLayers {
            full: [plain(0), plain(1)],
            to_half: strided(2),
            half: [plain(3), plain(4)],
            to_quarter: strided(5),
            quarter: [plain(6), image_layer(level, &last, false)],
        }))
    }
}

impl RegularizationLayers {
    pub(crate) fn new(weights: &Weights, level: Level) -> Self {
        let folded = |i: usize| {
            let name = format!("cost_regularization.conv{i}");
            weights.normalised(&format!("{name}.conv"), &format!("{name}.bn"), KernelOrder::OutputFirst)
        };
        let plain = |i| {
            let FoldedConvolution { shape, weight, bias } = folded(i);
            let inputs = shape[1];
            let kernel = |o, c, y, x, k| weight[volume_tap(o * inputs + c, k, y, x)];
            WinogradLayer::new(level, [inputs, shape[0], 3], kernel, &bias, true)
        };
        let down = |i| {
            let FoldedConvolution { shape, weight, bias } = folded(i);
            let inputs = shape[1];
            let kernel = |o, c, tap, k| weight[volume_tap(o * inputs + c, k, tap / 3, tap % 3)];
            StridedLayer::new(level, [inputs, shape[0], 9, 3], kernel, &bias, true)
        };
        let up = |i: usize| {
            let name = format!("cost_regularization.conv{i}");
            let (convolution, batch_norm) = (format!("{name}.0"), format!("{name}.1"));
            let FoldedConvolution { shape, weight, bias } =
                weights.normalised(&convolution, &batch_norm, KernelOrder::InputFirst);
            let outputs = shape[1];
            let kernel = |o, c, tap, k| weight[volume_tap(c * outputs + o, k, tap / 3, tap % 3)];
            TransposedLayer::new(level, [shape[0], outputs, 9, 3], kernel, &bias, true)
        };
        let prob = weights.biased("cost_regularization.prob");
        let kernel = |c, y, x, k| prob.weight[volume_tap(c, k, y, x)];
        Self {
            plain: [0, 2, 4, 6].map(plain),
            down: [1, 3, 5].map(down),
            up: [7, 9, 11].map(up),
            prob: RegressionLayer::new(level, kernel, prob.bias[0]),
        }
    }
}

/// Refinement (paper section 3.3), in the order of the layers; `None` when the weights have none.
pub(crate) fn refinement_layers(weights: &Weights, level: Level) -> Option<[WinogradLayer; 4]> {
    let normalised = |name: &str| {
        let (convolution, batch_norm) =
            (format!("refine_network.{name}.conv"), format!("refine_network.{name}.bn"));
        image_layer(level, &weights.normalised(&convolution, &batch_norm, KernelOrder::OutputFirst), true)
    };
    let last = match weights.metadata().refinement {
        Refinement::None => return None,
        Refinement::Paper => image_layer(level, &weights.biased("refine_network.res"), false),
        Refinement::WithBnRelu => normalised("res"),
    };
    Some([normalised("conv1"), normalised("conv2"), normalised("conv3"), last])
}

/// A 3x3 layer of images, whose slabs have a column for each image row.
fn image_layer(level: Level, folded: &FoldedConvolution, relu: bool) -> WinogradLayer {
    let FoldedConvolution { shape, weight, bias } = folded;
    let inputs = shape[1];
    let kernel = |o, c, _, row, k| weight[(o * inputs + c) * 9 + row * 3 + k];
    WinogradLayer::new(level, [inputs, shape[0], 1], kernel, bias, relu)
}

/// The index of a tap of kernel `pair` in a volume's weights.
fn volume_tap(pair: usize, depth: usize, y: usize, x: usize) -> usize {
    pair * 27 + depth * 9 + y * 3 + x
}
