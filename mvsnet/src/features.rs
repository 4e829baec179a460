//! Image features (paper section 3.1): eight layers of convolution, or one, shared by all views.

use tch::{Device, Kind, TchError, Tensor};

use crate::convolution::Convolution;
use crate::weights::KernelOrder;
use crate::{FeatureNetwork, Weights};

/// Strides of the layers that batch normalisation follows.
const STRIDES: [i64; 7] = [1, 1, 2, 1, 1, 2, 1];

/// Maps an image to features of 32 channels at a quarter of its size; pixel `u` is centred on image pixel `4u`.
#[derive(Debug)]
pub(crate) struct FeatureNet {
    layers: Vec<Convolution>,
}

impl FeatureNet {
    pub(crate) fn new(weights: &Weights, options: (Kind, Device)) -> Result<Self, TchError> {
        let last = weights.biased("feature.feature");
        if weights.metadata().features == FeatureNetwork::SingleLayer {
            return Ok(Self { layers: vec![Convolution::new(&last, 4, false, options)?] });
        }
        let mut layers = Vec::new();
        for (i, stride) in STRIDES.into_iter().enumerate() {
            let (convolution, batch_norm) = (format!("feature.conv{i}.conv"), format!("feature.conv{i}.bn"));
            let folded = weights.normalised(&convolution, &batch_norm, KernelOrder::OutputFirst);
            layers.push(Convolution::new(&folded, stride, true, options)?);
        }
        layers.push(Convolution::new(&last, 1, false, options)?);
        Ok(Self { layers })
    }

    /// `[1, 3, H, W]` to `[1, 32, H/4, W/4]`.
    pub(crate) fn apply(&self, image: &Tensor) -> Result<Tensor, TchError> {
        self.layers.iter().try_fold(image.shallow_clone(), |features, layer| layer.apply(&features))
    }
}
