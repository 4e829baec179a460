//! Depth map refinement (paper section 3.3): a residual guided by the reference image.

use tch::{Device, Kind, TchError, Tensor};

use crate::convolution::Convolution;
use crate::weights::KernelOrder;
use crate::{Refinement, Weights};

/// Adds a residual to a depth map that is scaled to [0, 1].
#[derive(Debug)]
pub(crate) struct RefinementNet {
    layers: Vec<Convolution>,
}

impl RefinementNet {
    /// `None` when the weights have no refinement network.
    pub(crate) fn new(weights: &Weights, options: (Kind, Device)) -> Result<Option<Self>, TchError> {
        let normalised = |name: &str| {
            let (convolution, batch_norm) =
                (format!("refine_network.{name}.conv"), format!("refine_network.{name}.bn"));
            let folded = weights.normalised(&convolution, &batch_norm, KernelOrder::OutputFirst);
            Convolution::new(&folded, 1, true, options)
        };
        let last = match weights.metadata().refinement {
            Refinement::None => return Ok(None),
            Refinement::Paper => Convolution::new(&weights.biased("refine_network.res"), 1, false, options)?,
            Refinement::WithBnRelu => normalised("res")?,
        };
        let layers = vec![normalised("conv1")?, normalised("conv2")?, normalised("conv3")?, last];
        Ok(Some(Self { layers }))
    }

    /// Refines `[H, W]` with an image `[1, 3, 4H, 4W]`, normalised as for the features. Its colours are taken at
    /// every fourth pixel, on which depth pixels are centred; channels are red, green, blue, depth.
    pub(crate) fn apply(&self, scaled_depth: &Tensor, image: &Tensor) -> Result<Tensor, TchError> {
        let guide = image.f_slice(2, None, None, 4)?.f_slice(3, None, None, 4)?;
        let depth = scaled_depth.f_to_kind(image.kind())?.f_unsqueeze(0)?.f_unsqueeze(0)?;
        let input = Tensor::f_cat(&[guide, depth], 1)?;
        let residual = self.layers.iter().try_fold(input, |x, layer| layer.apply(&x))?;
        scaled_depth.f_add(&residual.f_squeeze_dim(0)?.f_squeeze_dim(0)?)
    }
}
