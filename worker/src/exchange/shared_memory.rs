//! Maps between the processes of one host, without a copy.
//!
//! The host's fusion worker has an [`Inbox`]: a service that others send to. A worker that infers
//! opens it as an [`Outbox`], has the network's result written straight into memory that the outbox
//! lends ([`Loan`]), and sends it when it is stored. The inbox keeps what it received where it lies,
//! within a budget, and jobs read it in place.
//!
//! ```text
//! inference ──encode──> loan ──store──> send ═══> inbox ── shelf ──decode in place──> filter
//! ```
//!
//! Everything lies in the memory of the sender, in a segment of as many slots as can be on the way,
//! kept and lent at once. All names carry the user's id: what another user left behind is neither
//! seen nor touched. What a process left behind that was killed is removed by the next one of the
//! same user that opens an inbox or an outbox.

use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::sync::{Mutex, PoisonError};
use std::{fs, io};

use bytes::{BufMut, Bytes};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::prelude::{
    AllocationStrategy, BackpressureStrategy, Config, FileName, LogLevel, Node, NodeBuilder, Path,
    SemanticString, SignalHandlingMode, ZeroCopySend, ipc_threadsafe, set_log_level,
};
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::publish_subscribe::PublishSubscribeOpenError;
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use planesweep_plan::BlobKey;
use thiserror::Error;

use super::loan::Loan;
use super::room::{free_bytes, reserve};
use super::shelf::Shelf;

pub(super) type Ipc = ipc_threadsafe::Service;
type Service = PortFactory<Ipc, [u8], Label>;

/// Workers that send to one inbox.
const MAX_SENDERS: usize = 64;
/// Maps of one sender on the way; the inbox looks for them more often than this many come.
const ON_THE_WAY: usize = 4;
/// Maps of one sender that the inbox keeps, at most.
const MAX_KEPT: usize = 32;
/// Maps that a sender writes at once: one that the network has just made, and others on their way to
/// the store.
const LENT: usize = 3;
/// Bytes of a sender's segment, unless so few slots would fit that none could be kept.
const SEGMENT_BYTES: u64 = 64 << 20;
/// The fewest slots with which maps can be lent, be on the way and be kept.
const MIN_SLOTS: usize = LENT + 2;
/// Lengths of slots are rounded up to this, so that maps of slightly different sizes share a segment.
const SLOT_STEP: usize = 64 << 10;

/// Why maps do not go through shared memory.
#[derive(Debug, Error)]
pub(crate) enum SharedMemoryError {
    /// There is none.
    #[error("there is no shared memory at {folder}")]
    Absent {
        /// Where it should be.
        folder: &'static str,
        /// What is there instead.
        #[source]
        source: io::Error,
    },
    /// It is full.
    #[error("shared memory at {folder} has only {} MiB left", free >> 20)]
    Full {
        /// Where.
        folder: &'static str,
        /// Bytes left.
        free: u64,
    },
    /// Others took it meanwhile.
    #[error("cannot reserve room in shared memory at {folder}")]
    Reserve {
        /// Where.
        folder: &'static str,
        /// What the system said.
        #[source]
        source: io::Error,
    },
    /// The folder for its names cannot be made, or belongs to somebody else.
    #[error("cannot use the folder {folder}")]
    Folder {
        /// The folder.
        folder: String,
        /// What is wrong with it.
        #[source]
        source: io::Error,
    },
    /// The inbox is not in the memory that this process sees.
    #[error("there is no inbox {inbox} here")]
    Elsewhere {
        /// The inbox.
        inbox: String,
    },
    /// iceoryx2 refuses.
    #[error("cannot {attempt} in shared memory: {reason}")]
    Refused {
        /// What was attempted.
        attempt: &'static str,
        /// What it said.
        reason: String,
    },
}

/// What goes with a map.
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[repr(C)]
pub(super) struct Label {
    pub key: [u8; 32],
    /// How many maps of this sender the inbox may keep.
    pub keep: u32,
}

fn refused<E: std::fmt::Debug>(attempt: &'static str) -> impl FnOnce(E) -> SharedMemoryError {
    move |error| SharedMemoryError::Refused { attempt, reason: format!("{error:?}") }
}

/// The files' names begin with this.
fn prefix() -> String {
    format!("planesweep{}_", rustix::process::getuid().as_raw())
}

/// Enters the shared memory of this user. What dead processes left behind is removed on the way.
fn enter() -> Result<Node<Ipc>, SharedMemoryError> {
    // What goes wrong is returned; iceoryx2 would print it too.
    set_log_level(LogLevel::Fatal);
    free_bytes()?;
    let user = rustix::process::getuid().as_raw();
    let folder = format!("/tmp/planesweep-{user}");
    let own = || -> io::Result<()> {
        fs::DirBuilder::new().recursive(true).mode(0o700).create(&folder)?;
        match fs::symlink_metadata(&folder)? {
            found if found.is_dir() && found.uid() == user => Ok(()),
            _ => Err(io::Error::other("it belongs to another user")),
        }
    };
    own().map_err(|source| SharedMemoryError::Folder { folder: folder.clone(), source })?;
    let mut config = Config::default();
    config.global.prefix = FileName::new(prefix().as_bytes()).map_err(refused("name segments"))?;
    config.global.set_root_path(&Path::new(folder.as_bytes()).map_err(refused("name a folder"))?);
    NodeBuilder::new()
        .config(&config)
        .signal_handling_mode(SignalHandlingMode::Disabled)
        .create()
        .map_err(refused("make a node"))
}

/// Where the maps of the host's other workers arrive.
#[derive(Debug)]
pub(crate) struct Inbox {
    name: String,
    subscriber: Subscriber<Ipc, [u8], Label>,
    shelf: Mutex<Shelf>,
    // Held for as long as others may open it.
    _service: Service,
    _node: Node<Ipc>,
}

