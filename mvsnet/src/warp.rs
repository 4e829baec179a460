//! Homography warping (paper section 3.2, equation 1 with its slips put right): source features onto
//! fronto-parallel planes of the reference camera.

use nalgebra::{Matrix3x4, Vector3};
use tch::{Device, Kind, TchError, Tensor};

/// Where samples go that have no place in the source image: beyond any border, in coordinates that run
/// from -1 to 1 over an image of two columns or more.
const OUTSIDE: f64 = 4.0;

/// Numbers of libtorch's interpolation and padding modes.
const BILINEAR: i64 = 0;
const ZEROS: i64 = 0;

/// The homographies of one source view for all depths.
///
/// With projections `[M_1 | m_1]` and `[M_i | m_i]`, reference pixel `x` at depth `d` lies at
/// `A x + b / d` in the source, where `A = M_i M_1^-1` and `b = m_i - A m_1`. This is
/// `K_i R_i (I - (c_i - c_1) n_1^T / d) R_1^T K_1^-1 x`, and its third component is the depth in the source
/// divided by `d`.
#[derive(Debug)]
pub(crate) struct PlaneSweep {
    /// `A x` of every reference pixel, `[1, 3, height, width]`, f64.
    base: Tensor,
    /// `b`.
    offset: Vector3<f64>,
}

impl PlaneSweep {
    /// The sweep between feature cameras `K [R | t]` with feature maps of these sizes (width, height).
    /// `None` when the reference's matrix has no inverse.
    ///
    /// The homographies and the reference pixels under them are computed here in f64: a coordinate in f32
    /// is off by a millionth of the image, which the features of sharp edges show.
    pub(crate) fn new(
        reference: &Matrix3x4<f64>,
        reference_size: (usize, usize),
        source: &Matrix3x4<f64>,
        source_size: (usize, usize),
        device: Device,
    ) -> Option<Result<Self, TchError>> {
        let inverse = reference.fixed_view::<3, 3>(0, 0).into_owned().try_inverse()?;
        let mut rotation = source.fixed_view::<3, 3>(0, 0) * inverse;
        let mut offset = source.column(3) - rotation * reference.column(3);
        // Pixels 0 to size - 1 become -1 to 1, as grid_sample with align_corners=true wants them.
        for (row, size) in [source_size.0, source_size.1].into_iter().enumerate() {
            let scale = 2.0 / (size - 1) as f64;
            let normalised = rotation.row(row) * scale - rotation.row(2);
            rotation.set_row(row, &normalised);
            offset[row] = offset[row] * scale - offset[2];
        }
        let (width, height) = reference_size;
        let mut base = Vec::with_capacity(3 * width * height);
        for row in rotation.row_iter() {
            for y in 0..height {
                base.extend((0..width).map(|x| row[0] * x as f64 + row[1] * y as f64 + row[2]));
            }
        }
        let base = Tensor::f_from_slice(&base)
            .and_then(|base| base.f_view([1, 3, height as i64, width as i64])?.f_to_device(device));
        Some(base.map(|base| Self { base, offset }))
    }

    /// Samples `[1, channels, height, width]` at every reference pixel on each plane, bilinearly; zero outside and behind the
    /// source camera. Gives `[planes, channels, reference height, reference width]`.
    pub(crate) fn apply(&self, features: &Tensor, depths: &[f64]) -> Result<Tensor, TchError> {
        let planes = depths.len() as i64;
        let grid = self.grid(depths, Kind::Double)?.f_to_kind(features.kind())?;
        // One batch entry per plane, all of the same memory, because libtorch's threads share a batch.
        let features = features.f_expand([planes, -1, -1, -1], false)?;
        features.f_grid_sampler_2d(&grid, BILINEAR, ZEROS, true)
    }

    /// The same as one image of all planes below each other, with positions of the features' own precision:
    /// what the public implementations do. Gives `[1, channels, planes, reference height, reference width]`.
    pub(crate) fn apply_at_once(&self, features: &Tensor, depths: &[f64]) -> Result<Tensor, TchError> {
        let grid = self.grid(depths, features.kind())?;
        let (planes, height, width, _) = grid.size4()?;
        let grid = grid.f_reshape([1, planes * height, width, 2])?;
        let warped = features.f_grid_sampler_2d(&grid, BILINEAR, ZEROS, true)?;
        warped.f_view([1, -1, planes, height, width])
    }

    /// Sampling positions `[planes, height, width, 2]`, computed in this precision.
    fn grid(&self, depths: &[f64], kind: Kind) -> Result<Tensor, TchError> {
        let offsets: Vec<f64> = depths.iter().flat_map(|depth| (self.offset / *depth).data.0[0]).collect();
        let offsets = Tensor::f_from_slice(&offsets)?
            .f_view([depths.len() as i64, 3, 1, 1])?
            .f_to_kind(kind)?
            .f_to_device(self.base.device())?;
        let position = self.base.f_to_kind(kind)?.f_add(&offsets)?;
        let depth = position.f_narrow(1, 2, 1)?;
        position
            .f_narrow(1, 0, 2)?
            .f_div(&depth)?
            .f_masked_fill_(&depth.f_gt(0.0)?.f_logical_not()?, OUTSIDE)?
            .f_clamp_(-OUTSIDE, OUTSIDE)?
            .f_permute([0, 2, 3, 1])
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Point2, Point3};
    use planesweep_scene::{Camera, Intrinsics, Pose};

