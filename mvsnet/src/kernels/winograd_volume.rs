//! Winograd's convolution of a whole volume: rows are summed before they are transformed back.
//!
//! Where rows need not be forgotten at once, three of them stay transformed, and each output is transformed back and
//! written once.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use std::ops::Range;
use std::sync::Arc;

use super::aligned::Aligned;
use super::simd::{LANES, Simd, by_level, by_width};
use super::slab::{COLUMN_START, Shape, Slab};
use super::winograd::{PRODUCTS, WinogradLayer, add, inverse, sums, transform};

/// Rows of the kernel, and transformed rows that are kept.
const ROWS: usize = 3;
/// Vectors of pairs computed at a time, at most.
const MAX_BLOCK: usize = 3;

/// Memory for the transformed values of one block.
#[derive(Debug)]
pub(crate) struct VolumeScratch(Aligned);

impl VolumeScratch {
    /// For a layer whose input has this shape.
    pub(crate) fn new(layer: &WinogradLayer, input: Shape) -> Self {
        Self(Aligned::zeroed(Self::floats(layer, input)))
    }

    fn floats(layer: &WinogradLayer, input: Shape) -> usize {
        let vectors = (input.padded() / (2 * LANES)).min(MAX_BLOCK);
        PRODUCTS * (ROWS * layer.inputs + 8) * vectors * LANES
    }
}

/// Computes a pair of adjacent columns (or the last one alone) of some output rows, each of which is given. Rows that
/// the input lacks are zero.
///
/// # Panics
/// When sizes do not fit the layer.
pub(crate) fn pair_of_rows(
    layer: &WinogradLayer,
    input: &[Arc<Slab>],
    rows: Range<usize>,
    pair: usize,
    output: &mut [&mut [f32]],
    scratch: &mut VolumeScratch,
) {
    let shape = input[0].shape();
    assert!(!rows.is_empty() && 2 * pair < shape.columns);
    let columns = (shape.columns - 2 * pair).min(2);
    let column = Shape { channels: layer.outputs, ..shape }.column();
    assert!(input.iter().all(|slab| slab.shape() == shape) && shape.channels == layer.inputs);
    assert!(layer.rows() == ROWS && rows.end <= input.len() && output.len() == rows.len());
    assert!(output.iter().all(|row| row.len() == columns * column));
    assert!(scratch.0.values().len() >= VolumeScratch::floats(layer, shape));
    run(layer.level, &mut Task { layer, input, rows, pair, shape, columns, output, scratch });
}

struct Task<'a, 'b> {
    layer: &'a WinogradLayer,
    input: &'a [Arc<Slab>],
    rows: Range<usize>,
    pair: usize,
    shape: Shape,
    columns: usize,
    output: &'a mut [&'b mut [f32]],
    scratch: &'a mut VolumeScratch,
}

by_level!(run(task: &mut Task<'_, '_>) = blocks[8, 3][4, 1]);

/// # Safety
/// As [`Simd`]; the sizes are those `pair_of_rows` checks.
#[inline(always)]
unsafe fn blocks<S: Simd, const OUTPUTS: usize, const WIDEST: usize>(task: &mut Task<'_, '_>) {
    by_width!(task.shape.padded() / (2 * LANES), WIDEST, block::<S, OUTPUTS>(task));
}

/// `VECTORS` vectors of pairs from vector `at` on, of all rows.
///
/// # Safety
/// As `blocks`; `at + VECTORS` is at most the number of vectors.
#[inline(always)]
unsafe fn block<S: Simd, const OUTPUTS: usize, const VECTORS: usize>(task: &mut Task<'_, '_>, at: usize) {
    let layer = task.layer;
    let height = task.input.len();
    let row_size = PRODUCTS * layer.inputs * VECTORS * LANES;
    let values = task.scratch.0.values_mut().as_mut_ptr();
    let products = values.add(ROWS * row_size);
    let rows = task.rows.clone();
    for row in rows.start.saturating_sub(1)..=rows.start {
        transform_row::<S, VECTORS>(task, row, at, values.add(row % ROWS * row_size));
    }
    for y in rows.clone() {
        if y + 1 < height {
            transform_row::<S, VECTORS>(task, y + 1, at, values.add((y + 1) % ROWS * row_size));
        }
        let taps = usize::from(y == 0)..if y + 1 < height { 3 } else { 2 };
        for output in (0..layer.outputs).step_by(OUTPUTS) {
            for product in 0..PRODUCTS {
                let mut all = [[S::splat(0.0); VECTORS]; OUTPUTS];
                for tap in taps.clone() {
                    let from = values.add((y + tap + 2) % ROWS * row_size);
                    let from = from.add(product * layer.inputs * VECTORS * LANES);
                    let weights = layer.weights.get_unchecked(tap).values().as_ptr();
                    let weights =
                        weights.add((output / OUTPUTS * PRODUCTS + product) * layer.inputs * OUTPUTS);
                    all = sums::<S, OUTPUTS, VECTORS>(from, weights, layer.inputs, all);
                }
                let to = products.add(product * OUTPUTS * VECTORS * LANES);
                for o in 0..OUTPUTS {
                    for v in 0..VECTORS {
                        S::store(to.add((o * VECTORS + v) * LANES), all[o][v]);
                    }
                }
            }
            let to = task.output.get_unchecked_mut(y - rows.start).as_mut_ptr();
            for o in 0..OUTPUTS {
                let to = to.add((output + o) * task.shape.stride() + COLUMN_START);
                let bias = S::splat(*layer.bias.get_unchecked(output + o));
                for v in 0..VECTORS {
                    let from = products.add((o * VECTORS + v) * LANES);
                    let outputs = inverse::<S>(from, OUTPUTS * VECTORS * LANES);
                    let begin = (at + v) * 2 * LANES;
                    for (i, output) in outputs.into_iter().enumerate().take(task.columns) {
                        let to = to.add(i * layer.outputs * task.shape.stride() + begin);
                        add::<S>(output, to, Some(bias), layer.relu);
                        for beyond in task.shape.length.max(begin)..begin + 2 * LANES {
                            *to.add(beyond - begin) = 0.0;
                        }
                    }
                }
            }
        }
    }
}

/// Transforms one row of the input.
///
/// # Safety
/// As `block`; the input has the row, and there is room for its values at `to`.
#[inline(always)]
unsafe fn transform_row<S: Simd, const VECTORS: usize>(
    task: &Task<'_, '_>,
    row: usize,
    at: usize,
    to: *mut f32,
) {
    let slab = task.input.get_unchecked(row);
    let columns = slab.four_columns(2 * task.pair).map(|column| column.as_ptr());
    let inputs = task.layer.inputs;
    for input in 0..inputs {
        for v in 0..VECTORS {
            let from = input * task.shape.stride() + (at + v) * 2 * LANES;
            let to = to.add((input * VECTORS + v) * LANES);
            transform::<S>(columns.map(|column| column.add(from)), to, inputs * VECTORS * LANES);
        }
    }
}
