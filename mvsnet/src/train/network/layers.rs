//! Layers with their weights: forward, remembering what the gradient needs, and backward.

use std::ops::Range;

use super::convolution::{Convolution, Sizes, bias_gradient};
use super::normalization::{Normalization, NormalizationWeights};
use super::regression::Regression;
use super::stack::{Stack, Tools};
use crate::WeightTensor;
use crate::bands::Row;
use crate::blocks::{self, contracted, expanded};
use crate::kernels::slab::Shape;
use crate::train::engine::BatchStatistics;
use crate::train::parameters::Tensors;

/// The weights of a step, and the gradients and statistics that are gathered.
pub(super) struct Step<'a> {
    pub(super) tools: Tools,
    pub(super) weights: &'a Tensors,
    pub(super) statistics: BatchStatistics,
    pub(super) gradients: Tensors,
    pub(super) measured: Tensors,
}

/// A layer that ran: convolution, batch normalisation, ReLU.
pub(super) struct Normalized {
    convolution: String,
    batch_norm: String,
    sizes: Sizes,
    input: Stack,
    z: Stack,
    normalization: Normalization,
}

/// A layer that ran: a convolution with a bias.
pub(super) struct Biased {
    name: String,
    input: Stack,
}

impl<'a> Step<'a> {
    /// Runs a layer and gives its output, with `more` added.
    pub(super) fn normalized(
        &mut self,
        convolution: &str,
        batch_norm: &str,
        sizes: Sizes,
        input: Stack,
        more: Option<&Stack>,
    ) -> (Normalized, Stack) {
        let kernel = Convolution::new(sizes, &self.weights[&format!("{convolution}.weight")], None);
        let z = kernel.forward(&self.tools, &input);
        self.normalized_from(convolution, batch_norm, sizes, (input, z), more)
    }

    /// The same for a layer that keeps sizes, of a volume whose rows are made when they are needed.
    pub(super) fn normalized_by_bands(
        &mut self,
        convolution: &str,
        batch_norm: &str,
        height: usize,
        band: usize,
        rows: impl Fn(Range<usize>) -> Vec<Row>,
    ) -> (Normalized, Stack) {
        let kernel = Convolution::new(Sizes::Same, &self.weights[&format!("{convolution}.weight")], None);
        let (input, z) = kernel.forward_by_bands(&self.tools, height, band, rows);
        self.normalized_from(convolution, batch_norm, Sizes::Same, (input, z), None)
    }

    fn normalized_from(
        &mut self,
        convolution: &str,
        batch_norm: &str,
        sizes: Sizes,
        (input, z): (Stack, Stack),
        more: Option<&Stack>,
    ) -> (Normalized, Stack) {
        let part = |part: &str| &self.weights[&format!("{batch_norm}.{part}")];
        let running = match self.statistics {
            BatchStatistics::Own => None,
            BatchStatistics::Running => Some([part("running_mean"), part("running_var")]),
        };
        let weights = NormalizationWeights { gamma: part("weight"), beta: part("bias"), running };
        let normalization = Normalization::new(&self.tools, &weights, &z);
        if let Some(measured) = &normalization.measured {
            for (part, values) in ["running_mean", "running_var"].into_iter().zip(measured) {
                let tensor = WeightTensor { shape: vec![values.len()], values: values.clone() };
                self.measured.insert(format!("{batch_norm}.{part}"), tensor);
            }
        }
        let output = normalization.apply(&self.tools, &z, more);
        let (convolution, batch_norm) = (convolution.to_owned(), batch_norm.to_owned());
        (Normalized { convolution, batch_norm, sizes, input, z, normalization }, output)
    }

    /// Goes back through a layer: from the gradient of its output to that of its input, if that is wanted, with
    /// `more` added.
    pub(super) fn back_normalized(
        &mut self,
        layer: Normalized,
        gradient: &Stack,
        wanted: bool,
        more: Option<&Stack>,
    ) -> Option<Stack> {
        let shape = fitting(layer.input.shape);
        let (kernel, gradient) = self.back_to_kernel(layer, gradient);
        wanted.then(|| kernel.input_gradient(&self.tools, &gradient, shape, more))
    }

