//! What lenses do to the image of a pinhole camera.

use serde::{Deserialize, Serialize};

/// How far out (87 degrees off the axis) a fold is looked for.
const LARGEST_RADIUS: f64 = 20.0;

/// Angles below this are their own tangents.
const SMALL: f64 = 1e-9;

/// What a lens does to normalised image coordinates `(x, y) = (X/Z, Y/Z)` before `K` applies.
///
/// In all of them `r^2 = x^2 + y^2`. The models of the fisheye family bend `(x, y) theta / r`
/// instead, with `theta = atan(r)` the angle off the axis. Coefficients have OpenCV's and COLMAP's
/// names and order.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Distortion {
    /// Nothing: the image is that of a pinhole camera.
    None,
    /// COLMAP's SIMPLE_RADIAL and RADIAL: `1 + k1 r^2 + k2 r^4`.
    Radial {
        /// Coefficient of `r^2`.
        k1: f64,
        /// Coefficient of `r^4`.
        k2: f64,
    },
    /// COLMAP's and OpenCV's four-parameter model: radial and tangential.
    OpenCv {
        /// Coefficient of `r^2`.
        k1: f64,
        /// Coefficient of `r^4`.
        k2: f64,
        /// First tangential coefficient.
        p1: f64,
        /// Second tangential coefficient.
        p2: f64,
    },
    /// FULL_OPENCV, a rational radial factor and a tangential part. OpenMVG's and Brown's models
    /// with `k3` are those whose last three coefficients are zero.
    FullOpenCv {
        /// Coefficient of `r^2` above.
        k1: f64,
        /// Coefficient of `r^4` above.
        k2: f64,
        /// First tangential coefficient.
        p1: f64,
        /// Second tangential coefficient.
        p2: f64,
        /// Coefficient of `r^6` above.
        k3: f64,
        /// Coefficient of `r^2` below the line.
        k4: f64,
        /// Coefficient of `r^4` below the line.
        k5: f64,
        /// Coefficient of `r^6` below the line.
        k6: f64,
    },
    /// FOV (Devernay and Faugeras): the radius becomes `atan(2 r tan(omega / 2)) / omega`.
    Fov {
        /// The field of view of the ideal lens, in radians.
        omega: f64,
    },
    /// OPENCV_FISHEYE, and COLMAP's RADIAL_FISHEYE and SIMPLE_RADIAL_FISHEYE, whose further
    /// coefficients are zero: `theta (1 + k1 theta^2 + ... + k4 theta^8)`.
    Fisheye {
        /// Coefficient of `theta^2`.
        k1: f64,
        /// Coefficient of `theta^4`.
        k2: f64,
        /// Coefficient of `theta^6`.
        k3: f64,
        /// Coefficient of `theta^8`.
        k4: f64,
    },
    /// THIN_PRISM_FISHEYE: radial, tangential and a thin prism, in angles.
    ThinPrismFisheye {
        /// Coefficient of `theta^2`.
        k1: f64,
        /// Coefficient of `theta^4`.
        k2: f64,
        /// First tangential coefficient.
        p1: f64,
        /// Second tangential coefficient.
        p2: f64,
        /// Coefficient of `theta^6`.
        k3: f64,
        /// Coefficient of `theta^8`.
        k4: f64,
        /// Horizontal shift by `theta^2`.
        sx1: f64,
        /// Vertical shift by `theta^2`.
        sy1: f64,
    },
}

