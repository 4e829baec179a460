//! The lanes of a 512-bit register.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of the trait covers each body as a whole")]

#[allow(clippy::wildcard_imports, reason = "the intrinsics have a namespace of their own")]
use std::arch::x86_64::*;

use super::lanes::{LANES, Lanes};

/// 512-bit registers, with masks.
pub(crate) struct Avx512;

/// # Safety
/// The processor has AVX-512 F, BW, DQ and VL.
impl Lanes for Avx512 {
    type F = __m512;
    type I = __m512i;
    type M = __mmask16;

    #[inline(always)]
    unsafe fn splat(value: f32) -> __m512 {
        _mm512_set1_ps(value)
    }
    #[inline(always)]
    unsafe fn load(from: &[f32; LANES]) -> __m512 {
        _mm512_loadu_ps(from.as_ptr())
    }
    #[inline(always)]
    unsafe fn store(v: __m512) -> [f32; LANES] {
        let mut lanes = [0.0; LANES];
        _mm512_storeu_ps(lanes.as_mut_ptr(), v);
        lanes
    }
    #[inline(always)]
    unsafe fn add(a: __m512, b: __m512) -> __m512 {
        _mm512_add_ps(a, b)
    }
    #[inline(always)]
    unsafe fn sub(a: __m512, b: __m512) -> __m512 {
        _mm512_sub_ps(a, b)
    }
    #[inline(always)]
    unsafe fn mul(a: __m512, b: __m512) -> __m512 {
        _mm512_mul_ps(a, b)
    }
    #[inline(always)]
    unsafe fn div(a: __m512, b: __m512) -> __m512 {
        _mm512_div_ps(a, b)
    }
    #[inline(always)]
    unsafe fn mul_add(a: __m512, b: __m512, c: __m512) -> __m512 {
        _mm512_fmadd_ps(a, b, c)
    }
    #[inline(always)]
    unsafe fn mul_sub_from(a: __m512, b: __m512, c: __m512) -> __m512 {
        _mm512_fnmadd_ps(a, b, c)
    }
    #[inline(always)]
    unsafe fn abs(a: __m512) -> __m512 {
        _mm512_abs_ps(a)
    }
    #[inline(always)]
    unsafe fn sqrt(a: __m512) -> __m512 {
        _mm512_sqrt_ps(a)
    }
    #[inline(always)]
    unsafe fn floor(a: __m512) -> __m512 {
        _mm512_roundscale_ps::<{ _MM_FROUND_TO_NEG_INF | _MM_FROUND_NO_EXC }>(a)
    }
    #[inline(always)]
    unsafe fn less(a: __m512, b: __m512) -> __mmask16 {
        _mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b)
    }
    #[inline(always)]
    unsafe fn and(a: __mmask16, b: __mmask16) -> __mmask16 {
        a & b
    }
    #[inline(always)]
    unsafe fn or(a: __mmask16, b: __mmask16) -> __mmask16 {
        a | b
    }
    #[inline(always)]
    unsafe fn but_not(a: __mmask16, b: __mmask16) -> __mmask16 {
        a & !b
    }
    #[inline(always)]
    unsafe fn bits(m: __mmask16) -> u32 {
        m.into()
    }
    #[inline(always)]
    unsafe fn select(m: __mmask16, a: __m512, b: __m512) -> __m512 {
        _mm512_mask_blend_ps(m, b, a)
    }
    #[inline(always)]
    unsafe fn only(m: __mmask16, v: __m512) -> __m512 {
        _mm512_maskz_mov_ps(m, v)
    }
    #[inline(always)]
    unsafe fn splat_i(value: i32) -> __m512i {
        _mm512_set1_epi32(value)
    }
    #[inline(always)]
    unsafe fn load_i(from: &[i32; LANES]) -> __m512i {
        _mm512_loadu_si512(from.as_ptr().cast())
    }
    #[inline(always)]
    unsafe fn store_i(v: __m512i) -> [i32; LANES] {
        let mut lanes = [0; LANES];
        _mm512_storeu_si512(lanes.as_mut_ptr().cast(), v);
        lanes
    }
    #[inline(always)]
    unsafe fn add_i(a: __m512i, b: __m512i) -> __m512i {
        _mm512_add_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn mul_i(a: __m512i, b: __m512i) -> __m512i {
        _mm512_mullo_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn min_i(a: __m512i, b: __m512i) -> __m512i {
        _mm512_min_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn max_i(a: __m512i, b: __m512i) -> __m512i {
        _mm512_max_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn or_i(a: __m512i, b: __m512i) -> __m512i {
        _mm512_or_si512(a, b)
    }
    #[inline(always)]
    unsafe fn only_i(m: __mmask16, v: __m512i) -> __m512i {
        _mm512_maskz_mov_epi32(m, v)
    }
    #[inline(always)]
    unsafe fn sub_i(a: __m512i, b: __m512i) -> __m512i {
        _mm512_sub_epi32(a, b)
    }
    #[inline(always)]
    unsafe fn and_i(a: __m512i, b: __m512i) -> __m512i {
        _mm512_and_si512(a, b)
    }
    #[inline(always)]
    unsafe fn shift_down(v: __m512i, by: __m512i) -> __m512i {
        _mm512_srlv_epi32(v, by)
    }
    #[inline(always)]
    unsafe fn truncate(v: __m512) -> __m512i {
        _mm512_cvttps_epi32(v)
    }
    #[inline(always)]
    unsafe fn to_float(v: __m512i) -> __m512 {
        _mm512_cvtepi32_ps(v)
    }
    #[inline(always)]
    unsafe fn below(a: __m512i, limit: i32) -> __mmask16 {
        _mm512_cmplt_epu32_mask(a, _mm512_set1_epi32(limit))
    }
    #[inline(always)]
    unsafe fn equal(a: __m512i, b: __m512i) -> __mmask16 {
        _mm512_cmpeq_epi32_mask(a, b)
    }
    #[inline(always)]
    unsafe fn select_i(m: __mmask16, a: __m512i, b: __m512i) -> __m512i {
        _mm512_mask_blend_epi32(m, b, a)
    }

    #[inline(always)]
    unsafe fn compress(m: __mmask16, v: __m512) -> __m512 {
        _mm512_maskz_compress_ps(m, v)
    }
    #[inline(always)]
    unsafe fn compress_i(m: __mmask16, v: __m512i) -> __m512i {
        _mm512_maskz_compress_epi32(m, v)
    }

    const PICKS: bool = true;
    #[inline(always)]
    unsafe fn pick(window: *const f32, at: __m512i) -> __m512 {
        let (first, second) = (_mm512_loadu_ps(window), _mm512_loadu_ps(window.add(LANES)));
        _mm512_permutex2var_ps(first, at, second)
    }
    #[inline(always)]
    unsafe fn pick_words(window: *const [u8; 4], at: __m512i) -> __m512i {
        let (first, second) = (window.cast(), window.add(LANES).cast());
        _mm512_permutex2var_epi32(_mm512_loadu_si512(first), at, _mm512_loadu_si512(second))
    }
    #[inline(always)]
    unsafe fn pairs(from: *const f32, at: __m512i) -> (__m512, __m512) {
        let (low, high) = (_mm512_castsi512_si256(at), _mm512_extracti64x4_epi64::<1>(at));
        let low = _mm512_castpd_ps(_mm512_i32gather_pd::<4>(low, from.cast()));
        let high = _mm512_castpd_ps(_mm512_i32gather_pd::<4>(high, from.cast()));
        let even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
        let odd = _mm512_or_si512(even, _mm512_set1_epi32(1));
        (_mm512_permutex2var_ps(low, even, high), _mm512_permutex2var_ps(low, odd, high))
    }
    #[inline(always)]
    unsafe fn gather(from: *const f32, at: __m512i) -> __m512 {
        _mm512_i32gather_ps::<4>(at, from)
    }
    #[inline(always)]
    unsafe fn gather_words(from: *const [u8; 4], at: __m512i) -> __m512i {
        _mm512_i32gather_epi32::<4>(at, from.cast())
    }
    #[inline(always)]
    unsafe fn prefetch<T>(place: *const T) {
        _mm_prefetch::<_MM_HINT_T1>(place.cast());
    }
}
