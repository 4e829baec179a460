//! A cache that knows what it will be asked for.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use planesweep_scene::ViewId;
use rayon::prelude::*;

/// What each step of a known sequence needs, within a budget of bytes: when room is needed, that goes
/// whose next use is the farthest away (Belády), so nothing is read more often than the budget demands.
pub(super) struct Foreseen<T> {
    /// The steps that still need a view, the next first.
    uses: BTreeMap<ViewId, VecDeque<usize>>,
    held: BTreeMap<ViewId, Held<T>>,
    budget_bytes: u64,
    held_bytes: u64,
    /// The largest value so far: what the next one is expected to need.
    largest: u64,
}

struct Held<T> {
    value: Arc<T>,
    bytes: u64,
}

impl<T: Send + Sync> Foreseen<T> {
    /// A cache for `steps`, each the views that it needs.
    pub fn new<'a>(steps: impl IntoIterator<Item = Vec<&'a ViewId>>, budget_bytes: u64) -> Self {
        let mut uses: BTreeMap<ViewId, VecDeque<usize>> = BTreeMap::new();
        for (step, needed) in steps.into_iter().enumerate() {
            for view in needed {
                uses.entry(*view).or_default().push_back(step);
            }
        }
        Self { uses, held: BTreeMap::new(), budget_bytes, held_bytes: 0, largest: 0 }
    }

    /// The values of the views that `step` needs, in their order; `load` reads one and says how many
    /// bytes it holds. Steps come in order, but may be left out. What one step needs is held even
    /// beyond the budget.
    pub fn at<E: Send>(
        &mut self,
        step: usize,
        needed: &[ViewId],
        load: impl Fn(ViewId) -> Result<(T, u64), E> + Sync,
    ) -> Vec<Result<Arc<T>, E>> {
        for uses in self.uses.values_mut() {
            while uses.front().is_some_and(|next| *next < step) {
                uses.pop_front();
            }
        }
        let missing: Vec<ViewId> =
            needed.iter().copied().filter(|view| !self.held.contains_key(view)).collect();
        self.make_room(self.largest * missing.len() as u64, needed);
        let loaded: Vec<_> = missing.par_iter().map(|view| load(*view)).collect();
        let mut failed = BTreeMap::new();
        for (view, loaded) in missing.into_iter().zip(loaded) {
            match loaded {
                Ok((value, bytes)) => {
                    self.largest = self.largest.max(bytes);
                    self.held_bytes += bytes;
                    self.held.insert(view, Held { value: Arc::new(value), bytes });
                }
                Err(error) => {
                    failed.insert(view, error);
                }
            }
        }
        let values = needed.iter().filter_map(|view| match failed.remove(view) {
            Some(error) => Some(Err(error)),
            None => self.held.get(view).map(|held| Ok(Arc::clone(&held.value))),
        });
        values.collect()
    }

    /// Drops what is not needed any more, then what is needed last, until `bytes` more fit.
    fn make_room(&mut self, bytes: u64, needed: &[ViewId]) {
        let mut droppable: Vec<(usize, ViewId)> = self
            .held
            .keys()
            .filter(|view| !needed.contains(view))
            .map(|view| (self.uses[view].front().copied().unwrap_or(usize::MAX), *view))
            .collect();
        droppable.sort_unstable();
        while let Some((next, view)) = droppable.pop() {
            let fits = self.held_bytes + bytes <= self.budget_bytes;
            if fits && next < usize::MAX {
                return;
            }
            if let Some(held) = self.held.remove(&view) {
                self.held_bytes -= held.bytes;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;
    use std::sync::Mutex;

    use super::*;

    /// The views that are loaded, in order, for steps that need the given ones.
    fn loads(steps: &[&[u32]], budget: u64) -> Vec<u32> {
        let steps: Vec<Vec<ViewId>> =
            steps.iter().map(|step| step.iter().map(|view| ViewId(*view)).collect()).collect();
        let mut cache = Foreseen::new(steps.iter().map(|step| step.iter().collect()), budget);
        let loaded = Mutex::new(Vec::new());
        for (index, needed) in steps.iter().enumerate() {
            let before = loaded.lock().expect("no panic").len();
            let values = cache.at(index, needed, |view| {
                loaded.lock().expect("no panic").push(view.0);
                Ok::<_, Infallible>((view.0, 10))
            });
            let values: Vec<u32> = values.into_iter().map(|value| *value.expect("loaded")).collect();
            assert_eq!(values, needed.iter().map(|view| view.0).collect::<Vec<_>>());
            assert!(cache.held_bytes <= budget.max(10 * needed.len() as u64), "{}", cache.held_bytes);
            // Several are loaded at once, in any order.
            loaded.lock().expect("no panic")[before..].sort_unstable();
        }
        loaded.into_inner().expect("no panic")
    }

    #[test]
    fn what_is_needed_last_makes_room() {
        // At the third step 2 goes, for 1 is needed sooner.
        assert_eq!(loads(&[&[1], &[2], &[3], &[1], &[3], &[2]], 20), [1, 2, 3, 2]);
        assert_eq!(loads(&[&[1], &[2], &[3], &[1], &[3], &[2]], 30), [1, 2, 3]);
        assert_eq!(loads(&[&[1, 2, 3], &[1], &[2]], 0), [1, 2, 3, 2]);
    }

    #[test]
    fn a_failure_is_told_to_each_step_and_holds_nothing() {
        let needed = [ViewId(1), ViewId(2)];
        let mut cache: Foreseen<u8> = Foreseen::new([needed.iter().collect(), needed.iter().collect()], 99);
        for step in 0..2 {
            let values =
                cache.at(step, &needed, |view| if view == ViewId(1) { Err("no") } else { Ok((7, 1)) });
            assert_eq!(values[0].as_deref(), Err(&"no"));
            assert_eq!(values[1].as_deref(), Ok(&7));
        }
        assert_eq!(cache.held_bytes, 1);
    }
}