    /// The same for a layer of a volume that keeps sizes, whose input's gradient is handed out a few rows at a time.
    pub(super) fn back_normalized_by_bands(
        &mut self,
        layer: Normalized,
        gradient: &Stack,
        band: usize,
        take: impl FnMut(&[Row]),
    ) {
        let (kernel, gradient) = self.back_to_kernel(layer, gradient);
        kernel.input_gradient_by_bands(&self.tools, &gradient, band, take);
    }

    /// Goes back to the convolution and its kernel: gives the gradient of its output.
    fn back_to_kernel(&mut self, layer: Normalized, gradient: &Stack) -> (Convolution<'a>, Stack) {
        let Normalized { convolution, batch_norm, sizes, input, z, normalization } = layer;
        let (gradient, [gamma, beta]) = normalization.gradient(&self.tools, &z, gradient);
        drop(z);
        let name = format!("{convolution}.weight");
        let kernel = Convolution::new(sizes, &self.weights[&name], None);
        self.gradients.insert(name, kernel.kernel_gradient(&self.tools, &input, &gradient));
        self.gradients.insert(format!("{batch_norm}.weight"), gamma);
        self.gradients.insert(format!("{batch_norm}.bias"), beta);
        (kernel, gradient)
    }

    /// Runs a convolution with a bias.
    pub(super) fn biased(&mut self, name: &str, input: Stack) -> (Biased, Stack) {
        let (kernel, bias) =
            (&self.weights[&format!("{name}.weight")], &self.weights[&format!("{name}.bias")]);
        let output = Convolution::new(Sizes::Same, kernel, Some(bias)).forward(&self.tools, &input);
        (Biased { name: name.to_owned(), input }, output)
    }

    /// Runs the last layer of the regularisation, and the regression.
    pub(super) fn regressed(&self, name: &str, input: Stack) -> (Biased, Regression) {
        let (kernel, bias) =
            (&self.weights[&format!("{name}.weight")], &self.weights[&format!("{name}.bias")]);
        let layer = Convolution::new(Sizes::Same, kernel, Some(bias)).regression(&self.tools);
        let regression = Regression::new(&self.tools, &layer, &input);
        (Biased { name: name.to_owned(), input }, regression)
    }

    /// Runs the single layer of features over the blocks of images.
    pub(super) fn over_blocks(&self, name: &str, input: &Stack) -> Stack {
        let (kernel, bias) = (self.kernel_over_blocks(name), &self.weights[&format!("{name}.bias")]);
        Convolution::new(Sizes::Same, &kernel, Some(bias)).forward(&self.tools, input)
    }

    /// Goes back through it; images learn nothing.
    pub(super) fn back_over_blocks(&mut self, name: &str, input: &Stack, gradient: &Stack) {
        let kernel = self.kernel_over_blocks(name);
        let outputs = kernel.shape[0];
        let weight = Convolution::new(Sizes::Same, &kernel, None);
        let values = contracted(&weight.kernel_gradient(&self.tools, input, gradient).values, outputs);
        let weight = format!("{name}.weight");
        let shape = self.weights[&weight].shape.clone();
        self.gradients.insert(weight, WeightTensor { shape, values });
        self.gradients.insert(format!("{name}.bias"), bias_gradient(gradient, outputs));
    }

    fn kernel_over_blocks(&self, name: &str) -> WeightTensor {
        let kernel = &self.weights[&format!("{name}.weight")];
        let outputs = kernel.shape[0];
        let shape = vec![outputs, blocks::CHANNELS, 3, 3];
        WeightTensor { shape, values: expanded(&kernel.values, outputs) }
    }

    /// Goes back through it.
    pub(super) fn back_biased(&mut self, layer: Biased, gradient: &Stack) -> Stack {
        let Biased { name, input } = layer;
        let weight = format!("{name}.weight");
        let kernel = Convolution::new(Sizes::Same, &self.weights[&weight], None);
        let outputs = self.weights[&weight].shape[0];
        self.gradients.insert(weight.clone(), kernel.kernel_gradient(&self.tools, &input, gradient));
        self.gradients.insert(format!("{name}.bias"), bias_gradient(gradient, outputs));
        kernel.input_gradient(&self.tools, gradient, fitting(input.shape), None)
    }
}

/// Gradients have as many channels as kernels compute at once.
fn fitting(shape: Shape) -> Shape {
    Shape { channels: shape.channels.next_multiple_of(8), ..shape }
}
