//! What every store must do: in a folder, over the S3 protocol, and through a coordinator.

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;

use bytes::Bytes;
use planesweep_plan::BlobKey;
use planesweep_proto::limits::{MAX_BLOB_BYTES, MAX_EXCHANGE_MESSAGE_BYTES};
use planesweep_proto::wire::blobs_client::BlobsClient;
use planesweep_proto::wire::{Blob, BlobChunk};
use planesweep_proto::{Client, StorePlace};
use planesweep_store::{Objects, Store, StoreError};
use planesweep_tests::{Bench, Cluster, S3Server, files_below, run, wait_until};
use tokio::runtime::Runtime;
use tokio_util::sync::CancellationToken;

/// How long a state may take to come; far above what it ever takes.
const DEADLINE: Duration = Duration::from_mins(1);
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
    assert_eq!(store.get_file(&key).await.expect("read"), &b"depth"[..]);
    assert!(store.holds(&key).await.expect("asked"));
    assert_eq!(blob_files(folder).len(), 1, "a blob is one file, and nothing is left beside it");
    assert_eq!(store.get(&key, 5).await.expect("read"), &b"depth"[..]);
    let error = store.get(&key, 4).await.expect_err("more than it may have");
    assert!(matches!(error, StoreError::TooLarge { at_most: 4, .. }) && error.is_lost(), "{error}");
    let empty = store.put(Bytes::new()).await.expect("written");
    assert_eq!(store.get_file(&empty).await.expect("read"), &b""[..]);
}

async fn large_blobs_come_back(store: &Store) {
    let bytes: Bytes = (0..LARGE).map(|k| (k * 31 % 251) as u8).collect::<Vec<u8>>().into();
    let key = store.put(bytes.clone()).await.expect("written");
    assert!(store.holds(&key).await.expect("asked"));
    assert!(store.get_file(&key).await.expect("read") == bytes);
}

async fn a_flipped_bit_is_found_and_mended(store: &Store, folder: &Path) {
    let key = store.put(Bytes::from_static(b"confidence")).await.expect("written");
    let is_it = |path: &PathBuf| fs::read(path).is_ok_and(|bytes| bytes == b"confidence");
    let file = blob_files(folder).into_iter().find(is_it).expect("a blob is a file");
    fs::write(&file, b"confidencE").expect("spoilt");
    let error = store.get_file(&key).await.expect_err("damaged");
    assert!(matches!(error, StoreError::Damaged { .. }) && error.is_lost() && !error.is_passing());
    assert!(!store.holds(&key).await.expect("asked"));
    store.put(Bytes::from_static(b"confidence")).await.expect("written again");
    assert!(store.get_file(&key).await.is_ok());
}

async fn a_missing_blob_is_named(store: &Store) {
    let key = BlobKey::of(b"never written");
    let error = store.get_file(&key).await.expect_err("missing");
    assert_eq!(error.to_string(), format!("blob {key} is not in the store"));
    assert!(error.is_lost() && !store.holds(&key).await.expect("asked"));
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

/// A store whose blobs go through this cluster's coordinator, for nothing is found at its address.
fn through(cluster: &Cluster) -> (Runtime, Store) {
    let runtime = Runtime::new().expect("a runtime");
    let store = runtime.block_on(async {
        let client = Client::connect(cluster.url(), None).expect("an address");
        let place = client.clone().store().await.expect("an answer");
        assert!(Store::of(&client, &place).await.expect("a store").is_reached_from_here());
        let elsewhere = StorePlace { url: "file:///nowhere/to/be/seen".to_owned(), ..place };
        Store::of(&client, &elsewhere).await.expect("a store")
    });
    assert!(!store.is_reached_from_here() && !Path::new("/nowhere").exists());
    (runtime, store)
}

#[test]
fn a_coordinator_is_a_store() {
    let bench = Bench::new(|_| {});
    let cluster = Cluster::start(&bench, &[]);
    let (_runtime, store) = through(&cluster);
    conforms(&store, Path::new(&bench.path("store")));
}

#[test]
fn a_coordinator_never_has_a_large_blob_as_a_whole_in_memory() {
    const BLOB: usize = 256 << 20;
    let bench = Bench::new(|_| {});
    let mut cluster = Cluster::start(&bench, &[]);
    let (runtime, store) = through(&cluster);
    let pid = cluster.coordinator().pid();
    let most_mib = || {
        let status = fs::read_to_string(format!("/proc/{pid}/status")).expect("it runs");
        let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).expect("a peak");
        line.trim().trim_end_matches(" kB").parse::<usize>().expect("a number") >> 10
    };
    let before = most_mib();
    let bytes: Bytes = (0..BLOB / 4).flat_map(|k| (k as u32).to_le_bytes()).collect::<Vec<u8>>().into();
    let key = runtime.block_on(store.put(bytes.clone())).expect("written");
    assert!(runtime.block_on(store.get_file(&key)).expect("read") == bytes);
    let more = most_mib() - before;
    eprintln!("{more} MiB for a blob of {} MiB", BLOB >> 20);
    assert!(more < BLOB >> 21, "{more} MiB");
}

