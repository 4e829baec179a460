//! The benchmark's small text files.

use std::str::{FromStr, SplitWhitespace};

use nalgebra::{Matrix4, Point3};

use super::TntError;

/// The camera centres of a trajectory: per camera three integers, then its camera-to-world matrix.
pub fn parse_trajectory(text: &str) -> Result<Vec<Point3<f64>>, TntError> {
    let mut numbers = Numbers::new("the trajectory", text);
    let mut centres = Vec::new();
    while !numbers.is_at_end() {
        for _ in 0..3 {
            let _: i64 = numbers.next()?;
        }
        let pose = numbers.matrix()?;
        centres.push(Point3::new(pose[(0, 3)], pose[(1, 3)], pose[(2, 3)]));
    }
    Ok(centres)
}

/// A 4x4 matrix, row by row.
pub fn parse_transform(text: &str) -> Result<Matrix4<f64>, TntError> {
    let mut numbers = Numbers::new("the transform", text);
    let matrix = numbers.matrix()?;
    numbers.end()?;
    Ok(matrix)
}

/// Which frame of a video each reference camera is, counted from 0: the number of cameras and of frames,
/// then per camera its index and its frame counted from 1.
pub fn parse_mapping(text: &str) -> Result<Vec<usize>, TntError> {
    let mut numbers = Numbers::new("the mapping", text);
    let cameras: usize = numbers.next()?;
    let frames: usize = numbers.next()?;
    let mut mapping = Vec::new();
    for _ in 0..cameras {
        let _: usize = numbers.next()?;
        let frame: usize = numbers.next()?;
        if frame == 0 || frame > frames {
            return Err(TntError::Frame { frame, frames });
        }
        mapping.push(frame - 1);
    }
    numbers.end()?;
    Ok(mapping)
}

/// The numbers of a file, one after the other, whatever the lines.
struct Numbers<'a> {
    file: &'static str,
    words: SplitWhitespace<'a>,
    /// Words taken so far.
    taken: usize,
}

impl<'a> Numbers<'a> {
    fn new(file: &'static str, text: &'a str) -> Self {
        Self { file, words: text.split_whitespace(), taken: 0 }
    }

    fn is_at_end(&self) -> bool {
        self.words.clone().next().is_none()
    }

    fn next<T: FromStr>(&mut self) -> Result<T, TntError> {
        self.taken += 1;
        let word = self.words.next().unwrap_or("its end");
        word.parse().map_err(|_| TntError::Number {
            file: self.file,
            place: self.taken,
            got: word.to_owned(),
        })
    }

    fn matrix(&mut self) -> Result<Matrix4<f64>, TntError> {
        let mut matrix = Matrix4::zeros();
        for (row, column) in (0..4).flat_map(|row| (0..4).map(move |column| (row, column))) {
            let place = self.taken + 1;
            let value: f64 = self.next()?;
            if !value.is_finite() {
                return Err(TntError::Number { file: self.file, place, got: value.to_string() });
            }
            matrix[(row, column)] = value;
        }
        Ok(matrix)
    }

    fn end(&mut self) -> Result<(), TntError> {
        match self.words.next() {
            None => Ok(()),
            Some(word) => Err(TntError::Rest { file: self.file, word: word.to_owned() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trajectory_gives_centres() {
        let text = "0 0 0\n1 0 0 2.5\n0 1 0 -3\n0 0 1 4e0\n0 0 0 1\r\n1 1 0\n0 1 0 7\n1 0 0 8\n0 0 -1 9\n0 0 0 1\n\n";
        let centres = parse_trajectory(text).expect("two cameras");
        assert_eq!(centres, [[2.5, -3.0, 4.0], [7.0, 8.0, 9.0]].map(Point3::from));
        assert_eq!(parse_trajectory("").expect("none"), []);
    }

    #[test]
    fn a_mapping_counts_frames_from_one() {
        assert_eq!(parse_mapping("3 200\n0 1\n1 100\n2 200\n").expect("three"), [0, 99, 199]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let trajectory = |text: &str| parse_trajectory(text).expect_err("refused").to_string();
        assert_eq!(trajectory("0 0 x"), "cannot understand the trajectory: number 3 is \"x\"");
        assert_eq!(trajectory("0 0 0 1 0"), "cannot understand the trajectory: number 6 is \"its end\"");
        assert_eq!(trajectory("0 0 0 1 nan"), "cannot understand the trajectory: number 5 is \"NaN\"");
        let mapping = |text: &str| parse_mapping(text).expect_err("refused").to_string();
        assert_eq!(mapping("1 5\n0 6"), "the mapping names frame 6 of 5");
        assert_eq!(mapping("1 5\n0 5 6"), "cannot understand the mapping: \"6\" follows its last number");
        let identity = "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1";
        assert_eq!(parse_transform(identity).expect("a matrix"), Matrix4::identity());
    }
}
