//! Photographs and masks, with cameras and lenses.

use std::ffi::OsString;
use std::os::unix::ffi::{OsStrExt, OsStringExt};
use std::path::PathBuf;

use nalgebra::{Matrix3, Vector3};
use planesweep_plan::{ImageSpec, MaskSpec};
use planesweep_scene::{Camera, CameraError, Distortion, Intrinsics, Pose, ViewId};

use super::check::{blob_key, finite, in_range, required, short};
use crate::limits::{MAX_PATH_BYTES, MAX_SIDE};
use crate::{WireError, wire};

impl From<&ImageSpec> for wire::Image {
    fn from(image: &ImageSpec) -> Self {
        Self {
            view: image.view.0,
            name: image.name.clone(),
            path: image.path.as_os_str().as_bytes().to_vec(),
            hash: image.hash.0.to_vec(),
            camera: Some((&image.camera).into()),
            distortion: Some(image.distortion.into()),
            working_width: image.working_width,
            working_height: image.working_height,
        }
    }
}

impl TryFrom<wire::Image> for ImageSpec {
    type Error = WireError;

    fn try_from(image: wire::Image) -> Result<Self, WireError> {
        let camera = required("camera", image.camera)?;
        Ok(Self {
            view: ViewId(image.view),
            name: image_name(image.name)?,
            path: path(image.path)?,
            hash: blob_key("image hash", &image.hash)?,
            camera: camera_from(image.view, &camera)?,
            distortion: required("distortion", image.distortion)?.try_into()?,
            working_width: in_range("working width", image.working_width, 1, MAX_SIDE)?,
            working_height: in_range("working height", image.working_height, 1, MAX_SIDE)?,
        })
    }
}

impl From<&MaskSpec> for wire::Mask {
    fn from(mask: &MaskSpec) -> Self {
        Self { path: mask.path.as_os_str().as_bytes().to_vec(), hash: mask.hash.0.to_vec() }
    }
}

impl TryFrom<wire::Mask> for MaskSpec {
    type Error = WireError;

    fn try_from(mask: wire::Mask) -> Result<Self, WireError> {
        Ok(Self { path: path(mask.path)?, hash: blob_key("mask hash", &mask.hash)? })
    }
}

/// Names become file names at the end, so what leads out of a folder is refused here too.
fn image_name(name: String) -> Result<String, WireError> {
    let name = short("image name", name, MAX_PATH_BYTES)?;
    let leads_out = name.starts_with('/') || name.split('/').any(|part| part == "..");
    if name.is_empty() || leads_out || name.chars().any(char::is_control) {
        return Err(WireError::BadText { field: "image name", text: name });
    }
    Ok(name)
}

fn path(bytes: Vec<u8>) -> Result<PathBuf, WireError> {
    if bytes.len() > MAX_PATH_BYTES {
        return Err(WireError::TooLong { field: "image path", got: bytes.len(), limit: MAX_PATH_BYTES });
    }
    if bytes.contains(&0) {
        let text = String::from_utf8_lossy(&bytes).into_owned();
        return Err(WireError::BadText { field: "image path", text });
    }
    Ok(PathBuf::from(OsString::from_vec(bytes)))
}

impl From<&Camera> for wire::Camera {
    fn from(camera: &Camera) -> Self {
        let Intrinsics { width, height, fx, fy, skew, cx, cy } = camera.intrinsics;
        let Pose { rotation, translation } = camera.pose;
        Self {
            width,
            height,
            fx,
            fy,
            skew,
            cx,
            cy,
            // nalgebra iterates by column, the wire has rows.
            rotation: rotation.transpose().iter().copied().collect(),
            translation: translation.iter().copied().collect(),
        }
    }
}

