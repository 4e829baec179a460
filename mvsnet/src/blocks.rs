//! The feature network of the paper's ablation: one layer of 7x7 with stride 4 and padding 3, without batch
//! normalisation and ReLU.
//!
//! An image seen as blocks of 4x4 pixels has 48 channels at a quarter of its size, and the layer becomes one of
//! 3x3 with stride 1 over them, for which there are kernels.

use std::sync::Arc;

use crate::input::InputImage;
use crate::kernels::slab::{Pool, Shape, Slab};

/// Pixels along the side of a block: the layer's stride.
const SIDE: usize = 4;
/// Taps along the side of the layer's kernel.
const TAPS: usize = 7;
/// Taps along the side of the kernel over blocks.
const BLOCK_TAPS: usize = 3;
/// Channels of blocks: those of an image for each pixel of a block.
pub(crate) const CHANNELS: usize = 3 * SIDE * SIDE;

/// The blocks of an image, with channels `[color][row in the block][column in the block]`.
pub(crate) fn blocks(pool: &Arc<Pool>, image: &InputImage) -> Slab {
    let InputImage { width, height, planes } = image;
    let mut slab = pool.take(shape(image));
    for (channel, plane) in planes.chunks_exact(width * height).enumerate() {
        for (y, row) in plane.chunks_exact(*width).enumerate() {
            for column in 0..SIDE {
                let to = slab.channel_mut(y / SIDE, (channel * SIDE + y % SIDE) * SIDE + column);
                for (to, from) in to.iter_mut().zip(row[column..].iter().step_by(SIDE)) {
                    *to = *from;
                }
            }
        }
    }
    slab
}

/// The shape of the blocks of an image.
pub(crate) fn shape(image: &InputImage) -> Shape {
    Shape { columns: image.height / SIDE, channels: CHANNELS, length: image.width / SIDE }
}

/// Where the layer's kernel `[output][color][7][7]` has the tap that the kernel over blocks has for an output, a
/// channel of the blocks, and a row and column of the 3x3 blocks; `None` where the layer does not reach.
pub(crate) fn tap(output: usize, channel: usize, row: usize, column: usize) -> Option<usize> {
    let color = channel / (SIDE * SIDE);
    // The middle block begins at the pixel that the kernel is centred on, its tap 3.
    let along = |block: usize, pixel: usize| {
        (SIDE * block + pixel).checked_sub(SIDE - TAPS / 2).filter(|tap| *tap < TAPS)
    };
    let (y, x) = (along(row, channel / SIDE % SIDE)?, along(column, channel % SIDE)?);
    Some(((output * 3 + color) * TAPS + y) * TAPS + x)
}

/// The kernel over blocks `[output][channel][3][3]`, from the layer's.
pub(crate) fn expanded(kernel: &[f32], outputs: usize) -> Vec<f32> {
    taps(outputs).map(|tap| tap.map_or(0.0, |tap| kernel[tap])).collect()
}

/// The gradient of the layer's kernel, from that of the kernel over blocks.
pub(crate) fn contracted(gradient: &[f32], outputs: usize) -> Vec<f32> {
    let mut kernel = vec![0.0; outputs * 3 * TAPS * TAPS];
    for (tap, value) in taps(outputs).zip(gradient) {
        if let Some(tap) = tap {
            kernel[tap] += value;
        }
    }
    kernel
}

/// [`tap`] of all values of the kernel over blocks, in their order.
fn taps(outputs: usize) -> impl Iterator<Item = Option<usize>> {
    (0..outputs * CHANNELS * BLOCK_TAPS * BLOCK_TAPS).map(|at| {
        let (pair, row, column) = (at / 9, at / BLOCK_TAPS % BLOCK_TAPS, at % BLOCK_TAPS);
        tap(pair / CHANNELS, pair % CHANNELS, row, column)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_tap_of_the_layer_meets_its_pixel_once() {
        let kernel: Vec<f32> = (0..2 * 3 * 49).map(|value| value as f32 + 1.0).collect();
        let expanded = expanded(&kernel, 2);
        assert_eq!(expanded.iter().filter(|value| **value != 0.0).count(), kernel.len());
        assert_eq!(contracted(&expanded, 2), kernel);
        // Output 1, green, three rows up and two columns to the right of the centre.
        let at = ((CHANNELS + 16 + 4 + 2) * 3) * 3 + 1;
        assert_eq!(expanded[at], kernel[((3 + 1) * 7) * 7 + 5]);
    }
}
