//! Jobs: what a worker is handed, complete, so that nothing is left to decide when it is carried out.

use std::ops::Range;
use std::path::PathBuf;

use planesweep_fusion::FilterOptions;
use planesweep_scene::{Camera, DepthHypotheses, Distortion, ViewId};

use crate::{BlobKey, JobId};

/// Raised whenever a change of the code changes the numbers of a result, so that results of older
/// code are not taken for those of newer code.
pub const NUMERICS_VERSION: u32 = 4;

/// One unit of work.
#[derive(Clone, Debug, PartialEq)]
pub struct Job {
    /// The hash of the specification and of the ids in `needs`.
    pub id: JobId,
    /// What is to be done.
    pub spec: JobSpec,
    /// Jobs whose results this one reads; it is ready when each is done or failed for good.
    pub needs: Vec<JobId>,
}

/// What a job does.
#[derive(Clone, Debug, PartialEq)]
pub enum JobSpec {
    /// Infers the depth map of a view, or a band of its rows.
    Infer(InferSpec),
    /// Puts the bands of a view's depth map together.
    Stitch(StitchSpec),
    /// Makes of the network's depth map what fusion takes: masked, at the photograph's resolution.
    Fit(FitSpec),
    /// Checks the depth map of a view against those of its neighbours and merges agreeing depths.
    Filter(FilterSpec),
    /// Turns the filtered depth map of a view into points, less what a neighbour emits.
    Emit(EmitSpec),
    /// Puts the points of all views together, in the order given.
    Assemble(AssembleSpec),
}

/// Inference of one view or of a band of it. Needs nothing.
#[derive(Clone, Debug, PartialEq)]
pub struct InferSpec {
    /// The reference image.
    pub reference: ImageSpec,
    /// The source images, best first; at least one.
    pub sources: Vec<ImageSpec>,
    /// The depth planes of the reference camera.
    pub hypotheses: DepthHypotheses,
    /// The rows of the depth map that are wanted; all without.
    pub rows: Option<Range<u32>>,
    /// The weights file in the store.
    pub weights: BlobKey,
}

/// The depth map of a view that is inferred in bands. Needs the `Infer` jobs of all bands, from the top.
#[derive(Clone, Debug, PartialEq)]
pub struct StitchSpec {
    /// The reference view.
    pub view: ViewId,
}

/// The depth map of a view, changed for fusion. Needs the `Infer` or `Stitch` job that gives it.
#[derive(Clone, Debug, PartialEq)]
pub struct FitSpec {
    /// The photograph.
    pub image: ImageSpec,
    /// What is left out.
    pub mask: Option<MaskSpec>,
    /// Whether the map is upsampled to the resolution of the working image.
    pub full_resolution: bool,
}

/// An image that is black where the depth map of a view is to have none.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MaskSpec {
    /// Where the file lies, on hosts that can read it.
    pub path: PathBuf,
    /// BLAKE3 hash of the file's bytes.
    pub hash: BlobKey,
}

/// An image as the network wants it: undistorted, then resized to the working size.
#[derive(Clone, Debug, PartialEq)]
pub struct ImageSpec {
    /// The view it belongs to.
    pub view: ViewId,
    /// The view's name.
    pub name: String,
    /// Where the file lies, on hosts that can read it.
    pub path: PathBuf,
    /// BLAKE3 hash of the file's bytes.
    pub hash: BlobKey,
    /// The camera of the stored image.
    pub camera: Camera,
    /// What the lens adds to it.
    pub distortion: Distortion,
    /// Columns of the working image, before padding.
    pub working_width: u32,
    /// Rows of the working image, before padding.
    pub working_height: u32,
}

/// Filtering of one view. Needs the jobs that give the depth maps (`Infer`, `Stitch` where there are bands, or `Fit`)
/// of the view, first, and of its neighbours, in order.
#[derive(Clone, Debug, PartialEq)]
pub struct FilterSpec {
    /// The reference view.
    pub view: ViewId,
    /// The views it is checked against, best first.
    pub neighbours: Vec<ViewId>,
    /// The thresholds.
    pub options: FilterOptions,
}

/// Points of one view. Needs the `Filter` jobs of the view, first, and of its neighbours, in order.
#[derive(Clone, Debug, PartialEq)]
pub struct EmitSpec {
    /// The reference view.
    pub view: ViewId,
    /// The views that may emit the same surface; none when every view is to emit all it keeps.
    pub neighbours: Vec<ViewId>,
    /// Two depths that differ by less, relatively, are the same surface.
    pub max_relative_depth: f32,
    /// Whether positions are written as doubles, for scenes far from their origin.
    pub double: bool,
}

/// The cloud. Needs the `Emit` jobs of all views, in order.
#[derive(Clone, Debug, PartialEq)]
pub struct AssembleSpec {
    /// The views, in the order of their points in the cloud.
    pub views: Vec<ViewId>,
}

impl JobSpec {
    /// The name of the kind: "infer", "stitch", "fit", "filter", "emit" or "assemble".
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Infer(_) => "infer",
            Self::Stitch(_) => "stitch",
            Self::Fit(_) => "fit",
            Self::Filter(_) => "filter",
            Self::Emit(_) => "emit",
            Self::Assemble(_) => "assemble",
        }
    }

    /// The view the job is about; `None` for the whole cloud.
    pub fn view(&self) -> Option<ViewId> {
        match self {
            Self::Infer(spec) => Some(spec.reference.view),
            Self::Stitch(spec) => Some(spec.view),
            Self::Fit(spec) => Some(spec.image.view),
            Self::Filter(spec) => Some(spec.view),
            Self::Emit(spec) => Some(spec.view),
            Self::Assemble(_) => None,
        }
    }
}
