//! Rasters whose rows are written one by one, wherever a thread has time for them.

use std::mem::MaybeUninit;

use planesweep_scene::Raster;
use rayon::prelude::*;

/// A raster to be. Its memory is touched first by the thread that writes a row, just before: clearing all of it on one
/// thread would take a tenth of the filter's time.
pub(super) struct Unwritten<T> {
    width: usize,
    height: usize,
    values: Vec<T>,
}

#[allow(unsafe_code, reason = "values that no thread has written yet have no safe type")]
impl<T: Copy + Default + Send> Unwritten<T> {
    /// Memory for as many values.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, values: Vec::with_capacity(width * height) }
    }

    /// All rows, from the top; each is zeros when it is taken.
    pub fn rows(&mut self) -> impl IndexedParallelIterator<Item = &mut [T]> {
        let pixels = self.width * self.height;
        // A chunk is not empty, though there be none.
        let rows = self.values.spare_capacity_mut()[..pixels].par_chunks_exact_mut(self.width.max(1));
        rows.map(|row| {
            row.fill(MaybeUninit::new(T::default()));
            // SAFETY: all of it was written.
            unsafe { row.assume_init_mut() }
        })
    }

    /// The raster.
    ///
    /// # Safety
    /// Every one of the [`Unwritten::rows`] was taken.
    pub unsafe fn written(mut self) -> Raster<T> {
        let pixels = self.width * self.height;
        // SAFETY: the capacity is that large, and the caller vouches for the values.
        unsafe { self.values.set_len(pixels) };
        Raster::new(self.width, self.height, self.values).expect("as many values as pixels")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[allow(unsafe_code, reason = "it is tested")]
    fn what_rows_are_not_given_is_zeros() {
        for (width, height) in [(3, 2), (1, 5), (0, 4), (4, 0), (0, 0)] {
            let mut raster = Unwritten::new(width, height);
            raster.rows().enumerate().for_each(|(y, row)| {
                if y % 2 == 1 {
                    row[0] = y as u16;
                }
            });
            // SAFETY: all rows were taken.
            let raster = unsafe { raster.written() };
            let expected =
                Raster::from_fn(width, height, |x, y| if x == 0 && y % 2 == 1 { y as u16 } else { 0 });
            assert_eq!(raster, expected);
        }
    }
}
