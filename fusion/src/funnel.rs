//! How many pixels each step of fusion leaves.

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
    /// Of these, pixels with a depth that other views neither hide nor see through; all where the
    /// method does not ask.
    #[serde(default)]
    pub visible: u64,
    /// Of these, pixels that enough views agree with.
    pub geometric: u64,
    /// Of these, pixels that became points: what another view emits is left out.
    #[serde(default)]
    pub emitted: u64,
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
    /// No view contradicts.
    Visible,
    /// Enough views agree.
    Geometric,
    /// No other view emits the same surface.
    Emitted,
}

impl fmt::Display for FilterStep {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::DepthMaps => "there is no depth map",
            Self::Depth => "no pixel has a depth",
            Self::Photometric => "no pixel passes the photometric filter (minimum confidence)",
            Self::Visible => "no pixel passes the visibility filter (views that contradict)",
            Self::Geometric => "no pixel passes the geometric filter (views that agree)",
            Self::Emitted => "no pixel is emitted",
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
    /// The steps in order, each with its name and what it left.
    pub fn steps(&self) -> [(&'static str, u64); 6] {
        [
            ("pixels", self.pixels),
            ("with a depth", self.with_depth),
            ("photometric", self.photometric),
            ("visible", self.visible),
            ("geometric", self.geometric),
            ("emitted", self.emitted),
        ]
    }

    /// The first step that left nothing; `None` when points remain.
    pub fn emptied_by(&self) -> Option<EmptyCloud> {
        let steps = [
            (FilterStep::DepthMaps, self.pixels),
            (FilterStep::Depth, self.with_depth),
            (FilterStep::Photometric, self.photometric),
            (FilterStep::Visible, self.visible),
            (FilterStep::Geometric, self.geometric),
            (FilterStep::Emitted, self.emitted),
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
            visible: self.visible + other.visible,
            geometric: self.geometric + other.geometric,
            emitted: self.emitted + other.emitted,
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

    fn funnel(counts: [u64; 6]) -> Funnel {
        let [pixels, with_depth, photometric, visible, geometric, emitted] = counts;
        Funnel { pixels, with_depth, photometric, visible, geometric, emitted }
    }

    #[test]
    fn the_first_step_that_left_nothing_is_named() {
        assert_eq!(funnel([12, 10, 5, 4, 2, 1]).emptied_by(), None);
        let cases = [
            ([0; 6], FilterStep::DepthMaps, 0),
            ([12, 0, 0, 0, 0, 0], FilterStep::Depth, 12),
            ([12, 10, 0, 0, 0, 0], FilterStep::Photometric, 10),
            ([12, 10, 5, 0, 0, 0], FilterStep::Visible, 5),
            ([12, 10, 5, 4, 0, 0], FilterStep::Geometric, 4),
            ([12, 10, 5, 4, 2, 0], FilterStep::Emitted, 2),
        ];
        for (counts, step, before) in cases {
            assert_eq!(funnel(counts).emptied_by(), Some(EmptyCloud { step, before }));
        }
        let message = funnel([12, 10, 5, 5, 0, 0]).emptied_by().expect("empty").to_string();
        assert_eq!(
            message,
            "the cloud is empty: no pixel passes the geometric filter (views that agree), 5 came that far"
        );
    }

    #[test]
    fn funnels_of_views_add_up() {
        let sum: Funnel = [funnel([12, 10, 5, 4, 2, 1]), funnel([12, 3, 1, 1, 0, 0])].into_iter().sum();
        assert_eq!(sum, funnel([24, 13, 6, 5, 2, 1]));
        assert_eq!(sum.emptied_by(), None);
    }
}
