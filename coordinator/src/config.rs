//! What a coordinator is started with.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::time::Duration;

use planesweep_proto::ServerTls;
use planesweep_store::Objects;
use thiserror::Error;
use tonic::metadata::{Ascii, MetadataValue};

use crate::ledger::LedgerPlace;

/// Shorter leases would end between two reports on a busy host.
const MIN_LEASE: Duration = Duration::from_millis(100);
/// Longer leases would leave a dead worker's jobs undone for an hour and more.
const MAX_LEASE: Duration = Duration::from_hours(1);

/// A store whose blobs the coordinator passes on.
#[derive(Clone, Debug)]
pub struct ServedStore {
    /// The store.
    pub store: Objects,
    /// What tells it from all others from now on if nothing does yet; must be unique.
    pub new_identity: String,
}

/// What a coordinator is started with.
#[derive(Clone, Debug)]
pub struct Config {
    /// What knows every job.
    pub ledger: LedgerPlace,
    /// Where to listen; port 0 takes a free one.
    pub listen: SocketAddr,
    /// How long a worker that does not report keeps its jobs. Everything else about time is derived
    /// from it.
    pub lease: Duration,
    /// Where blobs lie; told to the workers.
    pub store_url: String,
    /// The same store, for callers that do not reach it at its address; `None` when all do.
    pub served: Option<ServedStore>,
    /// What callers must show; needed when listening to other hosts.
    pub token: Option<String>,
    /// With it, nobody is let in who does not speak TLS.
    pub tls: Option<ServerTls>,
}

/// Why a configuration is refused.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum ConfigError {
    /// Anybody could give jobs and results to a coordinator that other hosts reach.
    #[error(
        "listening on {listen} lets other hosts in, so a token is needed; set one, or listen on 127.0.0.1"
    )]
    NoToken {
        /// Where it was to listen.
        listen: SocketAddr,
    },
    /// The token guards nothing.
    #[error("the token is empty or has characters other than printable ASCII")]
    BadToken,
    /// The lease is too short or too long.
    #[error("a lease of {lease:?} is not within {MIN_LEASE:?} to {MAX_LEASE:?}")]
    Lease {
        /// The lease.
        lease: Duration,
    },
}

impl Config {
    /// The defaults: a free port of the loopback interface, leases of 7 s, no token.
    pub fn new(ledger: impl Into<LedgerPlace>, store_url: impl Into<String>) -> Self {
        Self {
            ledger: ledger.into(),
            listen: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0),
            lease: Duration::from_secs(7),
            store_url: store_url.into(),
            served: None,
            token: None,
            tls: None,
        }
    }

    /// How often a worker reports: 2 s for a lease of 7 s. Three reports fit into a lease, and half
    /// an interval is left for the last one's way.
    pub fn report_interval(&self) -> Duration {
        self.lease * 2 / 7
    }

    /// Checks the configuration; returns what callers must show.
    pub(crate) fn check(&self) -> Result<Option<MetadataValue<Ascii>>, ConfigError> {
        if !(MIN_LEASE..=MAX_LEASE).contains(&self.lease) {
            return Err(ConfigError::Lease { lease: self.lease });
        }
        match self.token.as_deref() {
            None if self.listen.ip().is_loopback() => Ok(None),
            None => Err(ConfigError::NoToken { listen: self.listen }),
            Some("") => Err(ConfigError::BadToken),
            Some(token) => planesweep_proto::bearer(token).map(Some).map_err(|_| ConfigError::BadToken),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn other_hosts_need_a_token() {
        let local = Config::new("ledger", "file:///store");
        assert_eq!(local.check(), Ok(None));
        let listen = SocketAddr::from(([0, 0, 0, 0], 7070));
        let open = Config { listen, ..local };
        assert_eq!(open.check(), Err(ConfigError::NoToken { listen }));
        assert!(
            Config { token: Some("s3cret".into()), ..open.clone() }
                .check()
                .is_ok_and(|token| token.is_some())
        );
        assert_eq!(Config { token: Some(String::new()), ..open }.check(), Err(ConfigError::BadToken));
    }

    #[test]
    fn intervals_come_from_the_lease() {
        let config = Config::new("ledger", "file:///store");
        assert_eq!(config.report_interval(), Duration::from_secs(2));
        let hasty = Config { lease: Duration::from_millis(10), ..config };
        assert_eq!(hasty.check(), Err(ConfigError::Lease { lease: Duration::from_millis(10) }));
    }
}
