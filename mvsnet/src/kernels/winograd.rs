//! Convolutions of size 3 and stride 1, by Winograd's F(2x2, 3x3) over columns and the contiguous axis
//! (Lavin and Gray 2016): 16 products make four outputs instead of 36.
//!
//! The third axis of a volume, its rows, is summed plainly: each input row is added to up to three output
//! rows ("targets"), so that it is transformed once and may be forgotten at once. All additions into an
//! output happen in the order of the input rows.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use super::aligned::Aligned;
use super::simd::{LANES, Level, Simd, by_level, by_width};
use super::slab::{COLUMN_START, Column, Shape};

/// Products for a 2x2 block of outputs.
pub(crate) const PRODUCTS: usize = 16;
/// Vectors of pairs computed at a time, at most.
const MAX_BLOCK: usize = 3;

/// A layer's weights, transformed, in the order they are used.
#[derive(Debug)]
pub(crate) struct WinogradLayer {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    pub(super) relu: bool,
    pub(super) level: Level,
    /// `[tap][output / block][product][input][output % block]`.
    pub(super) weights: Vec<Aligned>,
    pub(super) bias: Vec<f32>,
}

/// Two adjacent output columns that an input row is added to, or the last one alone.
pub(crate) struct Target<'a> {
    /// The columns, one after the other.
    pub(crate) columns: &'a mut [f32],
    /// The row of the kernel that the input row meets there.
    pub(crate) tap: usize,
    /// This is the first input row of that output row.
    pub(crate) first: bool,
    /// This is the last one.
    pub(crate) last: bool,
}

/// Memory for the transformed values of one block.
#[derive(Debug)]
pub(crate) struct WinogradScratch(Aligned);

impl WinogradLayer {
    /// `weight(output, input, tap, column, k)` is the kernel, where `tap` counts rows of a volume (one for
    /// images) and `k` runs along the contiguous axis. Outputs without a bias are zero.
    pub(crate) fn new(
        level: Level,
        [inputs, outputs, taps]: [usize; 3],
        weight: impl Fn(usize, usize, usize, usize, usize) -> f64,
        bias: &[f64],
        relu: bool,
    ) -> Self {
        let block = level.outputs_at_once();
        let padded = outputs.next_multiple_of(8);
        let weights = (0..taps).map(|tap| {
            let mut packed = Aligned::zeroed(padded * inputs * PRODUCTS);
            for output in 0..outputs {
                for input in 0..inputs {
                    let kernel = |column, k| weight(output, input, tap, column, k);
                    for (product, value) in transformed(kernel).into_iter().enumerate() {
                        let at = (output / block * PRODUCTS + product) * inputs + input;
                        packed.values_mut()[at * block + output % block] = value as f32;
                    }
                }
            }
            packed
        });
        let weights = weights.collect();
        let bias = (0..padded).map(|output| bias.get(output).map_or(0.0, |bias| *bias as f32)).collect();
        Self { inputs, outputs: padded, relu, level, weights, bias }
    }

    /// Rows of the kernel.
    pub(super) fn rows(&self) -> usize {
        self.weights.len()
    }

    pub(crate) fn scratch(&self) -> WinogradScratch {
        WinogradScratch(Aligned::zeroed(PRODUCTS * (self.inputs + 8) * MAX_BLOCK * LANES))
    }

