//! How long a map takes from one process to another, through shared memory and as a stream.
//!
//! ```sh
//! cargo test -p planesweep-worker --lib exchange::bench -- --ignored --nocapture
//! ```

use std::io::{BufRead, BufReader, Write};
use std::process::{ChildStdin, ChildStdout, Command, Stdio};
use std::time::Instant;

use planesweep_proto::Credentials;

use super::conformance::{depth_map, shared_memory};
use super::*;
use crate::blob::{depth_map_bytes, encode_depth_map};

const INBOX: &str = "PLANESWEEP_BENCH_INBOX";
const ROUNDS: usize = 15;
/// Columns, rows and the bytes that makes.
const SIZES: [(u32, u32, &str); 2] = [(1024, 744, "8 MB"), (2880, 2112, "67 MB")];

/// Not a measurement but the process that has the maps; without being asked it does nothing.
#[tokio::test(flavor = "multi_thread")]
async fn sender() {
    let Ok(inbox) = std::env::var(INBOX) else { return };
    let maps = Arc::new(Maps::new(1 << 30));
    let listen = "127.0.0.1:0".parse().expect("an address");
    let config = ExchangeConfig { listen, tls: None, shared_memory: false };
    let served =
        start_serving(&config, "localhost", None, Arc::clone(&maps), None).await.expect("loopback is there");
    println!("{}", served.address);
    let outbox = Outbox::open(&inbox).expect("the parent's inbox");
    let mut made = None;
    for line in std::io::stdin().lines() {
        let line = line.expect("a parent");
        let words: Vec<u32> = line.split(' ').map_while(|word| word.parse().ok()).collect();
        if let [width, height, depth] = words[..] {
            let map = depth_map(width, height, depth as f32);
            let mut bytes = Vec::new();
            encode_depth_map(&map, &mut bytes);
            let key = BlobKey::of(&bytes);
            maps.depth.insert(key, Arc::clone(&map));
            outbox.fit(bytes.len()).expect("room");
            println!("{key}");
            made = Some((map, key));
        } else if let Some((map, key)) = made.take() {
            let loan = outbox.lend(depth_map_bytes(&map), |out| encode_depth_map(&map, out));
            assert!(loan.expect("a slot").send(&key), "nobody takes it");
        }
    }
}

struct Sender {
    orders: ChildStdin,
    answers: std::io::Lines<BufReader<ChildStdout>>,
}

impl Sender {
    /// What the sender says next; the harness of tests speaks first.
    fn answer(&mut self, is_it: impl Fn(&str) -> bool) -> String {
        let mut words = self.answers.by_ref().map(|line| line.expect("it lives"));
        words
            .find_map(|line| line.split(' ').next_back().filter(|word| is_it(word)).map(ToOwned::to_owned))
            .expect("it lives")
    }

    /// Has a new map made, outside of the time that is taken.
    fn make(&mut self, width: u32, height: u32, depth: usize) -> Produced {
        writeln!(self.orders, "{width} {height} {depth}").expect("it lives");
        let key = self.answer(|word| word.len() == 64);
        let byte = |k: usize| u8::from_str_radix(&key[2 * k..2 * k + 2], 16).expect("a hash");
        let length = depth_map_bytes(&depth_map(width, height, 0.0)) as u64;
        Produced { blob: BlobKey(std::array::from_fn(byte)), length, worker: WorkerId("sender".into()) }
    }
}

/// Reads every byte, as the job does that needs the map.
fn read(bytes: &[u8]) -> u64 {
    let (words, rest) = bytes.as_chunks::<8>();
    words.iter().map(|word| u64::from_le_bytes(*word)).fold(rest.len() as u64, u64::wrapping_add)
}

fn spread(values: &mut [f64]) -> (f64, f64, f64) {
    values.sort_by(f64::total_cmp);
    (values[values.len() / 2], values[0], values[values.len() - 1])
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "a measurement"]
async fn shared_memory_against_streams() {
    let Some(_alone) = shared_memory("shared_memory_against_streams") else { return };
    let name = format!("bench-{}", std::process::id());
    let inbox = Inbox::open(&name, 1 << 30).expect("an inbox");
    let mut child = Command::new(std::env::current_exe().expect("a test knows its file"))
        .args(["--exact", "exchange::bench::sender", "--nocapture"])
        .env(INBOX, &name)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("started");
    let answers = BufReader::new(child.stdout.take().expect("piped")).lines();
    let mut sender = Sender { orders: child.stdin.take().expect("piped"), answers };
    let address = Some(sender.answer(|word| word.starts_with("http://")));
    let peers = Peers::new(Trust::of("", Credentials::default()));
    let peer = Peer { worker: WorkerId("sender".into()), endpoint: Endpoint { address, inbox: None } };
    peers.learn(&[peer], Instant::now());

    for (width, height, size) in SIZES {
        let (mut shared, mut streamed, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
        // A first round does not count.
        for round in 0..=ROUNDS {
            let wanted = sender.make(width, height, 2 * round);
            inbox.receive();
            let begun = Instant::now();
            writeln!(sender.orders, "send").expect("it lives");
            let bytes = loop {
                match inbox.get(&wanted.blob) {
                    Some(bytes) => break bytes,
                    None => std::thread::yield_now(),
                }
            };
            let sum = read(&bytes);
            let by_memory = begun.elapsed().as_secs_f64() * 1e3;
            assert_eq!(BlobKey::of(&bytes), wanted.blob);
            drop(bytes);

            let wanted = sender.make(width, height, 2 * round + 1);
            let begun = Instant::now();
            let bytes = peers.get(&wanted).await.expect("it is in memory");
            let other = read(&bytes);
            let by_stream = begun.elapsed().as_secs_f64() * 1e3;
            assert_ne!(sum, other, "another map came");
            if round > 0 {
                shared.push(by_memory);
                streamed.push(by_stream);
                ratios.push(by_stream / by_memory);
            }
        }
        for (what, unit, values) in [
            ("shared memory", "ms", &mut shared),
            ("stream", "ms", &mut streamed),
            ("ratio", "", &mut ratios),
        ] {
            let (median, least, most) = spread(values);
            println!("{size:>6} {what:>14}: median {median:.2} {unit} ({least:.2} to {most:.2})");
        }
    }
    drop(sender);
    child.wait().expect("it has ended");
}
