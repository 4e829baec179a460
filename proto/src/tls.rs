//! The server's side of TLS: its certificate, and who is let in.

use std::io;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{Semaphore, mpsc};
use tokio::task::JoinHandle;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::pki_types::pem::PemObject;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::{self, ServerConfig, crypto::ring};
use tokio_rustls::server::TlsStream;
use tokio_stream::StreamExt;
use tokio_stream::wrappers::ReceiverStream;
use tonic::service::{InterceptorLayer, Routes};
use tonic::transport::Server;
use tonic::transport::server::{Router, TcpIncoming};
use tonic::{Request, Status};

use crate::client::KEEP_ALIVE;
use crate::{Code, Refusals, ServiceError};

/// How long a handshake may take, and how many may be under way: who connects and says nothing is sent away.
const HANDSHAKE: (Duration, usize) = (Duration::from_secs(10), 256);
/// How long a connection without TLS is kept, to be told so, and then to say goodbye.
const REFUSAL: (Duration, Duration) = (Duration::from_secs(10), Duration::from_secs(2));
/// How long nobody is let in after a connection could not be accepted; there may be too many.
const PAUSE: Duration = Duration::from_millis(100);

/// Calls of one connection at a time; more wait at the caller.
const MAX_STREAMS: u32 = 128;
/// Data of a call that may be on its way before anybody reads it.
const STREAM_WINDOW_BYTES: u32 = 1 << 20;

/// Who a server is to those who call it.
#[derive(Clone, PartialEq, Eq)]
pub struct ServerTls {
    /// Its certificate, with those that vouch for it, PEM.
    pub cert_pem: Vec<u8>,
    /// The certificate's private key, PEM.
    pub key_pem: Vec<u8>,
}

impl std::fmt::Debug for ServerTls {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str("ServerTls")
    }
}

