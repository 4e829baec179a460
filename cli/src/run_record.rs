//! `run.json`: every parameter, hash and version of a result; nothing in it depends on time.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use planesweep_mvsnet::WeightsMetadata;
use planesweep_plan::{BlobKey, PlanOptions};
use planesweep_scene::{Camera, DepthHypotheses, Distortion, ViewId};
use serde::{Deserialize, Serialize};

use crate::input::Skipped;

/// The name of the file.
pub const FILE_NAME: &str = "run.json";

/// What determined a result.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RunRecord {
    /// Version of the program.
    pub version: String,
    /// Version of its numbers.
    pub numerics_version: u32,
    /// The scene.
    pub scene: PathBuf,
    /// The plan's options.
    pub options: PlanOptions,
    /// The device.
    pub device: String,
    /// Hash of the weights file.
    pub weights_blake3: BlobKey,
    /// What the weights say of themselves.
    pub weights: WeightsMetadata,
    /// The views with a depth map, by id.
    pub views: Vec<RecordedView>,
    /// The views without.
    pub skipped: Vec<Skipped>,
    /// Points of the cloud.
    pub points: u64,
    /// Hash of `cloud.ply`.
    pub cloud_blake3: BlobKey,
}

/// One view of a result.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RecordedView {
    /// Its id.
    pub id: ViewId,
    /// Its name.
    pub name: String,
    /// Its files are `depth/FILE.pfm` and so on.
    pub file: String,
    /// The photograph.
    pub image: PathBuf,
    /// Hash of the photograph.
    pub image_blake3: BlobKey,
    /// The camera of the photograph as it is stored.
    pub image_camera: Camera,
    /// What the lens adds to it.
    pub distortion: Distortion,
    /// The camera of the depth map.
    pub depth_camera: Camera,
    /// The depth planes.
    pub hypotheses: DepthHypotheses,
    /// Source views, best first.
    pub sources: Vec<ViewId>,
    /// Views it was checked against, best first.
    pub neighbours: Vec<ViewId>,
}

impl RunRecord {
    /// Reads the record of a result.
    pub fn read(out: &Path) -> Result<Self> {
        let path = out.join(FILE_NAME);
        let bytes = std::fs::read(&path).with_context(|| {
            format!("cannot read {}; is this a folder that `reconstruct` made?", path.display())
        })?;
        serde_json::from_slice(&bytes).with_context(|| format!("cannot understand {}", path.display()))
    }
}
