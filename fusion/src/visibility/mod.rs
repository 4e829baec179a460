//! Visibility: which of all views' depths along the line of sight of a pixel is its surface (Merrell
//! et al., "Real-Time Visibility-Based Fusion of Depth Maps", ICCV 2007; paper, section 4.2).
//!
//! The candidates of a pixel are its own depth and those of the neighbours that are rendered into it.
//! Two kinds of evidence speak against a candidate: a rendered depth in front of it *occludes* it, so
//! it should not be seen here; and a view that sees something behind it along its own line of sight
//! finds its place empty, a *violation of free space*.
#![allow(
    unsafe_code,
    clippy::inline_always,
    reason = "compiled for the instructions of the processor, as the kernel"
)]

mod confidence;
mod render;
mod stability;

use planesweep_scene::DepthMap;
use rayon::prelude::*;

use crate::geometric::{Neighbour, RowTransfer};
use crate::hypotheses::{Hypothesis, HypothesisRow};
use crate::kernel::{Kernel, Lanes, Level};
use crate::options::{FilterOptions, FusionMethod};
use render::{Rendered, render};

/// A depth along the line of sight of a pixel, and how sure the view that saw it was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Candidate {
    pub depth: f32,
    pub confidence: f32,
}

/// The reference and its neighbours, rendered into it.
pub(crate) struct Candidates<'a> {
    reference: &'a DepthMap,
    neighbours: &'a [Neighbour<'a>],
    rendered: Vec<Rendered>,
    options: &'a FilterOptions,
    level: Level,
}

/// How many pixels of a row had something to choose from.
#[derive(Default)]
pub(crate) struct RowCounts {
    /// Pixels with a depth of their own or of a neighbour.
    pub with_depth: usize,
    /// Of these, pixels with a confident one.
    pub photometric: usize,
}

/// Memory that the rows share.
#[derive(Default)]
pub(crate) struct Scratch {
    candidates: Vec<Candidate>,
    transfers: Vec<RowTransfer>,
}

impl<'a> Candidates<'a> {
    /// Renders the confident depths of all neighbours into the reference.
    pub fn new(
        reference: &'a DepthMap,
        neighbours: &'a [Neighbour<'a>],
        options: &'a FilterOptions,
        level: Level,
    ) -> Self {
        let (width, height) = (reference.width(), reference.height());
        let rendered = neighbours
            .par_iter()
            .map(|neighbour| render(level, neighbour, width, height, options.min_confidence))
            .collect();
        Self { reference, neighbours, rendered, options, level }
    }

    /// Chooses the hypotheses of row `y`: at most one depth for each pixel.
    pub fn choose(&self, y: usize, scratch: &mut Scratch, row: &mut HypothesisRow) -> RowCounts {
        scratch.transfers.clear();
        scratch.transfers.extend(self.neighbours.iter().map(|neighbour| neighbour.row_transfer(y)));
        row.clear(self.reference.width());
        let counts = self.level.run(Choice { candidates: self, y, scratch, row });
        row.end();
        counts
    }

    #[inline(always)]
    fn choose_each(&self, y: usize, scratch: &mut Scratch, row: &mut HypothesisRow) -> RowCounts {
        let Scratch { candidates, transfers } = scratch;
        let mut counts = RowCounts::default();
        for x in 0..self.reference.width() {
            let (depth, confidence) = (self.reference.depth.at(x, y), self.reference.confidence.at(x, y));
            let sure = depth > 0.0 && confidence >= self.options.min_confidence;
            let own = sure.then_some(Candidate { depth, confidence });
            candidates.clear();
            candidates.extend(own);
            candidates.extend(self.rendered.iter().filter_map(|map| map.at(x, y)));
            counts.with_depth += usize::from(depth > 0.0 || !candidates.is_empty());
            counts.photometric += usize::from(!candidates.is_empty());
            let views = Views { candidates: self, own, transfers, x: x as f32 };
            let chosen = match self.options.method {
                FusionMethod::VisibilityConfidence => confidence::choose(candidates, &views, self.options),
                _ => stability::choose(candidates, &views, self.options),
            };
            if let Some(chosen) = chosen {
                let agrees =
                    |own: &Candidate| (own.depth - chosen).abs() < self.options.max_relative_depth * chosen;
                let own = own.filter(agrees).map_or(0.0, |own| own.depth);
                row.push(Hypothesis { column: x as i32, depth: chosen, own });
            }
        }
        counts
    }
}

/// The choice of a row, compiled for the instructions of the processor.
struct Choice<'a, 'b> {
    candidates: &'a Candidates<'b>,
    y: usize,
    scratch: &'a mut Scratch,
    row: &'a mut HypothesisRow,
}

impl Kernel for Choice<'_, '_> {
    type Output = RowCounts;

    #[inline(always)]
    unsafe fn run<L: Lanes>(self) -> RowCounts {
        self.candidates.choose_each(self.y, self.scratch, self.row)
    }
}

/// All views, as they judge the depths of one pixel of the reference.
pub(crate) struct Views<'a> {
    candidates: &'a Candidates<'a>,
    own: Option<Candidate>,
    transfers: &'a [RowTransfer],
    x: f32,
}

impl Views<'_> {
    /// The confidences of the views that see something behind `depth`, the reference first.
    #[inline(always)]
    #[allow(clippy::inline_always)] // compiled once per instruction set
    fn seeing_through(&self, depth: f32) -> impl Iterator<Item = f32> {
        let options = self.candidates.options;
        let behind = 1.0 + options.max_relative_depth;
        let own = self.own.filter(|own| own.depth > depth * behind).map(|own| own.confidence);
        let views = self.candidates.neighbours.iter().zip(self.transfers);
        let neighbours = views.filter_map(move |(neighbour, transfer)| {
            let (u, v, z) = transfer.project(self.x, depth);
            let map = neighbour.map;
            // What lies outside is negative or too large; so is what is no number.
            if !(u > -0.5 && v > -0.5) {
                return None;
            }
            let (u, v) = ((u + 0.5) as usize, (v + 0.5) as usize);
            let seen = map.depth.get(u, v)?;
            let confidence = map.confidence.at(u, v);
            (seen > z * behind && confidence >= options.min_confidence).then_some(confidence)
        });
        own.into_iter().chain(neighbours)
    }
}

/// Whether `depth` lies in front of `other` by more than the relative tolerance.
#[inline]
fn in_front(depth: f32, other: f32, max_relative: f32) -> bool {
    depth * (1.0 + max_relative) < other
}

#[cfg(test)]
mod tests;