/// Why a certificate cannot be served with.
#[derive(Debug, thiserror::Error)]
pub enum TlsError {
    /// The file of the certificate holds none.
    #[error("there is no certificate in PEM format in the file of the certificate")]
    NoCertificate,
    /// The file of the key holds none.
    #[error("there is no private key in PEM format in the file of the key")]
    NoKey,
    /// They do not belong together, or are of a kind that is not understood.
    #[error("the certificate and its key cannot be used")]
    Unusable(#[from] rustls::Error),
}

impl ServerTls {
    /// What makes the handshakes.
    pub fn acceptor(&self) -> Result<TlsAcceptor, TlsError> {
        let certificates = CertificateDer::pem_slice_iter(&self.cert_pem).collect::<Result<Vec<_>, _>>();
        let certificates = certificates.map_err(|_| TlsError::NoCertificate)?;
        if certificates.is_empty() {
            return Err(TlsError::NoCertificate);
        }
        let key = PrivateKeyDer::from_pem_slice(&self.key_pem).map_err(|_| TlsError::NoKey)?;
        let mut config = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
            .with_safe_default_protocol_versions()?
            .with_no_client_auth()
            .with_single_cert(certificates, key)?;
        config.alpn_protocols.push(b"h2".to_vec());
        Ok(TlsAcceptor::from(Arc::new(config)))
    }
}

/// A server that probes its connections, and closes those on which nobody is there any more.
///
/// A call whose data waits for its turn takes no room from the other calls of its connection.
pub fn probing_server() -> Server {
    Server::builder()
        .http2_keepalive_interval(Some(KEEP_ALIVE.0))
        .http2_keepalive_timeout(Some(KEEP_ALIVE.1))
        .initial_stream_window_size(STREAM_WINDOW_BYTES)
        .initial_connection_window_size((MAX_STREAMS + 1) * STREAM_WINDOW_BYTES)
        .max_concurrent_streams(MAX_STREAMS)
}

/// Serves until `stopped`. With an acceptor, who speaks no TLS or does not end the handshake is refused, and counted.
pub fn serve(
    router: Router,
    listener: TcpListener,
    tls: Option<TlsAcceptor>,
    refusals: Refusals,
    stopped: impl Future<Output = ()> + Send + 'static,
) -> JoinHandle<Result<(), tonic::transport::Error>> {
    let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
    match tls {
        None => tokio::spawn(router.serve_with_incoming_shutdown(incoming, stopped)),
        Some(acceptor) => {
            let (secured, plain) = handshakes(incoming, acceptor, refusals.clone());
            tokio::spawn(refuse(plain, refusals));
            tokio::spawn(router.serve_with_incoming_shutdown(secured, stopped))
        }
    }
}

/// Tells callers without TLS so, in the only language that they understand, before their call is read.
async fn refuse(plain: Connections<TcpStream>, refusals: Refusals) {
    let refuse = move |_: Request<()>| -> Result<Request<()>, Status> {
        refusals.count();
        tracing::warn!("a call that does not speak TLS is refused");
        let text = "this server has a certificate and speaks TLS only; its address begins with https://";
        Err(ServiceError::new(Code::Unauthenticated, text).into())
    };
    let server = probing_server().max_connection_age(REFUSAL.0).max_connection_age_grace(REFUSAL.1);
    let server = server.layer(InterceptorLayer::new(refuse)).add_routes(Routes::default());
    if let Err(error) = server.serve_with_incoming(plain).await {
        tracing::debug!(%error, "callers without TLS are not told so any more");
    }
}

type Connections<T> = ReceiverStream<io::Result<T>>;

/// The connections whose handshake succeeded, and those that begin in plain text; a slow one keeps no other waiting.
fn handshakes(
    mut incoming: TcpIncoming,
    acceptor: TlsAcceptor,
    refusals: Refusals,
) -> (Connections<TlsStream<TcpStream>>, Connections<TcpStream>) {
    let (done, connections) = mpsc::channel(1);
    let (plain, plain_connections) = mpsc::channel(1);
    let turns = Arc::new(Semaphore::new(HANDSHAKE.1));
    tokio::spawn(async move {
        loop {
            let Ok(turn) = Arc::clone(&turns).acquire_owned().await else { return };
            let socket = tokio::select! {
                () = done.closed() => return,
                next = incoming.next() => match next {
                    Some(Ok(socket)) => socket,
                    Some(Err(error)) => {
                        tracing::debug!(%error, "a connection cannot be accepted");
                        tokio::time::sleep(PAUSE).await;
                        continue;
                    }
                    None => return,
                },
            };
            let (acceptor, refusals) = (acceptor.clone(), refusals.clone());
            let (done, plain) = (done.clone(), plain.clone());
            tokio::spawn(async move {
                let handshake = tokio::time::timeout(HANDSHAKE.0, handshake(socket, &acceptor)).await;
                drop(turn);
                match handshake.unwrap_or_else(|_| Err(io::ErrorKind::TimedOut.into())) {
                    Ok(Opened::Secured(stream)) => drop(done.send(Ok(*stream)).await),
                    Ok(Opened::Plain(socket)) => drop(plain.send(Ok(socket)).await),
                    // Nothing was said, as by a probe of the port.
                    Err(error) if error.kind() == io::ErrorKind::UnexpectedEof => {}
                    Err(error) => {
                        tracing::warn!(%error, "a handshake failed, and the caller is refused");
                        refusals.count();
                    }
                }
            });
        }
    });
    (ReceiverStream::new(connections), ReceiverStream::new(plain_connections))
}

/// How a connection begins.
enum Opened {
    Secured(Box<TlsStream<TcpStream>>),
    Plain(TcpStream),
}

async fn handshake(socket: TcpStream, acceptor: &TlsAcceptor) -> io::Result<Opened> {
    // No TLS begins like HTTP/2 does.
    let mut start = [0; 3];
    if socket.peek(&mut start).await? == start.len() && &start == b"PRI" {
        return Ok(Opened::Plain(socket));
    }
    acceptor.accept(socket).await.map(|stream| Opened::Secured(Box::new(stream)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_certificate_cannot_be_served_with() {
        let none = ServerTls { cert_pem: b"none".to_vec(), key_pem: Vec::new() };
        assert!(matches!(none.acceptor(), Err(TlsError::NoCertificate)));
    }
}
