//! Values of a layer: the rows of a volume, or the images of several views.

use std::sync::Arc;

use rayon::prelude::*;

use crate::bands::Row;
use crate::kernels::simd::Level;
use crate::kernels::slab::{Pool, Shape, Slab};

/// Slabs of one shape. In a volume they are neighbours, with columns `[x][channel][depth]`; images know nothing
/// of each other, with columns `[y][channel][x]`.
#[derive(Clone, Debug)]
pub(super) struct Stack {
    pub(super) slabs: Vec<Row>,
    pub(super) shape: Shape,
}

/// What all layers need: memory that is used again, and the instructions at hand.
#[derive(Clone, Debug)]
pub(super) struct Tools {
    pub(super) pool: Arc<Pool>,
    pub(super) level: Level,
}

impl Stack {
    pub(super) fn new(slabs: Vec<Row>) -> Self {
        let shape = slabs[0].shape();
        Self { slabs, shape }
    }

    /// Computes every slab.
    pub(super) fn compute(
        tools: &Tools,
        count: usize,
        shape: Shape,
        write: impl Fn(usize, &mut Slab) + Sync,
    ) -> Self {
        let slab = |i: usize| {
            let mut slab = tools.pool.take(shape);
            write(i, &mut slab);
            Arc::new(slab)
        };
        Self { slabs: (0..count).into_par_iter().map(slab).collect(), shape }
    }

    /// Computes every column of every slab: number of the slab, of the column, the column.
    pub(super) fn compute_columns(
        tools: &Tools,
        count: usize,
        shape: Shape,
        write: impl Fn(usize, usize, &mut [f32]) + Sync,
    ) -> Self {
        Self::compute(tools, count, shape, |i, slab| {
            let columns = slab.columns_mut().par_chunks_exact_mut(shape.column()).enumerate();
            columns.with_min_len(8).for_each(|(x, column)| write(i, x, column));
        })
    }

    /// The slabs, which nobody else holds, to be changed.
    pub(super) fn slabs_mut(&mut self) -> impl IndexedParallelIterator<Item = &mut Slab> {
        self.slabs.par_iter_mut().map(|slab| Arc::get_mut(slab).expect("the stack owns its slabs"))
    }

    /// Values of each channel.
    pub(super) fn values_per_channel(&self) -> usize {
        self.slabs.len() * self.shape.columns * self.shape.length
    }
}
