//! Other workers, and what they have in memory.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Mutex, PoisonError};

use bytes::Bytes;
use planesweep_plan::WorkerId;
use planesweep_proto::{Code, Credentials, Peer, PeerClient, Produced, ServiceError};

/// What is shown to other workers, and to which: all of them want the coordinator's token, and its authority vouches
/// for them.
pub(crate) struct Trust {
    pub credentials: Credentials,
    needs_tls: bool,
}

impl Trust {
    /// As a worker of this coordinator, or of these, has it: when they speak TLS, the token leaves this host over TLS
    /// only, whatever others say of themselves.
    pub fn of(coordinator: &str, credentials: Credentials) -> Self {
        Self { credentials, needs_tls: speaks_tls(coordinator) }
    }

    fn client(&self, url: &str) -> Result<PeerClient, ServiceError> {
        if self.needs_tls && !url.starts_with("https://") && !is_on_this_host(url) {
            let text = format!("{url} is not encrypted, and the coordinator is");
            return Err(ServiceError::new(Code::Unauthenticated, text));
        }
        PeerClient::connect(url, &self.credentials)
    }
}

/// Whether this coordinator, or one of these, speaks TLS.
pub(super) fn speaks_tls(coordinator: &str) -> bool {
    coordinator.to_ascii_lowercase().contains("https://")
}

fn is_on_this_host(url: &str) -> bool {
    let address = url.strip_prefix("http://").and_then(|address| address.parse::<SocketAddr>().ok());
    address.is_some_and(|address| address.ip().is_loopback())
}

/// The workers that maps can be fetched from.
pub(crate) struct Peers {
    trust: Trust,
    /// By address; without a client those that are shown nothing.
    known: Mutex<BTreeMap<WorkerId, (String, Option<PeerClient>)>>,
}

impl Peers {
    /// None are known yet.
    pub fn new(trust: Trust) -> Self {
        Self { trust, known: Mutex::new(BTreeMap::new()) }
    }

    /// Notes where workers are. What is in the memory of those that are refused comes from the store.
    pub fn learn(&self, peers: &[Peer]) {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        for Peer { worker, endpoint } in peers {
            let Some(address) = &endpoint.address else { continue };
            if known.get(worker).is_some_and(|(is, _)| is == address) {
                continue;
            }
            let client = self.trust.client(address);
            let error = client.as_ref().err().cloned();
            known.insert(worker.clone(), (address.clone(), client.ok()));
            if let Some(error) = error {
                let refused = known.values().filter(|(_, client)| client.is_none()).count();
                tracing::warn!(%worker, %error, refused, "nothing is fetched from a worker at this address");
            }
        }
    }

    /// A client of the worker, if it is known where it is.
    pub fn client(&self, worker: &WorkerId) -> Option<PeerClient> {
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.get(worker).and_then(|(_, client)| client.clone())
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

#[cfg(test)]
mod tests {
    use planesweep_proto::Endpoint;

    use super::*;

    #[tokio::test]
    async fn a_token_for_tls_leaves_the_host_over_tls_only() {
        let addresses = [
            ("http://other:7071", false),
            ("http://10.0.0.2:7071", false),
            ("http://127.0.0.1:7071@other:80", false),
            ("HTTP://other:7071", false),
            ("http://127.0.0.1:7071", true),
            ("http://[::1]:7071", true),
            ("https://other:7071", true),
        ];
        let peer = |address: &str| Peer {
            worker: WorkerId(address.to_owned()),
            endpoint: Endpoint { address: Some(address.to_owned()), inbox: None },
        };
        for coordinators in ["https://head:7070", "http://one:7070,HTTPS://two:7070"] {
            let peers = Peers::new(Trust::of(coordinators, Credentials::of_token(Some("s3cret"))));
            peers.learn(&addresses.map(|(address, _)| peer(address)));
            for (address, is_asked) in addresses {
                let client = peers.client(&WorkerId(address.to_owned()));
                assert_eq!(client.is_some(), is_asked, "{address} of {coordinators}");
            }
        }
        let peers = Peers::new(Trust::of("http://head:7070", Credentials::of_token(Some("s3cret"))));
        peers.learn(&[peer("http://other:7071")]);
        assert!(peers.client(&WorkerId("http://other:7071".to_owned())).is_some());
    }
}
