//! What can go wrong with blobs.

use std::io::{self, ErrorKind};

use planesweep_plan::BlobKey;
use planesweep_proto::{Code, ServiceError};
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
        /// The coordinator's store.
        url: String,
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
    /// There are more bytes than the blob has, or than any such blob may have.
    #[error("blob {key} is in the store with more than {at_most} bytes")]
    TooLarge {
        /// The blob.
        key: BlobKey,
        /// It has, or may have.
        at_most: u64,
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
        matches!(self, Self::Missing { .. } | Self::TooLarge { .. } | Self::Damaged { .. })
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
        let is_full = |kind| matches!(kind, ErrorKind::StorageFull | ErrorKind::QuotaExceeded);
        match self {
            Self::Write { url, .. } | Self::Read { url, .. } => {
                self.io_kind().is_some_and(is_full).then_some(url)
            }
            Self::Coordinator { url, source, .. } => (source.code == Code::DiskFull).then_some(url),
            _ => None,
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_the_same_behind_a_coordinator() {
        let key = BlobKey([1; 32]);
        let through = |code| {
            let source = ServiceError::new(code, "said so");
            StoreError::Coordinator { key, url: "file:///store".to_owned(), source }
        };
        let full = through(Code::DiskFull);
        assert!(full.full_disk() == Some("file:///store") && full.is_passing(), "{full}");
        let busy = through(Code::Unavailable);
        assert!(busy.full_disk().is_none() && busy.is_passing(), "{busy}");
        assert!(!through(Code::TooLarge).is_passing());
    }
}
