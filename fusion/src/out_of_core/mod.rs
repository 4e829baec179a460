//! Fusion of any number of views in bounded memory.
//!
//! The first pass filters every view and spills the result to a scratch folder; the second goes over
//! the views in the order of their ids, leaves out what another view emits, and hands the points on.
//! Both know beforehand which maps they will need, and keep those that are needed soonest.

mod foreseen;

use std::collections::BTreeMap;
use std::error::Error;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use planesweep_scene::{DepthMap, Raster, ViewId, write_atomically};
use thiserror::Error;

use crate::cloud::{Point, emit};
use crate::filter::{FilteredMap, filter};
use crate::filtered_bytes::{FilteredMapError, decode_filtered_map, encode_filtered_map};
use crate::funnel::Funnel;
use crate::options::FilterOptions;
use crate::surface::emitted;
use foreseen::Foreseen;

/// Names what the filtered maps in a scratch folder were made from.
const FINGERPRINT: &str = "fingerprint";

/// What is to be fused.
#[derive(Clone, Debug)]
pub struct Work {
    /// The views and the neighbours that each is checked against, best first, in the order of the
    /// first pass; a good one has views next to each other that share neighbours.
    pub views: Vec<(ViewId, Vec<ViewId>)>,
    /// How they are checked.
    pub options: FilterOptions,
    /// Whether a surface that several views see is emitted by one of them only.
    pub once_per_surface: bool,
    /// For the maps in memory. A view with its neighbours is held whatever is said here.
    pub memory_bytes: u64,
    /// Where filtered maps are spilled; it is left to the caller to remove it.
    pub scratch: PathBuf,
    /// Names all that determines the filtered maps. What an earlier, interrupted run with the same
    /// fingerprint left in the scratch folder is taken over; what another one left is removed.
    pub fingerprint: String,
}

/// Reads the depth map of a view.
pub type LoadMap<'a> = dyn Fn(ViewId) -> Result<DepthMap, LoadError> + Sync + 'a;
/// Why a depth map could not be read.
pub type LoadError = Box<dyn Error + Send + Sync>;

/// The points of one view.
#[derive(Clone, Copy, Debug)]
pub struct ViewPoints<'a> {
    /// The view that emits them.
    pub view: ViewId,
    /// The views that [`Point::seen_by`] counts.
    pub neighbours: &'a [ViewId],
    /// They, row by row from the top.
    pub points: &'a [Point],
    /// What they were chosen from.
    pub map: &'a FilteredMap,
}

/// What became of the views.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Fused {
    /// How many pixels each step left, of every view with a depth map.
    pub funnels: BTreeMap<ViewId, Funnel>,
    /// The views whose depth map could not be read, each with the reason.
    pub skipped: BTreeMap<ViewId, String>,
    /// Views that an earlier run had filtered.
    pub resumed: usize,
}

/// Why views could not be fused.
#[derive(Debug, Error)]
pub enum OutOfCoreError {
    /// A file of the scratch folder cannot be read or written.
    #[error("cannot use the scratch file {}", path.display())]
    Scratch {
        /// The file.
        path: PathBuf,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// A file of the scratch folder is not what was written.
    #[error("scratch file {} is damaged", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        #[source]
        source: FilteredMapError,
    },
    /// The points could not be handed on.
    #[error("cannot write the points of view {view}")]
    Points {
        /// The view that emitted them.
        view: ViewId,
        /// Why.
        #[source]
        source: Box<dyn Error + Send + Sync>,
    },
}

