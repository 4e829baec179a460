//! Data beside the checkout, which is not always there.

use std::path::{Path, PathBuf};

use crate::program::run;

/// A file or folder of the data beside the checkout; `None`, and a line on stderr, where it is missing.
pub fn shared_data(test: &str, path: &str) -> Option<PathBuf> {
    let data = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../shared/data"));
    let found = data.join(path);
    if found.exists() {
        return Some(found);
    }
    eprintln!("SKIPPED {test}: {path} is not there");
    None
}

/// The reference weights, imported into `folder` by the program; `None` where the checkpoint is missing.
pub fn reference_weights(test: &str, folder: &Path) -> Option<PathBuf> {
    let checkpoint = shared_data(test, "weights/mvsnet_dtu_d192_xyguo.ckpt")?;
    let weights = folder.join("reference.safetensors");
    let out = weights.to_str().expect("a temporary folder is UTF-8");
    let from = checkpoint.to_str().expect("the data folder is UTF-8");
    let _ = run(["weights", "import", from, "-o", out]).expect_code(0);
    Some(weights)
}