impl Inbox {
    /// Makes an inbox of this name, which nobody else has, that keeps maps of `budget_bytes` at most.
    pub fn open(name: &str, budget_bytes: u64) -> Result<Self, SharedMemoryError> {
        let node = enter()?;
        let service = node
            .service_builder(&name.try_into().map_err(refused("name an inbox"))?)
            .publish_subscribe::<[u8]>()
            .user_header::<Label>()
            .max_subscribers(1)
            .max_publishers(MAX_SENDERS)
            .max_nodes(MAX_SENDERS + 1)
            .subscriber_max_buffer_size(ON_THE_WAY)
            // One more than is kept, for that one is received before another goes.
            .subscriber_max_borrowed_samples(MAX_KEPT + 1)
            .history_size(0)
            // A map that does not fit is told to its sender, never put in the place of another.
            .enable_safe_overflow(false)
            .create()
            .map_err(refused("make an inbox"))?;
        let subscriber = service.subscriber_builder().create().map_err(refused("read an inbox"))?;
        let shelf = Mutex::new(Shelf::new(budget_bytes));
        Ok(Self { name: name.to_owned(), subscriber, shelf, _service: service, _node: node })
    }

    /// What others open it by.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Connects to new senders and takes what arrived. To be called often: a sender has room for a few
    /// maps on the way only.
    pub fn receive(&self) {
        let mut shelf = self.shelf.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            match self.subscriber.receive() {
                Ok(Some(sample)) => {
                    let publisher = sample.header().publisher_id().value();
                    let Label { key, keep } = *sample.user_header();
                    let keep = (keep as usize).min(MAX_KEPT);
                    shelf.put(publisher, keep, BlobKey(key), Bytes::from_owner(InPlace(sample)));
                }
                Ok(None) => return,
                Err(error) => {
                    tracing::debug!(?error, "cannot receive from shared memory now");
                    return;
                }
            }
        }
    }

    /// The bytes of a map where they lie; they stay there as long as they are held.
    pub fn get(&self, key: &BlobKey) -> Option<Bytes> {
        self.receive();
        self.shelf.lock().unwrap_or_else(PoisonError::into_inner).get(key)
    }
}

/// A received map, for as long as somebody reads it.
struct InPlace(Sample<Ipc, [u8], Label>);

impl AsRef<[u8]> for InPlace {
    fn as_ref(&self) -> &[u8] {
        self.0.payload()
    }
}

/// An inbox of another worker of this host, opened to send to it.
#[derive(Debug)]
pub(crate) struct Outbox {
    port: Mutex<Option<Port>>,
    service: Service,
    _node: Node<Ipc>,
}

/// A segment and the right to send from it.
#[derive(Debug)]
struct Port {
    publisher: Publisher<Ipc, [u8], Label>,
    slot_bytes: usize,
    keep: u32,
}

impl Outbox {
    /// Opens the inbox of this name.
    pub fn open(inbox: &str) -> Result<Self, SharedMemoryError> {
        let node = enter()?;
        let service = node
            .service_builder(&inbox.try_into().map_err(refused("name an inbox"))?)
            .publish_subscribe::<[u8]>()
            .user_header::<Label>()
            .open()
            .map_err(|error| match error {
                PublishSubscribeOpenError::DoesNotExist => {
                    SharedMemoryError::Elsewhere { inbox: inbox.to_owned() }
                }
                error => refused("open an inbox")(error),
            })?;
        Ok(Self { port: Mutex::new(None), service, _node: node })
    }

    /// Sees that maps of this length can be lent; `true` when a new segment was made for that, to which
    /// the inbox is not connected yet.
    pub fn fit(&self, length: usize) -> Result<bool, SharedMemoryError> {
        let mut port = self.port.lock().unwrap_or_else(PoisonError::into_inner);
        if port.as_ref().is_some_and(|port| length <= port.slot_bytes) {
            return Ok(false);
        }
        // The old segment goes before the new one is made; what the inbox keeps of it stays until then.
        *port = None;
        *port = Some(Port::new(&self.service, length.next_multiple_of(SLOT_STEP))?);
        Ok(true)
    }

    /// Has a map of this length written into the segment; `None` when no slot is free. `write` must
    /// fill all of it.
    pub fn lend(&self, length: usize, write: impl FnOnce(&mut dyn BufMut)) -> Option<Loan> {
        let port = self.port.lock().unwrap_or_else(PoisonError::into_inner);
        let port = port.as_ref()?;
        let sample = port.publisher.loan_slice_uninit(length).ok()?;
        Some(Loan::write(sample, port.keep, write))
    }
}

impl Port {
    fn new(service: &Service, slot_bytes: usize) -> Result<Self, SharedMemoryError> {
        // Others look for room at the same moment: nobody takes more than half.
        let free = free_bytes()? / 2;
        let slots = |bytes: u64| (bytes / slot_bytes as u64) as usize;
        let slots = slots(free).min(slots(SEGMENT_BYTES).max(MIN_SLOTS));
        if slots < MIN_SLOTS {
            return Err(SharedMemoryError::Full { folder: "/dev/shm", free });
        }
        let publisher = service
            .publisher_builder()
            .initial_max_slice_len(slot_bytes)
            .max_loaned_samples(LENT)
            .allocation_strategy(AllocationStrategy::Static)
            .backpressure_strategy(BackpressureStrategy::DiscardData)
            .override_sample_preallocation(move |all| slots.min(all))
            .create()
            .map_err(refused("make a segment"))?;
        reserve(&prefix())?;
        let keep = slots.saturating_sub(LENT + 1).clamp(1, MAX_KEPT) as u32;
        Ok(Self { publisher, slot_bytes, keep })
    }
}
