//! One suite over all ways, and what happens when a way does not work.

use std::fs::File;
use std::net::{IpAddr, Ipv4Addr};

use nalgebra::{Point3, Vector3};
use planesweep_proto::{Code, Credentials, PeerClient, first_chunk, wire};
use planesweep_scene::{Camera, DepthMap, Intrinsics, Pose, Raster};
use tempfile::TempDir;
use tonic::codegen::BoxStream;
use tonic::{Request, Response, Status};

use super::*;
use crate::blob::{depth_map_bytes, encode_depth_map};

const LOOPBACK: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0);
const INBOX_BYTES: u64 = 64 << 20;

pub(super) fn depth_map(width: u32, height: u32, depth: f32) -> Arc<DepthMap> {
    let intrinsics = Intrinsics { width, height, fx: 9.5, fy: 9.25, skew: 0.0, cx: 3.5, cy: 2.0 };
    let pose = Pose::look_at(&Point3::new(1.0, 2.0, 3.0), &Point3::origin(), &Vector3::y());
    let (columns, rows) = (width as usize, height as usize);
    let map = DepthMap::new(
        Camera { intrinsics, pose },
        Raster::from_fn(columns, rows, |x, y| depth + (x + 8 * y) as f32),
        Raster::filled(columns, rows, 0.5),
        Raster::filled(columns, rows, [1, 2, 3]),
    );
    Arc::new(map.expect("sizes agree"))
}

fn bytes_of(map: &DepthMap) -> Bytes {
    let mut bytes = Vec::new();
    encode_depth_map(map, &mut bytes);
    bytes.into()
}

/// A worker as far as maps are concerned.
struct Party {
    id: WorkerId,
    maps: Arc<Maps>,
    exchange: Exchange,
}

impl Party {
    async fn start(name: &str, role: Role, shared_memory: bool, token: Option<&str>) -> Self {
        static NEXT: std::sync::atomic::AtomicU32 = std::sync::atomic::AtomicU32::new(0);
        let number = NEXT.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        let id = WorkerId(format!("{name}-{}-{number}", std::process::id()));
        let maps = Arc::new(Maps::new(64 << 20));
        let config = ExchangeConfig { listen: LOOPBACK, tls: None, shared_memory };
        let trust = Trust::of("http://127.0.0.1:7070", Credentials::of_token(token));
        let exchange = Exchange::start(&config, &id, "host", role, trust, Arc::clone(&maps), INBOX_BYTES);
        Self { exchange: exchange.await.expect("loopback is there"), id, maps }
    }

    fn as_peer(&self) -> Peer {
        Peer { worker: self.id.clone(), endpoint: self.exchange.endpoint() }
    }

    fn made(&self, bytes: &Bytes) -> Produced {
        Produced { blob: BlobKey::of(bytes), length: bytes.len() as u64, worker: self.id.clone() }
    }

    /// Finishes a map as an inference does, but for the store.
    async fn finish(&self, map: &Arc<DepthMap>) -> Produced {
        let source = Arc::clone(map);
        let write = move |out: &mut dyn BufMut| encode_depth_map(&source, out);
        let written = self.exchange.write(depth_map_bytes(map), write).await;
        let produced = self.made(&written.bytes());
        assert!(written.bytes() == bytes_of(map), "other bytes were written");
        self.maps.depth.insert(produced.blob, Arc::clone(map));
        written.send(&produced.blob);
        produced
    }
}

/// Two workers that know of each other, and a store.
struct Pair {
    infers: Party,
    fuses: Party,
    store: Store,
    _folder: TempDir,
}

impl Pair {
    async fn start(shared_memory: bool) -> Self {
        let infers = Party::start("infers", Role::Infer, shared_memory, Some("token")).await;
        let fuses = Party::start("fuses", Role::Fuse, shared_memory, Some("token")).await;
        infers.exchange.learn(&[fuses.as_peer()]);
        fuses.exchange.learn(&[infers.as_peer()]);
        let folder = tempfile::tempdir().expect("a folder");
        let store = Store::open(&format!("file://{}", folder.path().display())).expect("a local folder");
        Self { infers, fuses, store, _folder: folder }
    }

    async fn get(&self, wanted: &Produced) -> Result<(Bytes, Way), StoreError> {
        self.fuses.exchange.get(wanted, &self.store).await
    }
}

/// Shared memory to test with, to one test at a time until this is dropped: any process of the user that
/// enters it removes what dead ones left behind.
pub(super) fn shared_memory(test: &str) -> Option<File> {
    if let Err(error) = room::free_bytes() {
        eprintln!("SKIPPED {test}: {error}");
        return None;
    }
    let lock = File::create(std::env::temp_dir().join("planesweep-shared-memory.lock")).expect("a file");
    lock.lock().expect("others end some time");
    Some(lock)
}

