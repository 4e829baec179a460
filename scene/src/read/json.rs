//! Numbers out of JSON objects, and what is missing there.

use std::path::Path;

use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

use super::{ReadError, read_bytes};

/// The contents of a JSON file; an error names the line.
pub(super) fn json_at<T: DeserializeOwned>(path: &Path) -> Result<T, ReadError> {
    serde_json::from_slice(&read_bytes(path)?).map_err(|error| ReadError::Text {
        path: path.to_owned(),
        line: error.line(),
        what: error.to_string(),
    })
}

/// A number that must be there. The error continues "object so-and-so ...".
pub(super) fn number(object: &Map<String, Value>, key: &str) -> Result<f64, String> {
    object.get(key).and_then(Value::as_f64).ok_or_else(|| format!("without the number {key:?}"))
}

/// An array of so many numbers that must be there.
pub(super) fn numbers<const N: usize>(object: &Map<String, Value>, key: &str) -> Result<[f64; N], String> {
    let values: Option<Vec<f64>> =
        object.get(key).and_then(Value::as_array).and_then(|a| a.iter().map(Value::as_f64).collect());
    let values = values.and_then(|values| values.try_into().ok());
    values.ok_or_else(|| format!("without the {N} numbers {key:?}"))
}
