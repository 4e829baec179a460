//! Gradients of kernels of size 3 and stride 1, as products of Winograd's transforms: 16 products of a 4x4 block of
//! inputs and a 2x2 block of the output's gradient make all nine taps, instead of 36.
//!
//! The products are summed over all blocks before they are transformed back. Lanes are input channels, so that the
//! sums are few and stay near.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use std::ops::Range;
use std::sync::Arc;

use super::aligned::Aligned;
use super::cost::transposed;
use super::simd::{LANES, Level, Simd, by_level};
use super::slab::Slab;
use super::winograd::{PRODUCTS, transform};

/// Vectors of blocks that are transformed at a time.
const VECTORS: usize = 4;
/// Blocks in them.
const BLOCKS: usize = VECTORS * LANES;

/// Products of an input with the gradient of an output.
pub(crate) struct WinogradProducts<'a> {
    pub(crate) input: &'a [Arc<Slab>],
    pub(crate) gradient: &'a [Arc<Slab>],
    /// Rows of the kernel: 3 if slabs are the rows of a volume, 1 if they are images.
    pub(crate) rows: usize,
}

/// Memory for transformed values and sums.
#[derive(Debug, Default)]
pub(crate) struct ProductScratch {
    memory: Option<Aligned>,
}

impl WinogradProducts<'_> {
    /// Whether kernels of these inputs and outputs fill the vectors.
    pub(crate) fn fit(inputs: usize, outputs: usize) -> bool {
        inputs.is_multiple_of(LANES) && outputs.is_multiple_of(8)
    }

    /// Vectors of blocks of a slab; they may be summed in parts.
    pub(crate) fn vectors(&self) -> usize {
        let shape = self.input[0].shape();
        shape.columns.div_ceil(2) * (shape.padded() / (2 * LANES))
    }

    /// Sums of the products over these vectors of all slabs: `[product][row][input / 16][output][input % 16]`.
    ///
    /// # Panics
    /// When sizes do not fit.
    pub(crate) fn sums(&self, level: Level, vectors: Range<usize>, scratch: &mut ProductScratch) -> Vec<f32> {
        let (input, gradient) = (self.input[0].shape(), self.gradient[0].shape());
        assert!(self.input.len() == self.gradient.len() && (self.rows == 1 || self.rows == 3));
        assert!(self.input.iter().all(|slab| slab.shape() == input));
        assert!(self.gradient.iter().all(|slab| slab.shape() == gradient));
        assert!((input.columns, input.length) == (gradient.columns, gradient.length));
        assert!(Self::fit(input.channels, gradient.channels) && vectors.end <= self.vectors());
        let sizes = [LANES * LANES, input.channels * BLOCKS, self.rows * gradient.channels * BLOCKS];
        let [near, inputs, gradients] = sizes.map(|size| PRODUCTS * size);
        let needed = near + inputs + gradients;
        let memory = scratch.memory.take().filter(|memory| memory.values().len() >= needed);
        let memory = scratch.memory.insert(memory.unwrap_or_else(|| Aligned::zeroed(needed)));
        let (near, memory) = memory.values_mut().split_at_mut(near);
        let (inputs, gradients) = memory.split_at_mut(inputs);
        let mut sums = vec![0.0; PRODUCTS * self.rows * input.channels * gradient.channels];
        run(level, &mut Task { products: self, vectors, near, inputs, gradients, sums: &mut sums });
        sums
    }
}

/// The gradient of a kernel's 3x3 taps `[column][k]`, from the sums of its products.
pub(crate) fn taps(products: &[f64; PRODUCTS]) -> [[f64; 3]; 3] {
    let along = |m: [f64; 4]| [m[0] + 0.5 * (m[1] + m[2]), 0.5 * (m[1] - m[2]), 0.5 * (m[1] + m[2]) + m[3]];
    let mut columns = [[0.0; 3]; 4];
    for (column, m) in columns.iter_mut().zip(products.as_chunks::<4>().0) {
        *column = along(*m);
    }
    let mut taps = [[0.0; 3]; 3];
    for k in 0..3 {
        let column = along([columns[0][k], columns[1][k], columns[2][k], columns[3][k]]);
        for at in 0..3 {
            taps[at][k] = column[at];
        }
    }
    taps
}