/// What every way must do: `offer` makes a map known, `get` asks for it.
async fn conforms(
    way: Way,
    offer: impl AsyncFn(&Arc<DepthMap>) -> Produced,
    get: impl AsyncFn(&Produced) -> Option<(Bytes, Way)>,
) {
    // Keys stand for bytes, for nobody reads a map in a failure.
    let get = async |wanted: &Produced| get(wanted).await.map(|(bytes, way)| (BlobKey::of(&bytes), way));
    let came = |bytes: Bytes| Some((BlobKey::of(&bytes), way));
    let small = depth_map(8, 6, 1.0);
    let offered = offer(&small).await;
    assert_eq!(get(&offered).await, came(bytes_of(&small)));
    assert_eq!(get(&offered).await, came(bytes_of(&small)), "asked for again");

    // Larger than all before, and more than one chunk.
    let large = depth_map(640, 401, 2.0);
    let others = [Arc::clone(&large), depth_map(9, 6, 3.0), depth_map(8, 6, 4.0)];
    let mut offers = Vec::new();
    for map in &others {
        offers.push((offer(map).await, bytes_of(map)));
    }
    for (offered, bytes) in offers.iter().rev() {
        assert_eq!(get(offered).await, came(bytes.clone()));
    }
    let (first, second) = tokio::join!(get(&offers[0].0), get(&offers[0].0));
    assert_eq!((first, second), (came(bytes_of(&large)), came(bytes_of(&large))));

    let never = Produced { blob: BlobKey::of(b"never made"), ..offered };
    assert_eq!(get(&never).await, None);
}

