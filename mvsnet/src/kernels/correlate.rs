//! Gradients of kernels: how the gradient of a layer's output goes with its input, tap by tap.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use super::simd::{LANES, Level, Simd, by_level};
use super::slab::Column;

/// Output channels summed at a time.
pub(crate) const OUTPUTS: usize = 8;
/// Values of the output's gradient that stay in the nearest cache.
const NEAR: usize = 4096;

/// What is correlated: pairs of columns of an output's gradient and of an input.
pub(crate) struct Correlation<'a> {
    pub(crate) pairs: &'a [(Column<'a>, Column<'a>)],
    /// The first of eight channels of the gradients.
    pub(crate) output: usize,
    /// 1 or 2: the inputs' step along the contiguous axis.
    pub(crate) stride: usize,
    /// Size of the kernel along the contiguous axis, 3 or 5.
    pub(crate) size: usize,
}

impl Correlation<'_> {
    /// Gives `sum over t of gradient[output][t] * input[stride * t + k - size / 2]` at `[input][output][k]`, summed over
    /// the pairs in their order.
    ///
    /// # Panics
    /// When sizes do not fit.
    pub(crate) fn sums(&self, level: Level) -> Vec<f32> {
        let Some((gradient, input)) = self.pairs.first().map(|(g, x)| (g.shape(), x.shape())) else {
            return Vec::new();
        };
        assert!(self.pairs.iter().all(|(g, x)| g.shape() == gradient && x.shape() == input));
        assert!(self.output + OUTPUTS <= gradient.channels);
        assert!(gradient.length == input.length.div_ceil(self.stride));
        assert!((self.stride == 1 || self.stride == 2) && (self.size == 3 || self.size == 5));
        let mut sums = vec![0.0; input.channels * OUTPUTS * self.size];
        let mut lanes = vec![0.0; sums.len() * LANES];
        run(level, &mut Task { correlation: self, lanes: &mut lanes });
        for (sum, lanes) in sums.iter_mut().zip(lanes.as_chunks::<LANES>().0) {
            let quarters: [f32; 4] =
                std::array::from_fn(|i| lanes[i] + lanes[i + 4] + lanes[i + 8] + lanes[i + 12]);
            *sum = (quarters[0] + quarters[1]) + (quarters[2] + quarters[3]);
        }
        sums
    }
}

struct Task<'a> {
    correlation: &'a Correlation<'a>,
    /// `[input][output][k][lane]`.
    lanes: &'a mut [f32],
}

by_level!(run(task: &mut Task<'_>) = sizes[8, 4][4, 2]);

/// # Safety
/// As [`Simd`]; the sizes are those `sums` checks. With a stride of 2, at most 36 values are read from twice a place
/// of the gradient's column: within what `Column` allows. Those beyond the input meet gradients that are zero.
#[inline(always)]
unsafe fn sizes<S: Simd, const WIDE: usize, const NARROW: usize>(task: &mut Task<'_>) {
    match (task.correlation.stride, task.correlation.size) {
        (1, 3) => block::<S, 1, 3, WIDE>(task),
        (1, _) => block::<S, 1, 5, NARROW>(task),
        (_, 3) => block::<S, 2, 3, WIDE>(task),
        (..) => block::<S, 2, 5, NARROW>(task),
    }
}

#[inline(always)]
unsafe fn block<S: Simd, const STRIDE: usize, const SIZE: usize, const AT_ONCE: usize>(task: &mut Task<'_>) {
    let correlation = task.correlation;
    let (gradient, input) = (correlation.pairs[0].0.shape(), correlation.pairs[0].1.shape());
    let near = (NEAR / (AT_ONCE * gradient.stride())).max(1);
    let vectors = gradient.length.div_ceil(LANES);
    for first in (0..OUTPUTS).step_by(AT_ONCE) {
        for pairs in correlation.pairs.chunks(near) {
            for channel in 0..input.channels {
                let lanes = task.lanes.as_mut_ptr().add((channel * OUTPUTS + first) * SIZE * LANES);
                let mut sums = [[S::splat(0.0); SIZE]; AT_ONCE];
                for o in 0..AT_ONCE {
                    for k in 0..SIZE {
                        sums[o][k] = S::load(lanes.add((o * SIZE + k) * LANES));
                    }
                }
                for (g, x) in pairs {
                    let mut g = g.as_ptr().add((correlation.output + first) * gradient.stride());
                    let mut x = x.as_ptr().add(channel * input.stride()).sub(SIZE / 2);
                    for _ in 0..vectors {
                        let x_at = inputs::<S, STRIDE, SIZE>(x);
                        for o in 0..AT_ONCE {
                            let g_at = S::load(g.add(o * gradient.stride()));
                            for k in 0..SIZE {
                                sums[o][k] = S::mul_add(g_at, x_at[k], sums[o][k]);
                            }
                        }
                        g = g.add(LANES);
                        x = x.add(STRIDE * LANES);
                    }
                }
                for o in 0..AT_ONCE {
                    for k in 0..SIZE {
                        S::store(lanes.add((o * SIZE + k) * LANES), sums[o][k]);
                    }
                }
            }
        }
    }
}

/// The inputs that 16 outputs meet at each tap.
#[inline(always)]
unsafe fn inputs<S: Simd, const STRIDE: usize, const SIZE: usize>(x: *const f32) -> [S::V; SIZE] {
    let mut at = [S::splat(0.0); SIZE];
    if STRIDE == 1 {
        for k in 0..SIZE {
            at[k] = S::load(x.add(k));
        }
    } else {
        for k in (0..SIZE).step_by(2) {
            let (a, b) = (S::load(x.add(k)), S::load(x.add(k + LANES)));
            at[k] = S::even(a, b);
            if k + 1 < SIZE {
                at[k + 1] = S::odd(a, b);
            }
        }
    }
    at
}