fn camera_from(view: u32, camera: &wire::Camera) -> Result<Camera, WireError> {
    let &wire::Camera { width, height, fx, fy, skew, cx, cy, .. } = camera;
    in_range("image width", width, 1, MAX_SIDE)?;
    in_range("image height", height, 1, MAX_SIDE)?;
    exactly("rotation", camera.rotation.len(), 9)?;
    exactly("translation", camera.translation.len(), 3)?;
    let refused = |source: CameraError| WireError::Camera { view, source };
    let intrinsics = Intrinsics { width, height, fx, fy, skew, cx, cy }.checked().map_err(refused)?;
    let rotation = Matrix3::from_row_slice(&camera.rotation);
    let pose = Pose::new(rotation, Vector3::from_row_slice(&camera.translation)).map_err(refused)?;
    Ok(Camera { intrinsics, pose })
}

fn exactly(field: &'static str, got: usize, expected: usize) -> Result<(), WireError> {
    if got == expected { Ok(()) } else { Err(WireError::WrongCount { field, got, expected }) }
}

impl From<Distortion> for wire::Distortion {
    fn from(distortion: Distortion) -> Self {
        use wire::distortion::Model;
        Self {
            model: match distortion {
                Distortion::None => None,
                Distortion::Radial { k1, k2 } => Some(Model::Radial(wire::RadialDistortion { k1, k2 })),
                Distortion::OpenCv { k1, k2, p1, p2 } => {
                    Some(Model::Opencv(wire::OpenCvDistortion { k1, k2, p1, p2 }))
                }
                Distortion::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 } => {
                    let lens = wire::FullOpenCvDistortion { k1, k2, p1, p2, k3, k4, k5, k6 };
                    Some(Model::FullOpencv(lens))
                }
                Distortion::Fov { omega } => Some(Model::Fov(wire::FovDistortion { omega })),
                Distortion::Fisheye { k1, k2, k3, k4 } => {
                    Some(Model::Fisheye(wire::FisheyeDistortion { k1, k2, k3, k4 }))
                }
                Distortion::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1, sy1 } => {
                    let lens = wire::ThinPrismFisheyeDistortion { k1, k2, p1, p2, k3, k4, sx1, sy1 };
                    Some(Model::ThinPrismFisheye(lens))
                }
            },
        }
    }
}

impl TryFrom<wire::Distortion> for Distortion {
    type Error = WireError;

    fn try_from(distortion: wire::Distortion) -> Result<Self, WireError> {
        use wire::distortion::Model;
        let distortion = match distortion.model {
            None => Self::None,
            Some(Model::Radial(d)) => Self::Radial { k1: d.k1, k2: d.k2 },
            Some(Model::Opencv(d)) => Self::OpenCv { k1: d.k1, k2: d.k2, p1: d.p1, p2: d.p2 },
            Some(Model::FullOpencv(d)) => {
                let wire::FullOpenCvDistortion { k1, k2, p1, p2, k3, k4, k5, k6 } = d;
                Self::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 }
            }
            Some(Model::Fov(d)) => Self::Fov { omega: d.omega },
            Some(Model::Fisheye(d)) => Self::Fisheye { k1: d.k1, k2: d.k2, k3: d.k3, k4: d.k4 },
            Some(Model::ThinPrismFisheye(d)) => {
                let wire::ThinPrismFisheyeDistortion { k1, k2, p1, p2, k3, k4, sx1, sy1 } = d;
                Self::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1, sy1 }
            }
        };
        for coefficient in distortion.coefficients() {
            finite("distortion coefficient", coefficient)?;
        }
        Ok(distortion)
    }
}

#[cfg(test)]
pub(super) mod tests {
    use nalgebra::Rotation3;
    use planesweep_plan::BlobKey;
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    fn camera() -> impl Strategy<Value = Camera> {
        let intrinsics =
            (1..9000_u32, 1..9000_u32, 1.0..1e5, 1.0..1e5, -1.0..1.0, -1e4..1e4, -1e4..1e4).prop_map(
                |(width, height, fx, fy, skew, cx, cy)| Intrinsics { width, height, fx, fy, skew, cx, cy },
            );
        let pose =
            ([-3.0..3.0_f64, -3.0..3.0, -3.0..3.0], [-1e6..1e6, -1e6..1e6, -1e6..1e6]).prop_map(|(r, t)| {
                let rotation = Rotation3::new(Vector3::from(r)).into_inner();
                Pose { rotation, translation: Vector3::from(t) }
            });
        (intrinsics, pose).prop_map(|(intrinsics, pose)| Camera { intrinsics, pose })
    }

