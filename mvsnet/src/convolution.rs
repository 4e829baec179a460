//! A convolution as inference needs it: batch normalisation folded in, ReLU in place.

use tch::{Device, Kind, TchError, Tensor};

use crate::weights::FoldedConvolution;

/// A convolution of two or three dimensions, or a transposed one, padded so that a stride of one keeps the size.
#[derive(Debug)]
pub(crate) struct Convolution {
    weight: Tensor,
    bias: Tensor,
    stride: i64,
    relu: bool,
}

impl Convolution {
    pub(crate) fn new(
        folded: &FoldedConvolution,
        stride: i64,
        relu: bool,
        (kind, device): (Kind, Device),
    ) -> Result<Self, TchError> {
        let tensor = |values: &[f64], shape: &[usize]| {
            let shape: Vec<i64> = shape.iter().map(|size| *size as i64).collect();
            Tensor::f_from_slice(values)?.f_view(shape.as_slice())?.f_to_kind(kind)?.f_to_device(device)
        };
        let weight = tensor(&folded.weight, &folded.shape)?;
        let bias = tensor(&folded.bias, &[folded.bias.len()])?;
        Ok(Self { weight, bias, stride, relu })
    }

    /// Convolves `[1, channels, (depth,) height, width]`.
    pub(crate) fn apply(&self, input: &Tensor) -> Result<Tensor, TchError> {
        let padding = self.padding();
        if input.dim() == 5 && input.kind() == Kind::Double && input.device() == Device::Cpu {
            return self.apply_by_planes(input);
        }
        self.activate(self.convolve(input, &padding)?)
    }

    /// Convolves transposed, doubling each size or one less, as `size` asks.
    pub(crate) fn apply_transposed(&self, input: &Tensor, size: &[i64]) -> Result<Tensor, TchError> {
        let padding = self.padding();
        let least = input.size().into_iter().skip(2).map(|size| self.stride * (size - 1) + 1);
        let output_padding: Vec<i64> = size.iter().zip(least).map(|(size, least)| size - least).collect();
        let (stride, ones) = (vec![self.stride; padding.len()], vec![1; padding.len()]);
        self.activate(input.f_convolution(
            &self.weight,
            Some(&self.bias),
            stride,
            padding,
            ones,
            true,
            output_padding,
            1,
        )?)
    }

    /// libtorch's convolution in f64 unfolds its whole input, 27 values for each; one plane at a time
    /// bounds that, and is faster.
    fn apply_by_planes(&self, input: &Tensor) -> Result<Tensor, TchError> {
        let depth = input.size()[2];
        let mut planes = Vec::new();
        for centre in (0..depth).step_by(self.stride as usize) {
            let (first, last) = ((centre - 1).max(0), (centre + 1).min(depth - 1));
            let (missing_before, missing_after) = (first - (centre - 1), centre + 1 - last);
            let slab = input.f_narrow(2, first, last - first + 1)?;
            let slab = slab.f_constant_pad_nd([0, 0, 0, 0, missing_before, missing_after])?;
            planes.push(self.activate(self.convolve(&slab, &[0, 1, 1])?)?);
        }
        Tensor::f_cat(&planes, 2)
    }

    fn convolve(&self, input: &Tensor, padding: &[i64]) -> Result<Tensor, TchError> {
        let (stride, ones) = (vec![self.stride; padding.len()], vec![1; padding.len()]);
        let none = vec![0; padding.len()];
        input.f_convolution(&self.weight, Some(&self.bias), stride, padding, ones, false, none, 1)
    }

    fn padding(&self) -> Vec<i64> {
        self.weight.size()[2..].iter().map(|kernel| kernel / 2).collect()
    }

    fn activate(&self, mut output: Tensor) -> Result<Tensor, TchError> {
        if self.relu { output.f_relu_() } else { Ok(output) }
    }
}
