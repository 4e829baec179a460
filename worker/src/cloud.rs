//! All points of all views as one PLY file.

use bytes::Bytes;
use planesweep_fusion::{EmptyCloud, FilterStep, Funnel, VertexFormat, ply_header};
use planesweep_plan::JobId;

use crate::blob::decode_points;
use crate::failure::JobError;

/// The cloud of the given results of `Emit` jobs, in their order, and how many points it has.
///
/// An empty cloud is an error that names the step that left nothing.
pub(crate) fn assemble(clouds: &[(JobId, Bytes)]) -> Result<(Vec<u8>, u64), JobError> {
    let mut funnel = Funnel::default();
    let mut format = VertexFormat::default();
    let mut vertices = Vec::with_capacity(clouds.len());
    for (job, bytes) in clouds {
        let malformed = |source| JobError::Malformed { job: *job, source };
        let (of_view, of_points, points) = decode_points(bytes).map_err(malformed)?;
        funnel = funnel + of_view;
        // The plan gives all views of a cloud the same.
        format = of_points;
        vertices.push(points);
    }
    let points: u64 = vertices.iter().map(|v| (v.len() / format.vertex_bytes()) as u64).sum();
    if points == 0 {
        let nothing = EmptyCloud { step: FilterStep::Emitted, before: funnel.geometric };
        return Err(funnel.emptied_by().unwrap_or(nothing).into());
    }
    let mut ply = ply_header(points, format).into_bytes();
    ply.reserve_exact(points as usize * format.vertex_bytes());
    for view in vertices {
        ply.extend_from_slice(view);
    }
    Ok((ply, points))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blob::encode_points;

    const FORMAT: VertexFormat = VertexFormat { double: false, quality: false };

    #[test]
    fn points_stand_in_the_order_of_the_views() {
        let funnel =
            Funnel { pixels: 9, with_depth: 9, photometric: 3, visible: 3, geometric: 2, emitted: 2 };
        let view = |value: u8| (JobId([value; 32]), encode_points(&funnel, FORMAT, &[value; 2 * 27]).into());
        let (ply, points) = assemble(&[view(1), view(2)]).expect("four points");
        assert_eq!(points, 4);
        let body = &ply[ply.len() - 4 * 27..];
        assert!(body[..2 * 27].iter().all(|b| *b == 1) && body[2 * 27..].iter().all(|b| *b == 2));
        assert!(ply.starts_with(b"ply\n") && String::from_utf8_lossy(&ply).contains("element vertex 4\n"));
    }

    #[test]
    fn an_empty_cloud_names_the_step_that_emptied_it() {
        let funnel = Funnel { pixels: 9, with_depth: 9, ..Funnel::default() };
        let error =
            assemble(&[(JobId([1; 32]), encode_points(&funnel, FORMAT, &[]).into())]).expect_err("no points");
        assert!(error.to_string().contains("photometric"), "{error}");
        assert!(assemble(&[]).is_err());
    }
}
