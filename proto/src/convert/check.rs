//! The checks that every message shares.

use std::collections::BTreeMap;

use planesweep_plan::{Attempt, BlobKey, JobId};
use planesweep_scene::{CameraError, HypothesesError};
use thiserror::Error;

use crate::limits::{MAX_MEASUREMENTS, MAX_NAME_BYTES};

/// Why a message is refused.
#[derive(Debug, Error, PartialEq)]
pub enum WireError {
    /// The bytes are no such message.
    #[error("bytes of a {message} do not decode: {reason}")]
    Undecodable {
        /// Which message.
        message: &'static str,
        /// What the decoder says.
        reason: String,
    },
    /// A field that must be there is not.
    #[error("{field} is missing")]
    Missing {
        /// The field.
        field: &'static str,
    },
    /// A hash does not have 32 bytes.
    #[error("{field} has {got} bytes, a hash has 32")]
    HashLength {
        /// The field.
        field: &'static str,
        /// Bytes there are.
        got: usize,
    },
    /// A list has the wrong number of values.
    #[error("{field} has {got} values instead of {expected}")]
    WrongCount {
        /// The field.
        field: &'static str,
        /// Values there are.
        got: usize,
        /// Values there should be.
        expected: usize,
    },
    /// A list is over its limit.
    #[error("{field} has {got} values, more than {limit}")]
    TooMany {
        /// The field.
        field: &'static str,
        /// Values there are.
        got: usize,
        /// Values there may be.
        limit: usize,
    },
    /// A text is over its limit.
    #[error("{field} has {got} bytes, more than {limit}")]
    TooLong {
        /// The field.
        field: &'static str,
        /// Bytes there are.
        got: usize,
        /// Bytes there may be.
        limit: usize,
    },
    /// A text is empty or holds control characters.
    #[error("{field} is empty or holds control characters: {text:?}")]
    BadText {
        /// The field.
        field: &'static str,
        /// The text.
        text: String,
    },
    /// A number is NaN, infinite or outside its range.
    #[error("{field} is {value}, which is not {expected}")]
    BadNumber {
        /// The field.
        field: &'static str,
        /// The number.
        value: f64,
        /// What it should be.
        expected: &'static str,
    },
    /// An enumeration has a value that this build does not know.
    #[error("{field} has the unknown value {value}")]
    UnknownValue {
        /// The field.
        field: &'static str,
        /// The value.
        value: i32,
    },
    /// A camera is refused.
    #[error("camera of view {view} is refused")]
    Camera {
        /// The view.
        view: u32,
        /// Why.
        #[source]
        source: CameraError,
    },
    /// Depth hypotheses are refused.
    #[error("depth hypotheses are refused")]
    Hypotheses {
        /// Why.
        #[from]
        source: HypothesesError,
    },
}

pub(super) fn hash(field: &'static str, bytes: &[u8]) -> Result<[u8; 32], WireError> {
    bytes.try_into().map_err(|_| WireError::HashLength { field, got: bytes.len() })
}

pub(super) fn job_id(field: &'static str, bytes: &[u8]) -> Result<JobId, WireError> {
    hash(field, bytes).map(JobId)
}

pub(super) fn blob_key(field: &'static str, bytes: &[u8]) -> Result<BlobKey, WireError> {
    hash(field, bytes).map(BlobKey)
}

/// An attempt that was granted; they count from 1.
pub(super) fn attempt(value: u32) -> Result<Attempt, WireError> {
    in_range("attempt", value, 1, u32::MAX).map(Attempt)
}

pub(super) fn required<T>(field: &'static str, value: Option<T>) -> Result<T, WireError> {
    value.ok_or(WireError::Missing { field })
}

pub(super) fn at_most(field: &'static str, got: usize, limit: usize) -> Result<(), WireError> {
    if got > limit { Err(WireError::TooMany { field, got, limit }) } else { Ok(()) }
}

pub(super) fn short(field: &'static str, text: String, limit: usize) -> Result<String, WireError> {
    if text.len() > limit { Err(WireError::TooLong { field, got: text.len(), limit }) } else { Ok(text) }
}

/// A text for one line: not empty, without control characters.
pub(super) fn name(field: &'static str, text: String) -> Result<String, WireError> {
    let text = optional_name(field, text)?;
    if text.is_empty() { Err(WireError::BadText { field, text }) } else { Ok(text) }
}

/// As [`name`], but may be empty.
pub(super) fn optional_name(field: &'static str, text: String) -> Result<String, WireError> {
    let text = short(field, text, MAX_NAME_BYTES)?;
    if text.chars().any(char::is_control) { Err(WireError::BadText { field, text }) } else { Ok(text) }
}

pub(super) fn in_range(field: &'static str, value: u32, min: u32, max: u32) -> Result<u32, WireError> {
    if (min..=max).contains(&value) {
        Ok(value)
    } else {
        Err(WireError::BadNumber { field, value: value.into(), expected: "within its limits" })
    }
}

pub(super) fn finite(field: &'static str, value: f64) -> Result<f64, WireError> {
    if value.is_finite() { Ok(value) } else { Err(WireError::BadNumber { field, value, expected: "finite" }) }
}

pub(super) fn not_negative(field: &'static str, value: f64) -> Result<f64, WireError> {
    if value.is_finite() && value >= 0.0 {
        Ok(value)
    } else {
        Err(WireError::BadNumber { field, value, expected: "finite and at least 0" })
    }
}

pub(super) fn measurements(values: BTreeMap<String, f64>) -> Result<BTreeMap<String, f64>, WireError> {
    at_most("measurements", values.len(), MAX_MEASUREMENTS)?;
    values
        .into_iter()
        .map(|(key, value)| Ok((name("measurement", key)?, finite("measurement", value)?)))
        .collect()
}

pub(super) fn each<W, D>(
    values: Vec<W>,
    convert: impl FnMut(W) -> Result<D, WireError>,
) -> Result<Vec<D>, WireError> {
    values.into_iter().map(convert).collect()
}
