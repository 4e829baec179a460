//! How finished maps reach the jobs that need them.
//!
//! Every result lies in the store; that is the truth. But a map is needed soon, by the filters of its
//! neighbours, and then it mostly is in somebody's memory. The ways, in the order in which they are
//! tried:
//!
//! 1. [`Way::Process`]: this worker made or read the map and still has it decoded ([`Maps`]).
//! 2. [`Way::SharedMemory`]: a worker of this host wrote it into shared memory ([`Inbox`]).
//! 3. [`Way::Stream`]: the worker that made it sends it over gRPC ([`Peers`]).
//! 4. [`Way::Store`].
//!
//! A way on which a map does not come is no error, and the bytes are the same on each.

mod loan;
mod outgoing;
mod peers;
mod room;
mod server;
mod shared_memory;
mod shelf;

#[cfg(test)]
mod bench;
#[cfg(test)]
mod conformance;
#[cfg(test)]
mod killed;

use std::net::SocketAddr;
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::{BufMut, Bytes};
use planesweep_plan::{BlobKey, WorkerId};
use planesweep_proto::{Endpoint, Peer, Produced, Role, ServerTls, ServiceError, TlsError, Way};
use thiserror::Error;

use loan::Loan;
use outgoing::Outgoing;
pub(crate) use peers::Trust;
use peers::{Peers, speaks_tls};
use server::{Served, start_serving};
use shared_memory::{Inbox, Outbox, SharedMemoryError};

use crate::jobs::compute;
use crate::maps::Maps;
use crate::store::{Store, StoreError};

/// How often an inbox is looked into: more often than a sender finishes the few maps that may be on
/// the way.
const INBOX_PERIOD: Duration = Duration::from_millis(10);

/// How a worker exchanges maps with others.
#[derive(Clone, Debug)]
pub struct ExchangeConfig {
    /// Where others fetch what this worker has in memory. Beyond the host's own addresses a token is
    /// needed.
    pub listen: SocketAddr,
    /// With it, others fetch over TLS only.
    pub tls: Option<ServerTls>,
    /// Whether maps go through shared memory where they can.
    pub shared_memory: bool,
}

impl ExchangeConfig {
    /// Checks that a worker of this coordinator, or of these, may serve its maps so.
    pub(crate) fn check(&self, coordinator: &str) -> Result<(), ExchangeError> {
        let is_guarded = self.tls.is_some() || self.listen.ip().is_loopback();
        if speaks_tls(coordinator) && !is_guarded {
            return Err(ExchangeError::NoTls { listen: self.listen });
        }
        Ok(())
    }
}

