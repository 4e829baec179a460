//! Layers of volumes, a few rows at a time. Each stage takes the next rows of its input, keeps those that
//! later rows still need, and gives the rows of its output that are complete.

use std::collections::VecDeque;
use std::sync::Arc;

use rayon::prelude::*;

use crate::kernels::cost::{CHANNELS, CostInput, CostScratch};
use crate::kernels::regress::{Regressed, RegressionLayer, RegressionScratch};
use crate::kernels::simd::Level;
use crate::kernels::slab::{Column, Pool, Shape, Slab};
use crate::kernels::strided::StridedLayer;
use crate::kernels::transposed::TransposedLayer;
use crate::kernels::winograd::{Target, WinogradLayer};

/// A row of a volume that several stages may hold.
pub(crate) type Row = Arc<Slab>;

/// Where a layer of stride 1 gets its input from, column by column.
pub(crate) trait ColumnSource {
    /// Columns `x - 1` to `x + 2` of the row with this number among the next rows; `x` is even.
    fn columns(&mut self, row: usize, x: usize) -> [Column<'_>; 4];
}

/// Rows that are stored.
struct StoredRows<'a>(&'a [Row]);

impl ColumnSource for StoredRows<'_> {
    fn columns(&mut self, row: usize, x: usize) -> [Column<'_>; 4] {
        self.0[row].four_columns(x)
    }
}

/// Rows of the cost volume, which never exist as a whole: four columns at a time are computed.
pub(crate) struct CostRows<'a> {
    input: &'a CostInput<'a>,
    level: Level,
    /// The row of the reference that row 0 is.
    first: usize,
    ring: Slab,
    scratch: CostScratch,
    /// Row of the columns in the ring, and the next column.
    at: Option<(usize, usize)>,
}

impl<'a> CostRows<'a> {
    pub(crate) fn new(input: &'a CostInput<'a>, level: Level, first: usize) -> Self {
        let shape = Shape { columns: 4, channels: CHANNELS, length: input.inverse_depths.len() };
        Self { input, level, first, ring: Slab::zeroed(shape), scratch: CostScratch::default(), at: None }
    }
}

impl ColumnSource for CostRows<'_> {
    fn columns(&mut self, row: usize, x: usize) -> [Column<'_>; 4] {
        let width = self.input.reference.width();
        let begin = if self.at == Some((row, x + 1)) { x + 1 } else { x.saturating_sub(1) };
        let size = self.ring.shape().column();
        for x in begin..(x + 3).min(width) {
            let output = &mut self.ring.columns_mut()[x % 4 * size..][..size];
            self.input.column(self.level, x, self.first + row, output, &mut self.scratch);
        }
        self.at = Some((row, x + 3));
        [-1, 0, 1, 2].map(|offset| {
            let x = x as isize + offset;
            // Columns outside are zeros, as is the one before the ring.
            let inside = (0..width as isize).contains(&x);
            self.ring.column(if inside { x % 4 } else { -1 })
        })
    }
}

/// A layer of stride 1.
#[derive(Debug)]
pub(crate) struct PlainStage {
    pool: Arc<Pool>,
    output: Shape,
    height: usize,
    /// Input rows taken so far.
    taken: usize,
    /// Output rows that have begun, from the first that is not complete.
    open: VecDeque<Slab>,
}

impl PlainStage {
    pub(crate) fn new(pool: &Arc<Pool>, layer: &WinogradLayer, input: Shape, height: usize) -> Self {
        let output = Shape { channels: layer.outputs, ..input };
        Self { pool: Arc::clone(pool), output, height, taken: 0, open: VecDeque::new() }
    }

    pub(crate) fn output(&self) -> Shape {
        self.output
    }

    pub(crate) fn push(&mut self, layer: &WinogradLayer, rows: &[Row]) -> Vec<Row> {
        self.push_from(layer, rows.len(), || StoredRows(rows))
    }

