//! What lies in the folder of a result.

use std::fs;
use std::path::{Path, PathBuf};

use planesweep_scene::read_pfm;

/// All files below a folder, relative to it, sorted.
pub fn files_below(folder: &Path) -> Vec<String> {
    let mut files = Vec::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(next) = folders.pop() {
        // A folder that is not there yet holds nothing.
        for entry in fs::read_dir(next).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else if let Ok(relative) = path.strip_prefix(folder) {
                files.push(relative.to_string_lossy().into_owned());
            }
        }
    }
    files.sort_unstable();
    files
}

/// The finished blobs in the store of a result.
pub fn blobs(out: &Path) -> Vec<PathBuf> {
    let root = out.join(".planesweep/store/blobs");
    let is_whole = |name: &String| name.len() == "aa/".len() + 62;
    files_below(&root).into_iter().filter(is_whole).map(|name| root.join(name)).collect()
}

/// The share of all pixels of all confidence maps of a result that are above `threshold`.
pub fn confident_share(out: &Path, threshold: f32) -> f64 {
    let folder = out.join("confidence");
    let (mut confident, mut pixels) = (0, 0);
    for name in files_below(&folder) {
        let map = read_pfm(&folder.join(name)).expect("a confidence map");
        confident += map.values().iter().filter(|value| **value > threshold).count();
        pixels += map.values().len();
    }
    confident as f64 / pixels.max(1) as f64
}
