//! Dynamic consistency: the more views agree, the less closely each must (D2HC-RMVSNet, Yan et al.
//! 2020, section 3.3).

#![allow(clippy::inline_always)] // compiled once per instruction set, with the row's other work

use crate::geometric::Agreement;

/// Pixels of reprojection error that each further neighbour allows, inverted.
const LEVELS_PER_PIXEL: f32 = 4.0;
/// Relative difference of depth that each further neighbour allows, inverted.
const LEVELS_PER_DEPTH: f32 = 1300.0;

/// The least n for which a reprojection error (given squared) is less than n/4 pixels and a relative
/// difference of depth less than n/1300; infinite where one of them is no number.
#[inline(always)]
pub(crate) fn level(squared_px: f32, relative_depth: f32) -> f32 {
    let level = (LEVELS_PER_PIXEL * squared_px.sqrt()).max(LEVELS_PER_DEPTH * relative_depth).floor() + 1.0;
    // `max` passes over what is no number.
    if (squared_px + relative_depth).is_nan() { f32::INFINITY } else { level }
}

/// Keeps, for each hypothesis, the neighbours that meet the strictest thresholds that enough of them
/// meet: those of level n or less, for the least n of at least `min_neighbours` that n of them meet.
/// Keeps none where there is no such n.
#[derive(Default)]
pub(crate) struct Settlement {
    /// How many neighbours have each level.
    having: Vec<u32>,
}

impl Settlement {
    #[inline(always)]
    pub fn settle(&mut self, agreements: &mut [Agreement], hypotheses: usize, min_neighbours: u32) {
        let most = agreements.len();
        for i in 0..hypotheses {
            self.having.clear();
            self.having.resize(most + 1, 0);
            for agreement in agreements.iter().filter(|agreement| agreement.depth[i] > 0.0) {
                // Levels beyond `most`, which nothing can decide for, have no place.
                if let Some(having) = self.having.get_mut(agreement.level[i] as usize) {
                    *having += 1;
                }
            }
            let decided = self.decided(min_neighbours.max(1) as usize);
            for agreement in agreements.iter_mut() {
                let met = decided.is_some_and(|n| agreement.level[i] <= n as f32);
                agreement.depth[i] = if met { agreement.depth[i] } else { 0.0 };
            }
        }
    }

    /// The least n from `least` on that as many neighbours have at most as their level.
    fn decided(&self, least: usize) -> Option<usize> {
        let mut meeting = 0;
        for (n, having) in self.having.iter().enumerate() {
            meeting += having;
            if n >= least && meeting as usize >= n {
                return Some(n);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let agreement = |level: f32| Agreement {
            depth: vec![if level > 0.0 { 2.0 } else { 0.0 }],
            level: vec![level],
            ..Agreement::default()
        };
        let mut agreements = levels.map(agreement);
        Settlement::default().settle(&mut agreements, 1, min_neighbours);
        agreements.map(|agreement| agreement.depth[0] > 0.0)
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