    /// Takes the next `count` rows from sources that are made for each task.
    pub(crate) fn push_from<S: ColumnSource>(
        &mut self,
        layer: &WinogradLayer,
        count: usize,
        source: impl Fn() -> S + Sync,
    ) -> Vec<Row> {
        if count == 0 {
            return Vec::new();
        }
        let (height, taken) = (self.height, self.taken);
        // Input row y meets the outputs y - 1 to y + 1.
        let first_open = taken.saturating_sub(1);
        let end_open = (taken + count + 1).min(height);
        while first_open + self.open.len() < end_open {
            self.open.push_back(self.pool.take(self.output));
        }
        let shape = self.output;
        let column = shape.column();
        let pairs = shape.columns.div_ceil(2);
        let tasks = tasks(pairs);
        let per_task = pairs.div_ceil(tasks);
        let mut tiles: Vec<Vec<&mut [f32]>> = (0..tasks).map(|_| Vec::new()).collect();
        for slab in &mut self.open {
            for (tile, columns) in tiles.iter_mut().zip(slab.columns_mut().chunks_mut(2 * per_task * column))
            {
                tile.push(columns);
            }
        }
        tiles.into_par_iter().enumerate().for_each(|(task, mut outputs)| {
            let Some(pairs) = outputs.first().map(|row| row.len().div_ceil(2 * column)) else { return };
            let mut source = source();
            let mut scratch = layer.scratch();
            for row in 0..count {
                let y = taken + row;
                for pair in 0..pairs {
                    let input = source.columns(row, 2 * (task * per_task + pair));
                    let met = outputs.iter_mut().enumerate().map(|(i, columns)| (first_open + i, columns));
                    let mut targets: Vec<Target<'_>> = met
                        .filter(|(output, _)| output.abs_diff(y) <= 1)
                        .map(|(output, columns)| {
                            let begin = 2 * pair * column;
                            let end = (begin + 2 * column).min(columns.len());
                            Target {
                                columns: &mut columns[begin..end],
                                tap: y + 1 - output,
                                first: y == output.saturating_sub(1),
                                last: y == (output + 1).min(height - 1),
                            }
                        })
                        .collect();
                    layer.accumulate(input, &mut targets, &mut scratch);
                }
            }
        });
        self.taken += count;
        let complete = if self.taken == height { height } else { self.taken.saturating_sub(1) };
        self.open.drain(..complete - first_open).map(Arc::new).collect()
    }
}

/// Tasks that a row of this many parts is cut into: enough that no thread waits long for another.
fn tasks(parts: usize) -> usize {
    let threads = rayon::current_num_threads();
    if threads == 1 { 1 } else { (4 * threads).min(parts) }
}

/// A layer of stride 2. Width and height are even.
#[derive(Debug)]
pub(crate) struct DownStage {
    pool: Arc<Pool>,
    output: Shape,
    /// Input rows taken so far.
    taken: usize,
    /// The last of them.
    kept: Vec<Row>,
}

impl DownStage {
    pub(crate) fn new(pool: &Arc<Pool>, layer: &StridedLayer, input: Shape) -> Self {
        let output =
            Shape { columns: input.columns / 2, channels: layer.outputs, length: input.length.div_ceil(2) };
        Self { pool: Arc::clone(pool), output, taken: 0, kept: Vec::new() }
    }

    pub(crate) fn output(&self) -> Shape {
        self.output
    }

    pub(crate) fn push(&mut self, layer: &StridedLayer, rows: &[Row]) -> Vec<Row> {
        let first_kept = self.taken - self.kept.len();
        let done = self.taken / 2;
        self.kept.extend_from_slice(rows);
        self.taken += rows.len();
        let kept = &self.kept;
        let column = self.output.column();
        let mut outputs: Vec<Slab> = (done..self.taken / 2).map(|_| self.pool.take(self.output)).collect();
        outputs.par_iter_mut().enumerate().for_each(|(i, slab)| {
            let y = 2 * (done + i);
            let rows = (0..3).filter(|tap| y + tap > 0).map(|tap| (&kept[y + tap - 1 - first_kept], tap));
            let rows: Vec<_> = rows.collect();
            slab.columns_mut().par_chunks_exact_mut(column).enumerate().for_each(|(x, output)| {
                let mut columns = Vec::with_capacity(9);
                for (row, tap) in &rows {
                    let inside = (0..3).filter(|column| 2 * x + column > 0);
                    columns.extend(inside.map(|at| (row.column((2 * x + at) as isize - 1), 3 * tap + at)));
                }
                layer.apply(&columns, output);
            });
        });
        // The next output begins one row before its middle.
        let needed = (self.taken / 2 * 2).saturating_sub(1);
        self.kept.drain(..needed.saturating_sub(first_kept));
        outputs.into_iter().map(Arc::new).collect()
    }
}

/// A transposed layer with the skip connection that is added to it.
#[derive(Debug)]
pub(crate) struct UpStage {
    pool: Arc<Pool>,
    output: Shape,
    /// Rows of the input.
    height: usize,
    taken: usize,
    /// The last of them.
    kept: Option<Row>,
    /// Rows of the skip connection, from that of the next output on.
    skip: VecDeque<Row>,
}

impl UpStage {
    pub(crate) fn new(pool: &Arc<Pool>, skip: Shape, height: usize) -> Self {
        let pool = Arc::clone(pool);
        Self { pool, output: skip, height, taken: 0, kept: None, skip: VecDeque::new() }
    }

    pub(crate) fn push_skip(&mut self, rows: &[Row]) {
        self.skip.extend(rows.iter().cloned());
    }

