//! Passes of batch normalisation and ReLU over a few columns.
#![expect(unsafe_code, reason = "inner loops over pointers, with the sizes checked before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use super::simd::{LANES, Level, Simd, by_level};
use super::slab::{COLUMN_START, Columns};

/// `scale` and `shift` of a channel, whose output is the ReLU of `scale * z + shift`.
pub(crate) type Affine = [f32; 2];
/// The gradient of `z` is `a * g + (b * z + c)`, where `g` is the gradient of the output where ReLU lets it through.
pub(crate) type Slopes = [f32; 3];

/// Sums of `z` and of its square, for each of the first channels.
pub(crate) fn moments(level: Level, z: Columns<'_>, channels: usize) -> Vec<[f64; 2]> {
    assert!(channels <= z.shape().channels);
    let mut totals = vec![[0.0; 2]; channels];
    run_sums(level, &mut Sums { z, gradient: None, totals: &mut totals });
    totals
}

/// Sums of the gradient where ReLU lets it through, and of its product with `z`, for each channel.
///
/// # Panics
/// When sizes do not fit.
pub(crate) fn gradient_sums(
    level: Level,
    z: Columns<'_>,
    output: Columns<'_>,
    affine: &[Affine],
) -> Vec<[f64; 2]> {
    check(z, output, affine.len());
    let mut totals = vec![[0.0; 2]; affine.len()];
    run_sums(level, &mut Sums { z, gradient: Some((output, affine)), totals: &mut totals });
    totals
}

/// Writes the gradient of `z` from that of the output into columns of as many channels as there are slopes.
///
/// # Panics
/// When sizes do not fit.
pub(crate) fn gradient(
    level: Level,
    z: Columns<'_>,
    output: Columns<'_>,
    affine: &[Affine],
    slopes: &[Slopes],
    to: &mut [f32],
) {
    check(z, output, affine.len());
    let shape = z.shape();
    assert!(affine.len() == slopes.len());
    assert!(to.len() == shape.columns * slopes.len() * shape.stride());
    run_gradient(level, &mut Gradient { z, output, affine, slopes, to });
}

/// Writes the outputs of `z`, with `more` added, into columns of the same channels; those without parameters are zero
/// before the addition.
///
/// # Panics
/// When sizes do not fit.
pub(crate) fn apply(
    level: Level,
    z: Columns<'_>,
    more: Option<Columns<'_>>,
    affine: &[Affine],
    to: &mut [f32],
) {
    let shape = z.shape();
    assert!(more.as_ref().is_none_or(|more| more.shape() == shape) && affine.len() <= shape.channels);
    assert!(to.len() == shape.columns * shape.column());
    run_apply(level, &mut Apply { z, more, affine, to });
}

fn check(z: Columns<'_>, output: Columns<'_>, channels: usize) {
    let (z, output) = (z.shape(), output.shape());
    assert!((z.columns, z.length) == (output.columns, output.length));
    assert!(channels <= z.channels && channels <= output.channels);
}

struct Apply<'a> {
    z: Columns<'a>,
    more: Option<Columns<'a>>,
    affine: &'a [Affine],
    to: &'a mut [f32],
}

/// Sums of `g` and of `g * z`, where `g` is the gradient that ReLU lets through, or `z` itself.
struct Sums<'a> {
    z: Columns<'a>,
    gradient: Option<(Columns<'a>, &'a [Affine])>,
    totals: &'a mut [[f64; 2]],
}

struct Gradient<'a> {
    z: Columns<'a>,
    output: Columns<'a>,
    affine: &'a [Affine],
    slopes: &'a [Slopes],
    to: &'a mut [f32],
}