/// Why a worker cannot exchange maps.
#[derive(Debug, Error)]
pub enum ExchangeError {
    /// Anybody could fetch the maps.
    #[error("maps are served at {listen} only with a token")]
    NoToken {
        /// The address.
        listen: SocketAddr,
    },
    /// The token, and the maps, would travel in plain text.
    #[error(
        "the coordinator speaks TLS, so maps are served beyond this host over TLS only: give a certificate and \
         its key, or do not listen on {listen}"
    )]
    NoTls {
        /// The address.
        listen: SocketAddr,
    },
    /// The certificate cannot be served with.
    #[error("cannot speak TLS")]
    Tls(#[from] TlsError),
    /// The token cannot be sent.
    #[error("the token is refused")]
    Token(#[source] ServiceError),
    /// The address is taken, or not of this host.
    #[error("could not listen on {listen}")]
    Listen {
        /// The address.
        listen: SocketAddr,
        /// Why.
        #[source]
        source: std::io::Error,
    },
}

/// This worker's part in the exchange.
pub(crate) struct Exchange {
    inbox: Option<Arc<Inbox>>,
    outgoing: Outgoing,
    peers: Arc<Peers>,
    served: Served,
}

impl Exchange {
    /// Serves `maps`, and opens an inbox if this is a worker for fusion alone: one of those is enough
    /// for a host, and where all workers do both, maps are mostly needed where they are made.
    pub async fn start(
        config: &ExchangeConfig,
        worker: &WorkerId,
        host: &str,
        role: Role,
        trust: Trust,
        maps: Arc<Maps>,
        inbox_bytes: u64,
    ) -> Result<Self, ExchangeError> {
        let has_inbox = config.shared_memory && role == Role::Fuse;
        let inbox = if has_inbox { open_inbox(worker.0.clone(), inbox_bytes).await } else { None };
        let served =
            start_serving(config, host, trust.credentials.token.as_deref(), maps, inbox.clone()).await?;
        let peers = Arc::new(Peers::new(trust));
        let outgoing = Outgoing::new(config.shared_memory && !has_inbox, Arc::clone(&peers));
        Ok(Self { inbox, outgoing, peers, served })
    }

    /// What the coordinator tells others.
    pub fn endpoint(&self) -> Endpoint {
        Endpoint {
            address: Some(self.served.address.clone()),
            inbox: self.inbox.as_ref().map(|inbox| inbox.name().to_owned()),
        }
    }

    /// Notes what the coordinator says of other workers.
    pub fn learn(&self, peers: &[Peer]) {
        self.peers.learn(peers, Instant::now());
        self.outgoing.learn(peers);
    }

    /// Has a map of this length written to where it can be sent from. `write` must fill all of it.
    pub async fn write(
        &self,
        length: usize,
        write: impl FnOnce(&mut dyn BufMut) + Send + 'static,
    ) -> Written {
        let outbox = self.outgoing.outbox_for(length).await;
        compute(move || {
            let mut write = Some(write);
            let lent = outbox.and_then(|outbox| {
                outbox.lend(length, |out| {
                    if let Some(write) = write.take() {
                        write(out);
                    }
                })
            });
            if let Some(loan) = lent {
                return Written::lent(loan);
            }
            let mut bytes = Vec::with_capacity(length);
            if let Some(write) = write {
                write(&mut bytes);
            }
            bytes.into()
        })
        .await
    }

    /// The bytes of a map that is not in this process, and the way they came.
    pub async fn get(&self, wanted: &Produced, store: &Store) -> Result<(Bytes, Way), StoreError> {
        if let Some(bytes) = self.inbox.as_ref().and_then(|inbox| inbox.get(&wanted.blob)) {
            return Ok((bytes, Way::SharedMemory));
        }
        if let Some(bytes) = self.peers.get(wanted).await {
            return Ok((bytes, Way::Stream));
        }
        Ok((store.get(&wanted.blob, wanted.length).await?, Way::Store))
    }
}

/// Opens an inbox and looks into it until it is dropped.
async fn open_inbox(name: String, budget_bytes: u64) -> Option<Arc<Inbox>> {
    let inbox = compute(move || Inbox::open(&name, budget_bytes)).await;
    let inbox = Arc::new(outgoing::or_say(inbox)?);
    let watched = Arc::downgrade(&inbox);
    tokio::spawn(async move {
        while let Some(inbox) = watched.upgrade() {
            inbox.receive();
            drop(inbox);
            tokio::time::sleep(INBOX_PERIOD).await;
        }
    });
    Some(inbox)
}

/// The bytes of a result, before they are in the store.
pub(crate) struct Written {
    bytes: Bytes,
    /// Where they lie, if that is shared memory.
    loan: Option<Arc<Loan>>,
}

/// Shared memory is lent as long as somebody reads it.
struct Lent(Arc<Loan>);

impl AsRef<[u8]> for Lent {
    fn as_ref(&self) -> &[u8] {
        (*self.0).as_ref()
    }
}

impl From<Vec<u8>> for Written {
    fn from(bytes: Vec<u8>) -> Self {
        Self { bytes: bytes.into(), loan: None }
    }
}

impl Written {
    fn lent(loan: Loan) -> Self {
        let loan = Arc::new(loan);
        Self { bytes: Bytes::from_owner(Lent(Arc::clone(&loan))), loan: Some(loan) }
    }

    /// The bytes.
    pub fn bytes(&self) -> Bytes {
        self.bytes.clone()
    }

    /// Sends the bytes to where they are going to be read, if they lie in shared memory. To be called
    /// when they are in the store: who gets them may then rely on them.
    pub fn send(self, key: &BlobKey) {
        drop(self.bytes);
        let Some(loan) = self.loan.and_then(Arc::into_inner) else { return };
        if !loan.send(key) {
            tracing::debug!(%key, "nobody takes a map from shared memory now; it comes on another way");
        }
    }
}
