//! What the gradient of one column of the cost volume says of the features it was made of.
//!
//! Warped features are computed again instead of stored, and what they learn goes at once to the four pixels they
//! were sampled from, which are in the nearest cache.
#![expect(
    unsafe_code,
    reason = "gathers from and scatters to feature maps, with the positions clamped before"
)]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use std::sync::Arc;

use nalgebra::Vector3;

use super::cost::{CHANNELS, CostInput, CostScratch, FeatureMap, Samples, locate, transposed};
use super::simd::{LANES, Level, Simd, by_level};
use super::slab::{Column, Pool, Shape, Slab};
use crate::CostMetric;

/// Gradients of the sources' feature maps, each with channels innermost within a border of one pixel.
#[derive(Debug)]
pub(crate) struct FeatureGradients {
    width: usize,
    height: usize,
    maps: Vec<Slab>,
}

impl FeatureGradients {
    /// Zero, for this many sources of the reference's size.
    pub(crate) fn zeroed(pool: &Arc<Pool>, reference: &FeatureMap, sources: usize) -> Self {
        let (width, height) = (reference.width(), reference.height());
        let shape = Shape { columns: 1, channels: 1, length: (height + 2) * (width + 2) * CHANNELS };
        let map = |_| {
            let mut map = pool.take(shape);
            map.channel_mut(0, 0).fill(0.0);
            map
        };
        Self { width, height, maps: (0..sources).map(map).collect() }
    }

    /// What a source's pixels of a row learned, channels innermost.
    pub(crate) fn row(&self, source: usize, y: usize) -> &[f32] {
        let begin = ((y + 1) * (self.width + 2) + 1) * CHANNELS;
        &self.maps[source].channel(0, 0)[begin..begin + self.width * CHANNELS]
    }
}

impl CostInput<'_> {
    /// Adds what the gradient of the cost at one pixel and all depths says of the sources' features, and gives what
    /// it says of the reference's. All maps have the reference's size.
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
    ) -> [f32; CHANNELS] {
        let (width, height) = (self.reference.width(), self.reference.height());
        let shape = gradient.shape();
        assert!(x < width && y < height && (gradients.width, gradients.height) == (width, height));
        assert!(self.sources.iter().all(|(map, _)| (map.width(), map.height()) == (width, height)));
        assert!(gradients.maps.len() == self.sources.len());
        assert!(shape.channels >= CHANNELS && shape.length == self.inverse_depths.len());
        let (samples, differences) = scratch.samples_and_differences(self.sources.len(), shape.padded());
        let mut own = [0.0; CHANNELS];
        let maps = gradients.maps.iter_mut().map(|map| map.channel_mut(0, 0).as_mut_ptr()).collect();
        run(level, &mut Task { input: self, x, y, gradient, samples, differences, maps, own: &mut own });
        own
    }
}

struct Task<'a> {
    input: &'a CostInput<'a>,
    x: usize,
    y: usize,
    gradient: Column<'a>,
    samples: &'a mut [Samples],
    /// Of each source's feature to the reference's, at one depth.
    differences: &'a mut [f32],
    /// The sources' gradients.
    maps: Vec<*mut f32>,
    own: &'a mut [f32; CHANNELS],
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
    let scale = S::splat(if *metric == CostMetric::Variance { 2.0 * share } else { share });
    let share = S::splat(share);
    let gradient = task.gradient.as_ptr();
    let own = reference.values().as_ptr().add(pixel);
    let own = [S::load(own), S::load(own.add(LANES))];
    let differences = task.differences.as_mut_ptr();
    let mut own_gradient = [S::splat(0.0); 2];
    for begin in (0..shape.length).step_by(LANES) {
        let mut by_depth = [[S::splat(0.0); LANES]; 2];
        for half in 0..2 {
            for channel in 0..LANES {
                let channel_at = (half * LANES + channel) * shape.stride();
                by_depth[half][channel] = S::load(gradient.add(channel_at + begin));
            }
            by_depth[half] = transposed::<S>(by_depth[half]);
        }
        for lane in 0..LANES.min(shape.length - begin) {
            // What the mean of all views' differences to the reference is.
            let mut mean = [S::splat(0.0); 2];
            if *metric == CostMetric::Variance {
                for (source, ((map, _), samples)) in sources.iter().zip(task.samples.iter()).enumerate() {
                    let sample = samples.as_ptr().add(begin + lane);
                    let features = sampled::<S>(map, sample, padded, pitch);
                    for half in 0..2 {
                        let difference = S::sub(features[half], own[half]);
                        S::store(differences.add((2 * source + half) * LANES), difference);
                        mean[half] = S::add(mean[half], difference);
                    }
                }
                mean = [S::mul(mean[0], share), S::mul(mean[1], share)];
            }
            let scaled = [S::mul(by_depth[0][lane], scale), S::mul(by_depth[1][lane], scale)];
            for (source, samples) in task.samples.iter().enumerate() {
                let sample = samples.as_ptr().add(begin + lane);
                let mut learned = scaled;
                if *metric == CostMetric::Variance {
                    for half in 0..2 {
                        let difference = S::load(differences.add((2 * source + half) * LANES));
                        learned[half] = S::mul(scaled[half], S::sub(difference, mean[half]));
                    }
                }
                let to = *task.maps.get_unchecked(source);
                let to = to.add((*sample).to_bits() as usize * CHANNELS);
                for (part, corner) in [0, CHANNELS, pitch, pitch + CHANNELS].into_iter().enumerate() {
                    let weight = S::splat(*sample.add((part + 1) * padded));
                    for half in 0..2 {
                        let to = to.add(corner + half * LANES);
                        S::store(to, S::mul_add(weight, learned[half], S::load(to)));
                    }
                }
            }
            for half in 0..2 {
                own_gradient[half] = match metric {
                    // The reference's own difference is zero.
                    CostMetric::Variance => S::sub(own_gradient[half], S::mul(scaled[half], mean[half])),
                    CostMetric::Mean => S::add(own_gradient[half], scaled[half]),
                };
            }
        }
    }
    for half in 0..2 {
        S::store(task.own.as_mut_ptr().add(half * LANES), own_gradient[half]);
    }
}

/// The channels of a feature, bilinear.
#[inline(always)]
unsafe fn sampled<S: Simd>(map: &FeatureMap, sample: *const f32, padded: usize, pitch: usize) -> [S::V; 2] {
    let corner = map.values().as_ptr().add((*sample).to_bits() as usize * CHANNELS);
    let mut values = [S::splat(0.0); 2];
    for (part, from) in [0, CHANNELS, pitch, pitch + CHANNELS].into_iter().enumerate() {
        let weight = S::splat(*sample.add((part + 1) * padded));
        for half in 0..2 {
            values[half] = S::mul_add(weight, S::load(corner.add(from + half * LANES)), values[half]);
        }
    }
    values
}
