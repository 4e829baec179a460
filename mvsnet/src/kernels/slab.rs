//! The layout that all kernels share: columns of channels of a long, contiguous axis.
//!
//! A row of a volume is a slab of columns `[x][channel][depth]`; a whole image is one with columns
//! `[y][channel][x]`. Kernels vectorise along the last axis. Around the values lie zeros, which nobody
//! ever overwrites, so that convolutions need no case for the border.
use std::collections::HashMap;
use std::ops::Range;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::aligned::Aligned;
use super::simd::LANES;

/// Zeros before each channel, which are also those after the channel before it.
const PAD: usize = LANES;
/// Columns of zeros before the first column: a 5x5 kernel looks back by two.
const FRONT: usize = 2;
/// And after the last.
const BACK: usize = 1;
/// Values after the last column that kernels may read (and discard) in the last channel.
const SLACK: usize = 8 * LANES;

/// Sizes of a slab.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Shape {
    pub(crate) columns: usize,
    pub(crate) channels: usize,
    pub(crate) length: usize,
}

impl Shape {
    /// Values stored of each channel; those from `length` on are zero.
    pub(crate) fn padded(self) -> usize {
        self.length.next_multiple_of(2 * LANES)
    }

    /// From a channel to the next.
    pub(crate) fn stride(self) -> usize {
        self.padded() + PAD
    }

    /// From a column to the next.
    pub(crate) fn column(self) -> usize {
        self.channels * self.stride()
    }

    /// Where a value of a writable column lies.
    pub(crate) fn value(self, channel: usize, at: usize) -> usize {
        COLUMN_START + channel * self.stride() + at
    }

    /// Bytes of a slab.
    pub(crate) fn bytes(self) -> usize {
        self.floats() * size_of::<f32>()
    }

    fn floats(self) -> usize {
        ((FRONT + self.columns + BACK) * self.column() + PAD + SLACK).next_multiple_of(LANES)
    }
}

/// A slab with its zeros. Its memory goes back to where it came from.
#[derive(Debug)]
pub(crate) struct Slab {
    shape: Shape,
    data: Aligned,
    pool: Option<Arc<Pool>>,
}

impl Slab {
    pub(crate) fn zeroed(shape: Shape) -> Self {
        Self { shape, data: Aligned::zeroed(shape.floats()), pool: None }
    }

    pub(crate) fn shape(&self) -> Shape {
        self.shape
    }

    /// The column at `x`, where -2, -1 and `columns` are zero: from its first channel to the end of the memory.
    pub(crate) fn column(&self, x: isize) -> Column<'_> {
        let at = (x + FRONT as isize) as usize * self.shape.column() + PAD;
        let all = self.data.values();
        assert!(x >= -(FRONT as isize) && at + self.shape.column() + SLACK <= all.len() + PAD);
        Column { all, at, shape: self.shape }
    }

    /// Columns `x - 1` to `x + 2`; those beyond the last are zero.
    pub(crate) fn four_columns(&self, x: usize) -> [Column<'_>; 4] {
        let end = self.shape.columns as isize;
        [-1, 0, 1, 2].map(|offset| self.column((x as isize + offset).min(end)))
    }

    /// All columns, each of `Shape::column` values with the zeros of a channel before the channel.
    pub(crate) fn columns_mut(&mut self) -> &mut [f32] {
        let column = self.shape.column();
        &mut self.data.values_mut()[FRONT * column..(FRONT + self.shape.columns) * column]
    }

    /// Some neighbouring columns.
    pub(crate) fn columns(&self, range: Range<usize>) -> Columns<'_> {
        let column = self.shape.column();
        assert!(range.end <= self.shape.columns);
        let values = &self.data.values()[(FRONT + range.start) * column..(FRONT + range.end) * column];
        Columns { values, shape: Shape { columns: range.len(), ..self.shape } }
    }

    /// One channel of one column.
    pub(crate) fn channel_mut(&mut self, column: usize, channel: usize) -> &mut [f32] {
        let shape = self.shape;
        let at = column * shape.column() + channel * shape.stride() + PAD;
        &mut self.columns_mut()[at..at + shape.length]
    }

    /// One channel of one column.
    pub(crate) fn channel(&self, column: usize, channel: usize) -> &[f32] {
        let shape = self.shape;
        let at = (FRONT + column) * shape.column() + channel * shape.stride() + PAD;
        &self.data.values()[at..at + shape.length]
    }
}

#[cfg(test)]
impl Slab {
    /// All values, with the zeros around them.
    pub(super) fn all(&self) -> &[f32] {
        self.data.values()
    }
}

impl Drop for Slab {
    fn drop(&mut self) {
        if let Some(pool) = self.pool.take() {
            let data = std::mem::replace(&mut self.data, Aligned::zeroed(0));
            pool.free().entry(self.shape).or_default().push(data);
        }
    }
}

/// A readable column: its channels follow each other with the shape's stride, with zeros (or values to be
/// discarded) around them.
#[derive(Clone, Copy)]
pub(crate) struct Column<'a> {
    all: &'a [f32],
    at: usize,
    shape: Shape,
}

impl Column<'_> {
    /// The first value of the first channel. Valid for reading from `PAD` before it to `SLACK - PAD` after
    /// the last stored value of the last channel.
    pub(super) fn as_ptr(&self) -> *const f32 {
        self.all[self.at..].as_ptr()
    }

    pub(super) fn shape(&self) -> Shape {
        self.shape
    }
}

/// Readable columns that follow each other.
#[derive(Clone, Copy)]
pub(crate) struct Columns<'a> {
    values: &'a [f32],
    shape: Shape,
}

impl Columns<'_> {
    /// The first value of the first channel of the first column.
    pub(super) fn as_ptr(&self) -> *const f32 {
        self.values[COLUMN_START.min(self.values.len())..].as_ptr()
    }

    pub(super) fn shape(&self) -> Shape {
        self.shape
    }
}

/// Where the values of a writable column's first channel begin.
pub(super) const COLUMN_START: usize = PAD;

/// Slabs that are used again, so that the system need not hand out zeroed pages for each.
#[derive(Debug, Default)]
pub(crate) struct Pool {
    free: Mutex<HashMap<Shape, Vec<Aligned>>>,
    /// Bytes ever allocated, all of which it or its slabs still hold.
    bytes: AtomicUsize,
}

impl Pool {
    /// A slab whose columns hold anything and whose surrounding zeros are zero.
    pub(crate) fn take(self: &Arc<Self>, shape: Shape) -> Slab {
        let free = self.free().get_mut(&shape).and_then(Vec::pop);
        let data = free.unwrap_or_else(|| {
            self.bytes.fetch_add(shape.bytes(), Ordering::Relaxed);
            Aligned::zeroed(shape.floats())
        });
        Slab { shape, data, pool: Some(Arc::clone(self)) }
    }

    /// Bytes it and its slabs hold.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes.load(Ordering::Relaxed)
    }

    fn free(&self) -> MutexGuard<'_, HashMap<Shape, Vec<Aligned>>> {
        self.free.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