struct Task<'a> {
    products: &'a WinogradProducts<'a>,
    vectors: Range<usize>,
    /// `[product][input % 16][lane]` of one vector of blocks.
    near: &'a mut [f32],
    /// `[product][input / 16][block][input % 16]`.
    inputs: &'a mut [f32],
    /// `[row of three][product][output][block]`.
    gradients: &'a mut [f32],
    sums: &'a mut [f32],
}

by_level!(run(task: &mut Task<'_>) = all[8][4]);

/// # Safety
/// As [`Simd`]; the sizes are those `sums` checks.
#[inline(always)]
unsafe fn all<S: Simd, const OUTPUTS: usize>(task: &mut Task<'_>) {
    let height = task.products.input.len();
    let end = task.vectors.end;
    for begin in task.vectors.clone().step_by(VECTORS) {
        let vectors = begin..end.min(begin + VECTORS);
        let blocks = vectors.len() * LANES;
        if task.products.rows == 1 {
            for slab in 0..height {
                transform_gradient::<S>(task, 0, Some(slab), vectors.clone());
                transform_input::<S>(task, slab, vectors.clone());
                multiply_all::<S, OUTPUTS>(task, [0; 3], blocks);
            }
        } else {
            // Row y of the input meets rows y + 1, y and y - 1 of the gradient at rows 0, 1 and 2 of the kernel.
            transform_gradient::<S>(task, 2, None, vectors.clone());
            transform_gradient::<S>(task, 0, Some(0), vectors.clone());
            for y in 0..height {
                let next = y + 1;
                transform_gradient::<S>(task, next % 3, (next < height).then_some(next), vectors.clone());
                transform_input::<S>(task, y, vectors.clone());
                multiply_all::<S, OUTPUTS>(task, [next % 3, y % 3, (y + 2) % 3], blocks);
            }
        }
    }
}

/// `B^T d B` of blocks of 4x4 inputs, with channels innermost.
///
/// # Safety
/// As `all`; the vectors are some of the slab's, at most `VECTORS`.
#[inline(always)]
unsafe fn transform_input<S: Simd>(task: &mut Task<'_>, slab: usize, vectors: Range<usize>) {
    let slab = &task.products.input[slab];
    let shape = slab.shape();
    let per_pair = shape.padded() / (2 * LANES);
    for (i, at) in vectors.enumerate() {
        let columns = slab.four_columns(at / per_pair * 2);
        let begin = at % per_pair * 2 * LANES;
        for first in (0..shape.channels).step_by(LANES) {
            let near = task.near.as_mut_ptr();
            for channel in 0..LANES {
                let from =
                    columns.map(|column| column.as_ptr().add((first + channel) * shape.stride() + begin));
                transform::<S>(from, near.add(channel * LANES), LANES * LANES);
            }
            for product in 0..PRODUCTS {
                let mut rows = [S::splat(0.0); LANES];
                for channel in 0..LANES {
                    rows[channel] = S::load(near.add((product * LANES + channel) * LANES));
                }
                let to = (product * shape.channels + first) * BLOCKS + i * LANES * LANES;
                let to = task.inputs.as_mut_ptr().add(to);
                for (block, v) in transposed::<S>(rows).into_iter().enumerate() {
                    S::store(to.add(block * LANES), v);
                }
            }
        }
    }
}

/// `A g A^T` of blocks of 2x2 gradients, into one of three rows; zero of no slab.
///
/// # Safety
/// As `transform_input`.
#[inline(always)]
unsafe fn transform_gradient<S: Simd>(
    task: &mut Task<'_>,
    row: usize,
    slab: Option<usize>,
    vectors: Range<usize>,
) {
    let shape = task.products.gradient[0].shape();
    let size = PRODUCTS * shape.channels * BLOCKS;
    let row = &mut task.gradients[row * size..][..size];
    let Some(slab) = slab.map(|slab| &task.products.gradient[slab]) else { return row.fill(0.0) };
    let per_pair = shape.padded() / (2 * LANES);
    for (i, at) in vectors.enumerate() {
        let [_, left, right, _] = slab.four_columns(at / per_pair * 2);
        let begin = at % per_pair * 2 * LANES;
        for output in 0..shape.channels {
            let from = [left, right].map(|column| column.as_ptr().add(output * shape.stride() + begin));
            let left = gradient_along::<S>(from[0]);
            let right = gradient_along::<S>(from[1]);
            let to = row.as_mut_ptr().add(output * BLOCKS + i * LANES);
            let step = shape.channels * BLOCKS;
            for k in 0..4 {
                S::store(to.add(k * step), left[k]);
                S::store(to.add((4 + k) * step), S::add(left[k], right[k]));
                S::store(to.add((8 + k) * step), S::sub(left[k], right[k]));
                S::store(to.add((12 + k) * step), S::sub(S::splat(0.0), right[k]));
            }
        }
    }
}

/// The transform along the contiguous axis, of gradients `2j` and `2j + 1` for each lane `j`.
///
/// # Safety
/// As [`Simd`]; 32 values may be read.
#[inline(always)]
unsafe fn gradient_along<S: Simd>(from: *const f32) -> [S::V; 4] {
    let (low, high) = (S::load(from), S::load(from.add(LANES)));
    let (even, odd) = (S::even(low, high), S::odd(low, high));
    [even, S::add(even, odd), S::sub(even, odd), S::sub(S::splat(0.0), odd)]
}

/// Adds the products of all inputs and outputs, with the rows of the kernel in these rows of the gradients.
///
/// # Safety
/// As `all`; this many blocks are transformed.
#[inline(always)]
unsafe fn multiply_all<S: Simd, const OUTPUTS: usize>(task: &mut Task<'_>, rows: [usize; 3], blocks: usize) {
    let inputs = task.products.input[0].shape().channels;
    let outputs = task.products.gradient[0].shape().channels;
    let mut sums = task.sums.as_mut_ptr();
    for product in 0..PRODUCTS {
        for row in &rows[..task.products.rows] {
            let g = task.gradients.as_ptr().add((row * PRODUCTS + product) * outputs * BLOCKS);
            let mut input = 0;
            while input < inputs {
                let x = task.inputs.as_ptr().add((product * inputs + input) * BLOCKS);
                let vectors = if input + 2 * LANES <= inputs { 2 } else { 1 };
                for output in (0..outputs).step_by(OUTPUTS) {
                    let (g, sums) = (g.add(output * BLOCKS), sums.add(output * LANES));
                    if vectors == 2 {
                        multiply::<S, OUTPUTS, 2>(x, g, blocks, sums, outputs * LANES);
                    } else {
                        multiply::<S, OUTPUTS, 1>(x, g, blocks, sums, outputs * LANES);
                    }
                }
                sums = sums.add(vectors * outputs * LANES);
                input += vectors * LANES;
            }
        }
    }
}

/// Adds the products of some vectors of inputs and of some outputs.
///
/// # Safety
/// As `multiply_all`; `x`, `g` and `to` begin at those inputs and outputs.
#[inline(always)]
unsafe fn multiply<S: Simd, const OUTPUTS: usize, const INPUTS: usize>(
    x: *const f32,
    g: *const f32,
    blocks: usize,
    to: *mut f32,
    step: usize,
) {
    let mut sums = [[S::splat(0.0); INPUTS]; OUTPUTS];
    for block in 0..blocks {
        let mut x_at = [S::splat(0.0); INPUTS];
        for i in 0..INPUTS {
            x_at[i] = S::load(x.add(i * LANES * BLOCKS + block * LANES));
        }
        for o in 0..OUTPUTS {
            let g_at = S::splat(*g.add(o * BLOCKS + block));
            for i in 0..INPUTS {
                sums[o][i] = S::mul_add(g_at, x_at[i], sums[o][i]);
            }
        }
    }
    for o in 0..OUTPUTS {
        for i in 0..INPUTS {
            let to = to.add(i * step + o * LANES);
            S::store(to, S::add(S::load(to), sums[o][i]));
        }
    }
}
