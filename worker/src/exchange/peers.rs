//! Other workers, and what they have in memory.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use bytes::Bytes;
use planesweep_plan::WorkerId;
use planesweep_proto::{Code, Credentials, Peer, PeerClient, Produced, ServiceError};

/// How long a worker that cannot be reached is not asked: each try costs a job its time.
const REST: Duration = Duration::from_mins(1);

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
    known: Mutex<BTreeMap<WorkerId, Known>>,
}

/// What is known of another worker.
struct Known {
    address: String,
    /// None for one that is shown nothing, or is not asked for a while.
    client: Option<PeerClient>,
    /// When it could not be reached last.
    failed: Option<Instant>,
}

impl Peers {
    /// None are known yet.
    pub fn new(trust: Trust) -> Self {
        Self { trust, known: Mutex::new(BTreeMap::new()) }
    }

    /// Notes where workers are. What is in the memory of those that are refused comes from the store, and so it does
    /// for a while if one cannot be reached.
    pub fn learn(&self, peers: &[Peer], now: Instant) {
        let mut known = self.known();
        for Peer { worker, endpoint } in peers {
            let Some(address) = &endpoint.address else { continue };
            let before = known.get(worker).filter(|known| known.address == *address);
            let failed = before.and_then(|known| known.failed);
            let has_rested = failed.is_some_and(|failed| now.duration_since(failed) >= REST);
            if before.is_some_and(|known| known.client.is_some() || !has_rested) {
                continue;
            }
            let client = self.trust.client(address);
            let error = client.as_ref().err().cloned();
            known.insert(worker.clone(), Known { address: address.clone(), client: client.ok(), failed });
            if let Some(error) = error {
                let is_refused = |known: &&Known| known.client.is_none() && known.failed.is_none();
                let refused = known.values().filter(is_refused).count();
                tracing::warn!(%worker, %error, refused, "nothing is fetched from a worker at this address");
            }
        }
    }

    fn known(&self) -> MutexGuard<'_, BTreeMap<WorkerId, Known>> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A client of the worker, if it is known where it is, and it is asked.
    pub fn client(&self, worker: &WorkerId) -> Option<PeerClient> {
        self.known().get(worker)?.client.clone()
    }

    /// The bytes of a blob from the worker that made it, if it still has them.
    pub async fn get(&self, wanted: &Produced) -> Option<Bytes> {
        let mut client = self.client(&wanted.worker)?;
        match client.fetch(&wanted.blob, wanted.length).await {
            Ok(bytes) => Some(bytes),
            Err(error) => {
                tracing::debug!(worker = %wanted.worker, %error, "a map does not come from its worker");
                self.note_failure(&wanted.worker, &error, Instant::now());
                None
            }
        }
    }

    /// Lets a worker rest that cannot be reached, and says so the first time.
    fn note_failure(&self, worker: &WorkerId, error: &ServiceError, now: Instant) {
        let mut known = self.known();
        let Some(known) = known.get_mut(worker).filter(|_| error.is_retryable()) else { return };
        known.client = None;
        if known.failed.replace(now).is_none() {
            let (address, rest_s) = (&known.address, REST.as_secs());
            tracing::warn!(%worker, address, %error, rest_s, "a worker cannot be reached, its maps come from the store");
        }
    }
}

#[cfg(test)]
mod tests {
    use planesweep_proto::Endpoint;

    use super::*;

    fn peer(worker: &str, address: &str) -> Peer {
        let endpoint = Endpoint { address: Some(address.to_owned()), inbox: None };
        Peer { worker: WorkerId(worker.to_owned()), endpoint }
    }

    #[tokio::test]
    async fn who_cannot_be_reached_is_asked_again_after_a_while_only() {
        let peers = Peers::new(Trust::of("http://head:7070", Credentials::default()));
        let (worker, begun) = (WorkerId("other".to_owned()), Instant::now());
        let named = |address: &str, after: Duration| {
            peers.learn(&[peer("other", address)], begun + after);
            peers.client(&worker).is_some()
        };
        assert!(named("http://other:7071", Duration::ZERO));
        // It has the map no longer, but it answers.
        peers.note_failure(&worker, &ServiceError::new(Code::NotFound, "gone"), begun);
        assert!(named("http://other:7071", Duration::ZERO));

        let unreachable = ServiceError::new(Code::Unavailable, "no route");
        peers.note_failure(&worker, &unreachable, begun);
        assert!(!named("http://other:7071", Duration::ZERO) && !named("http://other:7071", REST / 2));
        assert!(named("http://other:7071", REST));
        peers.note_failure(&worker, &unreachable, begun + REST);
        assert!(!named("http://other:7071", REST * 3 / 2) && named("http://elsewhere:7071", REST * 3 / 2));
    }

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
        for coordinators in ["https://head:7070", "http://one:7070,HTTPS://two:7070"] {
            let peers = Peers::new(Trust::of(coordinators, Credentials::of_token(Some("s3cret"))));
            peers.learn(&addresses.map(|(address, _)| peer(address, address)), Instant::now());
            for (address, is_asked) in addresses {
                let client = peers.client(&WorkerId(address.to_owned()));
                assert_eq!(client.is_some(), is_asked, "{address} of {coordinators}");
            }
        }
        let peers = Peers::new(Trust::of("http://head:7070", Credentials::of_token(Some("s3cret"))));
        peers.learn(&[peer("http://other:7071", "http://other:7071")], Instant::now());
        assert!(peers.client(&WorkerId("http://other:7071".to_owned())).is_some());
    }
}
