//! Transposed convolutions of stride 2 (size 3, and size 5 for gradients of images), which double a volume and
//! may add a skip connection.
//!
//! Along each axis with size 3, output `2i` takes the middle of the kernel at input `i`, and output `2i + 1` its
//! last value at input `i` and its first at `i + 1`. With size 5, output `2i` takes values 4, 2 and 0 at inputs
//! `i - 1`, `i` and `i + 1`, and output `2i + 1` takes 3 and 1 at `i` and `i + 1`.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use super::aligned::Aligned;
use super::simd::{LANES, Level, Simd, by_level, by_width};
use super::slab::{COLUMN_START, Column, Shape};

/// A layer's weights in the order they are used.
#[derive(Debug)]
pub(crate) struct TransposedLayer {
    pub(crate) inputs: usize,
    pub(crate) outputs: usize,
    /// Size of the kernel along the contiguous axis: 3 or 5.
    size: usize,
    relu: bool,
    level: Level,
    /// `[tap][output / block][input][k][output % block]`.
    weights: Vec<Aligned>,
    bias: Vec<f32>,
}

impl TransposedLayer {
    /// `weight(output, input, tap, k)` is the kernel, where `tap` counts input columns and `k` runs along the
    /// contiguous axis. ReLU may follow, before the skip is added.
    ///
    /// # Panics
    /// When `outputs` is no multiple of 8.
    pub(crate) fn new(
        level: Level,
        [inputs, outputs, taps, size]: [usize; 4],
        weight: impl Fn(usize, usize, usize, usize) -> f64,
        bias: &[f64],
        relu: bool,
    ) -> Self {
        assert!(outputs.is_multiple_of(8) && (size == 3 || size == 5));
        // Even and odd outputs are held at the same time, so half as many channels.
        let block = level.outputs_at_once() / 2;
        let weights = (0..taps).map(|tap| {
            let mut packed = Aligned::zeroed(outputs * inputs * size);
            for output in 0..outputs {
                for input in 0..inputs {
                    for k in 0..size {
                        let at = (output / block * inputs + input) * size + k;
                        packed.values_mut()[at * block + output % block] =
                            weight(output, input, tap, k) as f32;
                    }
                }
            }
            packed
        });
        let weights = weights.collect();
        let bias = bias.iter().map(|bias| *bias as f32).collect();
        Self { inputs, outputs, size, relu, level, weights, bias }
    }

    /// Computes one output column of this length from input columns, each with its tap, and adds the skip
    /// connection's column.
    ///
    /// # Panics
    /// When sizes do not fit the layer.
    pub(crate) fn apply(
        &self,
        input: &[(Column<'_>, usize)],
        skip: Option<Column<'_>>,
        length: usize,
        output: &mut [f32],
    ) {
        let from = input.first().map(|(column, _)| column.shape()).expect("an input column");
        let to = Shape { columns: 2 * from.columns, channels: self.outputs, length };
        assert!(output.len() == to.column());
        let fits = |skip: &Column<'_>| skip.shape().channels == to.channels && skip.shape().length == length;
        assert!(skip.as_ref().is_none_or(fits));
        assert!(from.channels == self.inputs && from.length == to.length.div_ceil(2));
        assert!(input.iter().all(|(column, tap)| column.shape() == from && *tap < self.weights.len()));
        let skip = skip.as_ref().map(Column::as_ptr);
        run(self.level, &Task { layer: self, input, from, to, skip, output: output.as_mut_ptr() });
    }
}

struct Task<'a> {
    layer: &'a TransposedLayer,
    input: &'a [(Column<'a>, usize)],
    from: Shape,
    to: Shape,
    skip: Option<*const f32>,
    output: *mut f32,
}

