//! The last layer (8 channels to a logit), softmax, expectation and confidence of two pixels at once
//! (paper section 3.3). Neither logits nor probabilities are stored beyond that.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use super::aligned::Aligned;
use super::simd::{LANES, Level, Simd, by_level};
use super::slab::Column;

/// Channels of the last layer's input.
const CHANNELS: usize = 8;

/// The last layer's weights, and how many probabilities make the confidence.
#[derive(Debug)]
pub(crate) struct RegressionLayer {
    level: Level,
    /// `[row tap][input][k][column tap]`.
    weights: Vec<f32>,
    bias: f32,
}

/// What is known of a pixel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Regressed {
    /// The expected index of the hypothesis.
    pub(crate) index: f64,
    /// The sum of the probabilities around it.
    pub(crate) confidence: f32,
}

/// Memory for the logits, then the probabilities, of two pixels.
#[derive(Debug)]
pub(crate) struct RegressionScratch([Aligned; 2]);

impl RegressionScratch {
    /// For slabs with this many stored values a channel.
    pub(crate) fn new(padded: usize) -> Self {
        Self([Aligned::zeroed(padded), Aligned::zeroed(padded)])
    }

    /// What the probabilities of one of the last two pixels are in proportion to.
    pub(crate) fn exponentials(&self, pixel: usize) -> &[f32] {
        self.0[pixel].values()
    }
}

impl RegressionLayer {
    /// `weight(input, row tap, column tap, k)` is the kernel.
    pub(crate) fn new(level: Level, weight: impl Fn(usize, usize, usize, usize) -> f64, bias: f64) -> Self {
        let mut weights = Vec::with_capacity(9 * CHANNELS * 3);
        for row in 0..3 {
            for input in 0..CHANNELS {
                for k in 0..3 {
                    weights.extend((0..3).map(|column| weight(input, row, column, k) as f32));
                }
            }
        }
        Self { level, weights, bias: bias as f32 }
    }

    /// The two middle pixels of four adjacent columns, in rows of the input, each with its tap; rows outside
    /// the input are left out. `window` probabilities make the confidence.
    ///
    /// # Panics
    /// When sizes do not fit.
    pub(crate) fn apply(
        &self,
        input: &[([Column<'_>; 4], usize)],
        window: u32,
        scratch: &mut RegressionScratch,
    ) -> [Regressed; 2] {
        let shape = input.first().map(|(columns, _)| columns[0].shape()).expect("an input row");
        assert!(shape.channels == CHANNELS);
        assert!(input.iter().all(|(columns, tap)| *tap < 3 && columns.iter().all(|c| c.shape() == shape)));
        assert!(scratch.0.iter().all(|values| values.values().len() >= shape.padded()));
        let mut task =
            Task { layer: self, input, window: window as isize, scratch, out: [Regressed::default(); 2] };
        run(self.level, &mut task);
        task.out
    }
}

struct Task<'a> {
    layer: &'a RegressionLayer,
    input: &'a [([Column<'a>; 4], usize)],
    window: isize,
    scratch: &'a mut RegressionScratch,
    out: [Regressed; 2],
}

