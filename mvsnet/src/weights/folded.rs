//! Convolutions with their batch normalisation multiplied in, for inference.

use super::{WeightTensor, Weights};

/// What PyTorch adds to the variance by default; the checkpoints were trained with it.
const EPSILON: f64 = 1e-5;

/// A convolution's kernel and bias after its batch normalisation was folded into them, in f64.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct FoldedConvolution {
    /// `[out, in, kernel ...]`, or `[in, out, kernel ...]` when transposed.
    pub(crate) shape: Vec<usize>,
    pub(crate) weight: Vec<f64>,
    /// One value per output channel.
    pub(crate) bias: Vec<f64>,
}

/// Where the output channels stand in the kernel's shape.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum KernelOrder {
    OutputFirst,
    /// As transposed convolutions have it.
    InputFirst,
}

impl Weights {
    /// The convolution of this name with its own bias.
    pub(crate) fn biased(&self, convolution: &str) -> FoldedConvolution {
        let weight = self.tensor(&format!("{convolution}.weight"));
        let bias = self.tensor(&format!("{convolution}.bias"));
        FoldedConvolution { shape: weight.shape.clone(), weight: weight.to_f64(), bias: bias.to_f64() }
    }

    /// The convolution of this name followed by that batch normalisation with its running statistics.
    pub(crate) fn normalised(
        &self,
        convolution: &str,
        batch_norm: &str,
        order: KernelOrder,
    ) -> FoldedConvolution {
        let part = |name: &str| self.tensor(&format!("{batch_norm}.{name}")).to_f64();
        let (gamma, beta, mean, variance) =
            (part("weight"), part("bias"), part("running_mean"), part("running_var"));
        let scale: Vec<f64> = gamma
            .iter()
            .zip(&variance)
            .map(|(gamma, variance)| gamma / (variance + EPSILON).sqrt())
            .collect();
        let bias = (0..scale.len()).map(|o| beta[o] - mean[o] * scale[o]).collect();

        let kernel = self.tensor(&format!("{convolution}.weight"));
        let taps: usize = kernel.shape[2..].iter().product();
        let mut weight = kernel.to_f64();
        for (pair, values) in weight.chunks_exact_mut(taps).enumerate() {
            let output = match order {
                KernelOrder::OutputFirst => pair / kernel.shape[1],
                KernelOrder::InputFirst => pair % kernel.shape[1],
            };
            for value in values {
                *value *= scale[output];
            }
        }
        FoldedConvolution { shape: kernel.shape.clone(), weight, bias }
    }

    /// A tensor that the layout has.
    fn tensor(&self, name: &str) -> &WeightTensor {
        self.tensors.get(name).expect("the layout was checked when the weights were made")
    }
}

impl WeightTensor {
    fn to_f64(&self) -> Vec<f64> {
        self.values.iter().map(|value| *value as f64).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights::{Refinement, WeightsMetadata};

    #[test]
    fn folding_scales_the_kernels_of_each_output_channel() {
        let weights = Weights::seeded(WeightsMetadata::untrained(Refinement::None), 5);
        let value = |name: &str, i: usize| weights.tensors[name].values[i] as f64;
        let scale = |bn: &str, o: usize| {
            value(&format!("{bn}.weight"), o) / (value(&format!("{bn}.running_var"), o) + 1e-5).sqrt()
        };

        let bn = "cost_regularization.conv1.bn";
        let folded = weights.normalised("cost_regularization.conv1.conv", bn, KernelOrder::OutputFirst);
        // Output 3, input 5, tap 7 of a kernel [16, 8, 27].
        let at = (3 * 8 + 5) * 27 + 7;
        let expected = value("cost_regularization.conv1.conv.weight", at) * scale(bn, 3);
        assert!((folded.weight[at] - expected).abs() < 1e-15);
        let shift = value(&format!("{bn}.bias"), 3) - value(&format!("{bn}.running_mean"), 3) * scale(bn, 3);
        assert!((folded.bias[3] - shift).abs() < 1e-15);

        let bn = "cost_regularization.conv9.1";
        let folded = weights.normalised("cost_regularization.conv9.0", bn, KernelOrder::InputFirst);
        // Input 3, output 5, tap 7 of a transposed kernel [32, 16, 27].
        let at = (3 * 16 + 5) * 27 + 7;
        let expected = value("cost_regularization.conv9.0.weight", at) * scale(bn, 5);
        assert!((folded.weight[at] - expected).abs() < 1e-15);
    }
}