by_level!(run(task: &Task<'_>) = column[4, 2][2, 1]);

/// # Safety
/// As [`Simd`]; the sizes are those `apply` checks. The padded output is at most twice the padded input.
#[inline(always)]
unsafe fn column<S: Simd, const OUTPUTS: usize, const WIDEST: usize>(task: &Task<'_>) {
    by_width!(task.to.padded() / (2 * LANES), WIDEST, block::<S, OUTPUTS>(task));
}

/// All outputs of `VECTORS` input vectors from vector `at` on.
///
/// # Safety
/// As `column`; `at + VECTORS` is at most the number of vectors.
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
            let from = column.as_ptr().add(at * LANES);
            let weights = layer.weights.get_unchecked(*tap).values().as_ptr();
            let weights = weights.add(output * layer.inputs * layer.size);
            if layer.size == 3 {
                tap_sums::<S, OUTPUTS, VECTORS, 3>(task, from, weights, &mut even, &mut odd);
            } else {
                tap_sums::<S, OUTPUTS, VECTORS, 5>(task, from, weights, &mut even, &mut odd);
            }
        }
        for o in 0..OUTPUTS {
            let channel = (output + o) * task.to.stride();
            for v in 0..VECTORS {
                let begin = (at + v) * 2 * LANES;
                let (mut low, mut high) = S::interleave(even[o][v], odd[o][v]);
                if layer.relu {
                    (low, high) = (S::max(low, S::splat(0.0)), S::max(high, S::splat(0.0)));
                }
                let to = task.output.add(COLUMN_START + channel + begin);
                if let Some(skip) = task.skip {
                    let skip = skip.add(channel + begin);
                    (low, high) = (S::add(low, S::load(skip)), S::add(high, S::load(skip.add(LANES))));
                }
                S::store(to, low);
                S::store(to.add(LANES), high);
                for beyond in task.to.length.max(begin)..begin + 2 * LANES {
                    *to.add(beyond - begin) = 0.0;
                }
            }
        }
    }
}

/// Adds one input column to even and odd outputs.
///
/// # Safety
/// As `block`; `from` is a place in the column's first channel, `weights` the first of its tap's.
#[inline(always)]
unsafe fn tap_sums<S: Simd, const OUTPUTS: usize, const VECTORS: usize, const SIZE: usize>(
    task: &Task<'_>,
    mut from: *const f32,
    mut weights: *const f32,
    even: &mut [[S::V; VECTORS]; OUTPUTS],
    odd: &mut [[S::V; VECTORS]; OUTPUTS],
) {
    for _ in 0..task.layer.inputs {
        let mut x = [S::splat(0.0); VECTORS];
        let mut next = x;
        for v in 0..VECTORS {
            x[v] = S::load(from.add(v * LANES));
            next[v] = S::load(from.add(v * LANES + 1));
        }
        for o in 0..OUTPUTS {
            // Size 3 is size 5 without its ends.
            let middle = SIZE / 2;
            let at_x = S::splat(*weights.add(middle * OUTPUTS + o));
            let odd_at_x = S::splat(*weights.add((middle + 1) * OUTPUTS + o));
            let odd_at_next = S::splat(*weights.add((middle - 1) * OUTPUTS + o));
            for v in 0..VECTORS {
                even[o][v] = S::mul_add(at_x, x[v], even[o][v]);
                odd[o][v] = S::mul_add(odd_at_x, x[v], odd[o][v]);
                odd[o][v] = S::mul_add(odd_at_next, next[v], odd[o][v]);
            }
            if SIZE == 5 {
                let even_at_next = S::splat(*weights.add(o));
                let even_at_previous = S::splat(*weights.add(4 * OUTPUTS + o));
                for v in 0..VECTORS {
                    even[o][v] = S::mul_add(even_at_next, next[v], even[o][v]);
                    let previous = S::load(from.add(v * LANES).sub(1));
                    even[o][v] = S::mul_add(even_at_previous, previous, even[o][v]);
                }
            }
        }
        from = from.add(task.from.stride());
        weights = weights.add(SIZE * OUTPUTS);
    }
}
