//! Sixteen lanes, as the processor at hand has them.
//!
//! The kernel is written once over [`Lanes`]. Operations are fused where the method says so, on every processor,
//! and none is approximated: so the bits are the same with the vector instructions of the processor and with the
//! ordinary ones of [`Portable`].

/// Lanes of a vector.
pub(crate) const LANES: usize = 16;
/// Columns of a window that values are picked from.
pub(crate) const WINDOW_COLUMNS: i32 = 32;

/// The lanes' numbers.
pub(crate) const COUNTING: [i32; LANES] = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15];

/// Operations on sixteen lanes.
///
/// # Safety
/// Of every method: the processor has the implementor's instructions. Methods are inlined into functions that enable
/// them. Of those that read through a pointer: what they say that they read can be read, and indices are not negative, but
/// those of picks may be.
pub(crate) trait Lanes {
    /// Floats.
    type F: Copy;
    /// Integers, `i32`.
    type I: Copy;
    /// Yes or no.
    type M: Copy;

    unsafe fn splat(value: f32) -> Self::F;
    unsafe fn load(from: &[f32; LANES]) -> Self::F;
    unsafe fn store(v: Self::F) -> [f32; LANES];
    unsafe fn add(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn sub(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn mul(a: Self::F, b: Self::F) -> Self::F;
    unsafe fn div(a: Self::F, b: Self::F) -> Self::F;
    /// `a b + c`, rounded once.
    unsafe fn mul_add(a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// `c - a b`, rounded once.
    unsafe fn mul_sub_from(a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    unsafe fn abs(a: Self::F) -> Self::F;
    unsafe fn sqrt(a: Self::F) -> Self::F;
    unsafe fn floor(a: Self::F) -> Self::F;
    /// `a < b`; no where one is no number.
    unsafe fn less(a: Self::F, b: Self::F) -> Self::M;
    unsafe fn and(a: Self::M, b: Self::M) -> Self::M;
    unsafe fn or(a: Self::M, b: Self::M) -> Self::M;
    /// `a` and not `b`.
    unsafe fn but_not(a: Self::M, b: Self::M) -> Self::M;
    /// Lane k as bit k.
    unsafe fn bits(m: Self::M) -> u32;
    /// `a` where `m` says so, else `b`.
    unsafe fn select(m: Self::M, a: Self::F, b: Self::F) -> Self::F;
    /// `v` where `m` says so, else 0.
    unsafe fn only(m: Self::M, v: Self::F) -> Self::F;

    unsafe fn splat_i(value: i32) -> Self::I;
    unsafe fn load_i(from: &[i32; LANES]) -> Self::I;
    unsafe fn store_i(v: Self::I) -> [i32; LANES];
    unsafe fn add_i(a: Self::I, b: Self::I) -> Self::I;
    unsafe fn mul_i(a: Self::I, b: Self::I) -> Self::I;
    unsafe fn min_i(a: Self::I, b: Self::I) -> Self::I;
    unsafe fn max_i(a: Self::I, b: Self::I) -> Self::I;
    unsafe fn or_i(a: Self::I, b: Self::I) -> Self::I;
    unsafe fn only_i(m: Self::M, v: Self::I) -> Self::I;
    unsafe fn sub_i(a: Self::I, b: Self::I) -> Self::I;
    unsafe fn and_i(a: Self::I, b: Self::I) -> Self::I;
    /// Bits move down by `by`, from 0 to 31.
    unsafe fn shift_down(v: Self::I, by: Self::I) -> Self::I;
    /// Towards 0. What is too large or small becomes `i32::MIN` or `i32::MAX`, what is no number any integer.
    unsafe fn truncate(v: Self::F) -> Self::I;
    unsafe fn to_float(v: Self::I) -> Self::F;

    /// Whether `0 <= a < limit`; the limit is not negative.
    unsafe fn below(a: Self::I, limit: i32) -> Self::M;
    unsafe fn equal(a: Self::I, b: Self::I) -> Self::M;
    /// `a` where `m` says so, else `b`.
    unsafe fn select_i(m: Self::M, a: Self::I, b: Self::I) -> Self::I;

    /// The lanes that `m` names come first, in their order; behind them lies anything.
    #[inline(always)]
    unsafe fn compress(m: Self::M, v: Self::F) -> Self::F {
        // SAFETY: the caller vouches for the processor.
        unsafe { Self::load(&compressed(Self::bits(m), Self::store(v))) }
    }
    /// The same of integers.
    #[inline(always)]
    unsafe fn compress_i(m: Self::M, v: Self::I) -> Self::I {
        // SAFETY: as above.
        unsafe { Self::load_i(&compressed(Self::bits(m), Self::store_i(v))) }
    }

    /// The values at `at` from `from` on, and those behind them.
    #[inline(always)]
    unsafe fn pairs(from: *const f32, at: Self::I) -> (Self::F, Self::F) {
        // SAFETY: the caller vouches for the processor and for the values.
        unsafe { (Self::gather(from, at), Self::gather(from.add(1), at)) }
    }
    /// The values at `at` from `from` on.
    #[inline(always)]
    unsafe fn gather(from: *const f32, at: Self::I) -> Self::F {
        // SAFETY: as above.
        unsafe {
            let values = Self::store_i(at).map(|at| from.add(at as usize).read());
            Self::load(&values)
        }
    }
    /// The words at `at` from `from` on, the lowest byte first.
    #[inline(always)]
    unsafe fn gather_words(from: *const [u8; 4], at: Self::I) -> Self::I {
        // SAFETY: as above.
        unsafe {
            let words = Self::store_i(at).map(|at| from.add(at as usize).read());
            Self::load_i(&words.map(i32::from_le_bytes))
        }
    }

    /// Whether [`Lanes::pick`] and [`Lanes::pick_words`] are faster than a copy for each lane; else only tests use them.
    const PICKS: bool = false;
    /// Values of the [`WINDOW_COLUMNS`] that can be read from `window` on: in each lane the one at `at`, modulo their
    /// number.
    #[inline(always)]
    unsafe fn pick(window: *const f32, at: Self::I) -> Self::F {
        // SAFETY: the caller vouches for the processor and for the values.
        unsafe {
            let mut picked = [0.0; LANES];
            for (value, at) in picked.iter_mut().zip(Self::store_i(at)) {
                *value = window.add(at.rem_euclid(WINDOW_COLUMNS) as usize).read();
            }
            Self::load(&picked)
        }
    }
    /// The same of words, the lowest byte first.
    #[inline(always)]
    unsafe fn pick_words(window: *const [u8; 4], at: Self::I) -> Self::I {
        // SAFETY: as above.
        unsafe {
            let mut picked = [0; LANES];
            for (word, at) in picked.iter_mut().zip(Self::store_i(at)) {
                *word = i32::from_le_bytes(window.add(at.rem_euclid(WINDOW_COLUMNS) as usize).read());
            }
            Self::load_i(&picked)
        }
    }

    /// Has the processor fetch a place, if it is one, into its second cache.
    unsafe fn prefetch<T>(place: *const T);
}

/// The values whose bits are set, at the front.
#[inline(always)]
fn compressed<T: Copy>(bits: u32, mut values: [T; LANES]) -> [T; LANES] {
    let mut count = 0;
    for k in 0..LANES {
        values[count] = values[k];
        count += (bits >> k & 1) as usize;
    }
    values
}

/// Arrays, for every processor.
pub(crate) struct Portable;

#[inline(always)]
fn each<A: Copy, B: Copy, C>(a: [A; LANES], b: [B; LANES], f: impl Fn(A, B) -> C) -> [C; LANES] {
    std::array::from_fn(|k| f(a[k], b[k]))
}

/// # Safety
/// Nothing is asked of the processor.
impl Lanes for Portable {
    type F = [f32; LANES];
    type I = [i32; LANES];
    type M = [bool; LANES];

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self::F {
        [value; LANES]
    }
    #[inline(always)]
    unsafe fn load(from: &[f32; LANES]) -> Self::F {
        *from
    }
    #[inline(always)]
    unsafe fn store(v: Self::F) -> [f32; LANES] {
        v
    }
    #[inline(always)]
    unsafe fn add(a: Self::F, b: Self::F) -> Self::F {
        each(a, b, |a, b| a + b)
    }
    #[inline(always)]
    unsafe fn sub(a: Self::F, b: Self::F) -> Self::F {
        each(a, b, |a, b| a - b)
    }
    #[inline(always)]
    unsafe fn mul(a: Self::F, b: Self::F) -> Self::F {
        each(a, b, |a, b| a * b)
    }
    #[inline(always)]
    unsafe fn div(a: Self::F, b: Self::F) -> Self::F {
        each(a, b, |a, b| a / b)
    }
    #[inline(always)]
    unsafe fn mul_add(a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        std::array::from_fn(|k| a[k].mul_add(b[k], c[k]))
    }
    #[inline(always)]
    unsafe fn mul_sub_from(a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        std::array::from_fn(|k| (-a[k]).mul_add(b[k], c[k]))
    }
    #[inline(always)]
    unsafe fn abs(a: Self::F) -> Self::F {
        a.map(f32::abs)
    }
    #[inline(always)]
    unsafe fn sqrt(a: Self::F) -> Self::F {
        a.map(f32::sqrt)
    }
    #[inline(always)]
    unsafe fn floor(a: Self::F) -> Self::F {
        a.map(f32::floor)
    }
    #[inline(always)]
    unsafe fn less(a: Self::F, b: Self::F) -> Self::M {
        each(a, b, |a, b| a < b)
    }
    #[inline(always)]
    unsafe fn and(a: Self::M, b: Self::M) -> Self::M {
        each(a, b, |a, b| a & b)
    }
    #[inline(always)]
    unsafe fn or(a: Self::M, b: Self::M) -> Self::M {
        each(a, b, |a, b| a | b)
    }
    #[inline(always)]
    unsafe fn but_not(a: Self::M, b: Self::M) -> Self::M {
        each(a, b, |a, b| a && !b)
    }
    #[inline(always)]
    unsafe fn bits(m: Self::M) -> u32 {
        m.iter().rev().fold(0, |bits, lane| bits << 1 | u32::from(*lane))
    }
    #[inline(always)]
    unsafe fn select(m: Self::M, a: Self::F, b: Self::F) -> Self::F {
        std::array::from_fn(|k| if m[k] { a[k] } else { b[k] })
    }
    #[inline(always)]
    unsafe fn only(m: Self::M, v: Self::F) -> Self::F {
        each(m, v, |m, v| if m { v } else { 0.0 })
    }
    #[inline(always)]
    unsafe fn splat_i(value: i32) -> Self::I {
        [value; LANES]
    }
    #[inline(always)]
    unsafe fn load_i(from: &[i32; LANES]) -> Self::I {
        *from
    }
    #[inline(always)]
    unsafe fn store_i(v: Self::I) -> [i32; LANES] {
        v
    }
    #[inline(always)]
    unsafe fn add_i(a: Self::I, b: Self::I) -> Self::I {
        each(a, b, i32::wrapping_add)
    }
    #[inline(always)]
    unsafe fn mul_i(a: Self::I, b: Self::I) -> Self::I {
        each(a, b, i32::wrapping_mul)
    }
    #[inline(always)]
    unsafe fn min_i(a: Self::I, b: Self::I) -> Self::I {
        each(a, b, i32::min)
    }
    #[inline(always)]
    unsafe fn max_i(a: Self::I, b: Self::I) -> Self::I {
        each(a, b, i32::max)
    }
    #[inline(always)]
    unsafe fn or_i(a: Self::I, b: Self::I) -> Self::I {
        each(a, b, |a, b| a | b)
    }
    #[inline(always)]
    unsafe fn only_i(m: Self::M, v: Self::I) -> Self::I {
        each(m, v, |m, v| if m { v } else { 0 })
    }
    #[inline(always)]
    unsafe fn sub_i(a: Self::I, b: Self::I) -> Self::I {
        each(a, b, i32::wrapping_sub)
    }
    #[inline(always)]
    unsafe fn and_i(a: Self::I, b: Self::I) -> Self::I {
        each(a, b, |a, b| a & b)
    }
    #[inline(always)]
    unsafe fn shift_down(v: Self::I, by: Self::I) -> Self::I {
        each(v, by, |v, by| (v as u32 >> by) as i32)
    }
    #[inline(always)]
    unsafe fn truncate(v: Self::F) -> Self::I {
        v.map(|v| v as i32)
    }
    #[inline(always)]
    unsafe fn to_float(v: Self::I) -> Self::F {
        v.map(|v| v as f32)
    }
    #[inline(always)]
    unsafe fn below(a: Self::I, limit: i32) -> Self::M {
        a.map(|a| 0 <= a && a < limit)
    }
    #[inline(always)]
    unsafe fn equal(a: Self::I, b: Self::I) -> Self::M {
        each(a, b, |a, b| a == b)
    }
    #[inline(always)]
    unsafe fn select_i(m: Self::M, a: Self::I, b: Self::I) -> Self::I {
        std::array::from_fn(|k| if m[k] { a[k] } else { b[k] })
    }
    #[inline(always)]
    unsafe fn prefetch<T>(_: *const T) {}
}

#[cfg(all(test, target_arch = "x86_64"))]
mod tests {
    use super::super::{Level, avx2::Avx2, avx512::Avx512};
    use super::*;

    /// What comes out of the operations that the levels implement in ways of their own.
    fn outcomes<L: Lanes>(at: [i32; LANES], floats: [f32; LANES]) -> [[i32; LANES]; 13] {
        let values: Vec<f32> = (0..200).map(|i| i as f32 + 0.5).collect();
        let words: Vec<[u8; 4]> = (0..200).map(|i| [i, 64 + i % 64, 128 + i % 64, 255 - i]).collect();
        let inside = at.map(|at| at.rem_euclid(150));
        let as_bits = |v: L::F| unsafe { L::store(v) }.map(|v: f32| v.to_bits() as i32);
        let as_numbers = |m: L::M| unsafe { L::store_i(L::only_i(m, L::splat_i(1))) };
        // SAFETY: the caller asked the processor; 200 values and as many words are there.
        unsafe {
            let (lanes, inside) = (L::load_i(&at), L::load_i(&inside));
            let (first, second) = L::pairs(values.as_ptr(), inside);
            // Some lanes, none, and all; what lies behind them may be anything.
            let some = L::below(lanes, 30);
            let front = L::below(L::load_i(&COUNTING), L::bits(some).count_ones() as i32);
            let compressed =
                L::add_i(L::compress_i(some, lanes), L::truncate(L::compress(some, L::to_float(lanes))));
            [
                as_bits(L::pick(values.as_ptr(), lanes)),
                L::store_i(L::pick_words(words.as_ptr(), lanes)),
                as_bits(first),
                as_bits(second),
                as_bits(L::gather(values.as_ptr(), inside)),
                L::store_i(L::gather_words(words.as_ptr(), inside)),
                as_numbers(L::below(lanes, 0)),
                as_numbers(L::below(lanes, 7)),
                as_numbers(L::below(lanes, i32::MAX)),
                as_numbers(L::equal(lanes, L::splat_i(3))),
                L::store_i(L::max_i(lanes, L::splat_i(5))),
                as_bits(L::floor(L::load(&floats))),
                L::store_i(L::only_i(front, compressed)),
            ]
        }
    }

    #[test]
    fn all_levels_do_the_same() {
        for start in (-48..80).chain([i32::MIN, i32::MAX - 40]) {
            let at = std::array::from_fn(|k| start.wrapping_add((k * k % 37) as i32));
            let floats = std::array::from_fn(|k| start as f32 / 8.0 + k as f32 * 1.37);
            let portable = outcomes::<Portable>(at, floats);
            for level in Level::available() {
                let outcomes = match level {
                    Level::Avx512 => outcomes::<Avx512>(at, floats),
                    Level::Avx2 => outcomes::<Avx2>(at, floats),
                    Level::Portable => continue,
                };
                assert_eq!(outcomes, portable, "{level:?} from {start} on");
            }
        }
    }

    #[test]
    fn what_no_integer_holds_lies_at_the_ends() {
        let floats = [1e10, -1e10, f32::INFINITY, f32::NEG_INFINITY];
        let floats = std::array::from_fn(|k| floats[k % 4]);
        // SAFETY: the level was asked for.
        let truncated = |level| unsafe {
            match level {
                Level::Avx512 => Avx512::store_i(Avx512::truncate(Avx512::load(&floats))),
                Level::Avx2 => Avx2::store_i(Avx2::truncate(Avx2::load(&floats))),
                Level::Portable => Portable::store_i(Portable::truncate(Portable::load(&floats))),
            }
        };
        for level in Level::available() {
            assert!(truncated(level).iter().all(|i| [i32::MIN, i32::MAX].contains(i)), "{level:?}");
        }
    }
}
