//! What this worker has in memory, for others to fetch.

use std::io;
use std::sync::Arc;

use planesweep_plan::BlobKey;
use planesweep_proto::limits::{CHUNK_TIME, MAX_EXCHANGE_MESSAGE_BYTES};
use planesweep_proto::wire::exchange_server::{Exchange, ExchangeServer};
use planesweep_proto::{
    CheckToken, ChunkSender, Code, Refusals, ServerTls, ServiceError, bearer, blob_chunks, probing_server,
    serve, wire,
};
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tokio::task::spawn_blocking;
use tokio_util::sync::{CancellationToken, DropGuard};
use tonic::codegen::BoxStream;
use tonic::service::interceptor::InterceptedService;
use tonic::{Request, Response, Status};

use super::{ExchangeConfig, ExchangeError, Inbox};
use crate::maps::Maps;

/// Maps on their way at once, each as a whole in memory; who asks beyond that waits.
const MAX_FETCHES: usize = 4;

/// A server that stops when this is dropped.
pub(crate) struct Served {
    /// What others reach it by.
    pub address: String,
    _stop: DropGuard,
}

/// Serves maps, and the inbox if there is one. Beyond this host, only to those who have the token.
pub(crate) async fn start_serving(
    config: &ExchangeConfig,
    host: &str,
    token: Option<&str>,
    maps: Arc<Maps>,
    inbox: Option<Arc<Inbox>>,
) -> Result<Served, ExchangeError> {
    let listen = config.listen;
    if !listen.ip().is_loopback() && token.is_none() {
        return Err(ExchangeError::NoToken { listen });
    }
    let expected = token.map(bearer).transpose().map_err(ExchangeError::Token)?;
    let tls = config.tls.as_ref().map(ServerTls::acceptor).transpose()?;
    let scheme = if tls.is_some() { "https" } else { "http" };
    let cannot_listen = |source: io::Error| ExchangeError::Listen { listen, source };
    let listener = TcpListener::bind(listen).await.map_err(cannot_listen)?;
    let local = listener.local_addr().map_err(cannot_listen)?;
    // Whoever listens everywhere is found by the name of the host.
    let address = if local.ip().is_unspecified() {
        format!("{scheme}://{host}:{}", local.port())
    } else {
        format!("{scheme}://{local}")
    };
    tracing::info!("maps are served at {address}");
    if config.tls.is_none() && !listen.ip().is_loopback() {
        tracing::warn!(
            "the maps, and the token of those who fetch them, travel in plain text: there is no certificate"
        );
    }
    let service = ExchangeServer::new(Service { maps, inbox, turns: Arc::new(Semaphore::new(MAX_FETCHES)) })
        .max_decoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES)
        .max_encoding_message_size(MAX_EXCHANGE_MESSAGE_BYTES);
    let stop = CancellationToken::new();
    let stopped = stop.clone().cancelled_owned();
    let refusals = Refusals::default();
    let check = CheckToken { expected, refusals: refusals.clone() };
    let router = probing_server().add_service(InterceptedService::new(service, check));
    let server = serve(router, listener, tls, refusals, stopped);
    tokio::spawn(async move {
        if let Ok(Err(error)) = server.await {
            tracing::warn!(%error, "maps are served no longer");
        }
    });
    Ok(Served { address, _stop: stop.drop_guard() })
}

struct Service {
    maps: Arc<Maps>,
    inbox: Option<Arc<Inbox>>,
    turns: Arc<Semaphore>,
}

#[tonic::async_trait]
impl Exchange for Service {
    type FetchStream = BoxStream<wire::BlobChunk>;

    async fn fetch(
        &self,
        request: Request<wire::BlobRequest>,
    ) -> Result<Response<Self::FetchStream>, Status> {
        let key = BlobKey::try_from(request.into_inner()).map_err(ServiceError::from)?;
        let turn = self.turns.clone().acquire_owned().await;
        let turn = turn.map_err(|_| ServiceError::new(Code::Unavailable, "the worker is stopping"))?;
        let maps = Arc::clone(&self.maps);
        let bytes = spawn_blocking(move || maps.bytes_of(&key)).await;
        let Ok(Some(bytes)) = bytes else {
            let text = format!("blob {key} is not in memory any more");
            return Err(ServiceError::new(Code::NotFound, text).into());
        };
        let (reader, answer) = ChunkSender::new(CHUNK_TIME);
        tokio::spawn(async move {
            let _until_the_last = turn;
            for chunk in blob_chunks(key, bytes) {
                if !reader.send(chunk).await {
                    return;
                }
            }
        });
        Ok(Response::new(answer))
    }

    async fn open_inbox(
        &self,
        request: Request<wire::OpenInboxRequest>,
    ) -> Result<Response<wire::OpenInboxReply>, Status> {
        let name = request.into_inner().inbox;
        match self.inbox.as_ref().filter(|inbox| inbox.name() == name) {
            Some(inbox) => inbox.receive(),
            None => return Err(ServiceError::new(Code::NotFound, "this worker has no such inbox").into()),
        }
        Ok(Response::new(wire::OpenInboxReply {}))
    }
}