/// Fuses views whose depth maps need not fit into memory together.
///
/// `load` is called from several threads; a view that it fails for is left out, as a reference and as a
/// neighbour. `progress` is told how many of twice the number of views are done. `points` gets the
/// points of each view, in the order of the views' ids. The result does not depend on the order of the
/// work, the memory, or what an earlier run had done.
pub fn fuse_out_of_core(
    work: &Work,
    load: &LoadMap<'_>,
    progress: &mut dyn FnMut(usize),
    points: &mut dyn FnMut(ViewPoints<'_>) -> Result<(), LoadError>,
) -> Result<Fused, OutOfCoreError> {
    let scratch = Scratch::open(work)?;
    let mut fused = Fused::default();
    filter_all(work, &scratch, load, progress, &mut fused)?;
    emit_all(work, &scratch, progress, points, &mut fused)?;
    Ok(fused)
}

/// The first pass.
fn filter_all(
    work: &Work,
    scratch: &Scratch<'_>,
    load: &LoadMap<'_>,
    progress: &mut dyn FnMut(usize),
    fused: &mut Fused,
) -> Result<(), OutOfCoreError> {
    let open: Vec<&(ViewId, Vec<ViewId>)> =
        work.views.iter().filter(|(view, _)| !scratch.has(*view)).collect();
    fused.resumed = work.views.len() - open.len();
    let steps = open.iter().map(|(view, neighbours)| std::iter::once(view).chain(neighbours).collect());
    let mut maps = Foreseen::new(steps, work.memory_bytes);
    for (step, (view, neighbours)) in open.into_iter().enumerate() {
        let needed: Vec<ViewId> = std::iter::once(view)
            .chain(neighbours)
            .copied()
            .filter(|view| !fused.skipped.contains_key(view))
            .collect();
        let loaded = maps.at(step, &needed, |view| {
            let map = load(view)?;
            let bytes = map.depth.values().len() as u64 * MAP_PIXEL_BYTES;
            Ok::<_, LoadError>((map, bytes))
        });
        let mut read: Vec<(ViewId, Arc<DepthMap>)> = Vec::with_capacity(loaded.len());
        for (view, map) in needed.into_iter().zip(loaded) {
            match map {
                Ok(map) => read.push((view, map)),
                Err(error) => {
                    fused.skipped.insert(view, error_chain(error.as_ref()));
                }
            }
        }
        if let Some(((first, reference), others)) = read.split_first()
            && first == view
        {
            let others: Vec<&DepthMap> = others.iter().map(|(_, map)| map.as_ref()).collect();
            let mut filtered = filter(reference, &others, &work.options);
            restore_agreeing(&mut filtered, neighbours, &read[1..]);
            scratch.write(*view, &filtered)?;
        }
        progress(fused.resumed + step + 1);
    }
    Ok(())
}

/// Counts the agreeing neighbours among all of the view, those included that could not be read.
fn restore_agreeing(filtered: &mut FilteredMap, neighbours: &[ViewId], read: &[(ViewId, Arc<DepthMap>)]) {
    if read.len() == neighbours.len() {
        return;
    }
    let place = |(view, _): &(ViewId, _)| neighbours.iter().position(|n| n == view).unwrap_or(usize::MAX);
    let places: Vec<usize> = read.iter().map(place).collect();
    for bits in filtered.agreeing.values_mut() {
        let set = places.iter().enumerate().filter(|(k, _)| *k < 64 && *bits >> *k & 1 == 1);
        *bits = set.fold(0, |all, (_, place)| all | 1_u64.checked_shl(*place as u32).unwrap_or(0));
    }
}

/// The second pass.
fn emit_all(
    work: &Work,
    scratch: &Scratch<'_>,
    progress: &mut dyn FnMut(usize),
    points: &mut dyn FnMut(ViewPoints<'_>) -> Result<(), LoadError>,
    fused: &mut Fused,
) -> Result<(), OutOfCoreError> {
    let mut views: Vec<&(ViewId, Vec<ViewId>)> =
        work.views.iter().filter(|(view, _)| scratch.has(*view)).collect();
    views.sort_unstable_by_key(|(view, _)| *view);
    let needed: Vec<Vec<ViewId>> = views
        .iter()
        .map(|(view, neighbours)| {
            let others = neighbours.iter().filter(|view| work.once_per_surface && scratch.has(**view));
            std::iter::once(view).chain(others).copied().collect()
        })
        .collect();
    let mut maps = Foreseen::new(needed.iter().map(|views| views.iter().collect()), work.memory_bytes);
    for (step, ((view, neighbours), needed)) in views.into_iter().zip(&needed).enumerate() {
        let read = maps.at(step, needed, |view| {
            let map = scratch.read(view)?;
            let bytes = map.depth.values().len() as u64 * FILTERED_PIXEL_BYTES;
            Ok::<_, OutOfCoreError>((map, bytes))
        });
        let read: Vec<Arc<FilteredMap>> = read.into_iter().collect::<Result<_, _>>()?;
        let Some((map, others)) = read.split_first() else { continue };
        let others: Vec<&FilteredMap> = others.iter().map(AsRef::as_ref).collect();
        let chosen: Raster<bool> = emitted(map, &others, work.options.max_relative_depth);
        let emitted = emit(map, &chosen);
        fused.funnels.insert(*view, Funnel { emitted: emitted.len() as u64, ..map.funnel });
        points(ViewPoints { view: *view, neighbours, points: &emitted, map })
            .map_err(|source| OutOfCoreError::Points { view: *view, source })?;
        progress(work.views.len() + step + 1);
    }
    Ok(())
}

/// Bytes of memory of a pixel of a depth map.
const MAP_PIXEL_BYTES: u64 = 4 + 4 + 4;
/// Bytes of memory of a pixel of a filtered map.
const FILTERED_PIXEL_BYTES: u64 = 4 + 4 + 1 + 8 + 1;

/// Filtered maps on disk.
struct Scratch<'a> {
    folder: &'a Path,
}

impl<'a> Scratch<'a> {
    fn open(work: &'a Work) -> Result<Self, OutOfCoreError> {
        let folder = work.scratch.as_path();
        let named = folder.join(FINGERPRINT);
        let error = |path: &Path| {
            let path = path.to_owned();
            move |source| OutOfCoreError::Scratch { path, source }
        };
        let found = fs::read_to_string(&named).ok();
        if found.as_deref() != Some(work.fingerprint.as_str()) {
            if folder.exists() {
                fs::remove_dir_all(folder).map_err(error(folder))?;
            }
            fs::create_dir_all(folder).map_err(error(folder))?;
            write_atomically(&named, work.fingerprint.as_bytes()).map_err(error(&named))?;
        }
        Ok(Self { folder })
    }

    fn path(&self, view: ViewId) -> PathBuf {
        self.folder.join(format!("{:08}.filtered", view.0))
    }

    /// Files appear whole or not at all, so one that is there is done.
    fn has(&self, view: ViewId) -> bool {
        self.path(view).exists()
    }

    fn write(&self, view: ViewId, map: &FilteredMap) -> Result<(), OutOfCoreError> {
        let path = self.path(view);
        write_atomically(&path, &encode_filtered_map(map))
            .map_err(|source| OutOfCoreError::Scratch { path, source })
    }

    fn read(&self, view: ViewId) -> Result<FilteredMap, OutOfCoreError> {
        let path = self.path(view);
        match fs::read(&path) {
            Ok(bytes) => {
                decode_filtered_map(&bytes).map_err(|source| OutOfCoreError::Damaged { path, source })
            }
            Err(source) => Err(OutOfCoreError::Scratch { path, source }),
        }
    }
}

/// An error with its sources, on one line.
fn error_chain(error: &dyn Error) -> String {
    let mut text = error.to_string();
    let mut next = error.source();
    while let Some(error) = next {
        text.push_str(&format!(": {error}"));
        next = error.source();
    }
    text
}

#[cfg(test)]
mod tests;
