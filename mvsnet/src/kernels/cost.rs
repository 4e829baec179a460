//! Warping and cost of one column of the cost volume (paper section 3.2, equations 1 and 2).
//!
//! Along its depths a pixel's samples move slowly through each source, so the features around them are in the
//! nearest cache, and no warped feature is ever stored.
#![expect(unsafe_code, reason = "gathers from feature maps, with the positions clamped before")]
#![allow(unsafe_op_in_unsafe_fn, reason = "the contract of each kernel covers its body as a whole")]

use nalgebra::{Matrix3, Matrix3x4, Vector3};

use rayon::prelude::*;

use super::aligned::Aligned;
use super::simd::{LANES, Level, Simd, by_level};
use super::slab::{COLUMN_START, Shape, Slab};
use crate::CostMetric;

/// Channels of the features.
pub(crate) const CHANNELS: usize = 32;
const _: () = assert!(CHANNELS == 2 * LANES);

/// Features with channels innermost, within a border of one pixel of zeros.
#[derive(Debug)]
pub(crate) struct FeatureMap {
    width: usize,
    height: usize,
    data: Aligned,
}

impl FeatureMap {
    /// From a slab with columns `[y][channel][x]`.
    ///
    /// # Panics
    /// When it does not have 32 channels.
    pub(crate) fn new(slab: &Slab) -> Self {
        let Shape { columns: height, channels, length: width } = slab.shape();
        assert_eq!(channels, CHANNELS);
        let mut data = Aligned::zeroed((height + 2) * (width + 2) * CHANNELS);
        let rows = data.values_mut().par_chunks_exact_mut((width + 2) * CHANNELS).skip(1).take(height);
        rows.enumerate().for_each(|(y, row)| {
            for channel in 0..CHANNELS {
                let pixels = row.chunks_exact_mut(CHANNELS).skip(1);
                for (pixel, value) in pixels.zip(slab.channel(y, channel)) {
                    pixel[channel] = *value;
                }
            }
        });
        Self { width, height, data }
    }

    pub(crate) fn width(&self) -> usize {
        self.width
    }

    pub(crate) fn height(&self) -> usize {
        self.height
    }

    pub(super) fn values(&self) -> &[f32] {
        self.data.values()
    }

    /// Bytes it holds.
    pub(crate) fn bytes(&self) -> usize {
        size_of_val(self.data.values())
    }

    /// From a row to the next, in pixels.
    pub(super) fn pitch(&self) -> usize {
        self.width + 2
    }
}

/// Where reference pixels lie in a source at a depth `d`: at `A x + b / d`.
///
/// With projections `[M_1 | m_1]` and `[M_i | m_i]`, `A = M_i M_1^-1` and `b = m_i - A m_1`, which is
/// equation 1 with its slips put right. The third component is the depth in the source divided by `d`.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PixelSweep {
    pub(super) rotation: Matrix3<f64>,
    pub(super) offset: Vector3<f64>,
}

impl PixelSweep {
    /// Between feature cameras `K [R | t]`; `None` when the reference's matrix has no inverse.
    pub(crate) fn new(reference: &Matrix3x4<f64>, source: &Matrix3x4<f64>) -> Option<Self> {
        let inverse = reference.fixed_view::<3, 3>(0, 0).into_owned().try_inverse()?;
        let rotation = source.fixed_view::<3, 3>(0, 0) * inverse;
        Some(Self { rotation, offset: source.column(3) - rotation * reference.column(3) })
    }
}

/// What the cost of one reference view is computed from.
#[derive(Debug)]
pub(crate) struct CostInput<'a> {
    pub(crate) reference: &'a FeatureMap,
    pub(crate) sources: Vec<(&'a FeatureMap, PixelSweep)>,
    /// One over each depth.
    pub(crate) inverse_depths: Vec<f64>,
    pub(crate) metric: CostMetric,
}

/// Where each depth of one pixel lies in one source: the pixel above and left of it in the bordered map (the bits of
/// a `u32`), then the bilinear weights of that pixel and of those right, below, and right below, which are zero
/// outside; five parts, each of the padded number of depths.
pub(super) type Samples = Vec<f32>;

/// Memory for one pixel.
#[derive(Debug, Default)]
pub(crate) struct CostScratch {
    samples: Vec<Samples>,
    differences: Vec<f32>,
}

impl CostScratch {
    /// For this many sources and (padded) depths.
    pub(super) fn samples(&mut self, sources: usize, padded: usize) -> &mut [Samples] {
        self.samples.resize_with(sources, Samples::default);
        for samples in &mut self.samples {
            samples.resize(5 * padded, 0.0);
        }
        &mut self.samples
    }

    /// The same, and a feature for each source.
    pub(super) fn samples_and_differences(
        &mut self,
        sources: usize,
        padded: usize,
    ) -> (&mut [Samples], &mut [f32]) {
        self.differences.resize(sources * CHANNELS, 0.0);
        self.samples(sources, padded);
        (&mut self.samples, &mut self.differences)
    }
}

impl CostInput<'_> {
    /// The cost at one pixel and all depths: one column of a slab of 32 channels.
    ///
    /// # Panics
    /// When the pixel is outside the reference or the column has another size.
    pub(crate) fn column(
        &self,
        level: Level,
        x: usize,
        y: usize,
        output: &mut [f32],
        scratch: &mut CostScratch,
    ) {
        let shape = Shape { columns: 1, channels: CHANNELS, length: self.inverse_depths.len() };
        assert!(x < self.reference.width && y < self.reference.height && output.len() == shape.column());
        let samples = scratch.samples(self.sources.len(), shape.padded());
        run(level, &mut Task { input: self, x, y, shape, output, samples });
    }
}

