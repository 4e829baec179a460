//! What the gradient of one column of the cost volume says of the features it was made of.
//!
//! Warped features are computed again instead of stored, and what they learn goes at once to the four pixels they
//! were sampled from, which are in the nearest cache.
#![expect(
    unsafe_code,
    reason = "gathers from and scatters to feature maps, with the positions clamped before"
)]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use nalgebra::Vector3;

use super::aligned::Aligned;
use super::cost::{CHANNELS, CostInput, CostScratch, FeatureMap, Samples, locate, transposed};
use super::simd::{LANES, Level, Simd, by_level};
use super::slab::{Column, Slab};
use crate::CostMetric;

/// Gradients of feature maps, the reference's first, each with channels innermost within a border of one pixel.
#[derive(Debug)]
pub(crate) struct FeatureGradients {
    width: usize,
    height: usize,
    maps: Vec<Aligned>,
}

impl FeatureGradients {
    /// Zero, for this many views of the reference's size.
    pub(crate) fn zeroed(reference: &FeatureMap, views: usize) -> Self {
        let (width, height) = (reference.width(), reference.height());
        let map = || Aligned::zeroed((height + 2) * (width + 2) * CHANNELS);
        Self { width, height, maps: (0..views).map(|_| map()).collect() }
    }

    /// Adds those of other columns.
    pub(crate) fn add(&mut self, other: &Self) {
        for (map, other) in self.maps.iter_mut().zip(&other.maps) {
            for (value, other) in map.values_mut().iter_mut().zip(other.values()) {
                *value += other;
            }
        }
    }

    /// Writes those of one view into a slab with columns `[y][channel][x]`.
    pub(crate) fn write(&self, view: usize, slab: &mut Slab) {
        let pitch = (self.width + 2) * CHANNELS;
        for y in 0..self.height {
            let row = &self.maps[view].values()[(y + 1) * pitch + CHANNELS..];
            for channel in 0..CHANNELS {
                for (value, pixel) in slab.channel_mut(y, channel).iter_mut().zip(row.chunks_exact(CHANNELS))
                {
                    *value = pixel[channel];
                }
            }
        }
    }
}

impl CostInput<'_> {
    /// Adds what the gradient of the cost at one pixel and all depths says of the features. All maps have the
    /// reference's size.
    ///
    /// # Panics
    /// When the pixel is outside the reference, or sizes do not fit.
    pub(crate) fn column_gradient(
        &self,
        level: Level,
        [x, y]: [usize; 2],
        gradient: Column<'_>,
        scratch: &mut CostScratch,
        gradients: &mut FeatureGradients,
    ) {
        let (width, height) = (self.reference.width(), self.reference.height());
        let shape = gradient.shape();
        assert!(x < width && y < height && (gradients.width, gradients.height) == (width, height));
        assert!(self.sources.iter().all(|(map, _)| (map.width(), map.height()) == (width, height)));
        assert!(gradients.maps.len() == self.sources.len() + 1);
        assert!(shape.channels >= CHANNELS && shape.length == self.inverse_depths.len());
        let samples = scratch.samples(self.sources.len(), shape.padded());
        run(level, &mut Task { input: self, x, y, gradient, samples, gradients });
    }
}

struct Task<'a> {
    input: &'a CostInput<'a>,
    x: usize,
    y: usize,
    gradient: Column<'a>,
    samples: &'a mut [Samples],
    gradients: &'a mut FeatureGradients,
}

