//! The lanes of a 512-bit register.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of the trait covers each body as a whole")]

#[allow(clippy::wildcard_imports, reason = "the intrinsics have a namespace of their own")]
use std::arch::x86_64::*;

use super::lanes::{LANES, Lanes, Pairs};

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
    unsafe fn load_pairs(from: &Pairs) -> (__m512, __m512) {
        let from = from.0.as_ptr().cast::<f32>();
        let (first, second) = (_mm512_load_ps(from), _mm512_load_ps(from.add(LANES)));
        (_mm512_shuffle_ps::<0b10_00_10_00>(first, second), _mm512_shuffle_ps::<0b11_01_11_01>(first, second))
    }
    #[inline(always)]
    unsafe fn prefetch<T>(place: *const T) {
        _mm_prefetch::<_MM_HINT_T1>(place.cast());
    }
}