by_level!(run_apply(task: &mut Apply<'_>) = apply_to[][]);
by_level!(run_sums(task: &mut Sums<'_>) = sums_of[][]);
by_level!(run_gradient(task: &mut Gradient<'_>) = gradient_of[][]);

/// # Safety
/// As [`Simd`]; the sizes are those `apply` checks. Stored values beyond the length become zero.
#[inline(always)]
unsafe fn apply_to<S: Simd>(task: &mut Apply<'_>) {
    let shape = task.z.shape();
    for x in 0..shape.columns {
        for channel in 0..shape.channels {
            let [scale, shift] = task.affine.get(channel).copied().unwrap_or_default();
            let (scale, shift) = (S::splat(scale), S::splat(shift));
            let at = x * shape.column() + channel * shape.stride();
            let z = task.z.as_ptr().add(at);
            let to = task.to.as_mut_ptr().add(at + COLUMN_START);
            for begin in (0..shape.length).step_by(LANES) {
                let mut v = S::max(S::mul_add(scale, S::load(z.add(begin)), shift), S::splat(0.0));
                if let Some(more) = &task.more {
                    v = S::add(v, S::load(more.as_ptr().add(at + begin)));
                }
                S::store(to.add(begin), v);
            }
            for beyond in shape.length..shape.padded() {
                *to.add(beyond) = 0.0;
            }
        }
    }
}

/// # Safety
/// As [`Simd`]; the sizes are those `moments` and `gradient_sums` check. Stored values beyond the length are zero and
/// count for nothing.
#[inline(always)]
unsafe fn sums_of<S: Simd>(task: &mut Sums<'_>) {
    let shape = task.z.shape();
    for (channel, totals) in task.totals.iter_mut().enumerate() {
        let mut sums = [S::splat(0.0); 2];
        for x in 0..shape.columns {
            let z = task.z.as_ptr().add(x * shape.column() + channel * shape.stride());
            if let Some((output, affine)) = &task.gradient {
                let [scale, shift] = *affine.get_unchecked(channel);
                let (scale, shift) = (S::splat(scale), S::splat(shift));
                let g = output.as_ptr().add(x * output.shape().column() + channel * shape.stride());
                for begin in (0..shape.length).step_by(LANES) {
                    let z = S::load(z.add(begin));
                    let g = S::where_positive(S::mul_add(scale, z, shift), S::load(g.add(begin)));
                    sums = [S::add(sums[0], g), S::mul_add(g, z, sums[1])];
                }
            } else {
                for begin in (0..shape.length).step_by(LANES) {
                    let z = S::load(z.add(begin));
                    sums = [S::add(sums[0], z), S::mul_add(z, z, sums[1])];
                }
            }
        }
        *totals = sums.map(|lanes| total::<S>(lanes));
    }
}

/// # Safety
/// As [`Simd`]; the sizes are those `gradient` checks. Stored values beyond the length become zero.
#[inline(always)]
unsafe fn gradient_of<S: Simd>(task: &mut Gradient<'_>) {
    let (shape, output) = (task.z.shape(), task.output.shape());
    let channels = task.slopes.len();
    for x in 0..shape.columns {
        for channel in 0..channels {
            let [scale, shift] = *task.affine.get_unchecked(channel);
            let (scale, shift) = (S::splat(scale), S::splat(shift));
            let [a, b, c] = *task.slopes.get_unchecked(channel);
            let (a, b, c) = (S::splat(a), S::splat(b), S::splat(c));
            let z = task.z.as_ptr().add(x * shape.column() + channel * shape.stride());
            let g = task.output.as_ptr().add(x * output.column() + channel * shape.stride());
            let to = task.to.as_mut_ptr().add((x * channels + channel) * shape.stride() + COLUMN_START);
            for begin in (0..shape.length).step_by(LANES) {
                let z = S::load(z.add(begin));
                let g = S::where_positive(S::mul_add(scale, z, shift), S::load(g.add(begin)));
                S::store(to.add(begin), S::mul_add(a, g, S::mul_add(b, z, c)));
            }
            for beyond in shape.length..shape.padded() {
                *to.add(beyond) = 0.0;
            }
        }
    }
}

/// The sum of all lanes, in their order.
///
/// # Safety
/// As [`Simd`].
#[inline(always)]
unsafe fn total<S: Simd>(lanes: S::V) -> f64 {
    let mut values = [0.0; LANES];
    S::store(values.as_mut_ptr(), lanes);
    values.iter().map(|value| f64::from(*value)).sum()
}
