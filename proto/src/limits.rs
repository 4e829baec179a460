//! How large foreign input may be, and how long it may take. Each limit is far above honest use and keeps memory,
//! and the waiting for others, bounded.

use std::time::Duration;

/// Bytes of one message. The largest honest one is the grant of an `Assemble` job over 100 000
/// views, about 12 MB.
pub const MAX_MESSAGE_BYTES: usize = 64 << 20;
/// Bytes of jobs that a client puts into one chunk of a submission.
pub const SUBMIT_CHUNK_BYTES: usize = 1 << 20;
/// Results in one chunk.
pub const RESULTS_CHUNK: usize = 500;
/// Jobs of one run.
pub const MAX_JOBS: usize = 4_000_000;
/// Views in one list, and needs of one job.
pub const MAX_VIEWS: usize = 1_000_000;
/// Source images of one inference.
pub const MAX_SOURCES: usize = 64;
/// Depth planes of one inference.
pub const MAX_PLANES: u32 = 4096;
/// Columns or rows of an image.
pub const MAX_SIDE: u32 = 1 << 17;
/// Free slots of one class that a worker may report.
pub const MAX_SLOTS: u32 = 256;
/// Jobs that a worker may report as held, or as finished.
pub const MAX_REPORTED: usize = 10_000;
/// Other workers that one is told of at once.
pub const MAX_PEERS: usize = 10_000;
/// Bytes of a blob. The largest honest one is the cloud, 15 bytes for each point.
pub const MAX_BLOB_BYTES: u64 = 1 << 40;
/// Bytes of a blob that is read as a whole when nobody has said how long it is: a photograph, or weights.
pub const MAX_FILE_BYTES: u64 = 4 << 30;
/// How long the next chunk of a blob may take to come, or to be taken.
pub const CHUNK_TIME: Duration = Duration::from_mins(1);
/// Bytes of a blob in one chunk on its way between workers, or through the coordinator.
pub const FETCH_CHUNK_BYTES: usize = 256 << 10;
/// Bytes of one message with such a chunk: the chunk and its frame.
pub const MAX_EXCHANGE_MESSAGE_BYTES: usize = FETCH_CHUNK_BYTES + 1024;
/// Bytes of the name of a worker, host, run, device, failure code or measurement.
pub const MAX_NAME_BYTES: usize = 255;
/// Bytes of a path or of the name of an image.
pub const MAX_PATH_BYTES: usize = 4096;
/// Bytes of a failure's message; longer ones are cut by the sender.
pub const MAX_MESSAGE_TEXT_BYTES: usize = 16 << 10;
/// Measurements of one job.
pub const MAX_MEASUREMENTS: usize = 256;
