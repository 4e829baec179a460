//! Wavefront OBJ: positions, faces and texture coordinates; materials are ignored.

use nalgebra::Point3;
use tobj::LoadOptions;

use super::Triangles;

pub(super) fn parse(bytes: &[u8]) -> Result<Triangles, String> {
    let options =
        LoadOptions { triangulate: true, ignore_points: true, ignore_lines: true, ..Default::default() };
    let (models, _) = tobj::load_obj_buf(&mut &bytes[..], &options, |_| Ok(Default::default()))
        .map_err(|error| error.to_string())?;
    let mut triangles = Triangles::default();
    let textured = models.iter().all(|model| model.mesh.texcoord_indices.len() == model.mesh.indices.len());
    for tobj::Model { mesh, .. } in models {
        let first = triangles.positions.len() as u32;
        triangles.positions.extend(mesh.positions.as_chunks().0.iter().map(|p: &[f64; 3]| Point3::from(*p)));
        triangles.corners.extend(mesh.indices.as_chunks().0.iter().map(|c: &[u32; 3]| c.map(|v| v + first)));
        if textured {
            let uv = mesh.texcoords.as_chunks::<2>().0;
            let at = |i: u32| uv.get(i as usize).map_or([0.0; 2], |p| p.map(|v| v as f32));
            triangles.uv.extend(mesh.texcoord_indices.as_chunks().0.iter().map(|c: &[u32; 3]| c.map(at)));
        }
    }
    Ok(triangles)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quads_become_triangles_and_indices_count_from_either_end() {
        let text = "# a square\nv 0 0 0\nv 1 0 0\nv 1 1 0.5\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n\
                    f 1/1 2/2 3/3 4/4\nf -4/-4 -3/-3 -2/-2\n";
        let triangles = parse(text.as_bytes()).expect("an OBJ");
        assert_eq!(triangles.corners.len(), 3);
        assert_eq!(triangles.uv[2], [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]);
        let corner = triangles.corners[2][2] as usize;
        assert_eq!(triangles.positions[corner], Point3::new(1.0, 1.0, 0.5));
    }

    #[test]
    fn nonsense_is_refused() {
        assert!(parse(b"v 0 0 0\nf 1 2 3\n").is_err());
        assert!(parse(b"v 0 zero 0\n").is_err());
    }
}
