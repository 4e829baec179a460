//! A scene: what every reader makes, and all that planning needs.

use std::collections::{BTreeMap, HashSet};
use std::fmt;
use std::path::PathBuf;

use nalgebra::Point3;
use serde::{Deserialize, Serialize};

use crate::{Camera, Distortion, Intrinsics, ViewId, undistorted_intrinsics};

/// Photographs with known cameras, and what is known of the surface.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scene {
    /// The views by id.
    pub views: BTreeMap<ViewId, View>,
    /// The sparse reconstruction; empty when the format has none.
    pub points: SparsePoints,
    /// Source views by reference view, best first, when the scene's files name them (pair.txt).
    pub pairs: BTreeMap<ViewId, Vec<SourceScore>>,
    /// What was odd about the files but had a clear meaning, in the order of reading.
    pub warnings: Vec<Warning>,
    /// Views that were left out, by name, each with the reason.
    pub skipped: BTreeMap<String, String>,
}

/// Something odd about a scene's files that had a clear meaning.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Warning {
    /// What is odd.
    pub what: String,
    /// What to do about it.
    pub advice: &'static str,
}

impl Warning {
    /// What is odd, and what to do about it.
    pub fn new(what: String, advice: &'static str) -> Self {
        Self { what, advice }
    }
}

impl fmt::Display for Warning {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(&self.what)
    }
}

/// One photograph with its camera.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Its id in the scene's files.
    pub id: ViewId,
    /// Its name, unique within the scene: the image's path relative to the image folder, with `/`
    /// between folders.
    pub name: String,
    /// Where the image lies.
    pub image: PathBuf,
    /// The camera, for the image as it is stored.
    pub camera: Camera,
    /// What the lens adds to the pinhole camera in the stored image.
    pub distortion: Distortion,
    /// The depth range, when the scene's files name it.
    pub depth_range: Option<DepthRange>,
}

impl Scene {
    /// The pinhole camera of every view's undistorted image, at full size. A lens that many views
    /// share is looked at once.
    pub fn undistorted_cameras(&self) -> BTreeMap<ViewId, Camera> {
        type Lens = (u32, u32, [u64; 5], &'static str, Vec<u64>);
        let mut known: BTreeMap<Lens, Intrinsics> = BTreeMap::new();
        let mut undistorted = |view: &View| {
            let k = &view.camera.intrinsics;
            if view.distortion == Distortion::None {
                return view.camera;
            }
            let inner = [k.fx, k.fy, k.skew, k.cx, k.cy].map(f64::to_bits);
            let coefficients = view.distortion.coefficients().into_iter().map(f64::to_bits).collect();
            let lens = (k.width, k.height, inner, view.distortion.model(), coefficients);
            let intrinsics =
                *known.entry(lens).or_insert_with(|| undistorted_intrinsics(k, &view.distortion));
            Camera { intrinsics, ..view.camera }
        };
        self.views.values().map(|view| (view.id, undistorted(view))).collect()
    }
}

/// A depth range as a file states it, in scene units.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DepthRange {
    /// Nearest depth.
    pub min: f64,
    /// Farthest depth.
    pub max: f64,
    /// Number of planes, when stated.
    pub count: Option<u32>,
}

/// A source view of some reference view with its score; higher is better.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SourceScore {
    /// The source view.
    pub view: ViewId,
    /// Its score; comparable within one scene only.
    pub score: f64,
}

/// Points of a sparse reconstruction with the views that see them, stored flat: a point is its
/// index here, its track the views `track_views[track_starts[i]..track_starts[i + 1]]`.
#[derive(Clone, Debug, PartialEq)]
pub struct SparsePoints {
    positions: Vec<Point3<f64>>,
    track_starts: Vec<usize>,
    track_views: Vec<ViewId>,
}

impl Default for SparsePoints {
    fn default() -> Self {
        Self { positions: Vec::new(), track_starts: vec![0], track_views: Vec::new() }
    }
}

impl SparsePoints {
    /// Adds a point (world) with the views that see it; a view seen twice counts once.
    pub fn push(&mut self, position: Point3<f64>, track: impl IntoIterator<Item = ViewId>) {
        /// From this length on, looking through the track would take longer than a set does.
        const LONG: usize = 64;
        let start = self.track_views.len();
        let mut seen = HashSet::new();
        for view in track {
            let known = &self.track_views[start..];
            let is_new = if known.len() < LONG {
                !known.contains(&view)
            } else {
                if seen.is_empty() {
                    seen.extend(known.iter().copied());
                }
                seen.insert(view)
            };
            if is_new {
                self.track_views.push(view);
            }
        }
        self.positions.push(position);
        self.track_starts.push(self.track_views.len());
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are no points.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Each point (world) with the views that see it.
    pub fn iter(&self) -> impl Iterator<Item = (&Point3<f64>, &[ViewId])> {
        self.positions
            .iter()
            .zip(self.track_starts.windows(2))
            .map(|(position, span)| (position, &self.track_views[span[0]..span[1]]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tracks_stay_with_their_points() {
        let mut points = SparsePoints::default();
        points.push(Point3::new(0.0, 0.0, 1.0), [ViewId(3), ViewId(7), ViewId(3)]);
        points.push(Point3::new(0.0, 0.0, 2.0), []);
        points.push(Point3::new(0.0, 0.0, 3.0), [ViewId(9)]);
        let seen: Vec<_> = points.iter().map(|(p, track)| (p.z, track.to_vec())).collect();
        assert_eq!(seen, [(1.0, vec![ViewId(3), ViewId(7)]), (2.0, vec![]), (3.0, vec![ViewId(9)])]);
    }
}
