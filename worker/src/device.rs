//! The thread that owns the network.
//!
//! libtorch keeps memory for every thread that ever ran it, and a forward pass cannot be awaited, so
//! one OS thread per device loads the weights, runs every inference and lives as long as the worker.

use std::ops::Range;
use std::sync::Arc;
use std::thread;

use bytes::Bytes;
use planesweep_mvsnet::{DepthBackend, InferError, InferInput};
use planesweep_plan::BlobKey;
use planesweep_scene::{DepthHypotheses, DepthMap, WorkingImage};
use thiserror::Error;
use tokio::sync::{mpsc, oneshot};

/// Makes the network from a weights file; called on the device's thread.
pub type BackendFactory =
    Box<dyn Fn(&[u8]) -> Result<Box<dyn DepthBackend>, Box<dyn std::error::Error + Send + Sync>> + Send>;

/// Why the device gave no depth map.
#[derive(Debug, Error)]
pub enum DeviceError {
    /// The weights are refused, or the device is not there.
    #[error("cannot load the network: {message}")]
    Load {
        /// What the backend said.
        message: String,
    },
    /// The network failed.
    #[error(transparent)]
    Infer(#[from] InferError),
    /// The device's thread ended: a bug.
    #[error("the thread of the device has ended")]
    Gone,
}

/// One inference, complete.
pub(crate) struct InferRequest {
    pub weights: (BlobKey, Bytes),
    pub reference: Arc<WorkingImage>,
    pub sources: Vec<Arc<WorkingImage>>,
    pub hypotheses: DepthHypotheses,
    /// Rows of the depth map; all without.
    pub rows: Option<Range<usize>>,
}

struct Task {
    request: InferRequest,
    reply: oneshot::Sender<Result<DepthMap, DeviceError>>,
}

/// A handle of the device's thread, which ends when the handle is dropped.
pub(crate) struct Device {
    tasks: mpsc::Sender<Task>,
}

impl Device {
    /// Starts the thread. Nothing is loaded until the first inference says which weights.
    pub fn start(factory: BackendFactory) -> std::io::Result<Self> {
        let (tasks, queue) = mpsc::channel(1);
        thread::Builder::new().name("device".to_owned()).spawn(move || run(&factory, queue))?;
        Ok(Self { tasks })
    }

    /// Runs one inference; they run one at a time, in the order of the calls.
    pub async fn infer(&self, request: InferRequest) -> Result<DepthMap, DeviceError> {
        let (reply, answer) = oneshot::channel();
        self.tasks.send(Task { request, reply }).await.map_err(|_| DeviceError::Gone)?;
        answer.await.map_err(|_| DeviceError::Gone)?
    }
}

fn run(factory: &BackendFactory, mut queue: mpsc::Receiver<Task>) {
    let mut loaded: Option<(BlobKey, Box<dyn DepthBackend>)> = None;
    while let Some(Task { request, reply }) = queue.blocking_recv() {
        let wanted = request.weights.0;
        if loaded.as_ref().is_none_or(|(have, _)| *have != wanted) {
            drop(loaded.take());
            match factory(&request.weights.1) {
                Ok(backend) => loaded = Some((wanted, backend)),
                Err(error) => {
                    // The receiver may have given up; then nobody needs to know.
                    let _ = reply.send(Err(DeviceError::Load { message: error.to_string() }));
                    continue;
                }
            }
        }
        let Some((_, backend)) = &mut loaded else { continue };
        let sources: Vec<&WorkingImage> = request.sources.iter().map(AsRef::as_ref).collect();
        let input =
            InferInput { reference: &request.reference, sources: &sources, hypotheses: &request.hypotheses };
        let map = match request.rows {
            None => backend.infer(input),
            Some(rows) => backend.infer_rows(input, rows),
        };
        let _ = reply.send(map.map_err(DeviceError::Infer));
    }
}
