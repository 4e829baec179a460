//! Which maps in shared memory are kept for the jobs to come: pure bookkeeping.

use std::collections::VecDeque;

use bytes::Bytes;
use planesweep_plan::BlobKey;

/// Maps that are still in the memory of those who wrote them. What was not used for the longest time
/// goes first, for neighbouring views come and are needed together.
#[derive(Debug)]
pub(super) struct Shelf {
    budget_bytes: u64,
    /// The least recently used first.
    maps: VecDeque<Kept>,
}

#[derive(Debug)]
struct Kept {
    key: BlobKey,
    /// Whose memory it is.
    publisher: u128,
    bytes: Bytes,
}

impl Shelf {
    /// A shelf of maps that together have at most `budget_bytes`.
    pub fn new(budget_bytes: u64) -> Self {
        Self { budget_bytes, maps: VecDeque::new() }
    }

    /// Keeps a map, at most `keep` of its publisher, who needs the rest of its memory for what comes
    /// next.
    pub fn put(&mut self, publisher: u128, keep: usize, key: BlobKey, bytes: Bytes) {
        self.maps.push_back(Kept { key, publisher, bytes });
        let mut of_publisher = self.maps.iter().filter(|map| map.publisher == publisher).count();
        self.maps.retain(|map| {
            let goes = map.publisher == publisher && of_publisher > keep;
            of_publisher -= usize::from(goes);
            !goes
        });
        while self.bytes() > self.budget_bytes {
            self.maps.pop_front();
        }
    }

    /// The map, if it is still kept.
    pub fn get(&mut self, key: &BlobKey) -> Option<Bytes> {
        let at = self.maps.iter().position(|map| map.key == *key)?;
        let map = self.maps.remove(at)?;
        let bytes = map.bytes.clone();
        self.maps.push_back(map);
        Some(bytes)
    }

    fn bytes(&self) -> u64 {
        self.maps.iter().map(|map| map.bytes.len() as u64).sum()
    }
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    fn key(map: u8) -> BlobKey {
        BlobKey([map; 32])
    }

    #[test]
    fn what_was_not_used_for_the_longest_time_goes_first() {
        let mut shelf = Shelf::new(3);
        for map in 0..3 {
            shelf.put(map.into(), 1, key(map), Bytes::from_static(b"x"));
        }
        assert!(shelf.get(&key(0)).is_some());
        shelf.put(3, 1, key(3), Bytes::from_static(b"x"));
        assert!(shelf.get(&key(0)).is_some() && shelf.get(&key(1)).is_none());
    }

    proptest! {
        #[test]
        fn neither_the_budget_nor_a_publishers_share_is_exceeded(
            maps in vec((0..3_u128, 0..20_usize, 0..20_u8), 1..40),
            budget in 0..60_u64,
        ) {
            let mut shelf = Shelf::new(budget);
            for (publisher, length, map) in maps {
                shelf.put(publisher, 2, key(map), Bytes::from(vec![map; length]));
                prop_assert!(shelf.bytes() <= budget);
                for of in 0..3 {
                    prop_assert!(shelf.maps.iter().filter(|kept| kept.publisher == of).count() <= 2);
                }
                // The newest is there if it fits at all.
                let is_there = shelf.get(&key(map)).is_some_and(|bytes| bytes.len() <= length || bytes[0] == map);
                prop_assert_eq!(is_there, length as u64 <= budget || shelf.get(&key(map)).is_some());
            }
        }
    }
}
