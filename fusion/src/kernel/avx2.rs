//! The lanes of two 256-bit registers.
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of the trait covers each body as a whole")]

#[allow(clippy::wildcard_imports, reason = "the intrinsics have a namespace of their own")]
use std::arch::x86_64::*;

use super::lanes::{LANES, Lanes};

/// 256-bit registers, two of them for a vector.
pub(crate) struct Avx2;

/// Lanes of a register.
const HALF: usize = LANES / 2;

/// Of eight bits, the numbers of those that are set; behind them zeros.
static LANES_OF_BITS: [[u8; HALF]; 1 << HALF] = lanes_of_bits();

const fn lanes_of_bits() -> [[u8; HALF]; 1 << HALF] {
    let mut lanes = [[0; HALF]; 1 << HALF];
    let mut bits = 0;
    while bits < lanes.len() {
        let (mut lane, mut count) = (0, 0);
        while lane < HALF {
            if bits >> lane & 1 == 1 {
                lanes[bits][count] = lane as u8;
                count += 1;
            }
            lane += 1;
        }
        bits += 1;
    }
    lanes
}

/// An operation on both registers of its arguments.
macro_rules! both {
    ($operation:expr; $($v:expr),*) => { [$operation($($v[0]),*), $operation($($v[1]),*)] };
}

/// # Safety
/// The processor has AVX2 and FMA.
impl Lanes for Avx2 {
    type F = [__m256; 2];
    type I = [__m256i; 2];
    type M = [__m256; 2];

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self::F {
        [_mm256_set1_ps(value); 2]
    }
    #[inline(always)]
    unsafe fn load(from: &[f32; LANES]) -> Self::F {
        [_mm256_loadu_ps(from.as_ptr()), _mm256_loadu_ps(from.as_ptr().add(HALF))]
    }
    #[inline(always)]
    unsafe fn store(v: Self::F) -> [f32; LANES] {
        let mut lanes = [0.0; LANES];
        _mm256_storeu_ps(lanes.as_mut_ptr(), v[0]);
        _mm256_storeu_ps(lanes.as_mut_ptr().add(HALF), v[1]);
        lanes
    }
    #[inline(always)]
    unsafe fn add(a: Self::F, b: Self::F) -> Self::F {
        both!(_mm256_add_ps; a, b)
    }
    #[inline(always)]
    unsafe fn sub(a: Self::F, b: Self::F) -> Self::F {
        both!(_mm256_sub_ps; a, b)
    }
    #[inline(always)]
    unsafe fn mul(a: Self::F, b: Self::F) -> Self::F {
        both!(_mm256_mul_ps; a, b)
    }
    #[inline(always)]
    unsafe fn div(a: Self::F, b: Self::F) -> Self::F {
        both!(_mm256_div_ps; a, b)
    }
    #[inline(always)]
    unsafe fn mul_add(a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        both!(_mm256_fmadd_ps; a, b, c)
    }
    #[inline(always)]
    unsafe fn mul_sub_from(a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        both!(_mm256_fnmadd_ps; a, b, c)
    }
    #[inline(always)]
    unsafe fn abs(a: Self::F) -> Self::F {
        both!(_mm256_andnot_ps; [_mm256_set1_ps(-0.0); 2], a)
    }
    #[inline(always)]
    unsafe fn sqrt(a: Self::F) -> Self::F {
        both!(_mm256_sqrt_ps; a)
    }
    #[inline(always)]
    unsafe fn floor(a: Self::F) -> Self::F {
        both!(_mm256_floor_ps; a)
    }
    #[inline(always)]
    unsafe fn less(a: Self::F, b: Self::F) -> Self::M {
        both!(_mm256_cmp_ps::<_CMP_LT_OQ>; a, b)
    }
    #[inline(always)]
    unsafe fn and(a: Self::M, b: Self::M) -> Self::M {
        both!(_mm256_and_ps; a, b)
    }
    #[inline(always)]
    unsafe fn or(a: Self::M, b: Self::M) -> Self::M {
        both!(_mm256_or_ps; a, b)
    }
    #[inline(always)]
    unsafe fn but_not(a: Self::M, b: Self::M) -> Self::M {
        both!(_mm256_andnot_ps; b, a)
    }
    #[inline(always)]
    unsafe fn bits(m: Self::M) -> u32 {
        _mm256_movemask_ps(m[0]) as u32 | (_mm256_movemask_ps(m[1]) as u32) << HALF
    }
    #[inline(always)]
    unsafe fn select(m: Self::M, a: Self::F, b: Self::F) -> Self::F {
        both!(_mm256_blendv_ps; b, a, m)
    }
    #[inline(always)]
    unsafe fn only(m: Self::M, v: Self::F) -> Self::F {
        both!(_mm256_and_ps; m, v)
    }
    #[inline(always)]
    unsafe fn splat_i(value: i32) -> Self::I {
        [_mm256_set1_epi32(value); 2]
    }
    #[inline(always)]
    unsafe fn load_i(from: &[i32; LANES]) -> Self::I {
        [_mm256_loadu_si256(from.as_ptr().cast()), _mm256_loadu_si256(from.as_ptr().add(HALF).cast())]
    }
    #[inline(always)]
    unsafe fn store_i(v: Self::I) -> [i32; LANES] {
        let mut lanes = [0; LANES];
        _mm256_storeu_si256(lanes.as_mut_ptr().cast(), v[0]);
        _mm256_storeu_si256(lanes.as_mut_ptr().add(HALF).cast(), v[1]);
        lanes
    }
    #[inline(always)]
    unsafe fn add_i(a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_add_epi32; a, b)
    }
    #[inline(always)]
    unsafe fn mul_i(a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_mullo_epi32; a, b)
    }
    #[inline(always)]
    unsafe fn min_i(a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_min_epi32; a, b)
    }
    #[inline(always)]
    unsafe fn max_i(a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_max_epi32; a, b)
    }
    #[inline(always)]
    unsafe fn or_i(a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_or_si256; a, b)
    }
    #[inline(always)]
    unsafe fn only_i(m: Self::M, v: Self::I) -> Self::I {
        [_mm256_and_si256(_mm256_castps_si256(m[0]), v[0]), _mm256_and_si256(_mm256_castps_si256(m[1]), v[1])]
    }
    #[inline(always)]
    unsafe fn sub_i(a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_sub_epi32; a, b)
    }
    #[inline(always)]
    unsafe fn and_i(a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_and_si256; a, b)
    }
    #[inline(always)]
    unsafe fn shift_down(v: Self::I, by: Self::I) -> Self::I {
        both!(_mm256_srlv_epi32; v, by)
    }
    #[inline(always)]
    unsafe fn truncate(v: Self::F) -> Self::I {
        both!(_mm256_cvttps_epi32; v)
    }
    #[inline(always)]
    unsafe fn to_float(v: Self::I) -> Self::F {
        both!(_mm256_cvtepi32_ps; v)
    }
    #[inline(always)]
    unsafe fn below(a: Self::I, limit: i32) -> Self::M {
        let limit = [_mm256_set1_epi32(limit); 2];
        let is_beyond = Self::equal(both!(_mm256_max_epu32; a, limit), a);
        Self::but_not(Self::equal(a, a), is_beyond)
    }
    #[inline(always)]
    unsafe fn equal(a: Self::I, b: Self::I) -> Self::M {
        both!(_mm256_castsi256_ps; both!(_mm256_cmpeq_epi32; a, b))
    }
    #[inline(always)]
    unsafe fn select_i(m: Self::M, a: Self::I, b: Self::I) -> Self::I {
        both!(_mm256_blendv_epi8; b, a, both!(_mm256_castps_si256; m))
    }
    #[inline(always)]
    unsafe fn pairs(from: *const f32, at: Self::I) -> (Self::F, Self::F) {
        let [(a, b), (c, d)] = [Self::eight_pairs(from, at[0]), Self::eight_pairs(from, at[1])];
        ([a, c], [b, d])
    }
    #[inline(always)]
    unsafe fn gather(from: *const f32, at: Self::I) -> Self::F {
        both!(_mm256_castsi256_ps; Self::gather_words(from.cast(), at))
    }
    #[inline(always)]
    unsafe fn gather_words(from: *const [u8; 4], at: Self::I) -> Self::I {
        [Self::eight_words(from, at[0]), Self::eight_words(from, at[1])]
    }
    #[inline(always)]
    unsafe fn compress(m: Self::M, v: Self::F) -> Self::F {
        let bits = [_mm256_movemask_ps(m[0]) as usize, _mm256_movemask_ps(m[1]) as usize];
        // The second half comes behind what is left of the first, over what is not.
        let mut lanes = [0.0; LANES];
        _mm256_storeu_ps(lanes.as_mut_ptr(), Self::eight_compressed(v[0], bits[0]));
        let behind = lanes.as_mut_ptr().add(bits[0].count_ones() as usize);
        _mm256_storeu_ps(behind, Self::eight_compressed(v[1], bits[1]));
        Self::load(&lanes)
    }
    #[inline(always)]
    unsafe fn compress_i(m: Self::M, v: Self::I) -> Self::I {
        // No arithmetic is done with these floats.
        let compressed = Self::compress(m, both!(_mm256_castsi256_ps; v));
        both!(_mm256_castps_si256; compressed)
    }
    #[inline(always)]
    unsafe fn prefetch<T>(place: *const T) {
        _mm_prefetch::<_MM_HINT_T1>(place.cast());
    }
}

