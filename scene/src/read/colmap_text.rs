//! COLMAP's text models: cameras.txt, images.txt, points3D.txt, read line by line: a model may be larger
//! than the memory.

use std::collections::HashSet;
use std::fs::File;
use std::io::{self, BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use super::ReadError;
use super::colmap::{CameraModel, RawCamera, RawImage};
use super::points::PointsInto;

/// The lines of a file not read yet.
struct Lines {
    path: PathBuf,
    reader: BufReader<File>,
    /// The line that was read last, counted from 1.
    number: usize,
    text: Vec<u8>,
}

impl Lines {
    fn open(path: &Path) -> Result<Self, ReadError> {
        let file = File::open(path).map_err(|source| ReadError::Io { path: path.to_owned(), source })?;
        let reader = BufReader::with_capacity(1 << 18, file);
        Ok(Self { path: path.to_owned(), reader, number: 0, text: Vec::new() })
    }

    /// The next line with something in it that is no comment; `None` at the end.
    fn record(&mut self) -> Result<Option<Line<'_>>, ReadError> {
        loop {
            self.text.clear();
            let length = self.reader.read_until(b'\n', &mut self.text);
            if length.map_err(|source| self.io_error(source))? == 0 {
                return Ok(None);
            }
            self.number += 1;
            let text = self.text.trim_ascii();
            if !text.is_empty() && !text.starts_with(b"#") {
                break;
            }
        }
        let (path, number) = (self.path.as_path(), self.number);
        match str::from_utf8(&self.text) {
            Ok(rest) => Ok(Some(Line { path, number, rest })),
            Err(_) => Err(Line { path, number, rest: "" }.error("not UTF-8")),
        }
    }

    /// Passes over a line, however long, without holding it.
    fn skip(&mut self) -> Result<(), ReadError> {
        let length = self.reader.skip_until(b'\n').map_err(|source| self.io_error(source))?;
        self.number += usize::from(length > 0);
        Ok(())
    }

    fn io_error(&self, source: io::Error) -> ReadError {
        ReadError::Io { path: self.path.clone(), source }
    }
}

/// One line, taken apart from the left.
struct Line<'a> {
    path: &'a Path,
    number: usize,
    rest: &'a str,
}

impl<'a> Line<'a> {
    fn error(&self, what: impl Into<String>) -> ReadError {
        ReadError::Text { path: self.path.to_owned(), line: self.number, what: what.into() }
    }

    fn word(&mut self) -> Option<&'a str> {
        let rest = self.rest.trim_ascii_start();
        let end = rest.find(|c: char| c.is_ascii_whitespace()).unwrap_or(rest.len());
        let (word, rest) = rest.split_at(end);
        self.rest = rest;
        (!word.is_empty()).then_some(word)
    }

    fn next<T: FromStr>(&mut self, field: &str) -> Result<T, ReadError> {
        let word = self.word();
        word.and_then(|w| w.parse().ok()).ok_or_else(|| match word {
            Some(word) => self.error(format!("{word:?} is no {field}")),
            None => self.error(format!("the {field} is missing")),
        })
    }

    fn numbers<const N: usize>(&mut self, field: &str) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.next(field)?;
        }
        Ok(values)
    }
}

pub(super) fn cameras(path: &Path) -> Result<Vec<RawCamera>, ReadError> {
    let mut lines = Lines::open(path)?;
    let mut cameras = Vec::new();
    while let Some(mut line) = lines.record()? {
        let id = line.next("camera id")?;
        let name: String = line.next("camera model")?;
        let model = CameraModel::by_name(&name)
            .ok_or_else(|| line.error(format!("camera {id} has the unknown model {name}")))?;
        let (width, height) = (line.next("width")?, line.next("height")?);
        let params = (0..model.params).map(|_| line.next("camera parameter")).collect::<Result<_, _>>()?;
        if line.word().is_some() {
            return Err(line.error(format!("{name} has {} parameters, there are more", model.params)));
        }
        cameras.push(RawCamera { id, model, width, height, params });
    }
    Ok(cameras)
}

pub(super) fn images(path: &Path) -> Result<Vec<RawImage>, ReadError> {
    let mut lines = Lines::open(path)?;
    let mut images = Vec::new();
    while let Some(mut line) = lines.record()? {
        let id = line.next("image id")?;
        let quaternion = line.numbers("quaternion")?;
        let translation = line.numbers("translation")?;
        let camera = line.next("camera id")?;
        // The name may have spaces: it is the rest of the line.
        let name = line.rest.trim_ascii().to_owned();
        images.push(RawImage { id, quaternion, translation, camera, name });
        // The line after it lists observations, megabytes of them, and is empty where there are none.
        lines.skip()?;
    }
    Ok(images)
}

/// Reads each point with the ids of the images that see it. An id that is not in `images` is an error.
pub(super) fn points(path: &Path, images: &HashSet<u32>, points: &mut PointsInto) -> Result<(), ReadError> {
    let mut lines = Lines::open(path)?;
    let mut track = Vec::new();
    while let Some(mut line) = lines.record()? {
        let id: u64 = line.next("point id")?;
        let position = line.numbers::<3>("position")?;
        line.numbers::<4>("colour or error")?;
        track.clear();
        while let Some(word) = line.word() {
            let image = word.parse().map_err(|_| line.error(format!("{word:?} is no image id")))?;
            let _: u32 = line.next("observation index")?;
            if !images.contains(&image) {
                return Err(line.error(format!("point {id} is seen by image {image}, which does not exist")));
            }
            track.push(image);
        }
        points.push(position, track.iter().copied());
    }
    Ok(())
}
