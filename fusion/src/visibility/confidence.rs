//! Confidence-based choice: the most confident depth, when its supporters outweigh its opponents.

use super::{Candidate, Views, in_front};
use crate::options::FilterOptions;

/// The mean, weighted by confidence, of the candidates that agree with the most confident one; `None`
/// when the sum of their confidences, less those of the candidates that occlude it and of the views
/// that see through it, is below the least confidence.
#[inline(always)]
#[allow(clippy::inline_always)] // compiled once per instruction set
pub(super) fn choose(candidates: &[Candidate], views: &Views<'_>, options: &FilterOptions) -> Option<f32> {
    let max_relative = options.max_relative_depth;
    let first = candidates.first()?;
    let best = candidates.iter().fold(first, |best, c| if c.confidence > best.confidence { c } else { best });
    let (mut weighted, mut support, mut conflict) = (0.0, 0.0, 0.0);
    for candidate in candidates {
        if (candidate.depth - best.depth).abs() < max_relative * best.depth {
            weighted += candidate.confidence * candidate.depth;
            support += candidate.confidence;
        }
    }
    let depth = if support > 0.0 { weighted / support } else { best.depth };
    for candidate in candidates.iter().filter(|c| in_front(c.depth, depth, max_relative)) {
        conflict += candidate.confidence;
    }
    conflict += views.seeing_through(depth).sum::<f32>();
    (support - conflict >= options.min_confidence).then_some(depth)
}
