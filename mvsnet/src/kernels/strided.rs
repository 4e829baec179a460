//! Convolutions of stride 2 (size 3 in volumes, size 5 in images), and the packing they share.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use super::aligned::Aligned;
use super::simd::{LANES, Level, Simd, by_level};
use super::slab::{COLUMN_START, Column, Shape};

/// A layer's weights in the order they are used.
#[derive(Debug)]
pub(crate) struct StridedLayer {
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

impl StridedLayer {
    /// `weight(output, input, tap, k)` is the kernel, where `tap` counts input columns and `k` runs along the
    /// contiguous axis. ReLU may follow.
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
        let block = level.outputs_at_once();
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

    /// Computes one output column, of half the input's length (rounded up), from input columns, each with its
    /// tap; columns outside the input are left out.
    ///
    /// # Panics
    /// When sizes do not fit the layer.
    pub(crate) fn apply(&self, input: &[(Column<'_>, usize)], output: &mut [f32]) {
        let from = input.first().map(|(column, _)| column.shape()).expect("an input column");
        let to = Shape { columns: from.columns, channels: self.outputs, length: from.length.div_ceil(2) };
        assert!(from.channels == self.inputs && output.len() == to.column());
        assert!(input.iter().all(|(column, tap)| column.shape() == from && *tap < self.weights.len()));
        let task = Task { layer: self, input, from, to, output: output.as_mut_ptr() };
        run(self.level, &task);
    }
}

impl Level {
    /// Output channels that a block of registers holds.
    pub(super) fn outputs_at_once(self) -> usize {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Avx512 => 8,
            _ => 4,
        }
    }
}

struct Task<'a> {
    layer: &'a StridedLayer,
    input: &'a [(Column<'a>, usize)],
    from: Shape,
    to: Shape,
    output: *mut f32,
}

by_level!(run(task: &Task<'_>) = column[8, 2][4, 1]);

/// # Safety
/// As [`Simd`]; the sizes are those `apply` checks. A vector of outputs reads at most 36 values from twice
/// its place, and outputs are stored up to at most 32 beyond half the input's: within what `Column` allows.
#[inline(always)]
unsafe fn column<S: Simd, const OUTPUTS: usize, const WIDEST: usize>(task: &Task<'_>) {
    for output in (0..task.layer.outputs).step_by(OUTPUTS) {
        let mut begin = 0;
        while begin < task.to.length {
            if WIDEST >= 2 && task.to.length > begin + LANES {
                block::<S, OUTPUTS, 2>(task, output, begin);
                begin += 2 * LANES;
            } else {
                block::<S, OUTPUTS, 1>(task, output, begin);
                begin += LANES;
            }
        }
        for o in 0..OUTPUTS {
            let to = task.output.add((output + o) * task.to.stride() + COLUMN_START);
            for beyond in task.to.length..task.to.padded() {
                *to.add(beyond) = 0.0;
            }
        }
    }
}

/// `VECTORS` vectors of some outputs.
///
/// # Safety
/// As `column`; `begin` is before the end of the output.
#[inline(always)]
unsafe fn block<S: Simd, const OUTPUTS: usize, const VECTORS: usize>(
    task: &Task<'_>,
    output: usize,
    begin: usize,
) {
    let layer = task.layer;
    let mut sums = [[S::splat(0.0); VECTORS]; OUTPUTS];
    for o in 0..OUTPUTS {
        sums[o] = [S::splat(*layer.bias.get_unchecked(output + o)); VECTORS];
    }
    for (column, tap) in task.input {
        let from = column.as_ptr().add(2 * begin).sub(layer.size / 2);
        let weights = layer.weights.get_unchecked(*tap).values().as_ptr();
        let weights = weights.add(output * layer.inputs * layer.size);
        if layer.size == 3 {
            sums = tap_sums::<S, OUTPUTS, VECTORS, 3>(task, from, weights, sums);
        } else {
            sums = tap_sums::<S, OUTPUTS, VECTORS, 5>(task, from, weights, sums);
        }
    }
    for o in 0..OUTPUTS {
        let to = task.output.add((output + o) * task.to.stride() + COLUMN_START + begin);
        for v in 0..VECTORS {
            let sum = sums[o][v];
            let sum = if layer.relu { S::max(sum, S::splat(0.0)) } else { sum };
            S::store(to.add(v * LANES), sum);
        }
    }
}

/// Adds one input column.
///
/// # Safety
/// As `block`; `from` is a place in the column's first channel, `weights` the first of its tap's.
#[inline(always)]
unsafe fn tap_sums<S: Simd, const OUTPUTS: usize, const VECTORS: usize, const SIZE: usize>(
    task: &Task<'_>,
    mut from: *const f32,
    mut weights: *const f32,
    mut sums: [[S::V; VECTORS]; OUTPUTS],
) -> [[S::V; VECTORS]; OUTPUTS] {
    for _ in 0..task.layer.inputs {
        // Two taps share their loads: even lanes for one, odd lanes for the other.
        for k in (0..SIZE).step_by(2) {
            let mut even = [S::splat(0.0); VECTORS];
            let mut odd = even;
            for v in 0..VECTORS {
                let at = from.add(k + 2 * v * LANES);
                let (a, b) = (S::load(at), S::load(at.add(LANES)));
                even[v] = S::even(a, b);
                odd[v] = S::odd(a, b);
            }
            for o in 0..OUTPUTS {
                let weight = S::splat(*weights.add(k * OUTPUTS + o));
                for v in 0..VECTORS {
                    sums[o][v] = S::mul_add(weight, even[v], sums[o][v]);
                }
            }
            if k + 1 < SIZE {
                for o in 0..OUTPUTS {
                    let weight = S::splat(*weights.add((k + 1) * OUTPUTS + o));
                    for v in 0..VECTORS {
                        sums[o][v] = S::mul_add(weight, odd[v], sums[o][v]);
                    }
                }
            }
        }
        from = from.add(task.from.stride());
        weights = weights.add(SIZE * OUTPUTS);
    }
    sums
}
