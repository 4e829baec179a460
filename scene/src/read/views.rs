//! From what a format says of a view to a view with its image.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::names::{ResolveError, resolve_inside};
use super::{ReadError, ReadOptions, ViewError, inconsistent};
use crate::{
    Camera, DepthRange, Distortion, Intrinsics, Pose, Scene, View, ViewId, Warning, fit_to_image, image_size,
};

/// A view as a format's files describe it, before its image was looked at.
pub(super) struct Candidate {
    pub id: ViewId,
    pub name: String,
    pub geometry: Result<Geometry, ViewError>,
}

pub(super) struct Geometry {
    pub pose: Pose,
    pub intrinsics: Intrinsics,
    pub units: Units,
    pub distortion: Distortion,
    pub depth_range: Option<DepthRange>,
}

/// What intrinsics are counted in.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Units {
    /// Pixels of an image of the size that they state.
    Pixels,
    /// Pixels of the image, whose size the files do not state.
    PixelsOfImage,
    /// The larger side of the image, whose size the files do not state.
    LargerSide,
}

enum Refusal {
    /// The view contradicts itself: the scene is refused, unless bad views are to be left out.
    Bad(ViewError),
    /// Its image is missing or damaged: the others go on.
    Skipped(String),
}

impl<E: Into<ViewError>> From<E> for Refusal {
    fn from(error: E) -> Self {
        Self::Bad(error.into())
    }
}

/// Adds the candidates that hold to the scene, and the others to those that were skipped. Names of candidates
/// are relative to `images`; two with the same name are refused as a contradiction of `file`.
pub(super) fn admit(
    candidates: Vec<Candidate>,
    file: &Path,
    images: &Path,
    options: &ReadOptions,
    scene: &mut Scene,
) -> Result<(), ReadError> {
    let mut names = HashSet::new();
    if let Some(candidate) = candidates.iter().find(|candidate| !names.insert(&candidate.name)) {
        return Err(inconsistent(file, format!("two images with the name {:?}", candidate.name)));
    }
    // Headers of many images: the time is that of the disk, so threads help.
    let examined: Vec<_> = candidates
        .into_par_iter()
        .map(|candidate| (candidate.name.clone(), examine(candidate, images)))
        .collect();
    for (name, result) in examined {
        match result {
            Ok((view, warning)) => {
                scene.warnings.extend(warning);
                scene.views.insert(view.id, view);
            }
            Err(Refusal::Skipped(reason)) => skip(scene, name, reason),
            Err(Refusal::Bad(error)) if options.skip_bad_views => skip(scene, name, error.to_string()),
            Err(Refusal::Bad(source)) => return Err(ReadError::View { view: name, source }),
        }
    }
    Ok(())
}

fn skip(scene: &mut Scene, name: String, reason: String) {
    scene.skipped.insert(name, reason);
}

fn examine(candidate: Candidate, images: &Path) -> Result<(View, Option<Warning>), Refusal> {
    let Candidate { id, name, geometry } = candidate;
    let geometry = geometry?;
    let image = locate(images, &name)?;
    let (width, height) = image_size(&image).map_err(|error| Refusal::Skipped(chain(&error)))?;
    let stated = geometry.intrinsics;
    let (intrinsics, warning) = match geometry.units {
        Units::Pixels => {
            let (intrinsics, scaled) = fit_to_image(&stated.checked()?, width, height)?;
            let warning = scaled.then(|| {
                let what = format!(
                    "view {name:?}: its image is {width}x{height}, its camera {}x{}; the intrinsics were scaled",
                    stated.width, stated.height
                );
                Warning::new(what, "nothing, if the image was made smaller or larger as a whole and not cropped")
            });
            (intrinsics, warning)
        }
        Units::PixelsOfImage => (stated.with_size(width, height).checked()?, None),
        Units::LargerSide => {
            let side = f64::from(width.max(height));
            let Intrinsics { fx, fy, skew, cx, cy, .. } = stated;
            let [fx, fy, skew, cx, cy] = [fx, fy, skew, cx, cy].map(|value| value * side);
            (Intrinsics { width, height, fx, fy, skew, cx, cy }.checked()?, None)
        }
    };
    let camera = Camera { intrinsics, pose: geometry.pose };
    let (distortion, depth_range) = (geometry.distortion, geometry.depth_range);
    Ok((View { id, name, image, camera, distortion, depth_range }, warning))
}

fn locate(images: &Path, name: &str) -> Result<PathBuf, Refusal> {
    resolve_inside(images, name).map_err(|error| match error {
        ResolveError::Name(error) => Refusal::Bad(error.into()),
        error @ ResolveError::Find { .. } => Refusal::Skipped(chain(&error)),
    })
}

/// An error with its causes, in one line.
fn chain(error: &dyn std::error::Error) -> String {
    let mut text = error.to_string();
    let mut source = error.source();
    while let Some(cause) = source {
        text = format!("{text}: {cause}");
        source = cause.source();
    }
    text
}
