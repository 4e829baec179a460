//! Other workers, and what they have in memory.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use bytes::Bytes;
use planesweep_plan::WorkerId;
use planesweep_proto::{Credentials, Peer, PeerClient, Produced, ServiceError};

/// The workers that maps can be fetched from.
pub(crate) struct Peers {
    credentials: Credentials,
    known: Mutex<BTreeMap<WorkerId, (String, PeerClient)>>,
}

impl Peers {
    /// None are known yet. All of them want the coordinator's token, and its authority vouches for them.
    pub fn new(credentials: Credentials) -> Self {
        Self { credentials, known: Mutex::new(BTreeMap::new()) }
    }

    /// Notes where workers are.
    pub fn learn(&self, peers: &[Peer]) {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        for Peer { worker, endpoint } in peers {
            let Some(address) = &endpoint.address else { continue };
            if known.get(worker).is_some_and(|(is, _)| is == address) {
                continue;
            }
            match PeerClient::connect(address, &self.credentials) {
                Ok(client) => drop(known.insert(worker.clone(), (address.clone(), client))),
                Err(error) => tracing::warn!(%worker, %error, "a worker's address makes no sense"),
            }
        }
    }

    /// A client of the worker, if it is known where it is.
    pub fn client(&self, worker: &WorkerId) -> Option<PeerClient> {
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.get(worker).map(|(_, client)| client.clone())
    }

    /// The bytes of a blob from the worker that made it, if it still has them.
    pub async fn get(&self, wanted: &Produced) -> Option<Bytes> {
        let mut client = self.client(&wanted.worker)?;
        match client.fetch(&wanted.blob, wanted.length).await {
            Ok(bytes) => Some(bytes),
            Err(error) => {
                tracing::debug!(worker = %wanted.worker, %error, "a map does not come from its worker");
                self.give_up_on(&wanted.worker, &error);
                None
            }
        }
    }

    /// A worker that cannot be reached is asked no more until the coordinator names it again: each try
    /// costs a job its time.
    fn give_up_on(&self, worker: &WorkerId, error: &ServiceError) {
        if error.is_retryable() {
            self.known.lock().unwrap_or_else(PoisonError::into_inner).remove(worker);
        }
    }
}
