//! The names and shapes of the network's tensors: those of the public PyTorch checkpoints.

use std::collections::BTreeMap;

use super::{FeatureNetwork, Refinement, WeightTensor, WeightsError, WeightsMetadata};

/// Statistics and affine parameters of a batch normalisation, each with one value per channel.
const BATCH_NORM: [&str; 4] = ["weight", "bias", "running_mean", "running_var"];

/// Every tensor of a network that is made so, by name.
pub(crate) fn tensors(metadata: &WeightsMetadata) -> BTreeMap<String, Vec<usize>> {
    let refinement = metadata.refinement;
    let mut layout = Layout(BTreeMap::new());
    // Section 3.1: output channels, input channels, kernel size.
    match metadata.features {
        FeatureNetwork::Paper => {
            for (i, (o, c, k)) in
                [(8, 3, 3), (8, 8, 3), (16, 8, 5), (16, 16, 3), (16, 16, 3), (32, 16, 5), (32, 32, 3)]
                    .into_iter()
                    .enumerate()
            {
                let (convolution, batch_norm) =
                    (format!("feature.conv{i}.conv"), format!("feature.conv{i}.bn"));
                layout.normalised(&convolution, &batch_norm, o, &[o, c, k, k]);
            }
            layout.biased("feature.feature", 32, &[32, 32, 3, 3]);
        }
        FeatureNetwork::SingleLayer => layout.biased("feature.feature", 32, &[32, 3, 7, 7]),
    }
    // Section 3.2, regularisation: down the four scales, then up again, transposed (input channels first).
    for (i, (o, c)) in
        [(8, 32), (16, 8), (16, 16), (32, 16), (32, 32), (64, 32), (64, 64)].into_iter().enumerate()
    {
        let name = format!("cost_regularization.conv{i}");
        layout.normalised(&format!("{name}.conv"), &format!("{name}.bn"), o, &[o, c, 3, 3, 3]);
    }
    for (i, c, o) in [(7, 64, 32), (9, 32, 16), (11, 16, 8)] {
        let name = format!("cost_regularization.conv{i}");
        layout.normalised(&format!("{name}.0"), &format!("{name}.1"), o, &[c, o, 3, 3, 3]);
    }
    layout.biased("cost_regularization.prob", 1, &[1, 8, 3, 3, 3]);
    // Section 3.3, refinement.
    if refinement != Refinement::None {
        for (i, c) in [(1, 4), (2, 32), (3, 32)] {
            let name = format!("refine_network.conv{i}");
            layout.normalised(&format!("{name}.conv"), &format!("{name}.bn"), 32, &[32, c, 3, 3]);
        }
    }
    match refinement {
        Refinement::None => {}
        Refinement::Paper => layout.biased("refine_network.res", 1, &[1, 32, 3, 3]),
        Refinement::WithBnRelu => {
            layout.normalised("refine_network.res.conv", "refine_network.res.bn", 1, &[1, 32, 3, 3]);
        }
    }
    layout.0
}

struct Layout(BTreeMap<String, Vec<usize>>);

impl Layout {
    fn normalised(&mut self, convolution: &str, batch_norm: &str, channels: usize, shape: &[usize]) {
        self.0.insert(format!("{convolution}.weight"), shape.to_vec());
        for part in BATCH_NORM {
            self.0.insert(format!("{batch_norm}.{part}"), vec![channels]);
        }
    }

    fn biased(&mut self, convolution: &str, channels: usize, shape: &[usize]) {
        self.0.insert(format!("{convolution}.weight"), shape.to_vec());
        self.0.insert(format!("{convolution}.bias"), vec![channels]);
    }
}

/// Which refinement network these tensors are for.
pub(super) fn refinement_of(tensors: &BTreeMap<String, WeightTensor>) -> Refinement {
    if tensors.contains_key("refine_network.res.conv.weight") {
        Refinement::WithBnRelu
    } else if tensors.contains_key("refine_network.res.weight") {
        Refinement::Paper
    } else {
        Refinement::None
    }
}

/// Checks that the tensors are those of the network, each with its shape and finite values.
pub(super) fn check(
    metadata: &WeightsMetadata,
    tensors: &BTreeMap<String, WeightTensor>,
) -> Result<(), WeightsError> {
    let expected = self::tensors(metadata);
    if let Some(name) = tensors.keys().find(|name| !expected.contains_key(*name)) {
        return Err(WeightsError::UnknownTensor { name: name.clone() });
    }
    for (name, shape) in expected {
        let Some(tensor) = tensors.get(&name) else { return Err(WeightsError::MissingTensor { name }) };
        if tensor.shape != shape || tensor.values.len() != shape.iter().product::<usize>() {
            return Err(WeightsError::WrongShape { name, expected: shape, got: tensor.shape.clone() });
        }
        if let Some(value) = tensor.values.iter().find(|value| !value.is_finite()) {
            return Err(WeightsError::BadValue { name, value: *value });
        }
        if let Some(value) = tensor.values.iter().find(|value| name.ends_with("running_var") && **value < 0.0)
        {
            return Err(WeightsError::BadValue { name, value: *value });
        }
    }
    Ok(())
}
