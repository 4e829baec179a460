//! The cost volume and its way back, a few rows at a time, while they are in the cache.

use std::ops::Range;

use rayon::prelude::*;

use super::stack::{Stack, Tools};
use crate::bands::Row;
use crate::kernels::cost::{CHANNELS, CostInput, CostScratch, FeatureMap, PixelSweep};
use crate::kernels::cost_gradient::FeatureGradients;
use crate::kernels::slab::Shape;
use crate::train::Example;
use crate::train::engine::GradientOptions;

/// Rows of the volume that are taken at a time, and parts that their gradients are summed in, whatever the number
/// of threads.
pub(super) const BAND: usize = 8;

/// The cost of an example with features of all views.
pub(super) fn input<'a>(
    maps: &'a [FeatureMap],
    example: &Example,
    options: &GradientOptions,
) -> CostInput<'a> {
    let sweep = |source| {
        let sweep = PixelSweep::new(&example.projections[0], source);
        sweep.expect("examples have invertible references")
    };
    CostInput {
        reference: &maps[0],
        sources: maps[1..].iter().zip(example.projections[1..].iter().map(sweep)).collect(),
        inverse_depths: example.hypotheses.depths().iter().map(|depth| 1.0 / depth).collect(),
        metric: options.network.metric,
    }
}

/// Some rows of the cost volume.
pub(super) fn rows(tools: &Tools, input: &CostInput<'_>, rows: Range<usize>) -> Vec<Row> {
    let (columns, length) = (input.reference.width(), input.inverse_depths.len());
    let shape = Shape { columns, channels: CHANNELS, length };
    let band = Stack::compute(tools, rows.len(), shape, |row, slab| {
        let mut scratch = CostScratch::default();
        for (x, column) in slab.columns_mut().chunks_exact_mut(shape.column()).enumerate() {
            input.column(tools.level, x, rows.start + row, column, &mut scratch);
        }
    });
    band.slabs
}

/// The gradient of features, gathered from that of the cost volume.
pub(super) struct CostGradient<'a> {
    tools: &'a Tools,
    input: &'a CostInput<'a>,
    /// Each with every row whose number has the same remainder.
    parts: Vec<FeatureGradients>,
    /// What the reference learned, row by row, channels innermost.
    reference: Vec<Vec<f32>>,
}

impl<'a> CostGradient<'a> {
    pub(super) fn new(tools: &'a Tools, input: &'a CostInput<'a>) -> Self {
        let part = |_| FeatureGradients::zeroed(&tools.pool, input.reference, input.sources.len());
        let parts = (0..BAND.min(input.reference.height())).into_par_iter().map(part).collect();
        Self { tools, input, parts, reference: Vec::new() }
    }

    /// Takes the gradient of the next rows of the volume.
    pub(super) fn take(&mut self, rows: &[Row]) {
        let (first, count) = (self.reference.len(), self.parts.len());
        let (input, level) = (self.input, self.tools.level);
        let part = |(part, gradients): (usize, &mut FeatureGradients)| {
            let mut scratch = CostScratch::default();
            let mut learned = Vec::new();
            for (y, row) in (first..).zip(rows).filter(|(y, _)| y % count == part) {
                let columns = 0..row.shape().columns;
                let pixel = |x| {
                    let column = row.column(x as isize);
                    input.column_gradient(level, [x, y], column, &mut scratch, gradients)
                };
                learned.push((y, columns.flat_map(pixel).collect::<Vec<f32>>()));
            }
            learned
        };
        let mut learned: Vec<_> = self.parts.par_iter_mut().enumerate().flat_map_iter(part).collect();
        learned.sort_unstable_by_key(|(y, _)| *y);
        self.reference.extend(learned.into_iter().map(|(_, row)| row));
    }

    /// That of all features, one slab for each view, with columns `[y][channel][x]`.
    pub(super) fn features(self, shape: Shape) -> Stack {
        let write = |view: usize, y: usize, column: &mut [f32]| {
            let rows: Vec<&[f32]> = if view == 0 {
                vec![&self.reference[y]]
            } else {
                self.parts.iter().map(|part| part.row(view - 1, y)).collect()
            };
            for x in 0..shape.length {
                let mut sum = [0.0; CHANNELS];
                for row in &rows {
                    let pixel = &row[x * CHANNELS..][..CHANNELS];
                    sum.iter_mut().zip(pixel).for_each(|(sum, value)| *sum += value);
                }
                for (channel, sum) in sum.into_iter().enumerate() {
                    column[shape.value(channel, x)] = sum;
                }
            }
        };
        Stack::compute_columns(self.tools, self.input.sources.len() + 1, shape, write)
    }
}
