//! Memory of a segment while a map is written into it and on its way to the store.
#![allow(unsafe_code)] // two claims about memory that is shared, each with its reason

use std::fmt;
use std::mem::MaybeUninit;

use bytes::BufMut;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::sample_mut_uninit::SampleMutUninit;
use planesweep_plan::BlobKey;

use super::shared_memory::{Ipc, Label};

/// A map in shared memory that was not sent yet. Dropped, it was never there.
pub(super) struct Loan {
    sample: SampleMut<Ipc, [u8], Label>,
}

// SAFETY: a shared loan only gives `&[u8]` of its payload. Nobody writes there until `send` takes the
// loan by value, and the lock that iceoryx2 takes to find the length is one for threads (`ipc_threadsafe`).
unsafe impl Sync for Loan {}

impl Loan {
    /// Has `write` fill all of the sample.
    ///
    /// # Panics
    /// When it does not.
    pub(super) fn write(
        mut sample: SampleMutUninit<Ipc, [MaybeUninit<u8>], Label>,
        keep: u32,
        write: impl FnOnce(&mut dyn BufMut),
    ) -> Self {
        let mut rest = sample.payload_mut();
        write(&mut rest);
        assert!(rest.is_empty(), "a map has the length that was said");
        // SAFETY: a `BufMut` moves the start of the slice past what was written, which safe code cannot feign,
        // and nothing is left of it.
        let mut sample = unsafe { sample.assume_init() };
        sample.user_header_mut().keep = keep;
        Self { sample }
    }

    /// Sends the map; whether it arrived where it can be received.
    pub(super) fn send(mut self, key: &BlobKey) -> bool {
        self.sample.user_header_mut().key = key.0;
        self.sample.send().is_ok_and(|receivers| receivers > 0)
    }
}

impl AsRef<[u8]> for Loan {
    fn as_ref(&self) -> &[u8] {
        self.sample.payload()
    }
}

impl fmt::Debug for Loan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Loan").field("bytes", &self.as_ref().len()).finish()
    }
}
