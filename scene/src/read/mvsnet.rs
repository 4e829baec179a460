//! MVSNet and BlendedMVS folders: `cams/00000000_cam.txt`, `images/00000000.jpg`, `pair.txt`.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use nalgebra::{Matrix3, Vector3};

use super::pairs::parse_pairs;
use super::views::{Candidate, Geometry, Units, admit};
use super::{DepthLine, PixelCentre, ReadError, ReadOptions, ViewError, read_text};
use crate::{Camera, DepthRange, Distortion, Intrinsics, Pose, Scene, SourceScore, ViewId, Warning};

/// The number of planes and the factor on the interval that files of "minimum, interval" were made for.
const DEFAULT_PLANES: u32 = 192;
const DEFAULT_INTERVAL_SCALE: f64 = 1.06;

/// How far fixed entries of the matrices may be from their value.
const ENTRY_TOLERANCE: f64 = 1e-6;

const IMAGE_FOLDERS: [&str; 2] = ["images", "blended_images"];
const IMAGE_EXTENSIONS: [&str; 5] = ["jpg", "jpeg", "png", "tif", "tiff"];

pub(super) fn is_scene(root: &Path) -> bool {
    root.join("cams").is_dir()
}

pub(super) fn read(root: &Path, options: &ReadOptions) -> Result<Scene, ReadError> {
    let cams = root.join("cams");
    let images = match &options.images {
        Some(folder) => vec![folder.clone()],
        None => IMAGE_FOLDERS.map(|name| root.join(name)).to_vec(),
    };
    let images = images
        .iter()
        .find(|folder| folder.is_dir())
        .ok_or_else(|| ReadError::NoImages { model: cams.clone(), images: images[0].clone() })?;
    let image_names = numbered_files(images, |name| {
        let (stem, extension) = name.rsplit_once('.')?;
        IMAGE_EXTENSIONS.contains(&extension.to_ascii_lowercase().as_str()).then_some(stem)
    })?;
    let mut scene = Scene::default();
    let mut candidates = Vec::new();
    for (id, file) in numbered_files(&cams, |name| name.strip_suffix("_cam.txt"))? {
        let path = cams.join(&file);
        let geometry = parse_camera(&read_text(&path)?, options).map_err(|error| error.at(path)).map(
            |(geometry, warning)| {
                let advice =
                    "mend the line (least depth, interval, number of planes), or give --depth-range NEAR,FAR";
                let what = warning.map(|warning| format!("cams/{file}: {warning}"));
                scene.warnings.extend(what.map(|what| Warning::new(what, advice)));
                geometry
            },
        );
        // Without an image the name is the one it would have; looking for it then says it is missing.
        let name = image_names.get(&id).cloned().unwrap_or_else(|| file.replace("_cam.txt", ".jpg"));
        candidates.push(Candidate { id: ViewId(id), name, geometry });
    }
    admit(candidates, &cams, images, options, &mut scene)?;
    let pair_path = root.join("pair.txt");
    if pair_path.is_file() {
        let Scene { views, pairs, warnings, .. } = &mut scene;
        *pairs = parse_pairs(&pair_path, &read_text(&pair_path)?, |id| views.contains_key(&id), warnings)?;
    }
    Ok(scene)
}

/// Reads a cam.txt that stands alone, for an image of `width` by `height`: the camera, and the depth
/// range where the file states one.
pub fn read_mvsnet_cam(
    path: &Path,
    width: u32,
    height: u32,
    options: &ReadOptions,
) -> Result<(Camera, Option<DepthRange>), ReadError> {
    let refused = |source| ReadError::View { view: path.display().to_string(), source };
    let (geometry, _) =
        parse_camera(&read_text(path)?, options).map_err(|error| refused(error.at(path.to_owned())))?;
    let intrinsics = geometry.intrinsics.with_size(width, height).checked();
    let intrinsics = intrinsics.map_err(|error| refused(error.into()))?;
    Ok((Camera { intrinsics, pose: geometry.pose }, geometry.depth_range))
}

