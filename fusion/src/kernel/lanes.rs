//! Eight lanes, as the processor at hand has them.
//!
//! The kernel is written once over [`Lanes`]. No operation is fused or approximated, so the bits are the same
//! with the vector instructions of the processor and with the safe [`Portable`] ones.

/// Lanes of a vector.
pub(crate) const LANES: usize = 8;

/// Operations on eight lanes.
///
/// # Safety
/// Of every method: the processor has the implementor's instructions. Of those that read at indices, too:
/// every index is one of the slice, as the method says. Methods are inlined into functions that enable
/// the instructions.
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
    /// The byte above the lowest `BITS` bits.
    unsafe fn byte<const BITS: i32>(v: Self::I) -> Self::I;
    /// Towards 0. What no `i32` holds becomes any integer.
    unsafe fn truncate(v: Self::F) -> Self::I;
    unsafe fn to_float(v: Self::I) -> Self::F;

    /// The values at each index.
    unsafe fn gather(from: &[f32], index: Self::I) -> Self::F;
    /// The values at each index and at the next one, which is one of the slice, too.
    unsafe fn gather_pairs(from: &[f32], index: Self::I) -> (Self::F, Self::F);
    /// Red, green and blue of the pixels at each index, in the three lowest bytes; the highest means nothing. There
    /// are at least two pixels.
    unsafe fn gather_rgb(from: &[[u8; 3]], index: Self::I) -> Self::I;
}

/// Arrays, for every processor.
pub(crate) struct Portable;

#[inline(always)]
fn each<A: Copy, B: Copy, C>(a: [A; LANES], b: [B; LANES], f: impl Fn(A, B) -> C) -> [C; LANES] {
    std::array::from_fn(|k| f(a[k], b[k]))
}

/// # Safety
/// Nothing is asked of the processor, and indices are checked.
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
    unsafe fn byte<const BITS: i32>(v: Self::I) -> Self::I {
        v.map(|v| v >> BITS & 255)
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
    unsafe fn gather(from: &[f32], index: Self::I) -> Self::F {
        index.map(|i| from[i as usize])
    }
    #[inline(always)]
    unsafe fn gather_pairs(from: &[f32], index: Self::I) -> (Self::F, Self::F) {
        (index.map(|i| from[i as usize]), index.map(|i| from[i as usize + 1]))
    }
    #[inline(always)]
    unsafe fn gather_rgb(from: &[[u8; 3]], index: Self::I) -> Self::I {
        index.map(|i| {
            let [r, g, b] = from[i as usize];
            i32::from_le_bytes([r, g, b, 0])
        })
    }
}
