//! Everything that is decided before the first job.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::{Result, bail};
use planesweep_mvsnet::Weights;
use planesweep_plan::{BlobKey, Job, Plan, PlanOptions, jobs, plan};
use planesweep_scene::{ReadOptions, ViewId};

use crate::input::{self, Input};
use crate::network::{weights_for, weights_or_default};

/// Seconds of each stage, in order.
pub type Stages = Vec<(String, f64)>;

/// Bytes of the name of a run.
const RUN_NAME_BYTES: usize = 100;

/// The network as the workers are going to load it.
pub struct Network {
    /// The file that was named.
    pub file: Option<PathBuf>,
    /// The device that infers.
    pub device: String,
    /// What the device loads the network from.
    pub bytes: Vec<u8>,
    /// The hash of these bytes.
    pub key: BlobKey,
    /// The weights in them.
    pub weights: Weights,
}

impl Network {
    /// Of the weights in this file, or those that come with the program, for this device.
    pub fn read(file: Option<&Path>, device: &str) -> Result<Self> {
        let (bytes, weights) = weights_or_default(file)?;
        let bytes = weights_for(device, bytes);
        let key = BlobKey::of(&bytes);
        Ok(Self { file: file.map(Path::to_owned), device: device.to_owned(), bytes, key, weights })
    }
}

/// A scene with its plan and the jobs of it.
pub struct Prepared {
    pub scene_path: PathBuf,
    pub network: Network,
    pub input: Input,
    pub plan: Plan,
    pub jobs: Vec<Job>,
}

impl Prepared {
    /// Reads the scene with all its images, and plans; `masks` is a folder of masks that lie elsewhere than beside
    /// the images.
    pub fn new(
        scene: &Path,
        network: Network,
        options: &PlanOptions,
        read: &ReadOptions,
        masks: Option<&Path>,
        stages: &mut Stages,
    ) -> Result<Self> {
        let input = timed(stages, "read images", || input::read(scene, read))?;
        for warning in &input.scene.warnings {
            eprintln!("warning: {warning}");
        }
        for skipped in &input.skipped {
            eprintln!("warning: view {} is left out: {}", skipped.view, skipped.reason);
        }
        let mut plan = timed(stages, "plan", || Ok(plan(&input.scene, options)))?;
        plan.masks = input::masks(&input.scene, masks)?;
        if let Some(warning) = input::no_mask_matches(masks, plan.masks.len()) {
            eprintln!("warning: {warning}");
        }
        if plan.views.is_empty() {
            bail!("no view can be reconstructed; `planesweep inspect {}` says why", scene.display());
        }
        let jobs = jobs(&input.scene, &plan, &input.image_hashes, network.key)?;
        Ok(Self { scene_path: scene.to_owned(), network, input, plan, jobs })
    }

    /// What the run is called: the name of the scene's folder, as far as it can be shown and sent.
    pub fn run_name(&self) -> String {
        let path = self.scene_path.canonicalize().unwrap_or_else(|_| self.scene_path.clone());
        let name: String = path
            .file_name()
            .map(|name| name.to_string_lossy().chars().filter(|c| !c.is_control()).collect())
            .unwrap_or_default();
        let name = &name[..name.floor_char_boundary(RUN_NAME_BYTES)];
        if name.trim().is_empty() { "scene".to_owned() } else { name.to_owned() }
    }

    /// The name of a view.
    pub fn view_name(&self, view: ViewId) -> Option<&str> {
        self.input.scene.views.get(&view).map(|view| view.name.as_str())
    }

    /// Views that were left out.
    pub fn left_out(&self) -> usize {
        self.input.skipped.len() + self.plan.skipped.len()
    }
}

fn timed<T>(stages: &mut Stages, name: &str, f: impl FnOnce() -> Result<T>) -> Result<T> {
    let begun = Instant::now();
    let value = f()?;
    stages.push((name.to_owned(), begun.elapsed().as_secs_f64()));
    Ok(value)
}