/// Reads a pair.txt that stands alone. Entries that name an unknown view, the reference view itself or
/// a source for the second time are left out.
pub fn read_mvsnet_pairs(
    path: &Path,
    is_known: impl Fn(ViewId) -> bool,
) -> Result<BTreeMap<ViewId, Vec<SourceScore>>, ReadError> {
    parse_pairs(path, &read_text(path)?, is_known, &mut Vec::new())
}

/// The files of a folder whose `stem` is a number, by it; of several with one number, the first by name.
fn numbered_files(
    folder: &Path,
    stem: impl Fn(&str) -> Option<&str>,
) -> Result<BTreeMap<u32, String>, ReadError> {
    let io_error = |source| ReadError::Io { path: folder.to_owned(), source };
    let mut names = Vec::new();
    for entry in fs::read_dir(folder).map_err(io_error)? {
        // What is not UTF-8 is no number either.
        names.extend(entry.map_err(io_error)?.file_name().into_string());
    }
    names.sort_unstable();
    let mut numbered = BTreeMap::new();
    for name in names {
        let digits = stem(&name).filter(|s| s.bytes().all(|b| b.is_ascii_digit()));
        if let Some(id) = digits.and_then(|digits| digits.parse().ok()) {
            numbered.entry(id).or_insert(name);
        }
    }
    Ok(numbered)
}

/// What is wrong with a cam.txt.
enum CameraFileError {
    Format(String),
    View(ViewError),
}

impl CameraFileError {
    fn at(self, path: PathBuf) -> ViewError {
        match self {
            Self::Format(what) => ViewError::CameraFile { path, what },
            Self::View(error) => error,
        }
    }
}

impl<E: Into<ViewError>> From<E> for CameraFileError {
    fn from(error: E) -> Self {
        Self::View(error.into())
    }
}

/// A camera without image size, and a warning where the depth line says nothing usable.
fn parse_camera(text: &str, options: &ReadOptions) -> Result<(Geometry, Option<String>), CameraFileError> {
    // Words, not lines: blank lines, their absence and any line ends occur.
    let mut words = text.split_ascii_whitespace();
    let [e0, e1, e2, e3] = block::<4>(&mut words, "extrinsic")?;
    let [k0, k1, k2] = block::<3>(&mut words, "intrinsic")?;
    let rotation = Matrix3::from_fn(|row, column| [e0, e1, e2][row][column]);
    let pose = Pose::new(rotation, Vector3::new(e0[3], e1[3], e2[3]))?;
    let format = |what: &str| Err(CameraFileError::Format(what.to_owned()));
    if !close(&e3, &[0.0, 0.0, 0.0, 1.0]) {
        return format("has an extrinsic whose last row is not 0 0 0 1");
    }
    if !close(&[k1[0]], &[0.0]) || !close(&k2, &[0.0, 0.0, 1.0]) {
        return format("has an intrinsic that is not upper triangular with 1 at its end");
    }
    let shift = match options.pixel_centre {
        PixelCentre::Integer => 0.0,
        PixelCentre::Half => 0.5,
    };
    // The image states the size; until then one pixel stands for it, for the other numbers' check.
    let intrinsics = Intrinsics {
        width: 1,
        height: 1,
        fx: k0[0],
        fy: k1[1],
        skew: k0[1],
        cx: k0[2] - shift,
        cy: k1[2] - shift,
    };
    let intrinsics = intrinsics.checked()?;
    let mut line = Vec::new();
    for word in words {
        let number = word.parse::<f64>().ok().filter(|v| v.is_finite());
        let Some(number) = number else { return format(&format!("has {word:?} in its depth line")) };
        line.push(number);
    }
    let range = depth_range(&line, options);
    let warning = (range.is_none() && !line.is_empty())
        .then(|| format!("its depth line {line:?} states no range and was left out"));
    let geometry = Geometry {
        pose,
        intrinsics,
        units: Units::PixelsOfImage,
        distortion: Distortion::None,
        depth_range: range,
    };
    Ok((geometry, warning))
}

