//! Layers of images: features (paper section 3.1) and refinement (section 3.3).
//!
//! A slab's columns are image rows, so its contiguous axis is x.

use std::sync::Arc;

use rayon::prelude::*;

use super::layers::FeatureLayers;
use crate::blocks::blocks;
use crate::input::InputImage;
use crate::kernels::cost::FeatureMap;
use crate::kernels::slab::{Pool, Shape, Slab};
use crate::kernels::strided::StridedLayer;
use crate::kernels::winograd::{Target, WinogradLayer};

/// The features of an image at a quarter of its size.
pub(crate) fn features(pool: &Arc<Pool>, layers: &FeatureLayers, image: &InputImage) -> FeatureMap {
    let layers = match layers {
        FeatureLayers::Paper(layers) => layers,
        FeatureLayers::Single(layer) => {
            return FeatureMap::new(&same_size(pool, layer, &blocks(pool, image)));
        }
    };
    let mut slab = to_slab(pool, image);
    for layer in &layers.full {
        slab = same_size(pool, layer, &slab);
    }
    slab = half_size(pool, &layers.to_half, &slab);
    for layer in &layers.half {
        slab = same_size(pool, layer, &slab);
    }
    slab = half_size(pool, &layers.to_quarter, &slab);
    for layer in &layers.quarter {
        slab = same_size(pool, layer, &slab);
    }
    FeatureMap::new(&slab)
}

/// Bytes of the slabs that [`features`] takes from its pool for an image of this (padded) size.
pub(crate) fn features_bytes(width: usize, height: usize) -> usize {
    let slab =
        |divisor, channels| Shape { columns: height / divisor, channels, length: width / divisor }.bytes();
    slab(1, 3) + 2 * (slab(1, 8) + slab(2, 16) + slab(4, 32))
}

/// Bytes of the slabs that [`refined`] takes for a depth map of this size.
pub(super) fn refined_bytes(width: usize, rows: usize) -> usize {
    let slab = |channels| Shape { columns: rows, channels, length: width }.bytes();
    slab(4) + 2 * slab(32) + slab(8)
}

fn to_slab(pool: &Arc<Pool>, image: &InputImage) -> Slab {
    let InputImage { width, height, planes } = image;
    let mut slab = pool.take(Shape { columns: *height, channels: 3, length: *width });
    for (channel, plane) in planes.chunks_exact(width * height).enumerate() {
        for (y, row) in plane.chunks_exact(*width).enumerate() {
            slab.channel_mut(y, channel).copy_from_slice(row);
        }
    }
    slab
}

/// A 3x3 layer. The number of rows is even.
fn same_size(pool: &Arc<Pool>, layer: &WinogradLayer, input: &Slab) -> Slab {
    let shape = Shape { channels: layer.outputs, ..input.shape() };
    let mut output = pool.take(shape);
    let pairs = output.columns_mut().par_chunks_exact_mut(2 * shape.column()).enumerate();
    pairs.for_each_init(
        || layer.scratch(),
        |scratch, (pair, columns)| {
            let y = 2 * pair as isize;
            let input = [y - 1, y, y + 1, y + 2].map(|y| input.column(y));
            layer.accumulate(input, &mut [Target { columns, tap: 0, first: true, last: true }], scratch);
        },
    );
    output
}

/// A 5x5 layer of stride 2.
fn half_size(pool: &Arc<Pool>, layer: &StridedLayer, input: &Slab) -> Slab {
    let from = input.shape();
    let shape = Shape { columns: from.columns / 2, channels: layer.outputs, length: from.length.div_ceil(2) };
    let mut output = pool.take(shape);
    output.columns_mut().par_chunks_exact_mut(shape.column()).enumerate().for_each(|(y, column)| {
        let rows = (0..5).map(|tap| (2 * y as isize + tap as isize - 2, tap));
        let inside = rows.filter(|(y, _)| (0..from.columns as isize).contains(y));
        let columns: Vec<_> = inside.map(|(y, tap)| (input.column(y), tap)).collect();
        layer.apply(&columns, column);
    });
    output
}

/// The refined depth of some rows, all of them scaled to [0, 1]. Takes `[row][x]` of the scaled depth and the
/// guide's three channels `[channel][row][x]`; the number of rows is even.
pub(crate) fn refined(layers: &[WinogradLayer; 4], width: usize, depth: &[f64], guide: &[f32]) -> Vec<f64> {
    let pool = &Arc::<Pool>::default();
    let rows = depth.len() / width;
    let mut slab = pool.take(Shape { columns: rows, channels: 4, length: width });
    for y in 0..rows {
        for channel in 0..3 {
            let row = &guide[(channel * rows + y) * width..][..width];
            slab.channel_mut(y, channel).copy_from_slice(row);
        }
        for (value, depth) in slab.channel_mut(y, 3).iter_mut().zip(&depth[y * width..]) {
            *value = *depth as f32;
        }
    }
    for layer in layers {
        slab = same_size(pool, layer, &slab);
    }
    let residual = (0..rows).flat_map(|y| slab.channel(y, 0));
    depth.iter().zip(residual).map(|(depth, residual)| depth + f64::from(*residual)).collect()
}
