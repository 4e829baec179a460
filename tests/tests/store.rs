//! What every store must do, over a folder and over the S3 protocol.

use std::fs;
use std::path::{Path, PathBuf};

use bytes::Bytes;
use planesweep_plan::BlobKey;
use planesweep_store::{Store, StoreError};
use planesweep_tests::{S3Server, files_below};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

/// More than two parts of an upload.
const LARGE: usize = 20 << 20;

/// Runs the suite on the store at an address whose blobs lie below a folder.
fn conforms(store: &Store, folder: &Path) {
    Runtime::new().expect("a runtime").block_on(async {
        what_is_put_comes_back_once(store, folder).await;
        large_blobs_come_back(store).await;
        a_flipped_bit_is_found_and_mended(store, folder).await;
        a_missing_blob_is_named(store).await;
    });
}

async fn what_is_put_comes_back_once(store: &Store, folder: &Path) {
    let key = store.put(Bytes::from_static(b"depth")).await.expect("written");
    assert_eq!(store.put(Bytes::from_static(b"depth")).await.expect("written"), key);
    assert_eq!(store.get(&key).await.expect("read"), &b"depth"[..]);
    assert!(store.has(&key, 5).await.expect("asked") && !store.has(&key, 4).await.expect("asked"));
    assert_eq!(blob_files(folder).len(), 1, "a blob is one file, and nothing is left beside it");
    let empty = store.put(Bytes::new()).await.expect("written");
    assert_eq!(store.get(&empty).await.expect("read"), &b""[..]);
}

async fn large_blobs_come_back(store: &Store) {
    let bytes: Bytes = (0..LARGE).map(|k| (k * 31 % 251) as u8).collect::<Vec<u8>>().into();
    let key = store.put(bytes.clone()).await.expect("written");
    assert!(store.has(&key, LARGE as u64).await.expect("asked"));
    assert!(store.get(&key).await.expect("read") == bytes);
}

async fn a_flipped_bit_is_found_and_mended(store: &Store, folder: &Path) {
    let key = store.put(Bytes::from_static(b"confidence")).await.expect("written");
    let is_it = |path: &PathBuf| fs::read(path).is_ok_and(|bytes| bytes == b"confidence");
    let file = blob_files(folder).into_iter().find(is_it).expect("a blob is a file");
    fs::write(&file, b"confidencE").expect("spoilt");
    let error = store.get(&key).await.expect_err("damaged");
    assert!(matches!(error, StoreError::Damaged { .. }) && error.is_lost() && !error.is_passing());
    store.put(Bytes::from_static(b"confidence")).await.expect("written again");
    assert!(store.get(&key).await.is_ok());
}

async fn a_missing_blob_is_named(store: &Store) {
    let key = BlobKey::of(b"never written");
    let error = store.get(&key).await.expect_err("missing");
    assert_eq!(error.to_string(), format!("blob {key} is not in the store"));
    assert!(error.is_lost() && !store.has(&key, 13).await.expect("asked"));
}

/// Files of blobs, not what the server keeps of its own.
fn blob_files(folder: &Path) -> Vec<PathBuf> {
    let is_blob = |path: &PathBuf| path.components().any(|part| part.as_os_str() == "blobs");
    files_below(folder).iter().map(|file| folder.join(file)).filter(is_blob).collect()
}

#[test]
fn a_folder_is_a_store() {
    let folder = tempfile::tempdir().expect("a folder");
    let store = Store::open(&format!("file://{}", folder.path().display())).expect("a store");
    conforms(&store, folder.path());
}

#[test]
fn an_s3_server_is_a_store_that_may_go_and_come_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut server = S3Server::start(folder.path());
    let variables = server.environment().into_iter().map(|(name, value)| (name.to_owned(), value));
    let store = Store::open_with(&server.store_url(), variables).expect("a store");
    conforms(&store, &server.bucket());

    let impatience = CancellationToken::new();
    let store = store.patient(impatience.clone());
    let runtime = Runtime::new().expect("a runtime");
    server.go_away();
    let write = runtime.spawn({
        let store = store.clone();
        async move { store.put(Bytes::from_static(b"written while nobody listens")).await }
    });
    std::thread::sleep(std::time::Duration::from_millis(500));
    assert!(!write.is_finished(), "it waits for the server");
    server.come_back();
    let key = runtime.block_on(write).expect("no panic").expect("written");
    assert_eq!(runtime.block_on(store.get(&key)).expect("read"), &b"written while nobody listens"[..]);

    server.go_away();
    impatience.cancel();
    let error = runtime.block_on(store.get(&key)).expect_err("nobody listens");
    assert!(error.is_passing() && !error.is_lost(), "{error}");
}

#[test]
fn addresses_that_are_none_are_refused_by_name() {
    for url in ["ftp://host/blobs", "http://host/blobs", "s3:/bucket", "nothing"] {
        let error = Store::open(url).expect_err("no store");
        assert!(error.to_string().contains(url), "{error}");
    }
}
