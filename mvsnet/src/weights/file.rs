//! Weights as one safetensors file, the metadata in its header.

use std::collections::{BTreeMap, HashMap};

use safetensors::tensor::{Dtype, Metadata, TensorView, serialize};

use super::{WeightTensor, Weights, WeightsError, WeightsMetadata};

/// Key of the header's metadata; its value is JSON. One key only, because the order of several would vary.
const METADATA_KEY: &str = "planesweep-mvsnet";
/// The header of the largest network is 12 KiB.
const MAX_HEADER_BYTES: u64 = 1 << 20;

impl Weights {
    /// The safetensors file. The same weights always give the same bytes.
    ///
    /// # Panics
    /// Never: names and sizes were checked when the weights were made.
    pub fn to_bytes(&self) -> Vec<u8> {
        let metadata = serde_json::to_string(&self.metadata).expect("metadata has only strings and numbers");
        let bytes: BTreeMap<&str, Vec<u8>> = self
            .tensors
            .iter()
            .map(|(name, tensor)| {
                (name.as_str(), tensor.values.iter().flat_map(|v| v.to_le_bytes()).collect())
            })
            .collect();
        let views = bytes.iter().map(|(name, bytes)| {
            let shape = self.tensors[*name].shape.clone();
            (*name, TensorView::new(Dtype::F32, shape, bytes).expect("the shape was checked"))
        });
        serialize(views, Some(HashMap::from([(METADATA_KEY.to_owned(), metadata)])))
            .expect("names and sizes of the network fit a header")
    }

    /// Reads a safetensors file and checks every tensor against the network.
    pub fn from_bytes(bytes: &[u8]) -> Result<Self, WeightsError> {
        let (header, data) = split(bytes)?;
        let header: Metadata =
            serde_json::from_slice(header).map_err(|source| WeightsError::Header { source })?;
        let text = header.metadata().as_ref().and_then(|entries| entries.get(METADATA_KEY));
        let metadata: WeightsMetadata = serde_json::from_str(text.ok_or(WeightsError::NoMetadata)?)
            .map_err(|source| WeightsError::Metadata { source })?;
        let mut tensors = BTreeMap::new();
        let mut end = 0;
        for (name, info) in header.tensors() {
            let dtype = info.dtype;
            if dtype != Dtype::F32 {
                return Err(WeightsError::WrongType { name, dtype: format!("{dtype:?}") });
            }
            let (from, to) = info.data_offsets;
            let Some(values) = data.get(from..to) else {
                return Err(WeightsError::Truncated { name, expected: to, got: data.len() });
            };
            end = end.max(to);
            let values =
                values.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
            tensors.insert(name, WeightTensor { shape: info.shape.clone(), values });
        }
        if end < data.len() {
            return Err(WeightsError::TrailingBytes { count: data.len() - end });
        }
        Self::new(metadata, tensors)
    }
}

