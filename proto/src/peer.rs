//! A worker's side of the contract between workers: fetching what another has in memory.

use std::time::Duration;

use bytes::Bytes;
use planesweep_plan::BlobKey;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::Channel;

use crate::chunks::{in_time, receive};
use crate::client::{KEEP_ALIVE, WithToken};
use crate::limits::MAX_EXCHANGE_MESSAGE_BYTES;
use crate::wire::exchange_client::ExchangeClient;
use crate::{Code, Credentials, ServiceError, bearer, wire};

/// How long a connection may take: a worker that is slow to reach is not the shorter way.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(2);
/// How long each message of an answer may take.
const MESSAGE_TIMEOUT: Duration = Duration::from_secs(10);
/// What may be under way before it is read: enough for a fast network, and bounded.
const WINDOW_BYTES: u32 = 4 << 20;

/// A client of one worker; cheap to clone, clones share the connection.
#[derive(Clone)]
pub struct PeerClient {
    stub: ExchangeClient<InterceptedService<Channel, WithToken>>,
}

impl PeerClient {
    /// A client of the worker at `url`, such as `http://10.0.0.2:7071`. The connection is made by the
    /// first call and again by the next call after it broke.
    ///
    /// Must be called within a tokio runtime.
    pub fn connect(url: &str, credentials: &Credentials) -> Result<Self, ServiceError> {
        let token = credentials.token.as_deref().map(bearer).transpose()?;
        // Certificates vouch only for those that have one; a worker of this host needs none.
        let is_tls = url.starts_with("https://");
        let endpoint = Credentials { ca_pem: credentials.ca_pem.clone().filter(|_| is_tls), token: None }
            .endpoint(url)?
            .connect_timeout(CONNECT_TIMEOUT)
            .tcp_nodelay(true)
            .initial_stream_window_size(WINDOW_BYTES)
            .initial_connection_window_size(WINDOW_BYTES)
            .http2_keep_alive_interval(KEEP_ALIVE.0)
            .keep_alive_timeout(KEEP_ALIVE.1);
        let stub = ExchangeClient::with_interceptor(endpoint.connect_lazy(), WithToken::new(token))
            .max_decoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
            .max_encoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES);
        Ok(Self { stub })
    }

    /// The bytes of a blob of this length. Refused are more or fewer bytes, and such of another hash.
    pub async fn fetch(&mut self, key: &BlobKey, length: u64) -> Result<Bytes, ServiceError> {
        let request = wire::BlobRequest::from(key);
        let chunks = in_time(MESSAGE_TIMEOUT, self.stub.fetch(request)).await??.into_inner();
        let bytes = receive(chunks, key, length, MESSAGE_TIMEOUT).await?;
        if bytes.len() as u64 != length || BlobKey::of(&bytes) != *key {
            let text = format!("blob {key} came with another hash or length");
            return Err(ServiceError::new(Code::Invalid, text));
        }
        Ok(bytes)
    }

    /// Tells the worker that this one has opened its inbox, and returns when the two are connected.
    pub async fn open_inbox(&mut self, inbox: &str) -> Result<(), ServiceError> {
        let request = wire::OpenInboxRequest { inbox: inbox.to_owned() };
        in_time(MESSAGE_TIMEOUT, self.stub.open_inbox(request)).await??;
        Ok(())
    }
}