struct Task<'a> {
    input: &'a CostInput<'a>,
    x: usize,
    y: usize,
    shape: Shape,
    output: &'a mut [f32],
    samples: &'a mut [Samples],
}

by_level!(run(task: &mut Task<'_>) = column[][]);

/// # Safety
/// As [`Simd`]; the sizes are those `CostInput::column` makes.
#[inline(always)]
unsafe fn column<S: Simd>(task: &mut Task<'_>) {
    let CostInput { reference, sources, inverse_depths, metric } = task.input;
    for ((map, sweep), samples) in sources.iter().zip(task.samples.iter_mut()) {
        let ray = sweep.rotation * Vector3::new(task.x as f64, task.y as f64, 1.0);
        locate(map, ray, sweep.offset, inverse_depths, samples);
    }
    let pixel = (task.y + 1) * reference.pitch() + task.x + 1;
    let own = reference.data.values().as_ptr().add(pixel * CHANNELS);
    let own = [S::load(own), S::load(own.add(LANES))];
    let share = S::splat(1.0 / (sources.len() + 1) as f32);
    let padded = task.shape.padded();
    for begin in (0..padded).step_by(LANES) {
        let mut costs = [[S::splat(0.0); LANES]; 2];
        for lane in 0..LANES {
            // Differences to the reference's features have the same variance, and smaller sums round less.
            let mut sum = [S::splat(0.0); 2];
            let mut squares = sum;
            for ((map, _), samples) in sources.iter().zip(task.samples.iter()) {
                let sample = samples.as_ptr().add(begin + lane);
                let corner = map.data.values().as_ptr().add((*sample).to_bits() as usize * CHANNELS);
                let below = corner.add(map.pitch() * CHANNELS);
                let w = [1, 2, 3, 4].map(|part: usize| S::splat(*sample.add(part * padded)));
                for half in 0..2 {
                    let offset = half * LANES;
                    let mut v = S::mul(w[0], S::load(corner.add(offset)));
                    v = S::mul_add(w[1], S::load(corner.add(CHANNELS + offset)), v);
                    v = S::mul_add(w[2], S::load(below.add(offset)), v);
                    v = S::mul_add(w[3], S::load(below.add(CHANNELS + offset)), v);
                    let difference = S::sub(v, own[half]);
                    sum[half] = S::add(sum[half], difference);
                    squares[half] = S::mul_add(difference, difference, squares[half]);
                }
            }
            for half in 0..2 {
                let mean = S::mul(sum[half], share);
                costs[half][lane] = match metric {
                    CostMetric::Variance => S::mul(S::sub(squares[half], S::mul(sum[half], mean)), share),
                    CostMetric::Mean => S::add(own[half], mean),
                };
            }
        }
        for (half, costs) in costs.into_iter().enumerate() {
            for (channel, v) in transposed::<S>(costs).into_iter().enumerate() {
                let at = (half * LANES + channel) * task.shape.stride() + COLUMN_START + begin;
                let to = task.output.as_mut_ptr().add(at);
                S::store(to, v);
                for beyond in task.shape.length.max(begin)..begin + LANES {
                    *to.add(beyond - begin) = 0.0;
                }
            }
        }
    }
}

/// Positions are computed in f64: a coordinate in f32 is off by a millionth of the image, which the features
/// of sharp edges show.
///
/// # Safety
/// None beyond the vectors' lengths, which are at least that of the depths; all positions written lie in the
/// bordered map, with their neighbours right and below.
#[inline(always)]
pub(super) unsafe fn locate(
    map: &FeatureMap,
    ray: Vector3<f64>,
    offset: Vector3<f64>,
    inverse_depths: &[f64],
    samples: &mut [f32],
) {
    let (width, height, pitch) = (map.width as f64, map.height as f64, map.pitch() as f64);
    let count = inverse_depths.len();
    let (pixel, weights) = samples.split_at_mut(samples.len() / 5);
    let mut weights = weights.chunks_exact_mut(pixel.len());
    let pixel = &mut pixel[..count];
    let mut part = || &mut weights.next().expect("there are four")[..count];
    let (w0, w1, w2, w3) = (part(), part(), part(), part());
    #[allow(clippy::needless_bitwise_bool, reason = "branches would keep the loop from being vectorised")]
    for i in 0..count {
        let s = inverse_depths[i];
        let depth = ray.z + offset.z * s;
        let scale = 1.0 / depth;
        let u = (ray.x + offset.x * s) * scale;
        let v = (ray.y + offset.y * s) * scale;
        // No number is outside, too.
        let inside = (depth > 0.0) & (u > -1.0) & (u < width) & (v > -1.0) & (v < height);
        let (u, v) = (if inside { u } else { -1.0 }, if inside { v } else { -1.0 });
        let (left, top) = (u.floor(), v.floor());
        let (right, bottom) = ((u - left) as f32, (v - top) as f32);
        let weight = if inside { 1.0 } else { 0.0 };
        let place = ((top + 1.0) * pitch + (left + 1.0)).to_int_unchecked::<i32>();
        pixel[i] = f32::from_bits(place as u32);
        w0[i] = weight * (1.0 - right) * (1.0 - bottom);
        w1[i] = weight * right * (1.0 - bottom);
        w2[i] = weight * (1.0 - right) * bottom;
        w3[i] = weight * right * bottom;
    }
}

/// Transposes 16 x 16 values: each of four rounds rotates the eight bits of a value's place by one.
#[inline(always)]
pub(super) unsafe fn transposed<S: Simd>(mut rows: [S::V; LANES]) -> [S::V; LANES] {
    for _ in 0..4 {
        let mut next = rows;
        for i in 0..8 {
            (next[2 * i], next[2 * i + 1]) = S::interleave(rows[i], rows[i + 8]);
        }
        rows = next;
    }
    rows
}
