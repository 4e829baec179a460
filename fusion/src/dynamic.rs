//! Dynamic consistency: the more views agree, the less closely each must (D2HC-RMVSNet, Yan et al.
//! 2020, section 3.3).

use crate::kernel::{Answer, LANES, Lanes};

/// Pixels of reprojection error that each further neighbour allows, inverted.
const LEVELS_PER_PIXEL: f32 = 4.0;
/// Relative difference of depth that each further neighbour allows, inverted.
const LEVELS_PER_DEPTH: f32 = 1300.0;

/// The least n for which a reprojection error (given squared) is less than n/4 pixels and a relative
/// difference of depth less than n/1300; infinite where one of them is no number.
///
/// # Safety
/// As [`Lanes`].
#[inline(always)]
#[expect(clippy::inline_always, reason = "compiled once per instruction set")]
#[expect(unsafe_code, reason = "part of the kernel")]
pub(crate) unsafe fn level<L: Lanes>(squared_px: L::F, relative_depth: L::F) -> L::F {
    // SAFETY: the caller vouches for the processor.
    unsafe {
        let by_pixels = L::mul(L::splat(LEVELS_PER_PIXEL), L::sqrt(squared_px));
        let by_depth = L::mul(L::splat(LEVELS_PER_DEPTH), relative_depth);
        let larger = L::select(L::less(by_pixels, by_depth), by_depth, by_pixels);
        let level = L::add(L::floor(larger), L::splat(1.0));
        let are_numbers = L::less(L::splat(-1.0), L::add(squared_px, relative_depth));
        L::select(are_numbers, level, L::splat(f32::INFINITY))
    }
}

/// Keeps, for each hypothesis, the neighbours that meet the strictest thresholds that enough of them
/// meet: those of level n or less, for the least n of at least `min_neighbours` that n of them meet.
/// Keeps none where there is no such n.
pub(crate) fn settle(answers: &mut [Answer], having: &mut Vec<u32>, min_neighbours: u32) {
    let most = answers.len();
    for k in 0..LANES {
        having.clear();
        having.resize(most + 1, 0);
        for answer in answers.iter().filter(|answer| answer.depth[k] > 0.0) {
            // Levels beyond `most`, which nothing can decide for, have no place.
            if let Some(having) = having.get_mut(answer.level[k] as usize) {
                *having += 1;
            }
        }
        let decided = decided(having, min_neighbours.max(1) as usize);
        for answer in answers.iter_mut() {
            let met = decided.is_some_and(|n| answer.level[k] <= n as f32);
            answer.depth[k] = if met { answer.depth[k] } else { 0.0 };
        }
    }
}

/// The least n from `least` on that as many neighbours have at most as their level, where `having[n]` have it.
fn decided(having: &[u32], least: usize) -> Option<usize> {
    let mut meeting = 0;
    for (n, having) in having.iter().enumerate() {
        meeting += having;
        if n >= least && meeting as usize >= n {
            return Some(n);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kernel::Portable;

    fn level(squared_px: f32, relative_depth: f32) -> f32 {
        // SAFETY: the portable lanes need nothing.
        #[expect(unsafe_code, reason = "part of the kernel")]
        unsafe {
            super::level::<Portable>([squared_px; LANES], [relative_depth; LANES])[0]
        }
    }

    #[test]
    fn a_level_is_the_least_that_meets_both_thresholds() {
        assert_eq!(level(0.0, 0.0), 1.0);
        assert_eq!(level(0.24 * 0.24, 0.5 / 1300.0), 1.0);
        assert_eq!(level(0.25 * 0.25, 0.0), 2.0); // the thresholds are exclusive
        assert_eq!(level(0.0, 2.5 / 1300.0), 3.0);
        assert_eq!(level(0.9 * 0.9, 2.5 / 1300.0), 4.0);
        assert_eq!((level(f32::NAN, 0.0), level(0.0, f32::NAN)), (f32::INFINITY, f32::INFINITY));
    }

    /// What is left of five neighbours of these levels; 0 stands for one that sees nothing there.
    fn settled(levels: [f32; 5], min_neighbours: u32) -> [bool; 5] {
        // The last lane stands for all, so that none is forgotten.
        let lanes = |value: f32| std::array::from_fn(|k| if k + 1 == LANES { value } else { 0.0 });
        let answer = |level: f32| Answer {
            depth: lanes(if level > 0.0 { 2.0 } else { 0.0 }),
            level: lanes(level),
            ..Answer::default()
        };
        let mut answers = levels.map(answer);
        settle(&mut answers, &mut Vec::new(), min_neighbours);
        answers.map(|answer| answer.depth[LANES - 1] > 0.0)
    }

    #[test]
    fn more_neighbours_may_agree_less_closely() {
        assert_eq!(settled([1.0, 2.0, 9.0, 9.0, 0.0], 2), [true, true, false, false, false]);
        assert_eq!(settled([3.0, 3.0, 9.0, 9.0, 0.0], 2), [false; 5]);
        assert_eq!(settled([3.0, 3.0, 2.0, 9.0, 0.0], 2), [true, true, true, false, false]);
        assert_eq!(settled([5.0, 5.0, 5.0, 5.0, 5.0], 2), [true; 5]);
        assert_eq!(settled([5.0, 5.0, 5.0, 5.0, 0.0], 2), [false; 5]);
        assert_eq!(settled([1.0, 0.0, 0.0, 0.0, 0.0], 1), [true, false, false, false, false]);
        assert_eq!(settled([1.0, 1.0, 3.0, 6.0, f32::INFINITY], 3), [true, true, true, false, false]);
    }
}