by_level!(run(task: &mut Task<'_>) = pixels[4][2]);

/// # Safety
/// As [`Simd`]; the sizes are those `apply` checks.
#[inline(always)]
unsafe fn pixels<S: Simd, const VECTORS: usize>(task: &mut Task<'_>) {
    let shape = task.input[0].0[0].shape();
    let mut begin = 0;
    while begin < shape.padded() {
        // The stored length is a multiple of two vectors.
        if begin + VECTORS * LANES <= shape.padded() {
            logits::<S, VECTORS>(task, begin);
            begin += VECTORS * LANES;
        } else {
            logits::<S, 2>(task, begin);
            begin += 2 * LANES;
        }
    }
    for pixel in 0..2 {
        let values = &mut task.scratch.0[pixel].values_mut()[..shape.padded()];
        values[shape.length..].fill(f32::NEG_INFINITY);
        task.out[pixel] = regress(values, shape.length, task.window);
    }
}

#[inline(always)]
unsafe fn logits<S: Simd, const VECTORS: usize>(task: &mut Task<'_>, begin: usize) {
    let mut sums = [[S::splat(task.layer.bias); VECTORS]; 2];
    for (columns, row) in task.input {
        for (at, column) in columns.iter().enumerate() {
            let mut from = column.as_ptr().add(begin).sub(1);
            let mut weights = task.layer.weights.as_ptr().add(row * CHANNELS * 9);
            for _ in 0..CHANNELS {
                for k in 0..3 {
                    let mut x = [S::splat(0.0); VECTORS];
                    for v in 0..VECTORS {
                        x[v] = S::load(from.add(k + v * LANES));
                    }
                    // The first pixel sees columns 0 to 2, the second 1 to 3.
                    if at < 3 {
                        let weight = S::splat(*weights.add(3 * k + at));
                        for v in 0..VECTORS {
                            sums[0][v] = S::mul_add(weight, x[v], sums[0][v]);
                        }
                    }
                    if at > 0 {
                        let weight = S::splat(*weights.add(3 * k + at - 1));
                        for v in 0..VECTORS {
                            sums[1][v] = S::mul_add(weight, x[v], sums[1][v]);
                        }
                    }
                }
                from = from.add(column.shape().stride());
                weights = weights.add(9);
            }
        }
    }
    for pixel in 0..2 {
        let to = task.scratch.0[pixel].values_mut().as_mut_ptr().add(begin);
        for v in 0..VECTORS {
            S::store(to.add(v * LANES), sums[pixel][v]);
        }
    }
}

/// Softmax in place (but for its divisor), and what follows from it. Values from `length` on are minus
/// infinity. Sixteen sums are kept, so that their order is the same in registers of any width.
#[inline(always)]
fn regress(values: &mut [f32], length: usize, window: isize) -> Regressed {
    let mut greatest = [f32::NEG_INFINITY; LANES];
    for chunk in values.chunks_exact(LANES) {
        for i in 0..LANES {
            greatest[i] = if chunk[i] > greatest[i] { chunk[i] } else { greatest[i] };
        }
    }
    let greatest = greatest.into_iter().fold(f32::NEG_INFINITY, f32::max);
    for value in values.iter_mut() {
        *value = exp(*value - greatest);
    }
    values[length..].fill(0.0);
    let mut totals = [0.0_f64; LANES];
    let mut moments = [0.0_f64; LANES];
    let mut first = 0.0_f64;
    for chunk in values.chunks_exact(LANES) {
        for i in 0..LANES {
            let value = f64::from(chunk[i]);
            totals[i] += value;
            moments[i] += value * (first + i as f64);
        }
        first += LANES as f64;
    }
    let total: f64 = totals.iter().sum();
    let index = moments.iter().sum::<f64>() / total;
    let begin = (index.floor() as isize).clamp(0, length as isize - 1) - window / 2 + 1;
    let around = begin.max(0) as usize..((begin + window).max(0) as usize).min(length);
    let around: f64 = values[around].iter().map(|value| f64::from(*value)).sum();
    Regressed { index, confidence: (around / total) as f32 }
}

/// `e^x` for `x` up to 0, to within two units in the last place; below -87 that of -87.
#[inline(always)]
fn exp(x: f32) -> f32 {
    // Adding it rounds to an integer, which then stands in the last bits.
    const ROUND: f32 = 12_582_912.0;
    const LN_2_HIGH: f32 = 0.693_359_4;
    const LN_2_LOW: f32 = -2.121_944_4e-4;
    let x = if x > -87.0 { x } else { -87.0 };
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN_2_HIGH - n * LN_2_LOW;
    let p = 1.0 / 5040.0;
    let p = p * r + 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = (p * r * r + r) + 1.0;
    let power = shifted.to_bits().wrapping_sub(ROUND.to_bits()).wrapping_add(127) << 23;
    p * f32::from_bits(power)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_is_near_the_true_one() {
        for i in 0..87_000 {
            let x = -(i as f32) / 1000.0;
            let truth = f64::from(x).exp();
            assert!((f64::from(exp(x)) - truth).abs() <= 2.4e-7 * truth, "{x}");
        }
        assert!(exp(f32::NEG_INFINITY) < 1e-37);
    }

    #[test]
    fn expectation_and_window_of_given_probabilities() {
        let p = [0.05_f32, 0.1, 0.2, 0.3, 0.2, 0.1, 0.05];
        let mut values = [f32::NEG_INFINITY; 32];
        for (value, p) in values.iter_mut().zip(p) {
            *value = p.ln() + 3.0;
        }
        let regressed = regress(&mut values, 7, 4);
        assert!((regressed.index - 3.0).abs() < 1e-6);
        // The window begins one before the floor, which is 2 or 3 here.
        assert!((regressed.confidence - 0.8).abs() < 1e-6);
    }
}
