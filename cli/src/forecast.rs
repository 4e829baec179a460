//! What the depth maps of a plan will take on this machine, before the first is inferred.

use std::collections::BTreeSet;

use planesweep_mvsnet::{InferCost, InferRates};
use planesweep_plan::Plan;
use planesweep_scene::ViewId;
use serde::Serialize;

use crate::network::{WORKER_BYTES, infer_size};

/// Who will infer on processors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub struct Team {
    /// Processes.
    pub workers: u32,
    /// Threads of each.
    pub threads: usize,
    /// What an inference may hold in memory.
    pub memory_bytes: Option<u64>,
    /// Whether the weights refine.
    pub refined: bool,
}

/// What one depth map takes.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct ViewForecast {
    pub view: ViewId,
    /// The most memory of the inference.
    pub bytes: u64,
    pub operations: f64,
    pub seconds: f64,
}

/// What all depth maps take.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Forecast {
    pub team: Team,
    /// In the order of the plan.
    pub views: Vec<ViewForecast>,
    /// The most memory of one worker.
    pub worker_bytes: u64,
    /// Until the last depth map is there.
    pub seconds: f64,
}

impl Forecast {
    /// From the sizes of the plan and the rates of this machine. A worker computes the features of an image once, and the
    /// order of the plan says for which view it is.
    pub fn new(plan: &Plan, team: Team, rates: &InferRates) -> Self {
        let mut known: BTreeSet<ViewId> = BTreeSet::new();
        let views: Vec<ViewForecast> = plan
            .views
            .iter()
            .map(|view| {
                let size = infer_size(view, team.refined);
                let cost = InferCost::predict(size, team.threads, team.memory_bytes);
                let images = std::iter::once(&view.view).chain(&view.sources);
                let new_images = images.filter(|id| known.insert(**id)).count();
                ViewForecast {
                    view: view.view,
                    bytes: cost.bytes,
                    operations: cost.operations.total(),
                    seconds: rates.seconds(size, new_images),
                }
            })
            .collect();
        Self {
            team,
            worker_bytes: WORKER_BYTES + views.iter().map(|view| view.bytes).max().unwrap_or(0),
            seconds: views.iter().map(|view| view.seconds).sum::<f64>() / f64::from(team.workers),
            views,
        }
    }
}
