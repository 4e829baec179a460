//! Which inbox this worker writes its maps for.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, PoisonError};

use planesweep_plan::WorkerId;
use planesweep_proto::{Peer, with_causes};
use thiserror::Error;

use super::peers::Peers;
use super::{Outbox, SharedMemoryError};
use crate::jobs::compute;

/// The way to the host's inbox: opened when there is a map to be sent, opened anew when the inbox is
/// another, and not tried again when it does not work.
pub(super) struct Outgoing {
    peers: Arc<Peers>,
    enabled: bool,
    /// The inboxes that the coordinator named last, and whose they are.
    named: Mutex<Vec<(WorkerId, String)>>,
    opened: tokio::sync::Mutex<Opened>,
}

#[derive(Default)]
struct Opened {
    tried: BTreeSet<String>,
    outbox: Option<(WorkerId, String, Arc<Outbox>)>,
}

impl Outgoing {
    pub fn new(enabled: bool, peers: Arc<Peers>) -> Self {
        Self { peers, enabled, named: Mutex::default(), opened: tokio::sync::Mutex::default() }
    }

    /// Notes which inboxes there are.
    pub fn learn(&self, peers: &[Peer]) {
        let inboxes =
            peers.iter().filter_map(|peer| Some((peer.worker.clone(), peer.endpoint.inbox.clone()?)));
        *self.named.lock().unwrap_or_else(PoisonError::into_inner) = inboxes.collect();
    }

    /// The way to the inbox, connected and with slots for maps of this length; `None` when there is no
    /// inbox, or no way to it.
    pub async fn outbox_for(&self, length: usize) -> Option<Arc<Outbox>> {
        if !self.enabled {
            return None;
        }
        let named = self.named.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let mut opened = self.opened.lock().await;
        opened.outbox.take_if(|(_, inbox, _)| !named.iter().any(|(_, name)| name == inbox));
        if opened.outbox.is_none() {
            for (worker, inbox) in named {
                if opened.tried.insert(inbox.clone())
                    && let Some(outbox) = open(inbox.clone()).await
                {
                    opened.outbox = Some((worker, inbox, Arc::new(outbox)));
                    break;
                }
            }
        }
        let (worker, inbox, outbox) = opened.outbox.clone()?;
        if !self.fit(&worker, &inbox, &outbox, length).await {
            opened.outbox = None;
            return None;
        }
        Some(outbox)
    }

    /// Sees that maps of this length can be lent and arrive.
    async fn fit(&self, worker: &WorkerId, inbox: &str, outbox: &Arc<Outbox>, length: usize) -> bool {
        let fitted = Arc::clone(outbox);
        match or_say(compute(move || fitted.fit(length)).await) {
            None => return false,
            Some(false) => return true,
            Some(true) => {}
        }
        // What is sent before the two are connected may be dropped unseen.
        let Some(mut peer) = self.peers.client(worker) else { return false };
        let answer = peer.open_inbox(inbox).await;
        answer.inspect_err(|error| tracing::debug!(%worker, %error, "the inbox does not answer")).is_ok()
    }
}

async fn open(inbox: String) -> Option<Outbox> {
    or_say(compute(move || Outbox::open(&inbox)).await)
}

/// The value, or a word that maps take the other ways.
pub(super) fn or_say<T>(result: Result<T, SharedMemoryError>) -> Option<T> {
    let error = match result {
        Ok(value) => return Some(value),
        Err(error) => error,
    };
    // Containers of one host may have memories of their own; that is nobody's fault.
    let is_elsewhere = matches!(error, SharedMemoryError::Elsewhere { .. });
    let text = with_causes(&OtherWays { source: error });
    if is_elsewhere {
        tracing::debug!("{text}");
    } else {
        tracing::warn!("{text}");
    }
    None
}

#[derive(Debug, Error)]
#[error("maps do not go through shared memory, but by stream or from the store")]
struct OtherWays {
    source: SharedMemoryError,
}
