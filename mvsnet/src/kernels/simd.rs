//! Sixteen f32 lanes, as the processor at hand has them.
//!
//! Every kernel is written once over [`Simd`]; lanes never mix but where a method says so. With a fused
//! multiply-add in hardware (AVX-512, AVX2 with FMA) the results are the same to the bit.
#![expect(unsafe_code, reason = "vector instructions take pointers and need a check of the processor")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of the trait covers each body as a whole")]

/// Lanes of a vector.
pub(crate) const LANES: usize = 16;

/// The widest instructions a kernel may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Level {
    /// 512-bit registers.
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// 256-bit registers and fused multiply-add.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// What every target has.
    Portable,
}

impl Level {
    /// The best of this processor.
    pub(crate) fn detect() -> Self {
        *Self::available().last().expect("every processor has the portable level")
    }

    /// All that this processor has, the best last.
    pub(crate) fn available() -> Vec<Self> {
        let mut levels = vec![Self::Portable];
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            levels.push(Self::Avx2);
            if is_x86_feature_detected!("avx512f") {
                levels.push(Self::Avx512);
            }
        }
        levels
    }
}

/// Makes `fn $name(level, arguments)` of a generic body, compiled once for each level. The numbers are the
/// body's block sizes at each level, which follow from the number of registers.
macro_rules! by_level {
    ($name:ident($arguments:ident: $type:ty) = $body:ident[$($wide:literal),*][$($narrow:literal),*]) => {
        #[inline]
        fn $name(level: $crate::kernels::simd::Level, $arguments: $type) {
            use $crate::kernels::simd::{Level, Portable};
            #[cfg(target_arch = "x86_64")]
            {
                use $crate::kernels::simd::{Avx2, Avx512};
                #[target_feature(enable = "avx512f,avx2,fma")]
                unsafe fn avx512($arguments: $type) {
                    unsafe { $body::<Avx512, $($wide),*>($arguments) }
                }
                #[target_feature(enable = "avx2,fma")]
                unsafe fn avx2($arguments: $type) {
                    unsafe { $body::<Avx2, $($narrow),*>($arguments) }
                }
                // SAFETY: a level other than the portable one comes from `Level::available`, which asked the
                // processor; what the body asks of its arguments, the caller of this function has checked.
                match level {
                    Level::Avx512 => return unsafe { avx512($arguments) },
                    Level::Avx2 => return unsafe { avx2($arguments) },
                    Level::Portable => {}
                }
            }
            let _ = level;
            // SAFETY: as above, and the portable level needs nothing of the processor.
            unsafe { $body::<Portable, $($narrow),*>($arguments) }
        }
    };
}
pub(crate) use by_level;

/// Calls a block over all pairs of vectors of a padded axis: as many at a time as `WIDEST` and what is left allow, where
/// four are better taken as two and two.
macro_rules! by_width {
    ($pairs:expr, $widest:ident, $block:ident::<$simd:ident, $outputs:ident>($task:ident)) => {
        let (pairs, mut at) = ($pairs, 0);
        while at < pairs {
            let left = pairs - at;
            if $widest >= 3 && (left == 3 || left > 4) {
                $block::<$simd, $outputs, 3>($task, at);
                at += 3;
            } else if $widest >= 2 && left >= 2 {
                $block::<$simd, $outputs, 2>($task, at);
                at += 2;
            } else {
                $block::<$simd, $outputs, 1>($task, at);
                at += 1;
            }
        }
    };
}
pub(crate) use by_width;

/// Operations on sixteen lanes.
///
/// # Safety
/// Of every method: the processor has the implementor's instructions, and pointers are valid for sixteen
/// values, of any alignment. Methods are inlined into functions that enable the instructions.
pub(crate) trait Simd {
    type V: Copy;

    unsafe fn splat(value: f32) -> Self::V;
    unsafe fn load(from: *const f32) -> Self::V;
    unsafe fn store(to: *mut f32, v: Self::V);
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V;
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V;
    /// `a * b + c`, fused where the processor can.
    unsafe fn mul_add(a: Self::V, b: Self::V, c: Self::V) -> Self::V;
    /// The greater; `b` where a lane of `a` is no number.
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V;
    /// `v` where `gate` is positive, otherwise zero.
    unsafe fn where_positive(gate: Self::V, v: Self::V) -> Self::V;
    /// Lanes 0, 2, 4 ... of the 32 lanes of `a`, then `b`.
    unsafe fn even(a: Self::V, b: Self::V) -> Self::V;
    /// Lanes 1, 3, 5 ... of the 32 lanes of `a`, then `b`.
    unsafe fn odd(a: Self::V, b: Self::V) -> Self::V;
    /// `a0 b0 a1 b1 ... a15 b15` in two vectors.
    unsafe fn interleave(a: Self::V, b: Self::V) -> (Self::V, Self::V);
}