#[test]
fn another_store_at_the_same_address_is_not_taken_for_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let url = format!("file://{}", folder.path().display());
    let runtime = Runtime::new().expect("a runtime");
    let said =
        |new: &str| runtime.block_on(Objects::open(&url).expect("a store").identity(new)).expect("one");
    // Says nothing.
    fs::write(folder.path().join("identity"), "\n").expect("written");
    assert_eq!(said("one"), "one");
    assert_eq!(said("another"), "one");
    runtime.block_on(async {
        let client = Client::connect("http://127.0.0.1:9", None).expect("an address");
        let of = async |identity: &str| {
            let place = StorePlace { url: url.clone(), identity: Some(identity.to_owned()) };
            Store::of(&client, &place).await.expect("a store")
        };
        assert!(of("one").await.is_reached_from_here());
        let other = of("two").await;
        assert!(!other.is_reached_from_here());
        let error = other.get_file(&BlobKey::of(b"x")).await.expect_err("nobody listens");
        assert!(error.is_passing() && !error.is_lost(), "{error}");
    });
}

#[test]
fn what_is_sent_to_a_coordinator_under_a_wrong_name_is_refused_and_leaves_nothing() {
    let bench = Bench::new(|_| {});
    let cluster = Cluster::start(&bench, &[]);
    let url = cluster.url().to_owned();
    let send = async |chunks: Vec<BlobChunk>| {
        let mut stub = BlobsClient::connect(url.clone()).await.expect("it listens");
        let refused = stub.write(tokio_stream::iter(chunks)).await.expect_err("refused");
        (refused.code(), refused.message().to_owned())
    };
    let first = |length: u64| {
        let key = BlobKey::of(b"depth").0.to_vec();
        BlobChunk { blob: Some(Blob { key, length }), data: Bytes::new() }
    };
    let data = |bytes: &'static [u8]| BlobChunk { blob: None, data: Bytes::from_static(bytes) };
    let larger = vec![0; MAX_EXCHANGE_MESSAGE_BYTES + 1];
    let larger = BlobChunk { blob: None, data: larger.into() };
    let name = BlobKey::of(b"depth").to_string();
    Runtime::new().expect("a runtime").block_on(async {
        for (what, chunks, code, says) in [
            ("another hash", vec![first(5), data(b"debth")], tonic::Code::InvalidArgument, &*name),
            ("too few bytes", vec![first(5), data(b"dep")], tonic::Code::InvalidArgument, &name),
            (
                "too many bytes",
                vec![first(5), data(b"dep"), data(b"ths")],
                tonic::Code::InvalidArgument,
                &name,
            ),
            ("no name", vec![data(b"depth")], tonic::Code::InvalidArgument, "names it"),
            (
                "a large message",
                vec![first(1 << 30), larger],
                tonic::Code::OutOfRange,
                "message length too large",
            ),
            (
                "a large blob",
                vec![first(MAX_BLOB_BYTES + 1)],
                tonic::Code::ResourceExhausted,
                "over the limit",
            ),
        ] {
            let (refused, message) = send(chunks).await;
            assert!(refused == code && message.contains(says), "{what}: {refused:?} {message}");
        }
    });
    let (_runtime, store) = through(&cluster);
    let runtime = Runtime::new().expect("a runtime");
    assert!(!runtime.block_on(store.holds(&BlobKey::of(b"depth"))).expect("asked"));
    let is_empty = || blob_files(Path::new(&bench.path("store"))).is_empty();
    assert!(wait_until(DEADLINE, is_empty), "{:?}", blob_files(Path::new(&bench.path("store"))));
}

#[test]
fn a_coordinator_whose_ledger_has_another_store_is_refused_and_told_what_to_do() {
    let bench = Bench::new(|_| {});
    let _ = Cluster::start(&bench, &[]).drain().wait().expect_code(0);
    let (ledger, other) = (bench.path("ledger.sqlite"), bench.path("other"));
    let given = ["coordinator", "--listen", "127.0.0.1:0", "--ledger", &ledger, "--store", &other];
    let refused = run(given).expect_code(1);
    let identity = fs::read_to_string(bench.path("store/identity")).expect("it says who it is");
    let advice = format!("write {identity} into the object \"identity\" of file://{other}");
    assert!(refused.stderr.contains(&advice), "{}", refused.stderr);
    let said = format!("{other}/identity");
    assert!(
        !fs::exists(&said).expect("it can be looked for"),
        "something is written into a store that is refused"
    );
    // As a shell writes it.
    fs::write(said, format!("{identity}\n")).expect("written");
    let _ = Cluster::start_on(&ledger, &other, Vec::new(), &[]).drain().wait().expect_code(0);
}

#[test]
fn an_s3_server_is_a_store_that_may_go_and_come_back() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut server = S3Server::start(folder.path());
    let variables = server.environment().into_iter().map(|(name, value)| (name.to_owned(), value));
    let store = Store::from(Objects::open_with(&server.store_url(), variables).expect("a store"));
    conforms(&store, &server.bucket());

    let impatience = CancellationToken::new();
    let store = store.patient(impatience.clone());
    let runtime = Runtime::new().expect("a runtime");
    server.go_away();
    let write = runtime.spawn({
        let store = store.clone();
        async move { store.put(Bytes::from_static(b"written while nobody listens")).await }
    });
    std::thread::sleep(Duration::from_millis(500));
    assert!(!write.is_finished(), "it waits for the server");
    server.come_back();
    let key = runtime.block_on(write).expect("no panic").expect("written");
    assert_eq!(runtime.block_on(store.get_file(&key)).expect("read"), &b"written while nobody listens"[..]);

    server.go_away();
    impatience.cancel();
    let error = runtime.block_on(store.get_file(&key)).expect_err("nobody listens");
    assert!(error.is_passing() && !error.is_lost(), "{error}");
}

#[test]
fn addresses_that_are_none_are_refused_by_name() {
    for url in ["ftp://host/blobs", "http://host/blobs", "s3:/bucket", "nothing"] {
        let error = Store::open(url).expect_err("no store");
        assert!(error.to_string().contains(url), "{error}");
    }
}
