//! COLMAP's text models: cameras.txt, images.txt, points3D.txt.

use std::collections::HashSet;
use std::path::Path;
use std::str::FromStr;

use super::ReadError;
use super::colmap::{CameraModel, RawCamera, RawImage};
use super::points::PointsInto;

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

fn lines<'a>(path: &'a Path, text: &'a str) -> impl Iterator<Item = Line<'a>> {
    text.lines().enumerate().map(move |(k, rest)| Line { path, number: k + 1, rest })
}

fn is_record(line: &Line) -> bool {
    let text = line.rest.trim_ascii();
    !text.is_empty() && !text.starts_with('#')
}

pub(super) fn cameras(path: &Path, text: &str) -> Result<Vec<RawCamera>, ReadError> {
    let mut cameras = Vec::new();
    for mut line in lines(path, text).filter(is_record) {
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

pub(super) fn images(path: &Path, text: &str) -> Result<Vec<RawImage>, ReadError> {
    let mut images = Vec::new();
    let mut lines = lines(path, text);
    while let Some(mut line) = lines.next() {
        if !is_record(&line) {
            continue;
        }
        let id = line.next("image id")?;
        let quaternion = line.numbers("quaternion")?;
        let translation = line.numbers("translation")?;
        let camera = line.next("camera id")?;
        // The name may have spaces: it is the rest of the line.
        let name = line.rest.trim_ascii().to_owned();
        images.push(RawImage { id, quaternion, translation, camera, name });
        // The line after it lists observations, and is empty where there are none.
        lines.next();
    }
    Ok(images)
}

/// Reads each point with the ids of the images that see it. An id that is not in `images` is an error.
pub(super) fn points(
    path: &Path,
    text: &str,
    images: &HashSet<u32>,
    points: &mut PointsInto,
) -> Result<(), ReadError> {
    let mut track = Vec::new();
    for mut line in lines(path, text).filter(is_record) {
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
