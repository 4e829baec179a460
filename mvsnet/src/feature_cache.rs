//! Features that were computed once and are used again.

use std::sync::Arc;

use planesweep_scene::WorkingImage;

use crate::kernels::cost::FeatureMap;

/// Feature maps by the content of their images, within a number of bytes.
///
/// The content names the image, because each job loads its own.
#[derive(Debug)]
pub(crate) struct FeatureCache {
    limit: usize,
    /// The least recently used first.
    maps: Vec<(blake3::Hash, Arc<FeatureMap>)>,
}

impl FeatureCache {
    pub(crate) fn new(limit: usize) -> Self {
        Self { limit, maps: Vec::new() }
    }

    /// The features of an image, computed when they are not there.
    pub(crate) fn get(
        &mut self,
        image: &WorkingImage,
        compute: impl FnOnce() -> FeatureMap,
    ) -> Arc<FeatureMap> {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&(image.pixels.width() as u64).to_le_bytes());
        hasher.update(image.pixels.values().as_flattened());
        let key = hasher.finalize();
        let known = self.maps.iter().position(|(other, _)| *other == key).map(|at| self.maps.remove(at).1);
        let map = known.unwrap_or_else(|| Arc::new(compute()));
        self.maps.push((key, Arc::clone(&map)));
        let mut bytes: usize = self.maps.iter().map(|(_, map)| map.bytes()).sum();
        while bytes > self.limit && !self.maps.is_empty() {
            bytes -= self.maps.remove(0).1.bytes();
        }
        map
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::backend::conformance::Images;
    use crate::kernels::slab::{Shape, Slab};

    #[test]
    fn content_is_computed_once_until_it_is_pushed_out() {
        let images = Images::new(32, 32, planesweep_scene::Sampling::Uniform);
        let computed = Cell::new(0);
        let map = || {
            computed.set(computed.get() + 1);
            FeatureMap::new(&Slab::zeroed(Shape { columns: 8, channels: 32, length: 8 }))
        };
        let mut cache = FeatureCache::new(2 * map().bytes());
        computed.set(0);
        let [a, b, c] = [&images.reference, &images.sources[0], &images.sources[1]];
        cache.get(a, map);
        cache.get(&a.clone(), map);
        assert_eq!(computed.get(), 1);
        cache.get(b, map);
        cache.get(a, map);
        cache.get(c, map);
        assert_eq!(computed.get(), 3);
        cache.get(a, map);
        assert_eq!(computed.get(), 3);
        cache.get(b, map);
        assert_eq!(computed.get(), 4);
    }
}
