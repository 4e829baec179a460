//! How many pixels each step of the filter leaves.

use std::fmt;
use std::iter::Sum;
use std::ops::Add;

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Pixels left after each step, of one view or, summed, of many; no count exceeds the one before.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Funnel {
    /// Pixels of the depth map.
    pub pixels: u64,
    /// Pixels with a depth.
    pub with_depth: u64,
    /// Of these, pixels that are confident enough.
    pub photometric: u64,
    /// Of these, pixels that enough views agree with.
    pub geometric: u64,
}

/// A step of the filter.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FilterStep {
    /// There is a view with a depth map.
    DepthMaps,
    /// The pixel has a depth.
    Depth,
    /// The pixel is confident.
    Photometric,
    /// Enough views agree.
    Geometric,
}

impl fmt::Display for FilterStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::DepthMaps => "there is no depth map",
            Self::Depth => "no pixel has a depth",
            Self::Photometric => "no pixel passes the photometric filter (minimum confidence)",
            Self::Geometric => "no pixel passes the geometric filter (views that agree)",
        })
    }
}

/// No pixel became a point.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
#[error("the cloud is empty: {step}, {before} came that far")]
pub struct EmptyCloud {
    /// The step that left nothing.
    pub step: FilterStep,
    /// The pixels that reached it.
    pub before: u64,
}

impl Funnel {
    /// The first step that left nothing; `None` when points remain.
    pub fn emptied_by(&self) -> Option<EmptyCloud> {
        let steps = [
            (FilterStep::DepthMaps, self.pixels),
            (FilterStep::Depth, self.with_depth),
            (FilterStep::Photometric, self.photometric),
            (FilterStep::Geometric, self.geometric),
        ];
        let mut before = 0;
        for (step, left) in steps {
            if left == 0 {
                return Some(EmptyCloud { step, before });
            }
            before = left;
        }
        None
    }
}

impl Add for Funnel {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self {
            pixels: self.pixels + other.pixels,
            with_depth: self.with_depth + other.with_depth,
            photometric: self.photometric + other.photometric,
            geometric: self.geometric + other.geometric,
        }
    }
}

impl Sum for Funnel {
    fn sum<I: Iterator<Item = Self>>(funnels: I) -> Self {
        funnels.fold(Self::default(), Add::add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_step_that_left_nothing_is_named() {
        let full = Funnel { pixels: 12, with_depth: 10, photometric: 5, geometric: 2 };
        assert_eq!(full.emptied_by(), None);
        let cases = [
            (Funnel::default(), FilterStep::DepthMaps, 0),
            (Funnel { pixels: 12, ..Funnel::default() }, FilterStep::Depth, 12),
            (Funnel { photometric: 0, geometric: 0, ..full }, FilterStep::Photometric, 10),
            (Funnel { geometric: 0, ..full }, FilterStep::Geometric, 5),
        ];
        for (funnel, step, before) in cases {
            assert_eq!(funnel.emptied_by(), Some(EmptyCloud { step, before }));
        }
        let message = cases[3].0.emptied_by().expect("empty").to_string();
        assert_eq!(
            message,
            "the cloud is empty: no pixel passes the geometric filter (views that agree), 5 came that far"
        );
    }

    #[test]
    fn funnels_of_views_add_up() {
        let one = Funnel { pixels: 12, with_depth: 10, photometric: 5, geometric: 2 };
        let none = Funnel { pixels: 12, with_depth: 3, photometric: 1, geometric: 0 };
        let sum: Funnel = [one, none].into_iter().sum();
        assert_eq!(sum, Funnel { pixels: 24, with_depth: 13, photometric: 6, geometric: 2 });
        assert_eq!(sum.emptied_by(), None);
    }
}