/// The processor's 512-bit registers.
#[cfg(target_arch = "x86_64")]
pub(crate) struct Avx512;

/// Pairs of 256-bit registers.
#[cfg(target_arch = "x86_64")]
pub(crate) struct Avx2;

/// Arrays, for the compiler to vectorise.
pub(crate) struct Portable;

#[cfg(target_arch = "x86_64")]
mod x86 {
    #[allow(clippy::wildcard_imports, reason = "the intrinsics have a namespace of their own")]
    use std::arch::x86_64::*;

    use super::{Avx2, Avx512, Simd};

    impl Simd for Avx512 {
        type V = __m512;

        #[inline(always)]
        unsafe fn splat(value: f32) -> __m512 {
            _mm512_set1_ps(value)
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> __m512 {
            _mm512_loadu_ps(from)
        }
        #[inline(always)]
        unsafe fn store(to: *mut f32, v: __m512) {
            _mm512_storeu_ps(to, v);
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
        unsafe fn mul_add(a: __m512, b: __m512, c: __m512) -> __m512 {
            _mm512_fmadd_ps(a, b, c)
        }
        #[inline(always)]
        unsafe fn max(a: __m512, b: __m512) -> __m512 {
            _mm512_max_ps(a, b)
        }
        #[inline(always)]
        unsafe fn where_positive(gate: __m512, v: __m512) -> __m512 {
            _mm512_maskz_mov_ps(_mm512_cmp_ps_mask::<_CMP_GT_OQ>(gate, _mm512_setzero_ps()), v)
        }
        #[inline(always)]
        unsafe fn even(a: __m512, b: __m512) -> __m512 {
            let lanes = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
            _mm512_permutex2var_ps(a, lanes, b)
        }
        #[inline(always)]
        unsafe fn odd(a: __m512, b: __m512) -> __m512 {
            let lanes = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
            _mm512_permutex2var_ps(a, lanes, b)
        }
        #[inline(always)]
        unsafe fn interleave(a: __m512, b: __m512) -> (__m512, __m512) {
            let low = _mm512_setr_epi32(0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
            let high = _mm512_setr_epi32(8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
            (_mm512_permutex2var_ps(a, low, b), _mm512_permutex2var_ps(a, high, b))
        }
    }

    impl Simd for Avx2 {
        type V = [__m256; 2];

        #[inline(always)]
        unsafe fn splat(value: f32) -> Self::V {
            [_mm256_set1_ps(value); 2]
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self::V {
            [_mm256_loadu_ps(from), _mm256_loadu_ps(from.add(8))]
        }
        #[inline(always)]
        unsafe fn store(to: *mut f32, v: Self::V) {
            _mm256_storeu_ps(to, v[0]);
            _mm256_storeu_ps(to.add(8), v[1]);
        }
        #[inline(always)]
        unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
            [_mm256_add_ps(a[0], b[0]), _mm256_add_ps(a[1], b[1])]
        }
        #[inline(always)]
        unsafe fn sub(a: Self::V, b: Self::V) -> Self::V {
            [_mm256_sub_ps(a[0], b[0]), _mm256_sub_ps(a[1], b[1])]
        }
        #[inline(always)]
        unsafe fn mul(a: Self::V, b: Self::V) -> Self::V {
            [_mm256_mul_ps(a[0], b[0]), _mm256_mul_ps(a[1], b[1])]
        }
        #[inline(always)]
        unsafe fn mul_add(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
            [_mm256_fmadd_ps(a[0], b[0], c[0]), _mm256_fmadd_ps(a[1], b[1], c[1])]
        }
        #[inline(always)]
        unsafe fn max(a: Self::V, b: Self::V) -> Self::V {
            [_mm256_max_ps(a[0], b[0]), _mm256_max_ps(a[1], b[1])]
        }
        #[inline(always)]
        unsafe fn where_positive(gate: Self::V, v: Self::V) -> Self::V {
            let half = |gate, v| _mm256_and_ps(_mm256_cmp_ps::<_CMP_GT_OQ>(gate, _mm256_setzero_ps()), v);
            [half(gate[0], v[0]), half(gate[1], v[1])]
        }
        #[inline(always)]
        unsafe fn even(a: Self::V, b: Self::V) -> Self::V {
            [pick::<0b10_00_10_00>(a), pick::<0b10_00_10_00>(b)]
        }
        #[inline(always)]
        unsafe fn odd(a: Self::V, b: Self::V) -> Self::V {
            [pick::<0b11_01_11_01>(a), pick::<0b11_01_11_01>(b)]
        }
        #[inline(always)]
        unsafe fn interleave(a: Self::V, b: Self::V) -> (Self::V, Self::V) {
            (zip(a[0], b[0]), zip(a[1], b[1]))
        }
    }

    /// Two lanes of each 128-bit quarter, in order.
    #[inline(always)]
    unsafe fn pick<const WHICH: i32>(v: [__m256; 2]) -> __m256 {
        let mixed = _mm256_castps_pd(_mm256_shuffle_ps::<WHICH>(v[0], v[1]));
        _mm256_castpd_ps(_mm256_permute4x64_pd::<0b11_01_10_00>(mixed))
    }

    #[inline(always)]
    unsafe fn zip(a: __m256, b: __m256) -> [__m256; 2] {
        let (low, high) = (_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
        [_mm256_permute2f128_ps::<0x20>(low, high), _mm256_permute2f128_ps::<0x31>(low, high)]
    }
}

impl Simd for Portable {
    type V = [f32; LANES];

    #[inline(always)]
    unsafe fn splat(value: f32) -> Self::V {
        [value; LANES]
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self::V {
        from.cast::<Self::V>().read_unaligned()
    }
    #[inline(always)]
    unsafe fn store(to: *mut f32, v: Self::V) {
        to.cast::<Self::V>().write_unaligned(v);
    }
    #[inline(always)]
    unsafe fn add(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] + b[i])
    }
    #[inline(always)]
    unsafe fn sub(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] - b[i])
    }
    #[inline(always)]
    unsafe fn mul(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| a[i] * b[i])
    }
    #[inline(always)]
    unsafe fn mul_add(a: Self::V, b: Self::V, c: Self::V) -> Self::V {
        // Fusing in software would cost ten times as much.
        std::array::from_fn(|i| a[i] * b[i] + c[i])
    }
    #[inline(always)]
    unsafe fn max(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| if a[i] > b[i] { a[i] } else { b[i] })
    }
    #[inline(always)]
    unsafe fn where_positive(gate: Self::V, v: Self::V) -> Self::V {
        std::array::from_fn(|i| if gate[i] > 0.0 { v[i] } else { 0.0 })
    }
    #[inline(always)]
    unsafe fn even(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| if i < 8 { a[2 * i] } else { b[2 * i - 16] })
    }
    #[inline(always)]
    unsafe fn odd(a: Self::V, b: Self::V) -> Self::V {
        std::array::from_fn(|i| if i < 8 { a[2 * i + 1] } else { b[2 * i - 15] })
    }
    #[inline(always)]
    unsafe fn interleave(a: Self::V, b: Self::V) -> (Self::V, Self::V) {
        let of = |i: usize| if i.is_multiple_of(2) { a[i / 2] } else { b[i / 2] };
        (std::array::from_fn(of), std::array::from_fn(|i| of(i + LANES)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Case {
        a: [f32; 16],
        b: [f32; 16],
        out: Vec<[f32; 16]>,
    }

    unsafe fn shuffles<S: Simd>(case: &mut Case) {
        let (a, b) = (S::load(case.a.as_ptr()), S::load(case.b.as_ptr()));
        let (low, high) = S::interleave(a, b);
        let from_two = S::sub(a, S::splat(2.0));
        let all = [S::even(a, b), S::odd(a, b), low, high, S::max(a, b), from_two];
        for v in all.into_iter().chain([S::where_positive(from_two, b)]) {
            let mut out = [0.0; 16];
            S::store(out.as_mut_ptr(), v);
            case.out.push(out);
        }
    }
    by_level!(run(case: &mut Case) = shuffles[][]);

    #[test]
    fn lanes_go_to_the_same_places_at_every_level() {
        let (a, b) = (std::array::from_fn(|i| i as f32), std::array::from_fn(|i| 31.0 - i as f32));
        let results: Vec<_> = Level::available()
            .into_iter()
            .map(|level| {
                let mut case = Case { a, b, out: Vec::new() };
                run(level, &mut case);
                case.out
            })
            .collect();
        assert!(results.windows(2).all(|pair| pair[0] == pair[1]));
        assert_eq!(results[0][0][..9], [0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 31.0]);
        assert_eq!(results[0][2][..4], [0.0, 31.0, 1.0, 30.0]);
        assert_eq!(results[0][3][14..], [15.0, 16.0]);
        assert_eq!(results[0][6][..5], [0.0, 0.0, 0.0, 28.0, 27.0]);
    }
}
