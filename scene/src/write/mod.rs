//! Writers of the field's formats, and the one way in which files are written.

mod atomic;
mod colmap;
mod mvsnet;

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

pub use atomic::write_atomically;
pub use colmap::write_colmap;
pub use mvsnet::{mvsnet_cam_text, mvsnet_pair_text, write_mvsnet};

/// Why a scene could not be written.
#[derive(Debug, Error)]
pub enum WriteError {
    /// A file or folder could not be written.
    #[error("could not write {}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The format cannot hold a view.
    #[error("could not write view {view:?}: {format} has no place for {what}")]
    NotHeld {
        /// The view's name.
        view: String,
        /// The format.
        format: &'static str,
        /// What it cannot hold.
        what: &'static str,
    },
}

fn create_folder(path: &Path) -> Result<(), WriteError> {
    fs::create_dir_all(path).map_err(|source| WriteError::Io { path: path.to_owned(), source })
}

fn write_file(path: &Path, bytes: &[u8]) -> Result<(), WriteError> {
    write_atomically(path, bytes).map_err(|source| WriteError::Io { path: path.to_owned(), source })
}
