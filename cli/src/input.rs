//! The scene, with every image read once: what cannot be decoded is left out before planning.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, Result, bail};
use planesweep_plan::{BlobKey, MaskSpec, Plan};
use planesweep_scene::{
    ReadError, ReadOptions, Scene, ViewId, decode_image, find_mask, first_reasons, read_scene, scenes_below,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

/// A view that gets no depth map.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Skipped {
    /// Its name.
    pub view: String,
    /// Why.
    pub reason: String,
}

/// A scene whose images can all be decoded.
pub struct Input {
    /// Without the views that were left out.
    pub scene: Scene,
    /// Hashes of the image files' bytes.
    pub image_hashes: BTreeMap<ViewId, BlobKey>,
    /// Views left out so far.
    pub skipped: Vec<Skipped>,
}

/// Reads a scene and decodes every image once. A view whose image is damaged is left out, as a
/// reference and as a source, and named.
pub fn read(path: &Path, options: &ReadOptions) -> Result<Input> {
    // Workers, and runs that resume, may have another working folder.
    let root = path.canonicalize().with_context(|| format!("cannot find the scene {}", path.display()))?;
    let mut scene = read_scene(&root, options).map_err(|error| {
        let near = match error {
            ReadError::NoScene { .. } | ReadError::NoImages { .. } => scenes_below(path),
            _ => Vec::new(),
        };
        let hint = near.first().map(|near| format!(" (there is one in {})", near.display()));
        let hint = hint.unwrap_or_default();
        anyhow::Error::new(error).context(format!("cannot read the scene {}{hint}", path.display()))
    })?;
    let mut skipped: Vec<Skipped> = scene
        .skipped
        .iter()
        .map(|(view, reason)| Skipped { view: view.clone(), reason: reason.clone() })
        .collect();
    let checked: Vec<(ViewId, Result<BlobKey>)> = scene
        .views
        .par_iter()
        .map(|(id, view)| {
            let check = || {
                let bytes = std::fs::read(&view.image)
                    .with_context(|| format!("cannot read image {}", view.image.display()))?;
                decode_image(&view.image, &bytes)?;
                Ok(BlobKey::of(&bytes))
            };
            (*id, check())
        })
        .collect();
    let mut image_hashes = BTreeMap::new();
    for (id, result) in checked {
        match result {
            Ok(hash) => {
                image_hashes.insert(id, hash);
            }
            Err(error) => {
                if let Some(view) = scene.views.remove(&id) {
                    skipped.push(Skipped { view: view.name, reason: format!("{error:#}") });
                }
            }
        }
    }
    if scene.views.is_empty() {
        let reasons = first_reasons(skipped.iter().map(|view| (&view.view, &view.reason)));
        bail!("no image of {} can be decoded{reasons}", path.display());
    }
    Ok(Input { scene, image_hashes, skipped })
}

/// The masks of the views that have one: in the folder given, or beside the photographs.
pub fn masks(scene: &Scene, folder: Option<&Path>) -> Result<BTreeMap<ViewId, MaskSpec>> {
    let folder = folder
        .map(|folder| folder.canonicalize().with_context(|| format!("cannot find {}", folder.display())))
        .transpose()?;
    let found = scene.views.iter().filter_map(|(id, view)| Some((*id, find_mask(view, folder.as_deref())?)));
    found
        .map(|(id, path)| {
            let read = || -> Result<BlobKey> {
                let bytes = std::fs::read(&path)?;
                decode_image(&path, &bytes)?;
                Ok(BlobKey::of(&bytes))
            };
            let hash = read().with_context(|| format!("cannot read the mask {}", path.display()))?;
            Ok((id, MaskSpec { path, hash }))
        })
        .collect()
}

/// What to say when the folder of masks that was given has none for any view.
pub fn no_mask_matches(folder: Option<&Path>, found: usize) -> Option<String> {
    let folder = folder.filter(|_| found == 0)?;
    Some(format!(
        "no view has a mask in {}: NAME.png and STEM.png of the photographs are looked for",
        folder.display()
    ))
}

/// All views without a depth map: those left out when reading, and those that the plan skips.
pub fn all_skipped(input: &Input, plan: &Plan) -> Vec<Skipped> {
    let planned = plan.skipped.iter().map(|(view, reason)| Skipped {
        view: input.scene.views[view].name.clone(),
        reason: reason.to_string(),
    });
    input.skipped.iter().cloned().chain(planned).collect()
}
