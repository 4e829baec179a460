//! Transposed convolutions of size 3 and stride 2, which double a volume and add the skip connection.
//!
//! Along each axis, output `2i` takes the middle of the kernel at input `i`, and output `2i + 1` its last
//! value at input `i` and its first at `i + 1`.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use super::aligned::Aligned;
use super::simd::{LANES, Level, Simd, by_level};
use super::slab::{COLUMN_START, Column, Shape};

/// A layer's weights in the order they are used.
#[derive(Debug)]
pub(crate) struct TransposedLayer {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    level: Level,
    /// `[row tap * 3 + column tap][output / block][input][k][output % block]`.
    weights: Vec<Aligned>,
    bias: Vec<f32>,
}

impl TransposedLayer {
    /// `weight(output, input, row tap, column tap, k)` is the kernel. ReLU follows, before the skip is added.
    ///
    /// # Panics
    /// When `outputs` is no multiple of 8.
    pub(crate) fn new(
        level: Level,
        [inputs, outputs]: [usize; 2],
        weight: impl Fn(usize, usize, usize, usize, usize) -> f64,
        bias: &[f64],
    ) -> Self {
        assert!(outputs.is_multiple_of(8));
        // Even and odd outputs are held at the same time, so half as many channels.
        let block = level.outputs_at_once() / 2;
        let weights = (0..9).map(|tap| {
            let mut packed = Aligned::zeroed(outputs * inputs * 3);
            for output in 0..outputs {
                for input in 0..inputs {
                    for k in 0..3 {
                        let at = (output / block * inputs + input) * 3 + k;
                        packed.values_mut()[at * block + output % block] =
                            weight(output, input, tap / 3, tap % 3, k) as f32;
                    }
                }
            }
            packed
        });
        let weights = weights.collect();
        let bias = bias.iter().map(|bias| *bias as f32).collect();
        Self { inputs, outputs, level, weights, bias }
    }

    /// Computes one output column from input columns, each with its tap `3 * row tap + column tap`, and adds
    /// the skip connection's column, whose length it has.
    ///
    /// # Panics
    /// When sizes do not fit the layer.
    pub(crate) fn apply(&self, input: &[(Column<'_>, usize)], skip: Column<'_>, output: &mut [f32]) {
        let from = input.first().map(|(column, _)| column.shape()).expect("an input column");
        let to = skip.shape();
        assert!(to.channels == self.outputs && output.len() == to.column());
        assert!(from.channels == self.inputs && from.length == to.length.div_ceil(2));
        assert!(input.iter().all(|(column, tap)| column.shape() == from && *tap < self.weights.len()));
        let skip = skip.as_ptr();
        run(self.level, &Task { layer: self, input, from, to, skip, output: output.as_mut_ptr() });
    }
}

struct Task<'a> {
    layer: &'a TransposedLayer,
    input: &'a [(Column<'a>, usize)],
    from: Shape,
    to: Shape,
    skip: *const f32,
    output: *mut f32,
}

by_level!(run(task: &Task<'_>) = column[4, 2][2, 1]);

/// # Safety
/// As [`Simd`]; the sizes are those `apply` checks. The padded output is at most twice the padded input.
#[inline(always)]
unsafe fn column<S: Simd, const OUTPUTS: usize, const WIDEST: usize>(task: &Task<'_>) {
    let vectors = task.to.padded() / (2 * LANES);
    let mut at = 0;
    while at < vectors {
        let left = vectors - at;
        if WIDEST >= 3 && (left == 3 || left > 4) {
            block::<S, OUTPUTS, 3>(task, at);
            at += 3;
        } else if WIDEST >= 2 && left >= 2 {
            block::<S, OUTPUTS, 2>(task, at);
            at += 2;
        } else {
            block::<S, OUTPUTS, 1>(task, at);
            at += 1;
        }
    }
}

/// All outputs of `VECTORS` input vectors from vector `at` on.
#[inline(always)]
unsafe fn block<S: Simd, const OUTPUTS: usize, const VECTORS: usize>(task: &Task<'_>, at: usize) {
    let layer = task.layer;
    for output in (0..layer.outputs).step_by(OUTPUTS) {
        let mut even = [[S::splat(0.0); VECTORS]; OUTPUTS];
        for o in 0..OUTPUTS {
            even[o] = [S::splat(*layer.bias.get_unchecked(output + o)); VECTORS];
        }
        let mut odd = even;
        for (column, tap) in task.input {
            let mut from = column.as_ptr().add(at * LANES);
            let mut weights = layer.weights.get_unchecked(*tap).values().as_ptr();
            weights = weights.add(output * layer.inputs * 3);
            for _ in 0..layer.inputs {
                let mut x = [S::splat(0.0); VECTORS];
                let mut next = x;
                for v in 0..VECTORS {
                    x[v] = S::load(from.add(v * LANES));
                    next[v] = S::load(from.add(v * LANES + 1));
                }
                for o in 0..OUTPUTS {
                    let first = S::splat(*weights.add(o));
                    let middle = S::splat(*weights.add(OUTPUTS + o));
                    let last = S::splat(*weights.add(2 * OUTPUTS + o));
                    for v in 0..VECTORS {
                        even[o][v] = S::mul_add(middle, x[v], even[o][v]);
                        odd[o][v] = S::mul_add(last, x[v], odd[o][v]);
                        odd[o][v] = S::mul_add(first, next[v], odd[o][v]);
                    }
                }
                from = from.add(task.from.stride());
                weights = weights.add(3 * OUTPUTS);
            }
        }
        for o in 0..OUTPUTS {
            let channel = (output + o) * task.to.stride();
            for v in 0..VECTORS {
                let begin = (at + v) * 2 * LANES;
                let zero = S::splat(0.0);
                let (low, high) = S::interleave(S::max(even[o][v], zero), S::max(odd[o][v], zero));
                let to = task.output.add(COLUMN_START + channel + begin);
                let skip = task.skip.add(channel + begin);
                S::store(to, S::add(low, S::load(skip)));
                S::store(to.add(LANES), S::add(high, S::load(skip.add(LANES))));
                for beyond in task.to.length.max(begin)..begin + 2 * LANES {
                    *to.add(beyond - begin) = 0.0;
                }
            }
        }
    }
}
