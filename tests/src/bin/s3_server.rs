//! A server of the S3 protocol as a program of its own: it stands in for the one of `docker/compose.yaml`, which comes
//! from a registry, and is told what to do as that one is.
//!
//! ```sh
//! ROOT_ACCESS_KEY=... ROOT_SECRET_KEY=... s3_server posix FOLDER
//! ```

use std::net::Ipv4Addr;

use planesweep_tests::serve_s3;
use tokio::net::TcpListener;

const PORT: u16 = 7070;

#[tokio::main]
async fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [backend, folder] = arguments.as_slice() else { panic!("posix and a folder are needed") };
    assert_eq!(backend, "posix", "folders are all it has");
    let key = |name: &str| std::env::var(name).unwrap_or_else(|error| panic!("{name}: {error}"));
    let (access, secret) = (key("ROOT_ACCESS_KEY"), key("ROOT_SECRET_KEY"));
    let listener = TcpListener::bind((Ipv4Addr::UNSPECIFIED, PORT)).await.expect("the port is free");
    serve_s3(folder.into(), access, secret, listener).await;
}
