//! Homography warping (paper section 3.2, equation 1 with its slips put right): source features onto
//! fronto-parallel planes of the reference camera.

use nalgebra::{Matrix3x4, Vector3};
use tch::{Device, TchError, Tensor};

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
        let grid = self.grid(depths)?.f_to_kind(features.kind())?;
        // One batch entry per plane, all of the same memory, because libtorch's threads share a batch.
        let features = features.f_expand([planes, -1, -1, -1], false)?;
        features.f_grid_sampler_2d(&grid, BILINEAR, ZEROS, true)
    }

    /// Sampling positions `[planes, height, width, 2]`, f64.
    fn grid(&self, depths: &[f64]) -> Result<Tensor, TchError> {
        let offsets: Vec<f64> = depths.iter().flat_map(|depth| (self.offset / *depth).data.0[0]).collect();
        let offsets = Tensor::f_from_slice(&offsets)?
            .f_view([depths.len() as i64, 3, 1, 1])?
            .f_to_device(self.base.device())?;
        let position = self.base.f_add(&offsets)?;
        let depth = position.f_narrow(1, 2, 1)?;
        position
            .f_narrow(1, 0, 2)?
            .f_div(&depth)?
            .f_masked_fill_(&depth.f_gt(0.0)?.f_logical_not()?, OUTSIDE)?
            .f_clamp_(-OUTSIDE, OUTSIDE)?
            .f_permute([0, 2, 3, 1])
    }
}