/// Header and data of a safetensors file.
fn split(bytes: &[u8]) -> Result<(&[u8], &[u8]), WeightsError> {
    let (len, rest) = bytes.split_first_chunk::<8>().ok_or(WeightsError::NotSafetensors)?;
    let len = u64::from_le_bytes(*len);
    if len > MAX_HEADER_BYTES {
        if super::checkpoint::looks_like_one(bytes) {
            return Err(WeightsError::PyTorchCheckpoint);
        }
        return Err(WeightsError::HugeHeader { bytes: len, limit: MAX_HEADER_BYTES });
    }
    rest.split_at_checked(len as usize).ok_or(WeightsError::NotSafetensors)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights::{FeatureNetwork, Refinement};

    fn weights() -> Weights {
        Weights::seeded(WeightsMetadata::untrained(Refinement::Paper), 7)
    }

    /// The file with its header replaced by `edit` of it.
    fn with_header(edit: impl FnOnce(&mut serde_json::Value)) -> Vec<u8> {
        let bytes = weights().to_bytes();
        let (header, data) = split(&bytes).expect("a whole file");
        let mut header = serde_json::from_slice(header).expect("JSON");
        edit(&mut header);
        let header = header.to_string();
        [&(header.len() as u64).to_le_bytes(), header.as_bytes(), data].concat()
    }

    #[test]
    fn files_name_a_feature_network_only_when_it_is_not_the_papers() {
        let of = |features| {
            let metadata = WeightsMetadata { features, ..WeightsMetadata::untrained(Refinement::None) };
            Weights::seeded(metadata, 7)
        };
        for (features, named) in [(FeatureNetwork::Paper, false), (FeatureNetwork::SingleLayer, true)] {
            let bytes = of(features).to_bytes();
            assert_eq!(String::from_utf8_lossy(&bytes).contains("single-layer"), named);
            assert_eq!(Weights::from_bytes(&bytes).expect("own file"), of(features));
        }
    }

    #[test]
    fn weights_survive_the_file_and_its_bytes_are_the_same_each_time() {
        let weights = weights();
        let bytes = weights.to_bytes();
        assert_eq!(Weights::from_bytes(&bytes).expect("own file"), weights);
        assert_eq!(weights.clone().to_bytes(), bytes);
    }

    #[test]
    fn truncated_file_names_the_tensor() {
        let bytes = weights().to_bytes();
        let error = Weights::from_bytes(&bytes[..bytes.len() - 1]).expect_err("a byte is missing");
        assert!(
            matches!(&error, WeightsError::Truncated { name, .. } if name.contains("refine_network")),
            "{error}"
        );
        for len in [0, 7, 8, 100] {
            assert!(matches!(Weights::from_bytes(&bytes[..len]), Err(WeightsError::NotSafetensors)));
        }
        let error = Weights::from_bytes(&[&bytes[..], b"more"].concat()).expect_err("bytes follow");
        assert!(matches!(error, WeightsError::TrailingBytes { count: 4 }));
    }

    #[test]
    fn huge_header_is_refused_before_it_is_read() {
        let mut bytes = weights().to_bytes();
        bytes[..8].copy_from_slice(&(1u64 << 62).to_le_bytes());
        assert!(
            matches!(Weights::from_bytes(&bytes), Err(WeightsError::HugeHeader { bytes, .. }) if bytes == 1 << 62)
        );
    }

    #[test]
    fn checkpoints_are_recognised_and_their_import_is_named() {
        for bytes in [b"PK\x03\x04\0\0\x08\x08\0\0".as_slice(), b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19."] {
            let error = Weights::from_bytes(bytes).expect_err("a checkpoint");
            assert!(matches!(error, WeightsError::PyTorchCheckpoint), "{error}");
            assert!(error.to_string().contains("weights import"), "{error}");
        }
    }

    #[test]
    fn wrong_shape_is_refused_and_named() {
        let bytes = with_header(|header| {
            header["cost_regularization.prob.weight"]["shape"] = serde_json::json!([8, 1, 3, 3, 3]);
        });
        let error = Weights::from_bytes(&bytes).expect_err("channels swapped");
        assert_eq!(
            error.to_string(),
            "tensor \"cost_regularization.prob.weight\" has shape [8, 1, 3, 3, 3], the network needs [1, 8, 3, 3, 3]"
        );
    }

    #[test]
    fn missing_and_unknown_tensors_are_refused_and_named() {
        let rename = |header: &mut serde_json::Value| {
            let entry = header["feature.conv3.bn.bias"].take();
            let entries = header.as_object_mut().expect("an object");
            entries.remove("feature.conv3.bn.bias");
            entries.insert("feature.conv3.bn.beta".to_owned(), entry);
        };
        let error = Weights::from_bytes(&with_header(rename)).expect_err("an unknown name");
        assert!(matches!(error, WeightsError::UnknownTensor { name } if name == "feature.conv3.bn.beta"));

        let weights = weights();
        let mut tensors = weights.tensors.clone();
        tensors.remove("feature.conv3.bn.bias");
        let error = Weights::new(weights.metadata, tensors).expect_err("a tensor is missing");
        assert!(matches!(error, WeightsError::MissingTensor { name } if name == "feature.conv3.bn.bias"));
    }

    #[test]
    fn header_that_lies_is_refused() {
        let far = with_header(|header| {
            header["feature.feature.bias"]["data_offsets"] = serde_json::json!([0, u64::MAX]);
        });
        assert!(matches!(Weights::from_bytes(&far), Err(WeightsError::Header { .. })));
        let untold = with_header(|header| {
            header.as_object_mut().expect("an object").remove("__metadata__");
        });
        assert!(matches!(Weights::from_bytes(&untold), Err(WeightsError::NoMetadata)));
    }

    #[test]
    fn values_that_are_no_numbers_are_refused_and_named() {
        let weights = weights();
        for (name, value) in [("feature.feature.bias", f32::NAN), ("feature.conv0.bn.running_var", -1.0)] {
            let mut tensors = weights.tensors.clone();
            tensors.get_mut(name).expect("a tensor of the network").values[3] = value;
            let error = Weights::new(weights.metadata.clone(), tensors).expect_err("a bad value");
            assert!(matches!(error, WeightsError::BadValue { name: n, .. } if n == name));
        }
    }
}