impl Distortion {
    /// The coefficients, in the order of the declaration. Together with [`Distortion::model`] they
    /// are the whole lens.
    pub fn coefficients(&self) -> Vec<f64> {
        match *self {
            Self::None => vec![],
            Self::Radial { k1, k2 } => vec![k1, k2],
            Self::OpenCv { k1, k2, p1, p2 } => vec![k1, k2, p1, p2],
            Self::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 } => vec![k1, k2, p1, p2, k3, k4, k5, k6],
            Self::Fov { omega } => vec![omega],
            Self::Fisheye { k1, k2, k3, k4 } => vec![k1, k2, k3, k4],
            Self::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1, sy1 } => {
                vec![k1, k2, p1, p2, k3, k4, sx1, sy1]
            }
        }
    }

    /// The name of the model, in lower case: "pinhole", "radial", "opencv", "full opencv", "fov",
    /// "fisheye" or "thin prism".
    pub fn model(&self) -> &'static str {
        match self {
            Self::None => "pinhole",
            Self::Radial { .. } => "radial",
            Self::OpenCv { .. } => "opencv",
            Self::FullOpenCv { .. } => "full opencv",
            Self::Fov { .. } => "fov",
            Self::Fisheye { .. } => "fisheye",
            Self::ThinPrismFisheye { .. } => "thin prism",
        }
    }

    /// Whether the model bends angles off the axis and not their tangents.
    fn is_fisheye(&self) -> bool {
        matches!(self, Self::Fisheye { .. } | Self::ThinPrismFisheye { .. })
    }

    /// Where the lens moves an undistorted normalised point.
    #[inline]
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        if self.is_fisheye() {
            let r = x.hypot(y);
            // On the axis the angle and its tangent are the same.
            let factor = if r > SMALL { r.atan() / r } else { 1.0 };
            self.bend(x * factor, y * factor)
        } else {
            self.bend(x, y)
        }
    }

    /// The undistorted normalised point that the lens moves to `(x, y)`; `None` where there is none,
    /// or none in front of the camera. The inverse of [`Distortion::distort`] within the radius in
    /// which that one does not fold the image back.
    pub fn undistort(&self, x: f64, y: f64) -> Option<(f64, f64)> {
        let (x, y) = match *self {
            Self::None => (x, y),
            Self::Fov { omega } => {
                let r = x.hypot(y);
                let angle = r * omega;
                if angle.abs() >= std::f64::consts::FRAC_PI_2 {
                    return None;
                }
                let factor = if angle.abs() > SMALL {
                    angle.tan() / (2.0 * (0.5 * omega).tan() * r)
                } else {
                    1.0 / fov_gain(omega)
                };
                (x * factor, y * factor)
            }
            _ => self.unbend(x, y)?,
        };
        if !self.is_fisheye() {
            return Some((x, y));
        }
        let theta = x.hypot(y);
        let factor = if theta > SMALL { theta.tan() / theta } else { 1.0 };
        (theta < std::f64::consts::FRAC_PI_2).then_some((x * factor, y * factor))
    }

    /// The lens in the space in which it is a polynomial: of tangents or, for fisheyes, of angles.
    #[inline]
    fn bend(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        let moved = |factor: f64, p1: f64, p2: f64| {
            (
                x * factor + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * factor + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            )
        };
        match *self {
            Self::None => (x, y),
            Self::Radial { k1, k2 } => {
                let factor = 1.0 + r2 * (k1 + r2 * k2);
                (x * factor, y * factor)
            }
            Self::OpenCv { k1, k2, p1, p2 } => moved(1.0 + r2 * (k1 + r2 * k2), p1, p2),
            Self::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 } => {
                let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
                let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
                moved(above / below, p1, p2)
            }
            Self::Fov { omega } => {
                let r = r2.sqrt();
                let scaled = 2.0 * r * (0.5 * omega).tan();
                let factor = if scaled.abs() > SMALL { scaled.atan() / (r * omega) } else { fov_gain(omega) };
                (x * factor, y * factor)
            }
            Self::Fisheye { k1, k2, k3, k4 } => {
                let factor = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
                (x * factor, y * factor)
            }
            Self::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1, sy1 } => {
                let (x, y) = moved(1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4))), p1, p2);
                (x + sx1 * r2, y + sy1 * r2)
            }
        }
    }

    /// Newton's method from the target itself, with the length of a step limited, so that a strong
    /// lens does not throw it beyond the fold.
    fn unbend(&self, target_x: f64, target_y: f64) -> Option<(f64, f64)> {
        const STEPS: usize = 100;
        const DERIVATIVE: f64 = 1e-6;
        const DONE: f64 = 1e-10;
        let (mut x, mut y) = (target_x, target_y);
        for _ in 0..STEPS {
            let at = self.bend(x, y);
            let (right, left) = (self.bend(x + DERIVATIVE, y), self.bend(x - DERIVATIVE, y));
            let (below, above) = (self.bend(x, y + DERIVATIVE), self.bend(x, y - DERIVATIVE));
            let half = 0.5 / DERIVATIVE;
            let (xx, yx) = ((right.0 - left.0) * half, (right.1 - left.1) * half);
            let (xy, yy) = ((below.0 - above.0) * half, (below.1 - above.1) * half);
            let determinant = xx * yy - xy * yx;
            let (ex, ey) = (at.0 - target_x, at.1 - target_y);
            let (dx, dy) = ((yy * ex - xy * ey) / determinant, (xx * ey - yx * ex) / determinant);
            let length = dx.hypot(dy);
            if !length.is_finite() {
                return None;
            }
            let shorter = ((0.1 * x.hypot(y)).max(0.1) / length).min(1.0);
            (x, y) = (x - shorter * dx, y - shorter * dy);
            if length < DONE {
                return Some((x, y));
            }
        }
        None
    }

    /// The normalised radius where the radial part of the lens stops growing: beyond it the model
    /// folds the image back onto itself. Infinite where that does not happen.
    pub(crate) fn fold_radius(&self) -> f64 {
        const STEPS: u32 = 2048;
        let radial = match *self {
            Self::None | Self::Fov { .. } => return f64::INFINITY,
            Self::OpenCv { k1, k2, .. } => Self::Radial { k1, k2 },
            Self::FullOpenCv { k1, k2, k3, k4, k5, k6, .. } => {
                Self::FullOpenCv { k1, k2, p1: 0.0, p2: 0.0, k3, k4, k5, k6 }
            }
            Self::ThinPrismFisheye { k1, k2, k3, k4, .. } => Self::Fisheye { k1, k2, k3, k4 },
            Self::Radial { .. } | Self::Fisheye { .. } => *self,
        };
        let end = if self.is_fisheye() { LARGEST_RADIUS.atan() } else { LARGEST_RADIUS };
        let grows = |r: f64| radial.bend(r + 1e-6, 0.0).0 > radial.bend(r - 1e-6, 0.0).0;
        let at = |k: u32| end * k as f64 / STEPS as f64;
        let Some(first) = (1..=STEPS).find(|k| !grows(at(*k))) else { return f64::INFINITY };
        let (mut low, mut high) = (at(first - 1), at(first));
        for _ in 0..30 {
            let middle = 0.5 * (low + high);
            if grows(middle) { low = middle } else { high = middle }
        }
        if self.is_fisheye() { low.tan() } else { low }
    }
}

