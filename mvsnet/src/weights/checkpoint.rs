//! PyTorch checkpoints, of the zip format and of the one before it, to named tensors.

use std::collections::BTreeMap;
use std::io::{Cursor, Read};

use half::{bf16, f16};
use thiserror::Error;
use zip::{CompressionMethod, ZipArchive};

use super::WeightTensor;
use super::pickle::{ElementType, Pickle, PickleError, Storage, TensorRef, Value};

/// First number of a checkpoint before the zip format.
const LEGACY_MAGIC: i128 = 0x1950_a86a_20f9_469c_fc6c;
const LEGACY_PROTOCOL: i128 = 1001;
/// Fifty times the network; a tensor of stride zero may claim any size.
const MAX_ELEMENTS: usize = 1 << 24;

/// Why a PyTorch checkpoint is refused.
#[derive(Debug, Error)]
pub enum CheckpointError {
    /// Its description of tensors is refused.
    #[error("refused the description of its tensors")]
    Pickle(#[from] PickleError),
    /// The zip archive is damaged.
    #[error("the zip archive is damaged")]
    Zip(#[from] zip::result::ZipError),
    /// It is no PyTorch checkpoint.
    #[error("not a PyTorch checkpoint: {what}")]
    NotACheckpoint {
        /// What gives it away.
        what: &'static str,
    },
    /// It holds no dictionary of named tensors.
    #[error("found no dictionary of named tensors, nor one under \"model\" or \"state_dict\"")]
    NoTensors,
    /// The elements of a tensor are missing or do not fit its description.
    #[error("tensor \"{name}\": {what}")]
    Tensor {
        /// The tensor.
        name: String,
        /// What is wrong.
        what: &'static str,
    },
    /// A block of elements is cut short or missing.
    #[error("storage \"{key}\" should hold {expected} bytes and does not")]
    Storage {
        /// Its key in the checkpoint.
        key: String,
        /// Bytes expected.
        expected: usize,
    },
}

/// Whether the bytes begin as a zip archive or as a pickle of protocol 2 do.
pub(super) fn looks_like_one(bytes: &[u8]) -> bool {
    bytes.starts_with(b"PK\x03\x04") || bytes.starts_with(&[0x80, 2])
}

/// Reads a checkpoint's network: names without the prefix `module.`, without the optimiser and without
/// the batch counters of batch normalisation.
pub(super) fn read(bytes: &[u8]) -> Result<BTreeMap<String, WeightTensor>, CheckpointError> {
    let (pickle, storages) = if bytes.starts_with(b"PK") { read_zip(bytes)? } else { read_legacy(bytes)? };
    let mut tensors = BTreeMap::new();
    for (name, tensor) in state_dict(&pickle)? {
        let refuse = |what| CheckpointError::Tensor { name: name.to_owned(), what };
        let storage = pickle.storages[&tensor.storage];
        let elements = storages.get(&*tensor.storage).ok_or_else(|| refuse("its elements are missing"))?;
        let tensor = gather(tensor, storage, elements).map_err(refuse)?;
        if tensors.insert(name.to_owned(), tensor).is_some() {
            return Err(refuse("is there twice"));
        }
    }
    Ok(tensors)
}

/// The tensors of the network by name.
fn state_dict(pickle: &Pickle) -> Result<Vec<(&str, &TensorRef)>, CheckpointError> {
    let nested = ["model", "state_dict"].iter().find_map(|key| pickle.get(&pickle.root, key));
    let entries = pickle.entries(nested.unwrap_or(&pickle.root)).ok_or(CheckpointError::NoTensors)?;
    let tensors: Vec<_> = entries
        .filter_map(|(name, value)| match value {
            Value::Tensor(tensor) => Some((name.strip_prefix("module.").unwrap_or(name), &**tensor)),
            _ => None,
        })
        .filter(|(name, _)| !name.ends_with("num_batches_tracked"))
        .collect();
    if tensors.is_empty() { Err(CheckpointError::NoTensors) } else { Ok(tensors) }
}

type Storages<'a> = BTreeMap<String, std::borrow::Cow<'a, [u8]>>;

/// Pickles one after another (magic number, protocol, the writer's machine, the object, the keys of the
/// storages), then each storage: its length as an i64, its elements.
fn read_legacy(bytes: &[u8]) -> Result<(Pickle, Storages<'_>), CheckpointError> {
    let mut rest = bytes;
    let mut next = || -> Result<Pickle, PickleError> {
        let pickle = Pickle::read(rest)?;
        rest = &rest[pickle.bytes..];
        Ok(pickle)
    };
    let not = |what| CheckpointError::NotACheckpoint { what };
    match next() {
        Ok(magic) if magic.root == Value::Int(LEGACY_MAGIC) => {}
        Err(code @ PickleError::Forbidden { .. }) => return Err(code.into()),
        _ => return Err(not("neither a zip archive nor the older format's magic number")),
    }
    if next()?.root != Value::Int(LEGACY_PROTOCOL) {
        return Err(not("the protocol is not 1001"));
    }
    let machine = next()?;
    if machine.get(&machine.root, "little_endian") != Some(&Value::Bool(true)) {
        return Err(not("it was not written on a little-endian machine"));
    }
    let object = next()?;
    let keys = next()?;
    let mut storages = Storages::new();
    for key in keys.sequence(&keys.root).ok_or_else(|| not("the list of storages is missing"))? {
        let Value::Str(key) = key else { return Err(not("the key of a storage is no string")) };
        let storage = object.storages.get(key).ok_or_else(|| not("a storage belongs to no tensor"))?;
        let expected = storage_bytes(key, *storage)?;
        let cut = || CheckpointError::Storage { key: key.to_string(), expected };
        let (len, elements) = rest.split_first_chunk::<8>().ok_or_else(cut)?;
        if i64::from_le_bytes(*len) != storage.len as i64 || elements.len() < expected {
            return Err(cut());
        }
        let (elements, after) = elements.split_at(expected);
        storages.insert(key.to_string(), elements.into());
        rest = after;
    }
    Ok((object, storages))
}

/// `NAME/data.pkl` and uncompressed `NAME/data/KEY`, with any folder NAME.
fn read_zip(bytes: &[u8]) -> Result<(Pickle, Storages<'_>), CheckpointError> {
    let not = |what| CheckpointError::NotACheckpoint { what };
    let mut archive = ZipArchive::new(Cursor::new(bytes))?;
    let mut description = None;
    for index in 0..archive.len() {
        let entry = archive.by_index(index)?;
        if let Some(folder) = entry.name()?.strip_suffix("data.pkl") {
            description = Some(folder.to_owned());
        }
    }
    let folder = description.ok_or_else(|| not("the zip archive holds no data.pkl"))?;
    let mut entry = |name: &str, expected: Option<usize>| -> Result<Vec<u8>, CheckpointError> {
        let entry = archive.by_name(&format!("{folder}{name}"))?;
        // Stored entries cannot be larger than the file, so no length is taken on trust.
        if entry.compression() != CompressionMethod::Stored {
            return Err(not("an entry of the zip archive is compressed"));
        }
        if let Some(expected) = expected.filter(|expected| entry.size() != *expected as u64) {
            return Err(CheckpointError::Storage { key: name.to_owned(), expected });
        }
        let mut content = Vec::new();
        entry.take(bytes.len() as u64).read_to_end(&mut content).map_err(zip::result::ZipError::Io)?;
        Ok(content)
    };
    if entry("byteorder", None).is_ok_and(|order| order != b"little") {
        return Err(not("it was not written on a little-endian machine"));
    }
    let object = Pickle::read(&entry("data.pkl", None)?)?;
    let mut storages = Storages::new();
    let mut left = bytes.len();
    for (key, storage) in &object.storages {
        let expected = storage_bytes(key, *storage)?;
        // Entries of a hostile archive may share bytes, so that all together are larger than the file.
        let cut = || CheckpointError::Storage { key: key.to_string(), expected };
        left = left.checked_sub(expected).ok_or_else(cut)?;
        let elements = entry(&format!("data/{key}"), Some(expected))?;
        storages.insert(key.to_string(), elements.into());
    }
    Ok((object, storages))
}

fn storage_bytes(key: &str, storage: Storage) -> Result<usize, CheckpointError> {
    let bytes = storage.len.checked_mul(storage.element.bytes());
    bytes.ok_or_else(|| CheckpointError::Storage { key: key.to_owned(), expected: usize::MAX })
}

/// The elements of a tensor in row-major order.
fn gather(tensor: &TensorRef, storage: Storage, bytes: &[u8]) -> Result<WeightTensor, &'static str> {
    if tensor.shape.len() != tensor.strides.len() {
        return Err("its strides do not match its shape");
    }
    let len = tensor.shape.iter().try_fold(1usize, |product, size| product.checked_mul(*size));
    let len = len.filter(|len| *len <= MAX_ELEMENTS).ok_or("it is too large")?;
    let last = tensor.shape.iter().zip(&tensor.strides).try_fold(tensor.offset, |at, (size, stride)| {
        size.saturating_sub(1).checked_mul(*stride).and_then(|step| at.checked_add(step))
    });
    if len > 0 && last.is_none_or(|last| last >= storage.len) {
        return Err("it reaches beyond its elements");
    }
    let element: fn(&[u8]) -> f32 = match storage.element {
        ElementType::F32 => |b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]),
        ElementType::F64 => |b| f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]]) as f32,
        ElementType::F16 => |b| f16::from_le_bytes([b[0], b[1]]).to_f32(),
        ElementType::Bf16 => |b| bf16::from_le_bytes([b[0], b[1]]).to_f32(),
        ElementType::Integer(_) => return Err("its elements are integers"),
    };
    let size = storage.element.bytes();
    let mut index = vec![0; tensor.shape.len()];
    let mut values = Vec::with_capacity(len);
    for _ in 0..len {
        let at =
            tensor.offset + index.iter().zip(&tensor.strides).map(|(i, stride)| i * stride).sum::<usize>();
        values.push(element(&bytes[at * size..(at + 1) * size]));
        for (i, size) in index.iter_mut().zip(&tensor.shape).rev() {
            *i += 1;
            if *i < *size {
                break;
            }
            *i = 0;
        }
    }
    Ok(WeightTensor { shape: tensor.shape.clone(), values })
}