    fn distortion() -> impl Strategy<Value = Distortion> {
        (0..7, proptest::array::uniform8(-1.0..1.0)).prop_map(|(model, [k1, k2, p1, p2, a, b, c, d])| {
            match model {
                0 => Distortion::None,
                1 => Distortion::Radial { k1, k2 },
                2 => Distortion::OpenCv { k1, k2, p1, p2 },
                3 => Distortion::FullOpenCv { k1, k2, p1, p2, k3: a, k4: b, k5: c, k6: d },
                4 => Distortion::Fov { omega: k1 },
                5 => Distortion::Fisheye { k1, k2, k3: a, k4: b },
                _ => Distortion::ThinPrismFisheye { k1, k2, p1, p2, k3: a, k4: b, sx1: c, sy1: d },
            }
        })
    }

    /// Any image that passes.
    pub fn image() -> impl Strategy<Value = ImageSpec> {
        let file = (any::<u32>(), "[a-zäß ]{1,9}(/[a-z.]{3}x)?", vec(1..=255_u8, 0..40), any::<[u8; 32]>());
        (file, camera(), distortion(), 1..=MAX_SIDE, 1..=MAX_SIDE).prop_map(
            |((view, name, path, hash), camera, distortion, working_width, working_height)| ImageSpec {
                view: ViewId(view),
                name,
                path: PathBuf::from(OsString::from_vec(path)),
                hash: BlobKey(hash),
                camera,
                distortion,
                working_width,
                working_height,
            },
        )
    }

    fn an_image() -> wire::Image {
        let camera = Camera {
            intrinsics: Intrinsics { width: 8, height: 6, fx: 5.0, fy: 5.0, skew: 0.0, cx: 3.5, cy: 2.5 },
            pose: Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() },
        };
        (&ImageSpec {
            view: ViewId(7),
            name: "a/b.jpg".into(),
            path: "/scene/a/b.jpg".into(),
            hash: BlobKey::of(b"image"),
            camera,
            distortion: Distortion::None,
            working_width: 8,
            working_height: 6,
        })
            .into()
    }

    fn refused(change: impl FnOnce(&mut wire::Image)) -> String {
        let mut image = an_image();
        change(&mut image);
        ImageSpec::try_from(image).expect_err("the change is bad").to_string()
    }

    #[test]
    fn each_bad_field_is_named() {
        assert!(ImageSpec::try_from(an_image()).is_ok());
        assert_eq!(refused(|i| i.hash.truncate(31)), "image hash has 31 bytes, a hash has 32");
        assert_eq!(refused(|i| i.camera = None), "camera is missing");
        assert_eq!(
            refused(|i| {
                if let Some(camera) = &mut i.camera {
                    camera.rotation.pop();
                }
            }),
            "rotation has 8 values instead of 9"
        );
        let mirrored = |i: &mut wire::Image| {
            if let Some(camera) = &mut i.camera {
                camera.rotation[0] = -1.0;
            }
        };
        assert_eq!(refused(mirrored), "camera of view 7 is refused");
        for name in ["", "../up", "/root", "a\0b", "a/../b"] {
            assert!(refused(|i| i.name = name.into()).starts_with("image name is empty or"), "{name:?}");
        }
        assert!(refused(|i| i.path.push(0)).starts_with("image path"));
        assert!(refused(|i| i.working_width = 0).starts_with("working width is 0"));
        let nan = wire::RadialDistortion { k1: f64::NAN, k2: 0.0 };
        let nan = wire::Distortion { model: Some(wire::distortion::Model::Radial(nan)) };
        assert_eq!(
            refused(|i| i.distortion = Some(nan)),
            "distortion coefficient is NaN, which is not finite"
        );
    }
}