    pub(crate) fn push(&mut self, layer: &TransposedLayer, rows: &[Row]) -> Vec<Row> {
        let complete =
            |taken: usize| if taken == self.height { 2 * taken } else { (2 * taken).saturating_sub(1) };
        let first_kept = self.taken - usize::from(self.kept.is_some());
        let done = complete(self.taken);
        self.taken += rows.len();
        let kept: Vec<Row> = self.kept.take().into_iter().chain(rows.iter().cloned()).collect();
        let shape = self.output;
        let inputs = shape.columns / 2;
        let skips: Vec<Row> = self.skip.drain(..complete(self.taken) - done).collect();
        let mut outputs: Vec<Slab> = skips.iter().map(|_| self.pool.take(self.output)).collect();
        outputs.par_iter_mut().zip(&skips).enumerate().for_each(|(i, (slab, skip))| {
            let rows: Vec<_> =
                taps(done + i, self.height).map(|(input, tap)| (&kept[input - first_kept], tap)).collect();
            slab.columns_mut().par_chunks_exact_mut(shape.column()).enumerate().for_each(|(x, output)| {
                let mut columns = Vec::with_capacity(4);
                for (row, tap) in &rows {
                    columns.extend(taps(x, inputs).map(|(x, at)| (row.column(x as isize), 3 * tap + at)));
                }
                layer.apply(&columns, Some(skip.column(x as isize)), shape.length, output);
            });
        });
        self.kept = kept.into_iter().next_back();
        outputs.into_iter().map(Arc::new).collect()
    }
}

/// The inputs that an output of a transposed layer is made of, each with its tap.
pub(crate) fn taps(output: usize, inputs: usize) -> impl Iterator<Item = (usize, usize)> {
    let i = output / 2;
    let all = if output.is_multiple_of(2) { [Some((i, 1)), None] } else { [Some((i, 2)), Some((i + 1, 0))] };
    all.into_iter().flatten().filter(move |(input, _)| *input < inputs)
}

/// The last layer and the regression.
#[derive(Debug)]
pub(crate) struct RegressionStage {
    shape: Shape,
    height: usize,
    window: u32,
    taken: usize,
    /// The last two of them, or fewer.
    kept: Vec<Row>,
    /// A pixel whose probabilities are wanted: column and row.
    probed: Option<(usize, usize)>,
    /// Its probabilities, once its row is complete.
    probability: Option<Vec<f32>>,
}

impl RegressionStage {
    pub(crate) fn new(input: Shape, height: usize, window: u32) -> Self {
        Self { shape: input, height, window, taken: 0, kept: Vec::new(), probed: None, probability: None }
    }

    /// Asks for the probabilities of a pixel, before its row comes.
    pub(crate) fn probe(&mut self, x: usize, y: usize) {
        self.probed = Some((x, y));
    }

    /// The probability of each hypothesis at the pixel asked for, once its row is complete.
    pub(crate) fn probability(&self) -> Option<&[f32]> {
        self.probability.as_deref()
    }

    /// What the pixels at `x` (which is even) and right of it are made of, row by row of the input.
    fn input(&self, first_kept: usize, x: usize, y: usize) -> Vec<([Column<'_>; 4], usize)> {
        let rows = (0..3).filter_map(|tap| {
            let row = self.kept.get((y + tap).checked_sub(first_kept + 1)?)?;
            Some(([-1, 0, 1, 2].map(|offset| row.column(x as isize + offset)), tap))
        });
        rows.collect()
    }

    /// The pixels of the next rows.
    pub(crate) fn push(&mut self, layer: &RegressionLayer, rows: &[Row]) -> Vec<Regressed> {
        let complete = |taken: usize| if taken == self.height { taken } else { taken.saturating_sub(1) };
        let first_kept = self.taken - self.kept.len();
        let done = complete(self.taken);
        self.kept.extend_from_slice(rows);
        self.taken += rows.len();
        let width = self.shape.columns;
        let mut pixels = vec![Regressed::default(); (complete(self.taken) - done) * width];
        pixels.par_chunks_exact_mut(2).enumerate().for_each_init(
            || RegressionScratch::new(self.shape.padded()),
            |scratch, (pair, pixels)| {
                let (y, x) = (done + 2 * pair / width, 2 * pair % width);
                let input = self.input(first_kept, x, y);
                pixels.copy_from_slice(&layer.apply(&input, self.window, scratch));
            },
        );
        if let Some((x, y)) = self.probed.filter(|(_, y)| (done..complete(self.taken)).contains(y)) {
            let mut scratch = RegressionScratch::new(self.shape.padded());
            layer.apply(&self.input(first_kept, x / 2 * 2, y), self.window, &mut scratch);
            let exponentials = &scratch.exponentials(x % 2)[..self.shape.length];
            let total: f64 = exponentials.iter().map(|value| f64::from(*value)).sum();
            let probability = exponentials.iter().map(|value| (f64::from(*value) / total) as f32);
            self.probability = Some(probability.collect());
        }
        let needed = complete(self.taken).saturating_sub(1);
        self.kept.drain(..needed - first_kept.min(needed));
        pixels
    }
}
