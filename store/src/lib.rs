//! The truth of the bytes: blobs named by their hash, in a local folder or an object store.
//!
//! A blob's key is the hash of its bytes, so writing it twice is harmless, and a blob is complete or
//! absent: it is written under a temporary name, flushed, and renamed, or put in one piece. Nothing
//! refers to it until the ledger does.
//!
//! | file | holds |
//! | --- | --- |
//! | `address` | `file://`, `s3://`, `gs://` and `az://` to something that keeps objects |
//! | `blobs` | writing, reading and checking |
//! | `patience` | the same while the store cannot be reached or is full |

#![warn(missing_docs)]

mod address;
mod blobs;
mod error;
mod patience;

pub use blobs::Store;
pub use error::StoreError;
