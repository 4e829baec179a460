//! Maps in this worker's memory: what it made and what it read, decoded once.

use std::sync::Arc;

use bytes::Bytes;
use planesweep_fusion::{FilteredMap, encode_filtered_map};
use planesweep_plan::BlobKey;
use planesweep_scene::DepthMap;
use quick_cache::Weighter;
use quick_cache::sync::Cache;

use crate::blob::{depth_map_bytes, encode_depth_map};
use crate::cache::cache;

#[derive(Clone)]
pub(crate) struct ByPixels;

impl Weighter<BlobKey, Arc<DepthMap>> for ByPixels {
    fn weight(&self, _: &BlobKey, map: &Arc<DepthMap>) -> u64 {
        map.depth.values().len() as u64 * 12
    }
}

impl Weighter<BlobKey, Arc<FilteredMap>> for ByPixels {
    fn weight(&self, _: &BlobKey, map: &Arc<FilteredMap>) -> u64 {
        map.depth.values().len() as u64 * 18
    }
}

/// Depth maps and filtered ones by the keys of their bytes, each kind within a budget.
pub(crate) struct Maps {
    pub depth: Cache<BlobKey, Arc<DepthMap>, ByPixels>,
    pub filtered: Cache<BlobKey, Arc<FilteredMap>, ByPixels>,
}

impl Maps {
    /// No maps yet; `budget_bytes` for each kind.
    pub fn new(budget_bytes: u64) -> Self {
        Self { depth: cache(budget_bytes, ByPixels), filtered: cache(budget_bytes, ByPixels) }
    }

    /// The bytes of a map that is in memory, as they are in the store.
    pub fn bytes_of(&self, key: &BlobKey) -> Option<Bytes> {
        if let Some(map) = self.depth.get(key) {
            let mut bytes = Vec::with_capacity(depth_map_bytes(&map));
            encode_depth_map(&map, &mut bytes);
            return Some(bytes.into());
        }
        self.filtered.get(key).map(|map| encode_filtered_map(&map).into())
    }
}
