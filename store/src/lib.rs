//! The truth of the bytes: blobs named by their hash, in a local folder or an object store.
//!
//! A blob's key is the hash of its bytes, so writing it twice is harmless, and a blob is complete or
//! absent: it is written under a temporary name, flushed, and renamed, or put in one piece. Nothing
//! refers to it until the ledger does. Who does not reach the store gets the bytes through the coordinator,
//! and to those who use a [`Store`] it is the same.
//!
//! | file | holds |
//! | --- | --- |
//! | `address` | `file://`, `s3://`, `gs://` and `az://` to something that keeps objects |
//! | `objects` | a store that is reached from here |
//! | `upload` | a blob on its way into it, in pieces |
//! | `blobs` | writing, reading and checking, there or through the coordinator |
//! | `patience` | the same while the store cannot be reached or is full |

#![warn(missing_docs)]

mod address;
mod blobs;
mod error;
mod objects;
mod patience;
mod upload;

pub use blobs::Store;
pub use error::StoreError;
pub use objects::Objects;
pub use upload::Upload;