    use super::*;

    fn camera(centre: Point3<f64>, target: Point3<f64>) -> Camera {
        let (width, height) = (12, 9);
        let intrinsics = Intrinsics { width, height, fx: 11.0, fy: 12.0, skew: 0.4, cx: 5.7, cy: 4.1 };
        Camera { intrinsics, pose: Pose::look_at(&centre, &target, &-Vector3::y()) }
    }

    fn reference() -> Camera {
        camera(Point3::new(0.1, -0.2, 0.3), Point3::new(0.3, 0.1, 5.0))
    }

    fn sweep(source: &Camera) -> PlaneSweep {
        let size = (12, 9);
        PlaneSweep::new(&reference().projection(), size, &source.projection(), size, Device::Cpu)
            .expect("an invertible camera")
            .expect("a tensor")
    }

    #[test]
    fn homography_is_the_corrected_equation_1() {
        let (reference, source) =
            (reference(), camera(Point3::new(1.0, 0.5, -0.5), Point3::new(0.0, 0.0, 4.0)));
        let (depth, pixel) = (3.7, Point2::new(4.0, 6.0));
        let baseline = source.pose.centre() - reference.pose.centre();
        let normal = reference.pose.rotation.row(2);
        let inverse = reference.intrinsics.matrix().try_inverse().expect("focal lengths are positive");
        let homography = source.intrinsics.matrix()
            * source.pose.rotation
            * (Matrix3::identity() - baseline * normal / depth)
            * reference.pose.rotation.transpose()
            * inverse;
        let expected = homography * pixel.to_homogeneous();

        let grid = sweep(&source).grid(&[1.0, depth], Kind::Double).expect("a grid");
        let x = (grid.double_value(&[1, 6, 4, 0]) + 1.0) * 11.0 / 2.0;
        let y = (grid.double_value(&[1, 6, 4, 1]) + 1.0) * 8.0 / 2.0;
        assert!((x - expected.x / expected.z).abs() < 1e-12 && (y - expected.y / expected.z).abs() < 1e-12);
        let (seen, _) = source.project(&reference.unproject(&pixel, depth)).expect("in front");
        assert!((x - seen.x).abs() < 1e-12 && (y - seen.y).abs() < 1e-12);
    }

    #[test]
    fn own_features_stay_where_they_are() {
        let features = Tensor::rand([1, 2, 9, 12], (Kind::Float, Device::Cpu));
        let warped = sweep(&reference()).apply(&features, &[1.0, 9.0]).expect("features");
        assert_eq!(warped.size(), [2, 2, 9, 12]);
        assert!((warped - features).abs().max().double_value(&[]) < 1e-5);
    }

    #[test]
    fn all_planes_at_once_are_the_same() {
        let source = camera(Point3::new(1.0, 0.5, -0.5), Point3::new(0.0, 0.0, 4.0));
        let features = Tensor::rand([1, 2, 9, 12], (Kind::Double, Device::Cpu));
        let depths = [1.0, 3.7, 50.0];
        let by_planes = sweep(&source).apply(&features, &depths).expect("features");
        let at_once = sweep(&source).apply_at_once(&features, &depths).expect("features");
        assert_eq!(at_once.size(), [1, 2, 3, 9, 12]);
        assert!((at_once.squeeze_dim(0).transpose(0, 1) - by_planes).abs().max().double_value(&[]) < 1e-12);
    }

    #[test]
    fn what_is_behind_the_source_camera_is_zero() {
        // It looks the other way, so every plane lies behind it, where the homography mirrors the image.
        let away = camera(Point3::new(0.0, 0.0, 0.0), Point3::new(0.0, 0.0, -5.0));
        let features = Tensor::ones([1, 1, 9, 12], (Kind::Float, Device::Cpu));
        let warped = sweep(&away).apply(&features, &[1.0, 2.0, 50.0]).expect("features");
        assert_eq!(warped.abs().max().double_value(&[]), 0.0);
    }

    #[test]
    fn planes_through_the_source_centre_give_finite_features() {
        let on_axis = |depth| reference().pose.to_world(&Point3::new(0.0, 0.0, depth));
        let ahead = camera(on_axis(2.0), on_axis(9.0));
        let features = Tensor::ones([1, 1, 9, 12], (Kind::Float, Device::Cpu));
        let warped = sweep(&ahead).apply(&features, &[2.0, 2.0 + 1e-15]).expect("features");
        assert!(warped.isfinite().all().int64_value(&[]) == 1);
    }

    #[test]
    fn singular_reference_is_refused() {
        let source = camera(Point3::origin(), Point3::new(0.0, 0.0, 1.0)).projection();
        let none = PlaneSweep::new(&Matrix3x4::zeros(), (12, 9), &source, (12, 9), Device::Cpu);
        assert!(none.is_none());
    }
}
