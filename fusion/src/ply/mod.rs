//! Point clouds as PLY files.

mod read;
mod write;

use std::io;
use std::path::PathBuf;

use thiserror::Error;

pub use read::read_ply;
pub use write::{PlyWriter, VertexFormat, encode, ply_header};

/// Why a PLY file could not be written or read.
#[derive(Debug, Error)]
pub enum PlyError {
    /// The temporary file beside the target cannot be made.
    #[error("cannot create {}", path.display())]
    Create {
        /// The file to be written.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// Writing, flushing or renaming failed; nothing stands under the final name.
    #[error("cannot write {}", path.display())]
    Write {
        /// The file to be written.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The file cannot be opened or read.
    #[error("cannot read {}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The file is no point cloud that is understood.
    #[error("cannot read {} as a point cloud: {problem}", path.display())]
    Malformed {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        problem: String,
    },
}