impl Avx2 {
    /// The lanes whose bits are set, at the front.
    #[inline(always)]
    unsafe fn eight_compressed(v: __m256, bits: usize) -> __m256 {
        let order = _mm_loadl_epi64(LANES_OF_BITS[bits % LANES_OF_BITS.len()].as_ptr().cast());
        _mm256_permutevar8x32_ps(v, _mm256_cvtepu8_epi32(order))
    }

    /// The values at `at` from `from` on, and those behind them. Each pair is loaded for itself: that takes fewer steps of
    /// the processor than its own gathering.
    #[inline(always)]
    unsafe fn eight_pairs(from: *const f32, at: __m256i) -> (__m256, __m256) {
        let mut lanes = [0_i32; HALF];
        _mm256_storeu_si256(lanes.as_mut_ptr().cast(), at);
        let pair = |k: usize| from.add(lanes[k] as usize).cast::<f64>().read_unaligned();
        // Two lanes of each four come first, for shuffles work within quarters.
        let first = _mm256_setr_pd(pair(0), pair(1), pair(4), pair(5));
        let second = _mm256_setr_pd(pair(2), pair(3), pair(6), pair(7));
        let (first, second) = (_mm256_castpd_ps(first), _mm256_castpd_ps(second));
        (_mm256_shuffle_ps::<0b10_00_10_00>(first, second), _mm256_shuffle_ps::<0b11_01_11_01>(first, second))
    }

    /// The words at `at` from `from` on, for the same reason each for itself.
    #[inline(always)]
    unsafe fn eight_words(from: *const [u8; 4], at: __m256i) -> __m256i {
        let mut lanes = [0_i32; HALF];
        _mm256_storeu_si256(lanes.as_mut_ptr().cast(), at);
        let [a, b, c, d, e, f, g, h] = lanes.map(|at| i32::from_le_bytes(from.add(at as usize).read()));
        _mm256_setr_epi32(a, b, c, d, e, f, g, h)
    }
}