    /// Adds four adjacent columns of an input row to their middle columns in the targets. All slabs have the same
    /// length; stored values beyond it become zero with the last input row.
    ///
    /// # Panics
    /// When sizes do not fit the layer.
    pub(crate) fn accumulate(
        &self,
        input: [Column<'_>; 4],
        targets: &mut [Target<'_>],
        scratch: &mut WinogradScratch,
    ) {
        let shape = input[0].shape();
        let output = Shape { channels: self.outputs, ..shape };
        assert!(input.iter().all(|column| column.shape() == shape) && shape.channels == self.inputs);
        let column = output.column();
        let sizes = [column, 2 * column];
        assert!(targets.iter().all(|target| sizes.contains(&target.columns.len())));
        assert!(targets.iter().all(|target| target.tap < self.weights.len()));
        assert!(scratch.0.values().len() >= PRODUCTS * (self.inputs + 8) * MAX_BLOCK * LANES);
        run(
            self.level,
            &mut Task { layer: self, input: input.map(|column| column.as_ptr()), shape, targets, scratch },
        );
    }
}

/// `G g G^T` of one 3x3 kernel.
fn transformed(kernel: impl Fn(usize, usize) -> f64) -> [f64; PRODUCTS] {
    let along = |g: [f64; 3]| [g[0], 0.5 * (g[0] + g[1] + g[2]), 0.5 * (g[0] - g[1] + g[2]), g[2]];
    let mut rows = [[0.0; 4]; 3];
    for column in 0..3 {
        rows[column] = along([kernel(column, 0), kernel(column, 1), kernel(column, 2)]);
    }
    let mut products = [0.0; PRODUCTS];
    for k in 0..4 {
        let columns = along([rows[0][k], rows[1][k], rows[2][k]]);
        for column in 0..4 {
            products[4 * column + k] = columns[column];
        }
    }
    products
}

struct Task<'a, 'b> {
    layer: &'a WinogradLayer,
    input: [*const f32; 4],
    shape: Shape,
    targets: &'a mut [Target<'b>],
    scratch: &'a mut WinogradScratch,
}

by_level!(run(task: &mut Task<'_, '_>) = blocks[8, 3][4, 1]);

/// # Safety
/// As [`Simd`]; the sizes are those `accumulate` checks.
#[inline(always)]
unsafe fn blocks<S: Simd, const OUTPUTS: usize, const WIDEST: usize>(task: &mut Task<'_, '_>) {
    by_width!(task.shape.padded() / (2 * LANES), WIDEST, block::<S, OUTPUTS>(task));
}

/// `VECTORS` vectors of pairs from vector `at` on, for all targets and outputs.
///
/// # Safety
/// As `blocks`; `at + VECTORS` is at most the number of vectors.
#[inline(always)]
unsafe fn block<S: Simd, const OUTPUTS: usize, const VECTORS: usize>(task: &mut Task<'_, '_>, at: usize) {
    let inputs = task.layer.inputs;
    let values = task.scratch.0.values_mut().as_mut_ptr();
    let products = values.add(PRODUCTS * inputs * VECTORS * LANES);
    let stride = task.shape.stride();
    for input in 0..inputs {
        for v in 0..VECTORS {
            let from = input * stride + (at + v) * 2 * LANES;
            let to = values.add((input * VECTORS + v) * LANES);
            transform::<S>(task.input.map(|column| column.add(from)), to, inputs * VECTORS * LANES);
        }
    }
    let layer = task.layer;
    for target in task.targets.iter_mut() {
        let mut weights = layer.weights[target.tap].values().as_ptr();
        for output in (0..layer.outputs).step_by(OUTPUTS) {
            let mut from = values.cast_const();
            for product in 0..PRODUCTS {
                multiply::<S, OUTPUTS, VECTORS>(
                    &mut from,
                    &mut weights,
                    inputs,
                    products.add(product * OUTPUTS * VECTORS * LANES),
                );
            }
            let column = task.shape.stride() * layer.outputs;
            let columns = target.columns.len() / column;
            for o in 0..OUTPUTS {
                let to = target.columns.as_mut_ptr().add((output + o) * stride + COLUMN_START);
                for v in 0..VECTORS {
                    let begin = (at + v) * 2 * LANES;
                    let to = to.add(begin);
                    let bias = S::splat(*layer.bias.get_unchecked(output + o));
                    let start = if target.first { Some(bias) } else { None };
                    let relu = target.last && layer.relu;
                    let from = products.add((o * VECTORS + v) * LANES);
                    let outputs = inverse::<S>(from, OUTPUTS * VECTORS * LANES);
                    for (i, output) in outputs.into_iter().enumerate().take(columns) {
                        let to = to.add(i * column);
                        add::<S>(output, to, start, relu);
                        if target.last {
                            for beyond in task.shape.length.max(begin)..begin + 2 * LANES {
                                *to.add(beyond - begin) = 0.0;
                            }
                        }
                    }
                }
            }
        }
    }
}

/// `B^T d B` of 16 blocks of 4x4 inputs, one per lane; product `4 * column + k` goes to `product * step`.
///
/// # Safety
/// As [`Simd`]; 33 values from each of `from` on, and the one before, may be read, and those products written.
#[inline(always)]
pub(super) unsafe fn transform<S: Simd>(from: [*const f32; 4], to: *mut f32, step: usize) {
    let t0 = along::<S>(from[0]);
    let t1 = along::<S>(from[1]);
    let t2 = along::<S>(from[2]);
    let t3 = along::<S>(from[3]);
    for k in 0..4 {
        S::store(to.add(k * step), S::sub(t0[k], t2[k]));
        S::store(to.add((4 + k) * step), S::add(t1[k], t2[k]));
        S::store(to.add((8 + k) * step), S::sub(t2[k], t1[k]));
        S::store(to.add((12 + k) * step), S::sub(t1[k], t3[k]));
    }
}

/// The transform along the contiguous axis, of inputs `2j - 1` to `2j + 2` for each lane `j`.
#[inline(always)]
unsafe fn along<S: Simd>(p: *const f32) -> [S::V; 4] {
    let (a, b) = (S::load(p), S::load(p.add(LANES)));
    let (d1, d2) = (S::even(a, b), S::odd(a, b));
    let d0 = S::even(S::load(p.sub(1)), S::load(p.add(LANES - 1)));
    let d3 = S::odd(S::load(p.add(1)), S::load(p.add(LANES + 1)));
    [S::sub(d0, d2), S::add(d1, d2), S::sub(d2, d1), S::sub(d1, d3)]
}

/// One product of all inputs, summed; both pointers move on to the next product.
#[inline(always)]
unsafe fn multiply<S: Simd, const OUTPUTS: usize, const VECTORS: usize>(
    from: &mut *const f32,
    weights: &mut *const f32,
    inputs: usize,
    to: *mut f32,
) {
    let all = sums::<S, OUTPUTS, VECTORS>(*from, *weights, inputs, [[S::splat(0.0); VECTORS]; OUTPUTS]);
    *from = from.add(inputs * VECTORS * LANES);
    *weights = weights.add(inputs * OUTPUTS);
    for o in 0..OUTPUTS {
        for v in 0..VECTORS {
            S::store(to.add((o * VECTORS + v) * LANES), all[o][v]);
        }
    }
}

/// Adds one product of all inputs.
///
/// # Safety
/// As [`Simd`]; there are `inputs` times `VECTORS` vectors at `from`, and `inputs * OUTPUTS` weights.
#[inline(always)]
pub(super) unsafe fn sums<S: Simd, const OUTPUTS: usize, const VECTORS: usize>(
    mut from: *const f32,
    mut weights: *const f32,
    inputs: usize,
    mut sums: [[S::V; VECTORS]; OUTPUTS],
) -> [[S::V; VECTORS]; OUTPUTS] {
    for _ in 0..inputs {
        let mut x = [S::splat(0.0); VECTORS];
        for v in 0..VECTORS {
            x[v] = S::load(from.add(v * LANES));
        }
        for o in 0..OUTPUTS {
            let weight = S::splat(*weights.add(o));
            for v in 0..VECTORS {
                sums[o][v] = S::mul_add(weight, x[v], sums[o][v]);
            }
        }
        from = from.add(VECTORS * LANES);
        weights = weights.add(OUTPUTS);
    }
    sums
}

/// `A^T m A` of 16 blocks: 32 values of each of two columns.
///
/// # Safety
/// As [`Simd`]; all products lie `step` apart from `from` on.
#[inline(always)]
pub(super) unsafe fn inverse<S: Simd>(from: *const f32, step: usize) -> [(S::V, S::V); 2] {
    let mut left = [S::splat(0.0); 4];
    let mut right = [S::splat(0.0); 4];
    for k in 0..4 {
        let m0 = S::load(from.add(k * step));
        let m1 = S::load(from.add((4 + k) * step));
        let m2 = S::load(from.add((8 + k) * step));
        let m3 = S::load(from.add((12 + k) * step));
        left[k] = S::add(S::add(m0, m1), m2);
        right[k] = S::sub(S::sub(m1, m2), m3);
    }
    [inverse_along::<S>(left), inverse_along::<S>(right)]
}

#[inline(always)]
unsafe fn inverse_along<S: Simd>(m: [S::V; 4]) -> (S::V, S::V) {
    let even = S::add(S::add(m[0], m[1]), m[2]);
    let odd = S::sub(S::sub(m[1], m[2]), m[3]);
    S::interleave(even, odd)
}

/// Adds 32 values to those that are there, or to `start`.
///
/// # Safety
/// As [`Simd`]; 32 values at `to` may be written, and read if there is no `start`.
#[inline(always)]
pub(super) unsafe fn add<S: Simd>(
    (mut low, mut high): (S::V, S::V),
    to: *mut f32,
    start: Option<S::V>,
    relu: bool,
) {
    if let Some(start) = start {
        (low, high) = (S::add(low, start), S::add(high, start));
    } else {
        low = S::add(low, S::load(to));
        high = S::add(high, S::load(to.add(LANES)));
    }
    if relu {
        low = S::max(low, S::splat(0.0));
        high = S::max(high, S::splat(0.0));
    }
    S::store(to, low);
    S::store(to.add(LANES), high);
}
