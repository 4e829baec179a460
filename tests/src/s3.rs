//! A server of the S3 protocol.

use std::net::{Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto::Builder;
use s3s::auth::SimpleAuth;
use s3s::service::S3ServiceBuilder;
use s3s_fs::FileSystem;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;

/// What opens the server.
const KEYS: (&str, &str) = ("test-key", "test-secret");
const BUCKET: &str = "bucket";
/// How long open connections may take to break when the server goes.
const CLOSING: Duration = Duration::from_secs(5);

/// A server in the test's process with one bucket in a folder. It can go away and come back at the same address.
pub struct S3Server {
    folder: PathBuf,
    address: SocketAddr,
    runtime: Option<Runtime>,
}

impl S3Server {
    /// Serves this folder, which is made, at a free port.
    pub fn start(folder: &Path) -> Self {
        std::fs::create_dir_all(folder.join(BUCKET)).expect("made");
        let mut server =
            Self { folder: folder.to_owned(), address: (Ipv4Addr::LOCALHOST, 0).into(), runtime: None };
        server.come_back();
        server
    }

    /// The address of a store in it.
    pub fn store_url(&self) -> String {
        format!("s3://{BUCKET}/some/prefix")
    }

    /// The variables that lead to it and open it.
    pub fn environment(&self) -> Vec<(&'static str, String)> {
        vec![
            ("AWS_ENDPOINT_URL", format!("http://{}", self.address)),
            ("AWS_ACCESS_KEY_ID", KEYS.0.to_owned()),
            ("AWS_SECRET_ACCESS_KEY", KEYS.1.to_owned()),
            ("AWS_REGION", "us-east-1".to_owned()),
        ]
    }

    /// The folder of the bucket.
    pub fn bucket(&self) -> PathBuf {
        self.folder.join(BUCKET)
    }

    /// Stops listening and breaks every connection.
    pub fn go_away(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(CLOSING);
        }
    }

    /// Serves again.
    pub fn come_back(&mut self) {
        let runtime = Runtime::new().expect("a runtime");
        let listener = runtime.block_on(TcpListener::bind(self.address)).expect("a free port");
        self.address = listener.local_addr().expect("it is bound");
        runtime.spawn(serve_s3(self.folder.clone(), KEYS.0.to_owned(), KEYS.1.to_owned(), listener));
        self.runtime = Some(runtime);
    }
}

impl Drop for S3Server {
    fn drop(&mut self) {
        self.go_away();
    }
}

/// Serves the folders in this one as buckets, to whoever has the keys, without end.
pub async fn serve_s3(folder: PathBuf, access_key: String, secret_key: String, listener: TcpListener) {
    let mut builder = S3ServiceBuilder::new(FileSystem::new(folder).expect("a folder"));
    builder.set_auth(SimpleAuth::from_single(access_key, secret_key));
    let service = builder.build();
    while let Ok((socket, _)) = listener.accept().await {
        let service = service.clone();
        tokio::spawn(async move {
            let server = Builder::new(TokioExecutor::new());
            // A connection that breaks is the client's affair.
            let _ = server.serve_connection(TokioIo::new(socket), service).await;
        });
    }
}
