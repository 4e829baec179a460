//! Caches within a budget of bytes.

use std::hash::Hash;

use quick_cache::sync::{Cache, DefaultLifecycle};
use quick_cache::{DefaultHashBuilder, OptionsBuilder, Weighter};

/// Entries that a cache expects; it grows beyond.
const EXPECTED_ENTRIES: usize = 256;

/// A cache of values that together weigh at most `budget_bytes`.
///
/// It is one shard: a budget split over one shard per processor would leave no room for a single
/// large image on a machine with many.
pub(crate) fn cache<K: Eq + Hash, V: Clone, W: Weighter<K, V> + Clone>(
    budget_bytes: u64,
    weighter: W,
) -> Cache<K, V, W> {
    let options = OptionsBuilder::new()
        .estimated_items_capacity(EXPECTED_ENTRIES)
        .weight_capacity(budget_bytes)
        .shards(1)
        .build()
        .expect("all that the builder wants is given");
    Cache::with_options(options, weighter, DefaultHashBuilder::default(), DefaultLifecycle::default())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Clone)]
    struct ByValue;

    impl Weighter<u8, u64> for ByValue {
        fn weight(&self, _: &u8, value: &u64) -> u64 {
            *value
        }
    }

    #[test]
    fn one_value_of_half_the_budget_is_kept() {
        let cache = cache(100, ByValue);
        cache.insert(1, 50);
        assert_eq!(cache.get(&1), Some(50));
        cache.insert(2, 101);
        assert_eq!(cache.get(&2), None);
    }
}
