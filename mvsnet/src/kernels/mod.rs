//! The network's inner loops for processors without a GPU: the only code here that is bound by arithmetic.
//!
//! Each kernel is generic over [`simd::Simd`] and compiled for AVX-512, AVX2 and any other processor; the
//! level is chosen when the program runs. Data lies in [`slab`]s. Sums have one order, whatever the level,
//! the number of threads or the rows at a time.

#![allow(
    clippy::inline_always,
    reason = "instructions are enabled by the function that a kernel is inlined into"
)]
#![allow(clippy::needless_range_loop, reason = "indices name registers, and loops over them must unroll")]

mod aligned;
pub(crate) mod correlate;
pub(crate) mod cost;
pub(crate) mod cost_gradient;
pub(crate) mod normalize;
pub(crate) mod regress;
pub(crate) mod simd;
pub(crate) mod slab;
pub(crate) mod strided;
#[cfg(test)]
mod tests;
pub(crate) mod transposed;
pub(crate) mod winograd;
pub(crate) mod winograd_gradient;
pub(crate) mod winograd_volume;
