//! The short list of errors that cross the wire, and back.

use std::fmt;

use bytes::Bytes;
use thiserror::Error;
use tonic::Status;

use crate::WireError;
use crate::credentials::certificate_trouble;

/// What kind of refusal it is; it survives the wire. Each has a gRPC code of its own, but for a full disk, which gRPC
/// does not tell from a message that is too large.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Code {
    /// The message breaks the contract.
    Invalid,
    /// No token, or a wrong one.
    Unauthenticated,
    /// The two sides are of different versions.
    VersionMismatch,
    /// There is no such run.
    NotFound,
    /// The message is over a limit.
    TooLarge,
    /// A newer report of the same worker was there first.
    Superseded,
    /// The other side cannot be reached, or is stopping.
    Unavailable,
    /// The disk under the store, or under the ledger, has no room left.
    DiskFull,
    /// The ledger or the server failed.
    Internal,
}

/// In the details of a status, and at the beginning of its message: the resource that is exhausted is a disk.
const DISK_FULL: &str = "disk full";

/// Proxies may drop the details; they leave the message.
fn says_disk_full(status: &Status) -> bool {
    status.details() == DISK_FULL.as_bytes() || status.message().starts_with(DISK_FULL)
}

impl Code {
    /// Whether the same call may succeed later.
    pub fn is_retryable(self) -> bool {
        matches!(self, Self::Superseded | Self::Unavailable | Self::DiskFull | Self::Internal)
    }
}

impl fmt::Display for Code {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Invalid => "invalid message",
            Self::Unauthenticated => "unauthenticated",
            Self::VersionMismatch => "version mismatch",
            Self::NotFound => "not found",
            Self::TooLarge => "message too large",
            Self::Superseded => "superseded",
            Self::Unavailable => "unavailable",
            Self::DiskFull => "no room",
            Self::Internal => "internal error",
        })
    }
}

/// Why a call failed.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{code}: {message}")]
pub struct ServiceError {
    /// The kind.
    pub code: Code,
    /// What was attempted, on which thing.
    pub message: String,
}

impl ServiceError {
    /// An error of this kind.
    pub fn new(code: Code, message: impl Into<String>) -> Self {
        Self { code, message: message.into() }
    }

    /// The disk under the store, or under the ledger, at this place has no room left.
    pub fn disk_full(place: impl fmt::Display, more: impl fmt::Display) -> Self {
        Self::new(Code::DiskFull, format!("{DISK_FULL} at {place}; {more}"))
    }

    /// Whether the same call may succeed later.
    pub fn is_retryable(&self) -> bool {
        self.code.is_retryable()
    }
}

impl From<WireError> for ServiceError {
    fn from(error: WireError) -> Self {
        let code = if matches!(error, WireError::TooMany { .. } | WireError::TooLong { .. }) {
            Code::TooLarge
        } else {
            Code::Invalid
        };
        Self::new(code, with_causes(&error))
    }
}

impl From<ServiceError> for Status {
    fn from(error: ServiceError) -> Self {
        let code = match error.code {
            Code::Invalid => tonic::Code::InvalidArgument,
            Code::Unauthenticated => tonic::Code::Unauthenticated,
            Code::VersionMismatch => tonic::Code::FailedPrecondition,
            Code::NotFound => tonic::Code::NotFound,
            Code::TooLarge | Code::DiskFull => tonic::Code::ResourceExhausted,
            Code::Superseded => tonic::Code::Aborted,
            Code::Unavailable => tonic::Code::Unavailable,
            Code::Internal => tonic::Code::Internal,
        };
        let details = if error.code == Code::DiskFull { DISK_FULL.as_bytes() } else { &[] };
        Self::with_details(code, error.message, Bytes::from_static(details))
    }
}

impl From<Status> for ServiceError {
    fn from(status: Status) -> Self {
        let code = match status.code() {
            tonic::Code::InvalidArgument | tonic::Code::OutOfRange | tonic::Code::Unimplemented => {
                Code::Invalid
            }
            tonic::Code::Unauthenticated | tonic::Code::PermissionDenied => Code::Unauthenticated,
            tonic::Code::FailedPrecondition => Code::VersionMismatch,
            tonic::Code::NotFound => Code::NotFound,
            tonic::Code::ResourceExhausted if says_disk_full(&status) => Code::DiskFull,
            tonic::Code::ResourceExhausted => Code::TooLarge,
            tonic::Code::Aborted => Code::Superseded,
            // Time-outs, broken connections and servers that go away come in all of these.
            tonic::Code::Unavailable
            | tonic::Code::DeadlineExceeded
            | tonic::Code::Cancelled
            | tonic::Code::Unknown => Code::Unavailable,
            _ => Code::Internal,
        };
        if let Some(advice) = certificate_trouble(&status) {
            return Self::new(Code::Unauthenticated, advice);
        }
        // "transport error" alone helps nobody.
        let message = and_causes(status.message().to_owned(), std::error::Error::source(&status));
        Self::new(code, message)
    }
}

/// What an error says, with what caused it, outermost first, and nothing twice.
pub fn with_causes(error: &dyn std::error::Error) -> String {
    and_causes(error.to_string(), error.source())
}

fn and_causes(mut text: String, mut cause: Option<&(dyn std::error::Error + 'static)>) -> String {
    while let Some(inner) = cause {
        let said = inner.to_string();
        if !text.contains(&said) {
            text = format!("{text}: {said}");
        }
        cause = inner.source();
    }
    text
}

#[cfg(test)]
mod tests {
    use planesweep_scene::{DepthHypotheses, Sampling};

    use super::*;

    #[test]
    fn codes_survive_the_wire() {
        for code in [
            Code::Invalid,
            Code::Unauthenticated,
            Code::VersionMismatch,
            Code::NotFound,
            Code::TooLarge,
            Code::Superseded,
            Code::Unavailable,
            Code::DiskFull,
            Code::Internal,
        ] {
            let error = ServiceError::new(code, "said so");
            let back = ServiceError::from(Status::from(error.clone()));
            assert_eq!((back.is_retryable(), &back), (error.is_retryable(), &error));
        }
    }

    #[test]
    fn a_full_disk_is_known_by_its_message_where_a_proxy_drops_the_details() {
        let told =
            |message: String| ServiceError::from(Status::new(tonic::Code::ResourceExhausted, message)).code;
        assert_eq!(told(ServiceError::disk_full("/ledger", "wait").message), Code::DiskFull);
        assert_eq!(told("the message has 9 bytes, the limit is 8".to_owned()), Code::TooLarge);
    }

    #[test]
    fn limits_and_nonsense_differ() {
        let large = ServiceError::from(WireError::TooMany { field: "needs", got: 9, limit: 8 });
        assert_eq!((large.code, large.is_retryable()), (Code::TooLarge, false));
        let nonsense = ServiceError::from(WireError::Missing { field: "spec" });
        assert_eq!(nonsense.code, Code::Invalid);
    }

    #[test]
    fn causes_are_told_too() {
        let cause = DepthHypotheses::new(Sampling::Uniform, 5.0, 1.0, 4).expect_err("far before near");
        let text = format!("refused: {cause}");
        let told = ServiceError::from(WireError::from(cause)).message;
        assert!(told.ends_with(&text), "{told}");
    }
}
