//! What can go wrong with blobs.

use std::io::{self, ErrorKind};

use planesweep_plan::BlobKey;
use planesweep_proto::ServiceError;
use thiserror::Error;

/// Why a blob could not be written or read.
#[derive(Debug, Error)]
pub enum StoreError {
    /// The address of the store is of no kind that is understood, or nothing is there.
    #[error("cannot open the store at {url}: {problem}")]
    Open {
        /// The address.
        url: String,
        /// What is wrong.
        problem: String,
    },
    /// Writing failed.
    #[error("cannot write blob {key} to {url}")]
    Write {
        /// The blob.
        key: BlobKey,
        /// The store.
        url: String,
        /// What the store said.
        #[source]
        source: object_store::Error,
    },
    /// Reading failed.
    #[error("cannot read blob {key} from {url}")]
    Read {
        /// The blob.
        key: BlobKey,
        /// The store.
        url: String,
        /// What the store said.
        #[source]
        source: object_store::Error,
    },
    /// The coordinator did not pass a blob on.
    #[error("blob {key} does not pass through the coordinator")]
    Coordinator {
        /// The blob.
        key: BlobKey,
        /// What the coordinator said.
        #[source]
        source: ServiceError,
    },
    /// A blob was not written, for its bytes were not those of its key.
    #[error("blob {key} was sent with another hash or length")]
    Refused {
        /// The blob.
        key: BlobKey,
    },
    /// The store has no such blob.
    #[error("blob {key} is not in the store")]
    Missing {
        /// The blob.
        key: BlobKey,
    },
    /// The bytes are not those that were written.
    #[error("blob {key} is damaged: its bytes have another hash or length")]
    Damaged {
        /// The blob.
        key: BlobKey,
    },
}

impl StoreError {
    /// Whether the blob must be made again.
    pub fn is_lost(&self) -> bool {
        matches!(self, Self::Missing { .. } | Self::Damaged { .. })
    }

    /// Whether the same call may succeed later: the store cannot be reached, or has no room. Keys that
    /// open nothing and folders that may not be written are for a person to mend.
    pub fn is_passing(&self) -> bool {
        let source = match self {
            Self::Write { source, .. } | Self::Read { source, .. } => source,
            Self::Coordinator { source, .. } => return source.is_retryable(),
            _ => return false,
        };
        let is_forbidden = |kind| matches!(kind, ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem);
        matches!(source, object_store::Error::Generic { .. } | object_store::Error::JoinError { .. })
            && !self.io_kind().is_some_and(is_forbidden)
    }

    /// The store whose disk has no room left, if that is the trouble.
    pub fn full_disk(&self) -> Option<&str> {
        let (Self::Write { url, .. } | Self::Read { url, .. }) = self else { return None };
        let is_full = |kind| matches!(kind, ErrorKind::StorageFull | ErrorKind::QuotaExceeded);
        self.io_kind().is_some_and(is_full).then_some(url)
    }

    /// What the system said, when it was the system.
    fn io_kind(&self) -> Option<ErrorKind> {
        let mut cause = std::error::Error::source(self);
        while let Some(error) = cause {
            if let Some(io) = error.downcast_ref::<io::Error>() {
                return Some(io.kind());
            }
            cause = error.source();
        }
        None
    }
}

/// An error with what caused it, outermost first.
pub(crate) fn with_causes(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut cause = error.source();
    while let Some(inner) = cause {
        text.push_str(": ");
        text.push_str(&inner.to_string());
        cause = inner.source();
    }
    text
}
