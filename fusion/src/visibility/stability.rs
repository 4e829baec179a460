//! Stability-based choice: a depth is right where occlusions outweigh violations of free space.

use super::{Candidate, Views, in_front};
use crate::options::FilterOptions;

/// The mean of the candidates about the nearest stable one.
///
/// A candidate is stable when at least as many candidates occlude it, or agree with it, as views see
/// through it: too far and all occlude it, too near and all see through it. In the paper any difference
/// counts as in front or behind, so half of those about the same depth count as occlusions; with a
/// tolerance they would count as nothing, and one view that sees through a surface would outweigh any
/// number that see it. `candidates` is sorted.
#[inline(always)]
#[allow(clippy::inline_always)] // compiled once per instruction set
pub(super) fn choose(
    candidates: &mut [Candidate],
    views: &Views<'_>,
    options: &FilterOptions,
) -> Option<f32> {
    let max_relative = options.max_relative_depth;
    candidates.sort_unstable_by(|a, b| a.depth.total_cmp(&b.depth));
    let stable = candidates.iter().position(|candidate| {
        let for_it = candidates.iter().take_while(|c| !in_front(candidate.depth, c.depth, max_relative));
        let for_it = for_it.count().saturating_sub(1); // less the candidate itself
        // Once outweighed, a candidate stays so.
        views.seeing_through(candidate.depth).take(for_it + 1).count() <= for_it
    })?;
    let depth = candidates[stable].depth;
    let about =
        candidates[stable..].iter().map(|c| c.depth).take_while(|d| *d - depth < max_relative * depth);
    let (sum, count) = about.fold((0.0, 0.0), |(sum, count), depth| (sum + depth, count + 1.0));
    // The nearest itself is among them unless the tolerance is 0.
    Some(if count > 0.0 { sum / count } else { depth })
}