#[cfg(test)]
mod tests {
    use super::*;

    // Made by tests/golden/make_checkpoints.py.
    const LEGACY: &[u8] = include_bytes!("../../tests/golden/legacy.ckpt");
    const ZIP: &[u8] = include_bytes!("../../tests/golden/zip.ckpt");
    const CODE: &[u8] = include_bytes!("../../tests/golden/code.ckpt");

    #[test]
    fn both_formats_give_the_network_without_prefix_optimiser_and_counters() {
        for bytes in [LEGACY, ZIP] {
            let tensors = read(bytes).expect("a checkpoint");
            let tensor = |name: &str| (tensors[name].shape.as_slice(), tensors[name].values.as_slice());
            assert_eq!(tensors.keys().collect::<Vec<_>>(), ["double", "half", "part", "plain", "transposed"]);
            assert_eq!(tensor("plain"), (&[2, 3][..], &[0.0, 1.0, 2.0, 3.0, 4.0, 5.0][..]));
            assert_eq!(tensor("transposed"), (&[3, 2][..], &[0.0, 3.0, 1.0, 4.0, 2.0, 5.0][..]));
            assert_eq!(tensor("part"), (&[2][..], &[2.0, 3.0][..]));
            assert_eq!(tensor("half"), (&[2][..], &[0.5, -2.0][..]));
            assert_eq!(tensor("double"), (&[1][..], &[0.25][..]));
        }
    }

