//! A rectangle of values whose length always matches its size.

use thiserror::Error;

/// A row-major rectangle of values: index `y * width + x`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Raster<T> {
    width: usize,
    height: usize,
    values: Vec<T>,
}

/// Why a raster could not be made.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum RasterError {
    /// The number of values is not `width * height`.
    #[error("a raster of {width}x{height} needs {} values, got {got}", width * height)]
    WrongLength {
        /// Columns.
        width: usize,
        /// Rows.
        height: usize,
        /// Values given.
        got: usize,
    },
}

impl<T> Raster<T> {
    /// Wraps `values`, row by row from the top.
    pub fn new(width: usize, height: usize, values: Vec<T>) -> Result<Self, RasterError> {
        if width.checked_mul(height) == Some(values.len()) {
            Ok(Self { width, height, values })
        } else {
            Err(RasterError::WrongLength { width, height, got: values.len() })
        }
    }

    /// Computes each value from its column and row.
    ///
    /// # Panics
    /// When no memory has so many addresses.
    pub fn from_fn(width: usize, height: usize, mut value: impl FnMut(usize, usize) -> T) -> Self {
        let mut values = Vec::with_capacity(pixels(width, height));
        for y in 0..height {
            for x in 0..width {
                values.push(value(x, y));
            }
        }
        Self { width, height, values }
    }

    /// Columns.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Rows.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All values, row by row from the top.
    pub fn values(&self) -> &[T] {
        &self.values
    }

    /// All values, mutable.
    pub fn values_mut(&mut self) -> &mut [T] {
        &mut self.values
    }

    /// The values themselves.
    pub fn into_values(self) -> Vec<T> {
        self.values
    }

    /// One row.
    ///
    /// # Panics
    /// When `y` is not below the height.
    pub fn row(&self, y: usize) -> &[T] {
        &self.values[y * self.width..(y + 1) * self.width]
    }

    /// Applies `f` to every value.
    pub fn map<U>(&self, f: impl FnMut(&T) -> U) -> Raster<U> {
        Raster { width: self.width, height: self.height, values: self.values.iter().map(f).collect() }
    }
}

impl<T: Copy> Raster<T> {
    /// A raster of one value.
    ///
    /// # Panics
    /// As [`Raster::from_fn`].
    pub fn filled(width: usize, height: usize, value: T) -> Self {
        Self { width, height, values: vec![value; pixels(width, height)] }
    }

    /// The value at a column and row.
    ///
    /// # Panics
    /// When outside the raster.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> T {
        debug_assert!(x < self.width);
        self.values[y * self.width + x]
    }

    /// The value at a column and row, or `None` outside.
    #[inline]
    pub fn get(&self, x: usize, y: usize) -> Option<T> {
        (x < self.width && y < self.height).then(|| self.values[y * self.width + x])
    }

    /// The top-left part, `width` by `height` or as much of it as there is.
    #[must_use]
    pub fn cropped(&self, width: usize, height: usize) -> Self {
        let (width, height) = (width.min(self.width), height.min(self.height));
        let values = (0..height).flat_map(|y| &self.row(y)[..width]).copied().collect();
        Self { width, height, values }
    }
}

/// How many values a raster has: kernels rely on it, so the product must not wrap.
fn pixels(width: usize, height: usize) -> usize {
    width.checked_mul(height).expect("memory has an address for each pixel")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn length_is_checked() {
        let error = Raster::new(3, 2, vec![0; 5]).expect_err("five values do not fill 3x2");
        assert_eq!(error, RasterError::WrongLength { width: 3, height: 2, got: 5 });
        assert_eq!(error.to_string(), "a raster of 3x2 needs 6 values, got 5");
        assert!(Raster::<u8>::new(usize::MAX, 2, vec![]).is_err());
    }

    #[test]
    #[should_panic(expected = "memory has an address for each pixel")]
    fn more_pixels_than_addresses_are_refused() {
        Raster::filled(usize::MAX / 2 + 2, 2, ());
    }

    #[test]
    fn cropping_keeps_the_top_left() {
        let raster = Raster::from_fn(4, 3, |x, y| 10 * y + x);
        assert_eq!(raster.cropped(2, 2).values(), [0, 1, 10, 11]);
        assert_eq!(raster.cropped(9, 9), raster);
        assert_eq!(raster.get(4, 0), None);
        assert_eq!(raster.at(3, 2), 23);
    }
}
