//! The ways on which finished maps, and photographs, reach the jobs that need them.

use std::collections::BTreeMap;
use std::fmt;

use crate::JobResult;

/// A way on which a map came, in the order in which the ways are tried.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Way {
    /// It was in the worker's own memory.
    Process,
    /// Another worker of the host wrote it into shared memory, where it was read.
    SharedMemory,
    /// The worker that had it in memory sent it.
    Stream,
    /// It was read from the store.
    Store,
}

impl Way {
    /// All ways, in the order in which they are tried.
    pub const ALL: [Self; 4] = [Self::Process, Self::SharedMemory, Self::Stream, Self::Store];

    /// The measurement of a job that counts the maps that came on this way.
    pub fn measurement(self) -> &'static str {
        match self {
            Self::Process => "maps_in_process",
            Self::SharedMemory => "maps_by_shared_memory",
            Self::Stream => "maps_by_stream",
            Self::Store => "maps_from_store",
        }
    }
}

impl fmt::Display for Way {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Process => "in process",
            Self::SharedMemory => "by shared memory",
            Self::Stream => "by stream",
            Self::Store => "from the store",
        })
    }
}

/// The measurement of a job that counts the photographs and masks that the store had to send, for they were
/// neither under their path nor on the worker's disk.
pub const IMAGES_FETCHED: &str = "images_fetched";

/// How many photographs and masks the store had to send, over these jobs.
pub fn images_fetched<'a>(results: impl IntoIterator<Item = &'a JobResult>) -> u64 {
    results.into_iter().filter_map(|result| result.measurements.get(IMAGES_FETCHED)).map(|n| *n as u64).sum()
}

/// How many maps came on each way, over these jobs.
pub fn maps_by_way<'a>(results: impl IntoIterator<Item = &'a JobResult>) -> BTreeMap<Way, u64> {
    let mut maps = BTreeMap::from(Way::ALL.map(|way| (way, 0)));
    for result in results {
        for (way, count) in &mut maps {
            *count += result.measurements.get(way.measurement()).map_or(0, |maps| *maps as u64);
        }
    }
    maps
}

#[cfg(test)]
mod tests {
    use planesweep_plan::{Attempt, JobId};

    use super::*;
    use crate::JobState;

    #[test]
    fn ways_are_summed_over_the_jobs() {
        let result = |measurements: &[(Way, f64)]| JobResult {
            job: JobId([0; 32]),
            kind: "filter".into(),
            view: None,
            state: JobState::Done,
            attempt: Attempt(1),
            ended: 1,
            blob: None,
            measurements: measurements.iter().map(|(way, n)| (way.measurement().to_owned(), *n)).collect(),
            seconds: 0.0,
            worker: None,
            failure: None,
        };
        let results = [result(&[(Way::Process, 3.0), (Way::Store, 1.0)]), result(&[(Way::Process, 2.0)])];
        let expected = [(Way::Process, 5), (Way::SharedMemory, 0), (Way::Stream, 0), (Way::Store, 1)];
        assert_eq!(maps_by_way(&results), expected.into());
    }
}