fn block<'a, const N: usize>(
    words: &mut impl Iterator<Item = &'a str>,
    name: &str,
) -> Result<[[f64; N]; N], CameraFileError> {
    if !words.next().is_some_and(|word| word.eq_ignore_ascii_case(name)) {
        return Err(CameraFileError::Format(format!("has no {name} where one is due")));
    }
    let mut rows = [[0.0; N]; N];
    for value in rows.as_flattened_mut() {
        let word = words.next().and_then(|word| word.parse().ok());
        *value = word
            .ok_or_else(|| CameraFileError::Format(format!("has an {name} of fewer than {N}x{N} numbers")))?;
    }
    Ok(rows)
}

fn close(values: &[f64], expected: &[f64]) -> bool {
    values.iter().zip(expected).all(|(value, e)| (value - e).abs() <= ENTRY_TOLERANCE)
}

/// The range that a depth line states: `min interval`, `min max`, or `min interval count [max]`,
/// where a maximum that disagrees with the rest is for information only.
fn depth_range(line: &[f64], options: &ReadOptions) -> Option<DepthRange> {
    let (min, max, count) = match *line {
        [min, second] => {
            let is_max = match options.depth_line {
                DepthLine::Auto => second > min,
                DepthLine::Interval => false,
                DepthLine::MinMax => true,
            };
            let scale = options.interval_scale.unwrap_or(DEFAULT_INTERVAL_SCALE);
            let steps = options.plane_count.unwrap_or(DEFAULT_PLANES).saturating_sub(1) as f64;
            (min, if is_max { second } else { min + second * scale * steps }, None)
        }
        // The number of planes may be printed as a float.
        [min, interval, count] | [min, interval, count, _] => {
            let count = count.round().clamp(0.0, u32::MAX as f64) as u32;
            let scale = options.interval_scale.unwrap_or(1.0);
            (min, min + interval * scale * count.saturating_sub(1) as f64, Some(count))
        }
        _ => return None,
    };
    (min > 0.0 && max > min && max.is_finite()).then_some(DepthRange { min, max, count })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn range(line: &[f64], options: &ReadOptions) -> Option<(f64, f64, Option<u32>)> {
        depth_range(line, options).map(|r| (r.min, r.max, r.count))
    }

    #[test]
    fn two_numbers_are_told_apart_by_value_or_option() {
        let auto = ReadOptions::default();
        let dtu = range(&[425.0, 2.5], &auto).expect("min, interval");
        assert!((dtu.1 - (425.0 + 2.5 * 1.06 * 191.0)).abs() < 1e-9 && dtu.2.is_none());
        assert_eq!(range(&[4.0, 8.5], &auto), Some((4.0, 8.5, None)));
        let interval = ReadOptions { depth_line: DepthLine::Interval, ..auto.clone() };
        assert!(range(&[0.1, 0.2], &interval).expect("a range").1 > 40.0);
        let max = ReadOptions { depth_line: DepthLine::MinMax, ..auto.clone() };
        assert_eq!(range(&[425.0, 2.5], &max), None);
        let planes = ReadOptions { plane_count: Some(257), interval_scale: Some(0.5), ..auto };
        assert_eq!(range(&[425.0, 2.5], &planes), Some((425.0, 425.0 + 2.5 * 128.0, None)));
    }

    #[test]
    fn three_and_four_numbers_state_the_number_of_planes() {
        let options = ReadOptions::default();
        assert_eq!(range(&[2.0, 0.5, 11.0], &options), Some((2.0, 7.0, Some(11))));
        assert_eq!(range(&[2.0, 0.5, 11.0, 99.0], &options), Some((2.0, 7.0, Some(11))));
        let scaled = ReadOptions { interval_scale: Some(2.0), ..options };
        assert_eq!(range(&[2.0, 0.5, 11.0, 7.0], &scaled), Some((2.0, 12.0, Some(11))));
    }

    #[test]
    fn lines_that_state_no_range_give_none() {
        let options = ReadOptions::default();
        for line in
            [&[][..], &[1.0], &[0.0, 1.0], &[1.0, -1.0], &[1.0, 0.5, 1.0], &[1.0, 0.5, 1e300, 2.0, 3.0]]
        {
            assert_eq!(depth_range(line, &options), None, "{line:?}");
        }
    }
}