/// The factor of the FOV model at the centre of the image.
#[inline]
fn fov_gain(omega: f64) -> f64 {
    if omega.abs() > SMALL { 2.0 * (0.5 * omega).tan() / omega } else { 1.0 }
}

#[cfg(test)]
pub(crate) mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A lens of any model, as mild as those of photographs.
    pub(crate) fn lens() -> impl Strategy<Value = Distortion> {
        let (strong, weak, tiny) = (-0.2..0.2, -0.03..0.03, -0.004..0.004);
        let radial = (strong.clone(), weak.clone());
        let tangential = (tiny.clone(), tiny.clone());
        prop_oneof![
            radial.clone().prop_map(|(k1, k2)| Distortion::Radial { k1, k2 }),
            (radial.clone(), tangential.clone()).prop_map(|((k1, k2), (p1, p2))| Distortion::OpenCv {
                k1,
                k2,
                p1,
                p2
            }),
            (radial.clone(), tangential.clone(), tiny.clone(), radial.clone(), tiny.clone()).prop_map(
                |((k1, k2), (p1, p2), k3, (k4, k5), k6)| Distortion::FullOpenCv {
                    k1,
                    k2,
                    p1,
                    p2,
                    k3,
                    k4,
                    k5,
                    k6
                }
            ),
            (0.2..1.2).prop_map(|omega| Distortion::Fov { omega }),
            (radial.clone(), tangential.clone()).prop_map(|((k1, k2), (k3, k4))| Distortion::Fisheye {
                k1,
                k2,
                k3,
                k4
            }),
            (radial, tangential.clone(), tangential.clone(), tangential).prop_map(
                |((k1, k2), (p1, p2), (k3, k4), (sx1, sy1))| Distortion::ThinPrismFisheye {
                    k1,
                    k2,
                    p1,
                    p2,
                    k3,
                    k4,
                    sx1,
                    sy1
                }
            ),
        ]
    }

    proptest! {
        #[test]
        fn undistorting_inverts_distorting(lens in lens(), r in 0.0..1.2, angle in 0.0..std::f64::consts::TAU) {
            // Near the fold the inverse is ill-conditioned, beyond it another point.
            let r: f64 = r * (lens.fold_radius() * 0.6_f64).min(1.0);
            let (x, y) = (r * f64::cos(angle), r * f64::sin(angle));
            let (xd, yd) = lens.distort(x, y);
            let (x1, y1) = lens.undistort(xd, yd).expect("within the fold");
            prop_assert!((x1 - x).hypot(y1 - y) < 1e-8, "{lens:?} {x} {y}: {x1} {y1}");
        }

        #[test]
        fn undistorting_any_number_does_not_hang_or_panic(
            k in proptest::array::uniform8(-1e6..1e6), x in -1e3..1e3, y in -1e3..1e3,
        ) {
            let [k1, k2, p1, p2, k3, k4, k5, k6] = k;
            for lens in [
                Distortion::FullOpenCv { k1, k2, p1, p2, k3, k4, k5, k6 },
                Distortion::ThinPrismFisheye { k1, k2, p1, p2, k3, k4, sx1: k5, sy1: k6 },
                Distortion::Fov { omega: k1 },
            ] {
                if let Some((x, y)) = lens.undistort(x, y) {
                    prop_assert!(x.is_finite() && y.is_finite());
                }
                lens.fold_radius();
            }
        }
    }

    #[test]
    fn fisheyes_without_coefficients_are_equidistant_and_a_narrow_fov_is_nothing() {
        let none = Distortion::Fisheye { k1: 0.0, k2: 0.0, k3: 0.0, k4: 0.0 };
        let (x, y) = none.distort(1.0, 0.0);
        assert!((x - std::f64::consts::FRAC_PI_4).abs() < 1e-15 && y == 0.0);
        assert_eq!(none.undistort(1.6, 0.0), None, "behind the camera");
        let narrow = Distortion::Fov { omega: 1e-9 };
        let (x, y) = narrow.distort(0.3, -0.4);
        assert!((x - 0.3).abs() < 1e-9 && (y + 0.4).abs() < 1e-9);
    }

    #[test]
    fn a_strong_barrel_folds_and_a_cushion_does_not() {
        let fold = |k1, k2| Distortion::Radial { k1, k2 }.fold_radius();
        assert!((fold(-1.0, 0.0) - (1.0_f64 / 3.0).sqrt()).abs() < 1e-6);
        assert!((fold(0.0, -0.2) - 1.0).abs() < 1e-6);
        assert_eq!(fold(0.1, 0.0), f64::INFINITY);
        assert_eq!(fold(0.0, 0.0), f64::INFINITY);
        let fisheye = Distortion::Fisheye { k1: -0.5, k2: 0.0, k3: 0.0, k4: 0.0 };
        assert!((fisheye.fold_radius().atan() - (1.0_f64 / 1.5).sqrt()).abs() < 1e-6);
    }
}
