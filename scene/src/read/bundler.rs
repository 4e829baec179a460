//! Bundler's `bundle.out` and its list of images.
//!
//! Cameras look along -z with y up, and pixels count from the centre of the image: both are turned
//! into ours. A focal length of zero stands for a photograph that was not placed.

use std::path::{Path, PathBuf};
use std::str::SplitAsciiWhitespace;

use nalgebra::{Matrix3, Vector3};

use super::names::resolve_inside;
use super::points::PointsInto;
use super::views::{Candidate, Geometry, Units, admit};
use super::{ReadError, ReadOptions, ViewError, inconsistent, read_text, relative_name};
use crate::{CameraError, Distortion, Intrinsics, Pose, Scene, ViewId, Warning, image_size};

/// Names of the list of images, after the name of the bundle file itself.
const LISTS: [&str; 3] = ["list.txt", "list_focal.txt", "image_list.txt"];

/// The words of a file with the line that each stands in, comments left out.
struct Words<'a> {
    path: &'a Path,
    lines: std::iter::Enumerate<std::str::Lines<'a>>,
    line: usize,
    rest: SplitAsciiWhitespace<'a>,
}

impl<'a> Words<'a> {
    fn new(path: &'a Path, text: &'a str) -> Self {
        Self { path, lines: text.lines().enumerate(), line: 0, rest: "".split_ascii_whitespace() }
    }

    fn error(&self, what: String) -> ReadError {
        ReadError::Text { path: self.path.to_owned(), line: self.line, what }
    }

    fn word(&mut self) -> Option<&'a str> {
        loop {
            if let Some(word) = self.rest.next() {
                return Some(word);
            }
            let (number, line) = self.lines.next()?;
            self.line = number + 1;
            if !line.starts_with('#') {
                self.rest = line.split_ascii_whitespace();
            }
        }
    }

    fn next<T: std::str::FromStr>(&mut self, field: &str) -> Result<T, ReadError> {
        let word = self.word().ok_or_else(|| self.error(format!("the file ends where a {field} is due")))?;
        word.parse().map_err(|_| self.error(format!("{word:?} is no {field}")))
    }

    fn numbers<const N: usize>(&mut self, field: &str) -> Result<[f64; N], ReadError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.next(field)?;
        }
        Ok(values)
    }
}

pub(super) fn read(file: &Path, options: &ReadOptions) -> Result<Scene, ReadError> {
    let folder = file.parent().unwrap_or(Path::new("."));
    let names = image_names(file, folder)?;
    let images = image_folder(folder, &names, options);
    let text = read_text(file)?;
    let mut words = Words::new(file, &text);
    let (cameras, points): (usize, usize) =
        (words.next("number of cameras")?, words.next("number of points")?);
    if cameras != names.len() {
        let what = format!("{cameras} cameras, but the list of images has {}", names.len());
        return Err(inconsistent(file, what));
    }
    let mut candidates = Vec::new();
    let mut scene = Scene::default();
    for (name, id) in names.into_iter().zip(0..) {
        let [focal, k1, k2] = words.numbers("focal length or distortion")?;
        let rotation = words.numbers::<9>("rotation")?;
        let translation = words.numbers::<3>("translation")?;
        if focal == 0.0 {
            continue;
        }
        let geometry = geometry(&images, &name, focal, (k1, k2), &rotation, translation);
        candidates.push(Candidate { id: ViewId(id), name, geometry });
    }
    let unplaced = cameras - candidates.len();
    if unplaced > 0 {
        scene.warnings.push(Warning::new(
            format!("{unplaced} photographs of {} have no camera", file.display()),
            "add photographs between them and the others, and run the bundle adjustment again, if they are needed",
        ));
    }
    admit(candidates, file, &images, options, &mut scene)?;
    let mut into = PointsInto::new(&mut scene);
    let mut track = Vec::new();
    for point in 0..points {
        let position = words.numbers::<3>("position")?;
        words.numbers::<3>("colour")?;
        track.clear();
        for _ in 0..words.next::<usize>("number of observations")? {
            let view: u32 = words.next("camera index")?;
            if view as usize >= cameras {
                let what = format!("point {point} is seen by camera {view}, which does not exist");
                return Err(words.error(what));
            }
            let _: u32 = words.next("feature index")?;
            words.numbers::<2>("observation")?;
            track.push(view);
        }
        into.push(position, track.iter().copied());
    }
    into.finish();
    if words.word().is_some() {
        return Err(words.error("more words follow the last point".to_owned()));
    }
    Ok(scene)
}

/// One image a line, its name first; what follows is an initial focal length.
fn image_names(file: &Path, folder: &Path) -> Result<Vec<String>, ReadError> {
    let own = format!("{}.list.txt", file.file_name().unwrap_or_default().to_string_lossy());
    let above = folder.parent().unwrap_or(folder);
    let lists = std::iter::once(folder.join(own))
        .chain([folder, above].into_iter().flat_map(|place| LISTS.iter().map(move |name| place.join(name))));
    let list = lists.into_iter().find(|path| path.is_file());
    let Some(list) = list else {
        return Err(ReadError::NoImages { model: file.to_owned(), images: folder.join(LISTS[0]) });
    };
    let text = read_text(&list)?;
    let names = text.lines().filter_map(|line| line.split_ascii_whitespace().next());
    Ok(names.map(relative_name).collect())
}

/// The first of the usual folders in which the first image lies.
fn image_folder(folder: &Path, names: &[String], options: &ReadOptions) -> PathBuf {
    if let Some(images) = &options.images {
        return images.clone();
    }
    let above = folder.parent().unwrap_or(folder);
    let places = [folder.to_owned(), folder.join("images"), above.to_owned(), above.join("images")];
    let holds = |place: &PathBuf| names.iter().any(|name| resolve_inside(place, name).is_ok());
    places.into_iter().find(holds).unwrap_or_else(|| folder.to_owned())
}

fn geometry(
    images: &Path,
    name: &str,
    focal: f64,
    (k1, k2): (f64, f64),
    rotation: &[f64; 9],
    translation: [f64; 3],
) -> Result<Geometry, ViewError> {
    // The principal point is the centre of the image, so the camera needs its size. A missing image
    // is told later; until then any size does.
    let (width, height) =
        resolve_inside(images, name).ok().and_then(|path| image_size(&path).ok()).unwrap_or((1, 1));
    let turned = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0));
    let pose = Pose::new(turned * Matrix3::from_row_slice(rotation), turned * Vector3::from(translation))?;
    let (cx, cy) = (0.5 * (width as f64 - 1.0), 0.5 * (height as f64 - 1.0));
    let intrinsics = Intrinsics { width, height, fx: focal, fy: focal, skew: 0.0, cx, cy }.checked()?;
    if !k1.is_finite() || !k2.is_finite() {
        return Err(CameraError::NotFinite { field: "distortion" }.into());
    }
    let distortion = if (k1, k2) == (0.0, 0.0) { Distortion::None } else { Distortion::Radial { k1, k2 } };
    Ok(Geometry { pose, intrinsics, units: Units::Pixels, distortion, depth_range: None })
}
