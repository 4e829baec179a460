//! MeshLab projects, which say where the scanner stood: `scan_alignment.mlp`.

use nalgebra::Matrix4;
use roxmltree::{Document, Node, ParsingOptions};

use super::Eth3dError;

/// A file of a scan with its place.
#[derive(Clone, Debug, PartialEq)]
pub struct PlacedScan {
    /// As it is written there: relative to the project's folder, or absolute.
    pub file: String,
    /// From the frame of the scanner to the world.
    pub to_world: Matrix4<f64>,
}

/// How far a matrix may be from a rotation; the benchmark's have six digits or more.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// The scans of a project, in its order.
pub fn parse_project(text: &str) -> Result<Vec<PlacedScan>, Eth3dError> {
    // MeshLab begins its projects with a document type.
    let options = ParsingOptions { allow_dtd: true, ..ParsingOptions::default() };
    let document = Document::parse_with_options(text, options)?;
    let meshes = document.descendants().filter(|node| node.has_tag_name("MLMesh"));
    let scans = meshes.enumerate().map(|(index, mesh)| placed_scan(mesh, index + 1));
    let scans: Vec<PlacedScan> = scans.collect::<Result<_, _>>()?;
    if scans.is_empty() { Err(Eth3dError::NoScan) } else { Ok(scans) }
}

fn placed_scan(mesh: Node, place: usize) -> Result<PlacedScan, Eth3dError> {
    let file = mesh.attribute("filename").filter(|file| !file.is_empty());
    let file = file.ok_or(Eth3dError::Incomplete { place, what: "filename" })?;
    let matrix = mesh.children().find(|node| node.has_tag_name("MLMatrix44"));
    let matrix =
        matrix.and_then(|node| node.text()).ok_or(Eth3dError::Incomplete { place, what: "MLMatrix44" })?;
    let numbers: Option<Vec<f64>> = matrix.split_whitespace().map(|word| word.parse().ok()).collect();
    let numbers = numbers.filter(|numbers| numbers.len() == 16).ok_or(Eth3dError::Matrix { place })?;
    let to_world = Matrix4::from_row_slice(&numbers);
    let rotation = to_world.fixed_view::<3, 3>(0, 0).into_owned();
    let off = (rotation * rotation.transpose() - nalgebra::Matrix3::identity()).amax();
    let is_rigid =
        off < ROTATION_TOLERANCE && rotation.determinant() > 0.0 && numbers[12..] == [0.0, 0.0, 0.0, 1.0];
    let is_finite = numbers.iter().all(|v| v.is_finite());
    if is_rigid && is_finite {
        Ok(PlacedScan { file: file.to_owned(), to_world })
    } else {
        Err(Eth3dError::Matrix { place })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PROJECT: &str = "<!DOCTYPE MeshLabDocument>\n<MeshLabProject>\n <MeshGroup>\n\
        <MLMesh label=\"scan1\" filename=\"scan1.ply\">\n <MLMatrix44>\n0 -1 0 2.5 \n1 0 0 -3 \n0 0 1 4 \n0 0 0 1 \n\
        </MLMatrix44>\n </MLMesh>\n <MLMesh label=\"b\" filename=\"more/scan 2.ply\"><MLMatrix44>1 0 0 0 0 1 0 0 0 0 1 0 \
        0 0 0 1</MLMatrix44></MLMesh>\n </MeshGroup>\n <RasterGroup/>\n</MeshLabProject>\n";

    #[test]
    fn scans_have_files_and_places() {
        let scans = parse_project(PROJECT).expect("two scans");
        assert_eq!((scans[0].file.as_str(), scans[1].file.as_str()), ("scan1.ply", "more/scan 2.ply"));
        assert_eq!(scans[1].to_world, Matrix4::identity());
        let place = scans[0].to_world.transform_point(&nalgebra::Point3::new(1.0, 2.0, 3.0));
        assert_eq!(place, nalgebra::Point3::new(0.5, -2.0, 7.0));
    }

    #[test]
    fn what_is_wrong_is_named() {
        let refused = |from: &str, to: &str| {
            assert!(PROJECT.contains(from));
            parse_project(&PROJECT.replacen(from, to, 1)).expect_err("refused").to_string()
        };
        assert_eq!(refused(" filename=\"scan1.ply\"", ""), "scan 1 of the MeshLab project has no filename");
        for (from, to) in
            [("0 -1 0 2.5", "0 -2 0 2.5"), ("-3", "nan"), ("-3", ""), ("0 0 0 1 \n", "0 0 1 1 \n")]
        {
            assert!(refused(from, to).starts_with("the matrix of scan 1 of"), "{to}");
        }
        assert!(refused("</MeshGroup>", "").starts_with("cannot understand"));
        assert_eq!(parse_project("<a/>").expect_err("none").to_string(), "the MeshLab project has no MLMesh");
    }
}