    #[test]
    fn code_in_a_checkpoint_is_refused_by_name() {
        let error = read(CODE).expect_err("code");
        assert!(
            matches!(&error, CheckpointError::Pickle(PickleError::Forbidden { name, .. }) if name == "posix.system"),
            "{error:?}"
        );
    }

    #[test]
    fn truncated_checkpoints_are_refused_wherever_they_end() {
        for bytes in [LEGACY, ZIP] {
            for len in (0..bytes.len()).step_by(7) {
                assert!(read(&bytes[..len]).is_err(), "{len} of {} bytes", bytes.len());
            }
        }
        let error = read(&LEGACY[..LEGACY.len() - 1]).expect_err("a byte is missing");
        assert!(matches!(error, CheckpointError::Storage { .. }), "{error:?}");
    }

    #[test]
    fn damaged_bytes_do_not_panic() {
        for bytes in [LEGACY, ZIP] {
            for at in 0..bytes.len() {
                let mut damaged = bytes.to_vec();
                damaged[at] ^= 0x5a;
                let _ = read(&damaged);
            }
        }
    }

    #[test]
    fn tensors_beyond_their_storage_are_refused() {
        let storage = Storage { element: ElementType::F32, len: 6 };
        let view = |offset, shape: &[usize], strides: &[usize]| {
            let tensor =
                TensorRef { storage: "0".into(), offset, shape: shape.to_vec(), strides: strides.to_vec() };
            gather(&tensor, storage, &[0; 24]).map(|tensor| tensor.values.len())
        };
        assert_eq!(view(0, &[2, 3], &[3, 1]), Ok(6));
        assert_eq!(view(1, &[2, 3], &[3, 1]), Err("it reaches beyond its elements"));
        assert_eq!(view(0, &[2], &[usize::MAX]), Err("it reaches beyond its elements"));
        assert_eq!(view(0, &[usize::MAX, 2], &[0, 0]), Err("it is too large"));
        assert_eq!(view(0, &[1 << 30], &[0]), Err("it is too large"));
        assert_eq!(view(0, &[2, 3], &[1]), Err("its strides do not match its shape"));
        assert_eq!(view(9, &[0], &[1]), Ok(0));
    }

    #[test]
    fn other_files_are_told_apart() {
        assert!(matches!(read(b"\x89PNG\r\n"), Err(CheckpointError::NotACheckpoint { .. })));
        assert!(matches!(read(b""), Err(CheckpointError::NotACheckpoint { .. })));
        assert!(matches!(read(b"PK\x03\x04"), Err(CheckpointError::Zip(_))));
        let code = read(b"\x80\x02cposix\nsystem\n.");
        assert!(matches!(code, Err(CheckpointError::Pickle(PickleError::Forbidden { .. }))));
    }
}
