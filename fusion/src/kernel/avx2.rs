//! The lanes of a 256-bit register.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of the trait covers each body as a whole")]

#[allow(clippy::wildcard_imports, reason = "the intrinsics have a namespace of their own")]
use std::arch::x86_64::*;

use super::lanes::{LANES, Lanes};

/// 256-bit registers.
pub(crate) struct Avx2;

/// # Safety
/// The processor has AVX2. Where memory is read, the caller vouches for the indices.
impl Lanes for Avx2 {
    type F = __m256;
    type I = __m256i;
    type M = __m256;

    #[inline(always)]
    unsafe fn splat(value: f32) -> __m256 {
        _mm256_set1_ps(value)
    }
    #[inline(always)]
    unsafe fn load(from: &[f32; LANES]) -> __m256 {
        _mm256_loadu_ps(from.as_ptr())
    }
    #[inline(always)]
    unsafe fn store(v: __m256) -> [f32; LANES] {
        let mut lanes = [0.0; LANES];
        _mm256_storeu_ps(lanes.as_mut_ptr(), v);
        lanes
    }
    #[inline(always)]
    unsafe fn add(a: __m256, b: __m256) -> __m256 {
        _mm256_add_ps(a, b)
    }
    #[inline(always)]
    unsafe fn sub(a: __m256, b: __m256) -> __m256 {
        _mm256_sub_ps(a, b)
    }
    #[inline(always)]
    unsafe fn mul(a: __m256, b: __m256) -> __m256 {
        _mm256_mul_ps(a, b)
    }
    #[inline(always)]
    unsafe fn div(a: __m256, b: __m256) -> __m256 {
        _mm256_div_ps(a, b)
    }
    #[inline(always)]
    unsafe fn abs(a: __m256) -> __m256 {
        _mm256_andnot_ps(_mm256_set1_ps(-0.0), a)
    }
    #[inline(always)]
    unsafe fn sqrt(a: __m256) -> __m256 {
        _mm256_sqrt_ps(a)
    }
    #[inline(always)]
    unsafe fn floor(a: __m256) -> __m256 {
        _mm256_floor_ps(a)
    }
    #[inline(always)]
    unsafe fn less(a: __m256, b: __m256) -> __m256 {
        _mm256_cmp_ps::<_CMP_LT_OQ>(a, b)
    }
    #[inline(always)]
    unsafe fn and(a: __m256, b: __m256) -> __m256 {
        _mm256_and_ps(a, b)
    }
    #[inline(always)]
    unsafe fn or(a: __m256, b: __m256) -> __m256 {
        _mm256_or_ps(a, b)
    }
    #[inline(always)]
    unsafe fn but_not(a: __m256, b: __m256) -> __m256 {
        _mm256_andnot_ps(b, a)
    }
    #[inline(always)]
    unsafe fn bits(m: __m256) -> u32 {
        _mm256_movemask_ps(m) as u32
    }
    #[inline(always)]
    unsafe fn select(m: __m256, a: __m256, b: __m256) -> __m256 {
        _mm256_blendv_ps(b, a, m)
    }
    #[inline(always)]
    unsafe fn only(m: __m256, v: __m256) -> __m256 {
        _mm256_and_ps(m, v)
    }
    #[inline(always)]
    unsafe fn splat_i(value: i32) -> __m256i {
        _mm256_set1_epi32(value)
    }
    #[inline(always)]
    unsafe fn load_i(from: &[i32; LANES]) -> __m256i {
        _mm256_loadu_si256(from.as_ptr().cast())
    }
    #[inline(always)]
    unsafe fn store_i(v: __m256i) -> [i32; LANES] {
        let mut lanes = [0; LANES];
        _mm256_storeu_si256(lanes.as_mut_ptr().cast(), v);
        lanes
    }
    #[inline(always)]
    unsafe fn add_i(a: __m256i, b: __m256i) -> __m256i {
        _mm256_add_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn mul_i(a: __m256i, b: __m256i) -> __m256i {
        _mm256_mullo_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn min_i(a: __m256i, b: __m256i) -> __m256i {
        _mm256_min_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn max_i(a: __m256i, b: __m256i) -> __m256i {
        _mm256_max_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn or_i(a: __m256i, b: __m256i) -> __m256i {
        _mm256_or_si256(a, b)
    }
    #[inline(always)]
    unsafe fn only_i(m: __m256, v: __m256i) -> __m256i {
        _mm256_and_si256(_mm256_castps_si256(m), v)
    }
    #[inline(always)]
    unsafe fn byte<const BITS: i32>(v: __m256i) -> __m256i {
        _mm256_and_si256(_mm256_srli_epi32::<BITS>(v), _mm256_set1_epi32(255))
    }
    #[inline(always)]
    unsafe fn truncate(v: __m256) -> __m256i {
        _mm256_cvttps_epi32(v)
    }
    #[inline(always)]
    unsafe fn to_float(v: __m256i) -> __m256 {
        _mm256_cvtepi32_ps(v)
    }
    // Loads one by one: the processor's own gathers take several times as long on some.
    #[inline(always)]
    unsafe fn gather(from: &[f32], index: __m256i) -> __m256 {
        let from = from.as_ptr();
        let [a, b, c, d, e, f, g, h] = indices(index);
        prefetch(from.wrapping_add(a));
        // SAFETY: each index is one of the slice.
        _mm256_setr_ps(
            *from.add(a),
            *from.add(b),
            *from.add(c),
            *from.add(d),
            *from.add(e),
            *from.add(f),
            *from.add(g),
            *from.add(h),
        )
    }
    #[inline(always)]
    unsafe fn gather_pairs(from: &[f32], index: __m256i) -> (__m256, __m256) {
        let [a, b, c, d, e, f, g, h] = indices(index);
        prefetch(from.as_ptr().wrapping_add(a));
        // Halves of pairs come to their places below.
        // SAFETY: each index and the next are of the slice.
        let first = four_pairs(from.as_ptr(), [a, b, e, f]);
        let second = four_pairs(from.as_ptr(), [c, d, g, h]);
        (_mm256_shuffle_ps::<0b10_00_10_00>(first, second), _mm256_shuffle_ps::<0b11_01_11_01>(first, second))
    }
    #[inline(always)]
    unsafe fn gather_rgb(from: &[[u8; 3]], index: __m256i) -> __m256i {
        let bytes = from.as_flattened();
        let offset = _mm256_add_epi32(index, _mm256_add_epi32(index, index));
        // Four bytes are read: those of the last pixel with the one before.
        let at = _mm256_min_epi32(offset, _mm256_set1_epi32(bytes.len() as i32 - 4));
        let [a, b, c, d, e, f, g, h] = indices(at);
        let bytes = bytes.as_ptr();
        prefetch(bytes.wrapping_add(a));
        // SAFETY: each index is one of the slice, which has four bytes or more.
        let four = _mm256_setr_epi32(
            bytes.add(a).cast::<i32>().read_unaligned(),
            bytes.add(b).cast::<i32>().read_unaligned(),
            bytes.add(c).cast::<i32>().read_unaligned(),
            bytes.add(d).cast::<i32>().read_unaligned(),
            bytes.add(e).cast::<i32>().read_unaligned(),
            bytes.add(f).cast::<i32>().read_unaligned(),
            bytes.add(g).cast::<i32>().read_unaligned(),
            bytes.add(h).cast::<i32>().read_unaligned(),
        );
        _mm256_srlv_epi32(four, _mm256_slli_epi32::<3>(_mm256_sub_epi32(offset, at)))
    }
}

/// The lanes, none of them negative, in general registers: the way through memory takes longer.
///
/// # Safety
/// The processor has AVX2.
#[inline(always)]
unsafe fn indices(v: __m256i) -> [usize; LANES] {
    let (low, high) = (_mm256_castsi256_si128(v), _mm256_extracti128_si256::<1>(v));
    let first = _mm_cvtsi128_si64(low) as u64;
    let second = _mm_extract_epi64::<1>(low) as u64;
    let third = _mm_cvtsi128_si64(high) as u64;
    let fourth = _mm_extract_epi64::<1>(high) as u64;
    [
        first as u32 as usize,
        (first >> 32) as usize,
        second as u32 as usize,
        (second >> 32) as usize,
        third as u32 as usize,
        (third >> 32) as usize,
        fourth as u32 as usize,
        (fourth >> 32) as usize,
    ]
}

/// The values at each index with the next one.
///
/// # Safety
/// Both are readable; the processor has AVX2.
#[inline(always)]
unsafe fn four_pairs(from: *const f32, [a, b, c, d]: [usize; 4]) -> __m256 {
    let low = _mm_load_sd(from.add(a).cast());
    let low = _mm_loadh_pd(low, from.add(b).cast());
    let high = _mm_load_sd(from.add(c).cast());
    let high = _mm_loadh_pd(high, from.add(d).cast());
    _mm256_castpd_ps(_mm256_set_m128d(high, low))
}

/// Has the processor fetch what lies `AHEAD` of a place: the next hypotheses of the row are likely to read it, and
/// it cannot foresee the rows of all neighbours by itself.
#[inline(always)]
unsafe fn prefetch<T>(place: *const T) {
    const AHEAD: usize = 160;
    _mm_prefetch::<_MM_HINT_T0>(place.cast::<i8>().wrapping_add(AHEAD));
}
