//! Cost volume regularisation (paper section 3.2): a 3D U-Net of four scales with additive skips.

use tch::{Device, Kind, TchError, Tensor};

use crate::Weights;
use crate::convolution::Convolution;
use crate::weights::KernelOrder;

/// Maps the cost volume to one logit per depth and pixel.
#[derive(Debug)]
pub(crate) struct CostRegularization {
    /// conv0 to conv6; the odd ones halve the volume.
    down: Vec<Convolution>,
    /// conv7, conv9 and conv11, transposed; each doubles the volume.
    up: Vec<Convolution>,
    prob: Convolution,
}

impl CostRegularization {
    pub(crate) fn new(weights: &Weights, options: (Kind, Device)) -> Result<Self, TchError> {
        let mut down = Vec::new();
        for i in 0..7 {
            let name = format!("cost_regularization.conv{i}");
            let (convolution, batch_norm) = (format!("{name}.conv"), format!("{name}.bn"));
            let folded = weights.normalised(&convolution, &batch_norm, KernelOrder::OutputFirst);
            down.push(Convolution::new(&folded, 1 + i % 2, true, options)?);
        }
        let mut up = Vec::new();
        for i in [7, 9, 11] {
            let name = format!("cost_regularization.conv{i}");
            let (convolution, batch_norm) = (format!("{name}.0"), format!("{name}.1"));
            let folded = weights.normalised(&convolution, &batch_norm, KernelOrder::InputFirst);
            up.push(Convolution::new(&folded, 2, true, options)?);
        }
        let prob = Convolution::new(&weights.biased("cost_regularization.prob"), 1, false, options)?;
        Ok(Self { down, up, prob })
    }

    /// `[1, 32, D, H, W]` to `[D, H, W]`. Takes the volume, so that it is freed after the first layer.
    pub(crate) fn apply(&self, volume: Tensor) -> Result<Tensor, TchError> {
        let mut x = self.down[0].apply(&volume)?;
        drop(volume);
        let mut skips = Vec::new();
        for pair in self.down[1..].chunks_exact(2) {
            let smaller = pair[0].apply(&x)?;
            skips.push(x);
            x = pair[1].apply(&smaller)?;
        }
        for layer in &self.up {
            let skip = skips.pop().expect("one skip for each step down");
            x = layer.apply_transposed(&x, &skip.size()[2..])?.f_add_(&skip)?;
        }
        self.prob.apply(&x)?.f_squeeze_dim(0)?.f_squeeze_dim(0)
    }
}
