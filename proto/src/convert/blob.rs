//! Blobs and requests for them.

use planesweep_plan::BlobKey;

use super::check::blob_key;
use crate::{WireError, wire};

impl TryFrom<wire::BlobRequest> for BlobKey {
    type Error = WireError;

    fn try_from(request: wire::BlobRequest) -> Result<Self, WireError> {
        blob_key("key of the blob", &request.key)
    }
}

impl From<&BlobKey> for wire::BlobRequest {
    fn from(key: &BlobKey) -> Self {
        Self { key: key.0.to_vec() }
    }
}

/// A blob's key and length.
impl TryFrom<wire::Blob> for (BlobKey, u64) {
    type Error = WireError;

    fn try_from(blob: wire::Blob) -> Result<Self, WireError> {
        Ok((blob_key("key of the blob", &blob.key)?, blob.length))
    }
}

impl From<(BlobKey, u64)> for wire::Blob {
    fn from((key, length): (BlobKey, u64)) -> Self {
        Self { key: key.0.to_vec(), length }
    }
}