by_level!(run(task: &mut Task<'_>) = column[][]);

/// # Safety
/// As [`Simd`]; the sizes are those `column_gradient` checks, and positions lie in the bordered maps.
#[inline(always)]
unsafe fn column<S: Simd>(task: &mut Task<'_>) {
    let CostInput { reference, sources, inverse_depths, metric } = task.input;
    for ((map, sweep), samples) in sources.iter().zip(task.samples.iter_mut()) {
        let ray = sweep.rotation * Vector3::new(task.x as f64, task.y as f64, 1.0);
        locate(map, ray, sweep.offset, inverse_depths, samples);
    }
    let shape = task.gradient.shape();
    let padded = shape.padded();
    let pitch = reference.pitch() * CHANNELS;
    let pixel = ((task.y + 1) * reference.pitch() + task.x + 1) * CHANNELS;
    let share = 1.0 / (sources.len() + 1) as f32;
    let gradient = task.gradient.as_ptr();
    for half in 0..2 {
        let channels = half * LANES;
        let own = S::load(reference.values().as_ptr().add(pixel + channels));
        let mut own_gradient = S::splat(0.0);
        for begin in (0..shape.length).step_by(LANES) {
            let mut rows = [S::splat(0.0); LANES];
            for lane in 0..LANES {
                rows[lane] = S::load(gradient.add((channels + lane) * shape.stride() + begin));
            }
            let by_depth = transposed::<S>(rows);
            for lane in 0..LANES.min(shape.length - begin) {
                let g = by_depth[lane];
                // What the mean of all views' differences to the reference is.
                let mut mean = S::splat(0.0);
                if *metric == CostMetric::Variance {
                    for ((map, _), samples) in sources.iter().zip(task.samples.iter()) {
                        let sample = samples.as_ptr().add(begin + lane);
                        let difference = S::sub(sampled::<S>(map, sample, padded, channels, pitch), own);
                        mean = S::add(mean, difference);
                    }
                    mean = S::mul(mean, S::splat(share));
                }
                let scale = match metric {
                    CostMetric::Variance => S::mul(g, S::splat(2.0 * share)),
                    CostMetric::Mean => S::mul(g, S::splat(share)),
                };
                for (view, ((map, _), samples)) in sources.iter().zip(task.samples.iter()).enumerate() {
                    let sample = samples.as_ptr().add(begin + lane);
                    let weights = [1, 2, 3, 4].map(|part: usize| *sample.add(part * padded));
                    let learned = match metric {
                        CostMetric::Variance => {
                            let difference = S::sub(sampled::<S>(map, sample, padded, channels, pitch), own);
                            S::mul(scale, S::sub(difference, mean))
                        }
                        CostMetric::Mean => scale,
                    };
                    let to = task.gradients.maps.get_unchecked_mut(view + 1).values_mut().as_mut_ptr();
                    let to = to.add((*sample).to_bits() as usize * CHANNELS + channels);
                    for (corner, weight) in [0, CHANNELS, pitch, pitch + CHANNELS].into_iter().zip(weights) {
                        let to = to.add(corner);
                        S::store(to, S::mul_add(S::splat(weight), learned, S::load(to)));
                    }
                }
                own_gradient = match metric {
                    // The reference's own difference is zero.
                    CostMetric::Variance => S::sub(own_gradient, S::mul(scale, mean)),
                    CostMetric::Mean => S::add(own_gradient, scale),
                };
            }
        }
        let to = task.gradients.maps[0].values_mut().as_mut_ptr().add(pixel + channels);
        S::store(to, S::add(S::load(to), own_gradient));
    }
}

/// Sixteen channels of a feature, bilinear.
#[inline(always)]
unsafe fn sampled<S: Simd>(
    map: &FeatureMap,
    sample: *const f32,
    padded: usize,
    channels: usize,
    pitch: usize,
) -> S::V {
    let corner = map.values().as_ptr().add((*sample).to_bits() as usize * CHANNELS + channels);
    let weight = |part: usize| S::splat(*sample.add(part * padded));
    let mut value = S::mul(weight(1), S::load(corner));
    value = S::mul_add(weight(2), S::load(corner.add(CHANNELS)), value);
    value = S::mul_add(weight(3), S::load(corner.add(pitch)), value);
    S::mul_add(weight(4), S::load(corner.add(pitch + CHANNELS)), value)
}
