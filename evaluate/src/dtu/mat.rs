//! The data set's MATLAB files: where the scanner could see, and the table.

use std::fs::File;
use std::path::Path;

use matfile::{Array, MatFile, NumericData};
use nalgebra::Point3;

use super::DtuError;

/// A grid of cells that say whether the scanner could see what is there.
#[derive(Clone, Debug, PartialEq)]
pub struct ObservabilityMask {
    /// Centre of the first cell, in mm.
    low: Point3<f64>,
    /// Upper corner of the box, in mm.
    high: Point3<f64>,
    /// Side of a cell, in mm.
    cell: f64,
    /// Cells along x, y and z.
    size: [usize; 3],
    /// x runs fastest.
    observable: Vec<bool>,
}

impl ObservabilityMask {
    /// Reads `ObsMaskN_10.mat`: `ObsMask`, its box `BB` (lower corner, upper corner) and its cell size `Res`.
    pub fn read(path: &Path) -> Result<Self, DtuError> {
        let file = MatlabFile::read(path)?;
        let (size, observable) = file.numbers("ObsMask")?;
        let size: [usize; 3] = size.try_into().map_err(|_| file.unusable("ObsMask"))?;
        // Columns of a 2 x 3 matrix.
        let (corners, corner_values) = file.numbers("BB")?;
        let &[x0, x1, y0, y1, z0, z1] = &corner_values[..] else { return Err(file.unusable("BB")) };
        let (low, high) = (Point3::new(x0, y0, z0), Point3::new(x1, y1, z1));
        let is_box =
            corners == [2, 3] && (0..3).all(|axis| low[axis] <= high[axis] && high[axis].is_finite());
        if !is_box {
            return Err(file.unusable("BB"));
        }
        let cell = file.numbers("Res")?.1.first().copied().filter(|cell| *cell > 0.0 && cell.is_finite());
        let cell = cell.ok_or_else(|| file.unusable("Res"))?;
        let observable = observable.into_iter().map(|value| value != 0.0).collect();
        Ok(Self { low, high, cell, size, observable })
    }

    /// Whether the scanner could see a place; not outside the grid. Halves are rounded away from zero, as
    /// MATLAB does.
    pub fn contains(&self, place: &Point3<f64>) -> bool {
        let index = ((place - self.low) / self.cell).map(f64::round);
        let inside = (0..3).all(|axis| index[axis] >= 0.0 && index[axis] < self.size[axis] as f64);
        let [width, height, _] = self.size;
        let at = || (index.z as usize * height + index.y as usize) * width + index.x as usize;
        inside && self.observable.get(at()).copied().unwrap_or(false)
    }

    /// Whether a place is in one of the blocks of side `block` that cover the box from its lower corner.
    pub fn is_in_blocks(&self, place: &Point3<f64>, block: f64) -> bool {
        (0..3).all(|axis| {
            let blocks = ((self.high[axis] - self.low[axis]) / block).floor() + 1.0;
            let along = place[axis] - self.low[axis];
            along >= 0.0 && along < blocks * block
        })
    }
}

/// The plane of the table: a point `(x, y, z)` is above it where `a x + b y + c z + d > 0`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TablePlane(pub [f64; 4]);

impl TablePlane {
    /// Reads `PlaneN.mat`: `P`.
    pub fn read(path: &Path) -> Result<Self, DtuError> {
        let file = MatlabFile::read(path)?;
        let (_, values) = file.numbers("P")?;
        values.try_into().map(Self).map_err(|_| file.unusable("P"))
    }

    /// Whether a place is above the table.
    pub fn is_above(&self, place: &Point3<f64>) -> bool {
        let [a, b, c, d] = self.0;
        a * place.x + b * place.y + c * place.z + d > 0.0
    }
}

struct MatlabFile<'a> {
    path: &'a Path,
    content: MatFile,
}

impl<'a> MatlabFile<'a> {
    fn read(path: &'a Path) -> Result<Self, DtuError> {
        let file = File::open(path).map_err(|source| DtuError::Open { path: path.to_owned(), source })?;
        let content =
            MatFile::parse(file).map_err(|source| DtuError::Mat { path: path.to_owned(), source })?;
        Ok(Self { path, content })
    }

    /// Size and numbers of a variable, its first index running fastest.
    fn numbers(&self, name: &'static str) -> Result<(Vec<usize>, Vec<f64>), DtuError> {
        let array = self.content.find_by_name(name).ok_or_else(|| self.unusable(name))?;
        let values = numbers(array).ok_or_else(|| self.unusable(name))?;
        let count = array.size().iter().try_fold(1_usize, |count, side| count.checked_mul(*side));
        if count == Some(values.len()) {
            Ok((array.size().clone(), values))
        } else {
            Err(self.unusable(name))
        }
    }

    fn unusable(&self, variable: &'static str) -> DtuError {
        DtuError::Variable { path: self.path.to_owned(), variable }
    }
}

/// The real numbers of an array; logical values are stored as bytes.
fn numbers(array: &Array) -> Option<Vec<f64>> {
    Some(match array.data() {
        NumericData::UInt8 { real, .. } => real.iter().map(|v| f64::from(*v)).collect(),
        NumericData::Int8 { real, .. } => real.iter().map(|v| f64::from(*v)).collect(),
        NumericData::Single { real, .. } => real.iter().map(|v| f64::from(*v)).collect(),
        NumericData::Double { real, .. } => real.clone(),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_centred_on_multiples_of_their_size() {
        let mask = ObservabilityMask {
            low: Point3::new(-10.0, 0.0, 5.0),
            high: Point3::new(-6.0, 2.0, 5.0),
            cell: 2.0,
            size: [3, 2, 1],
            observable: vec![true, false, false, false, false, true],
        };
        let contains = |x: f64, y: f64, z: f64| mask.contains(&Point3::new(x, y, z));
        assert!(contains(-10.9, -0.9, 5.9) && contains(-6.0, 2.0, 5.0) && contains(-6.5, 1.0, 4.5));
        assert!(!contains(-8.0, 0.0, 5.0) && !contains(-11.1, 0.0, 5.0) && !contains(-10.0, 0.0, 6.0));
        assert!(!contains(f64::NAN, 0.0, 5.0) && !contains(f64::INFINITY, 0.0, 5.0));
        // Blocks of 3: [-10, -4), [0, 3), [5, 8).
        let in_blocks = |x: f64, y: f64, z: f64| mask.is_in_blocks(&Point3::new(x, y, z), 3.0);
        assert!(in_blocks(-10.0, 2.9, 5.0) && !in_blocks(-4.0, 0.0, 5.0) && !in_blocks(-5.0, -0.1, 5.0));
    }

    #[test]
    fn the_side_of_the_table_is_the_sign() {
        let plane = TablePlane([0.0, 0.0, -1.0, 600.0]);
        assert!(
            plane.is_above(&Point3::new(0.0, 0.0, 599.0)) && !plane.is_above(&Point3::new(0.0, 0.0, 600.0))
        );
    }
}