#[tokio::test]
async fn in_process_conforms() {
    let maps = Maps::new(64 << 20);
    conforms(
        Way::Process,
        async |map| {
            let bytes = bytes_of(map);
            let blob = BlobKey::of(&bytes);
            maps.depth.insert(blob, Arc::clone(map));
            Produced { blob, length: bytes.len() as u64, worker: WorkerId("self".into()) }
        },
        async |wanted| maps.bytes_of(&wanted.blob).map(|bytes| (bytes, Way::Process)),
    )
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn shared_memory_conforms() {
    let Some(_alone) = shared_memory("shared_memory_conforms") else { return };
    let pair = Pair::start(true).await;
    let offer = async |map: &Arc<DepthMap>| pair.infers.finish(map).await;
    conforms(Way::SharedMemory, offer, async |wanted| pair.get(wanted).await.ok()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn streams_conform() {
    let pair = Pair::start(false).await;
    let offer = async |map: &Arc<DepthMap>| pair.infers.finish(map).await;
    conforms(Way::Stream, offer, async |wanted| pair.get(wanted).await.ok()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_store_conforms() {
    let pair = Pair::start(false).await;
    let offer = async |map: &Arc<DepthMap>| {
        pair.store.put(bytes_of(map)).await.expect("written");
        pair.infers.made(&bytes_of(map))
    };
    conforms(Way::Store, offer, async |wanted| pair.get(wanted).await.ok()).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_next_way_is_taken_when_one_ends() {
    let Some(_alone) = shared_memory("the_next_way_is_taken_when_one_ends") else { return };
    let Pair { infers, fuses, store, _folder } = Pair::start(true).await;
    let map = depth_map(64, 48, 1.0);
    let made = infers.finish(&map).await;
    store.put(bytes_of(&map)).await.expect("written");
    let came = async |party: &Party| {
        let (bytes, way) = party.exchange.get(&made, &store).await.expect("it is in the store");
        assert!(bytes == bytes_of(&map), "other bytes {way}");
        way
    };
    assert_eq!(came(&fuses).await, Way::SharedMemory);

    let other = Party::start("other", Role::Both, true, Some("token")).await;
    other.exchange.learn(&[infers.as_peer()]);
    assert_eq!(came(&other).await, Way::Stream);

    drop(infers);
    // Its server ends on a task of its own.
    let begun = Instant::now();
    while came(&other).await != Way::Store {
        assert!(begun.elapsed() < Duration::from_mins(1), "what is gone still answers");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(came(&fuses).await, Way::SharedMemory, "what was sent outlives its sender");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_the_inbox_has_no_room_for_is_told_to_the_sender() {
    let Some(_alone) = shared_memory("what_the_inbox_has_no_room_for_is_told_to_the_sender") else { return };
    let name = format!("full-{}", std::process::id());
    let inbox = Inbox::open(&name, INBOX_BYTES).expect("an inbox");
    let outbox = Outbox::open(&name).expect("its other end");
    assert!(outbox.fit(8).expect("a segment"));
    inbox.receive();
    let key = |map: u8| BlobKey([map; 32]);
    let send = |map: u8| outbox.lend(8, |out| out.put_bytes(map, 8)).is_some_and(|loan| loan.send(&key(map)));
    let arrived: Vec<u8> = (0..100).filter(|map| send(*map)).collect();
    assert!((1..100).contains(&arrived.len()), "{arrived:?}");
    for map in 0..100 {
        assert_eq!(inbox.get(&key(map)), arrived.contains(&map).then(|| vec![map; 8].into()), "map {map}");
    }
    assert!(send(100) && inbox.get(&key(100)).is_some(), "there is room again");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_loan_that_is_not_sent_is_given_back() {
    let Some(_alone) = shared_memory("a_loan_that_is_not_sent_is_given_back") else { return };
    let name = format!("loans-{}", std::process::id());
    let _inbox = Inbox::open(&name, INBOX_BYTES).expect("an inbox");
    let outbox = Outbox::open(&name).expect("its other end");
    outbox.fit(8).expect("a segment");
    for round in 0..50 {
        let loan = outbox.lend(8, |out| out.put_bytes(7, 8));
        assert!(loan.is_some(), "nothing is lent in round {round}");
    }
    let kept: Vec<Loan> = std::iter::from_fn(|| outbox.lend(8, |out| out.put_bytes(7, 8))).take(50).collect();
    assert!((1..50).contains(&kept.len()), "{}", kept.len());
}

#[tokio::test]
async fn nobody_is_served_without_the_token() {
    let served = |listen: &str, token: Option<&'static str>| {
        let config =
            ExchangeConfig { listen: listen.parse().expect("an address"), tls: None, shared_memory: false };
        async move { start_serving(&config, "host", token, Arc::new(Maps::new(0)), None).await }
    };
    let open = ExchangeConfig { listen: ([0, 0, 0, 0], 0).into(), tls: None, shared_memory: false };
    for coordinators in ["https://head:7070", "http://one:7070,https://two:7070"] {
        assert!(matches!(open.check(coordinators), Err(ExchangeError::NoTls { .. })), "{coordinators}");
    }
    assert!(open.check("http://head:7070").is_ok());
    assert!(matches!(served("0.0.0.0:0", None).await, Err(ExchangeError::NoToken { .. })));
    let everywhere = served("0.0.0.0:0", Some("token")).await.expect("with a token");
    assert!(everywhere.address.starts_with("http://host:"), "{}", everywhere.address);

    let served = served("127.0.0.1:0", Some("token")).await.expect("loopback is there");
    for (token, code) in [
        (None, Code::Unauthenticated),
        (Some("tokem"), Code::Unauthenticated),
        (Some("token"), Code::NotFound),
    ] {
        let mut client =
            PeerClient::connect(&served.address, &Credentials::of_token(token)).expect("an address");
        assert_eq!(client.fetch(&BlobKey([1; 32]), 9).await.map_err(|e| e.code), Err(code), "{token:?}");
        assert_eq!(client.open_inbox("x").await.map_err(|e| e.code), Err(code), "{token:?}");
    }
}

/// A worker that answers with whatever it was given.
struct Liar(Vec<Vec<u8>>);

#[tonic::async_trait]
impl wire::exchange_server::Exchange for Liar {
    type FetchStream = BoxStream<wire::BlobChunk>;

    async fn fetch(&self, _: Request<wire::BlobRequest>) -> Result<Response<Self::FetchStream>, Status> {
        // The last chunk comes again and again, without an end.
        let last = self.0.last().filter(|chunk| chunk.len() > 1).cloned();
        let chunks =
            self.0.clone().into_iter().chain(std::iter::repeat_with(move || last.clone()).map_while(|c| c));
        let chunks = chunks.map(|data| wire::BlobChunk { blob: None, data: data.into() });
        let chunks = std::iter::once(first_chunk(BlobKey::of(b"map"), 3)).chain(chunks).map(Ok);
        Ok(Response::new(Box::pin(tokio_stream::iter(chunks))))
    }

    async fn open_inbox(
        &self,
        _: Request<wire::OpenInboxRequest>,
    ) -> Result<Response<wire::OpenInboxReply>, Status> {
        Ok(Response::new(wire::OpenInboxReply {}))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn wrong_bytes_too_many_and_too_large_messages_are_refused() {
    let cases = [
        (vec![b"m".to_vec(), b"o".to_vec(), b"p".to_vec()], Code::Invalid),
        (vec![b"m".to_vec(), b"a".to_vec()], Code::Invalid),
        (vec![b"endless".to_vec()], Code::TooLarge),
        (vec![vec![0; 1 << 20]], Code::Invalid),
    ];
    for (chunks, code) in cases {
        let length = chunks.first().map(Vec::len);
        let listener = tokio::net::TcpListener::bind(LOOPBACK).await.expect("loopback is there");
        let address = format!("http://{}", listener.local_addr().expect("bound"));
        let liar = wire::exchange_server::ExchangeServer::new(Liar(chunks));
        let server = tonic::transport::Server::builder().add_service(liar);
        let server =
            tokio::spawn(server.serve_with_incoming(tonic::transport::server::TcpIncoming::from(listener)));
        let mut client = PeerClient::connect(&address, &Credentials::default()).expect("an address");
        let error = client.fetch(&BlobKey::of(b"map"), 3).await.expect_err("not the map");
        assert_eq!(error.code, code, "{length:?}: {error}");
        server.abort();
    }
}
