//! NPZ archives with the arrays of a mesh.

use std::io::{Cursor, Read};

use nalgebra::Point3;
use zip::ZipArchive;
use zip::result::ZipError;

use super::Triangles;

/// Arrays larger than this are refused before they are unpacked.
const MAX_BYTES: u64 = 4 << 30;

pub(super) fn parse(bytes: &[u8]) -> Result<Triangles, String> {
    let mut archive = ZipArchive::new(Cursor::new(bytes)).map_err(|error| error.to_string())?;
    let mut array = |name: &str, columns: usize| read_array(&mut archive, name, columns);
    let vertices = array("vertices", 3)?.ok_or("it holds no array vertices")?;
    let faces = array("faces", 3)?.ok_or("it holds no array faces")?;
    let (uv, face_uv) = (array("uv", 2)?, array("face_uv", 3)?);
    let positions = vertices.as_chunks::<3>().0.iter().map(|p| Point3::from(*p)).collect();
    let corners: Vec<[u32; 3]> = faces.as_chunks::<3>().0.iter().map(|f| f.map(index)).collect();
    let uv = match (uv, face_uv) {
        (Some(uv), Some(face_uv)) if face_uv.len() == faces.len() => {
            let uv = uv.as_chunks::<2>().0;
            let at = |i: f64| uv.get(index(i) as usize).map_or([0.0; 2], |p| p.map(|v| v as f32));
            face_uv.as_chunks::<3>().0.iter().map(|f| f.map(at)).collect()
        }
        _ => Vec::new(),
    };
    Ok(Triangles { positions, corners, uv })
}

/// An index as it was stored; what is none becomes one that no mesh has.
fn index(value: f64) -> u32 {
    if value >= 0.0 { value as u32 } else { u32::MAX }
}

/// A two-dimensional array of some width, row by row; `None` when the archive has no such entry.
fn read_array(
    archive: &mut ZipArchive<Cursor<&[u8]>>,
    name: &str,
    columns: usize,
) -> Result<Option<Vec<f64>>, String> {
    let mut entry = match archive.by_name(&format!("{name}.npy")) {
        Ok(entry) => entry,
        Err(ZipError::FileNotFound) => return Ok(None),
        Err(error) => return Err(format!("{name}: {error}")),
    };
    if entry.size() > MAX_BYTES {
        return Err(format!("{name} has {} bytes", entry.size()));
    }
    let mut bytes = Vec::new();
    entry.by_ref().take(MAX_BYTES).read_to_end(&mut bytes).map_err(|error| format!("{name}: {error}"))?;
    parse_npy(&bytes, columns).map(Some).ok_or_else(|| {
        format!("{name} is no array of {columns} columns of 32 or 64 bit numbers, little endian, row by row")
    })
}

fn parse_npy(bytes: &[u8], columns: usize) -> Option<Vec<f64>> {
    let rest = bytes.strip_prefix(b"\x93NUMPY")?;
    let (header_bytes, start) = match rest {
        [1, _, a, b, ..] => (u16::from_le_bytes([*a, *b]) as usize, 4),
        [2 | 3, _, a, b, c, d, ..] => (u32::from_le_bytes([*a, *b, *c, *d]) as usize, 6),
        _ => return None,
    };
    let header = std::str::from_utf8(rest.get(start..)?.get(..header_bytes)?).ok()?;
    let data = &rest[start + header_bytes..];
    let value = |key: &str| {
        let (_, after) = header.split_once(&format!("'{key}':"))?;
        Some(after.trim_start())
    };
    if !value("fortran_order")?.starts_with("False") {
        return None;
    }
    let (shape, _) = value("shape")?.strip_prefix('(')?.split_once(')')?;
    let mut sizes = shape.split(',').map(|size| size.trim().parse::<usize>());
    let (rows, width) = (sizes.next()?.ok()?, sizes.next()?.ok()?);
    let count = rows.checked_mul(columns)?;
    let kind = value("descr")?.trim_start_matches('\'').get(..3)?;
    let values: Vec<f64> = match kind {
        "<f4" => words(data, f32::from_le_bytes).map(f64::from).collect(),
        "<f8" => words(data, f64::from_le_bytes).collect(),
        "<i4" => words(data, i32::from_le_bytes).map(f64::from).collect(),
        "<u4" => words(data, u32::from_le_bytes).map(f64::from).collect(),
        "<i8" => words(data, i64::from_le_bytes).map(|v| v as f64).collect(),
        _ => return None,
    };
    (width == columns && values.len() == count).then_some(values)
}

fn words<const N: usize, T>(bytes: &[u8], decode: fn([u8; N]) -> T) -> impl Iterator<Item = T> {
    bytes.as_chunks::<N>().0.iter().map(move |word| decode(*word))
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use zip::ZipWriter;
    use zip::write::SimpleFileOptions;

    use super::*;

    fn npy(descr: &str, shape: [usize; 2], data: &[u8]) -> Vec<u8> {
        let header = format!(
            "{{'descr': '{descr}', 'fortran_order': False, 'shape': ({}, {}), }}",
            shape[0], shape[1]
        );
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend((header.len() as u16).to_le_bytes());
        bytes.extend(header.as_bytes());
        bytes.extend(data);
        bytes
    }

    fn floats(values: &[f32]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    fn archive(entries: &[(&str, Vec<u8>)]) -> Vec<u8> {
        let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
        for (name, bytes) in entries {
            writer.start_file(*name, SimpleFileOptions::default()).expect("an entry");
            writer.write_all(bytes).expect("written");
        }
        writer.finish().expect("an archive").into_inner()
    }

    #[test]
    fn arrays_become_a_mesh_with_texture_coordinates() {
        let indices: Vec<u8> = [0_i32, 1, 2].iter().flat_map(|v| v.to_le_bytes()).collect();
        let bytes = archive(&[
            ("vertices.npy", npy("<f4", [3, 3], &floats(&[0., 0., 0., 1., 0., 0., 0., 1., 0.]))),
            ("faces.npy", npy("<i4", [1, 3], &indices)),
            ("uv.npy", npy("<f4", [3, 2], &floats(&[0., 0., 1., 0., 0., 1.]))),
            ("face_uv.npy", npy("<i4", [1, 3], &indices)),
        ]);
        let triangles = parse(&bytes).expect("a mesh");
        assert_eq!(triangles.positions[1], Point3::new(1.0, 0.0, 0.0));
        assert_eq!(triangles.corners, [[0, 1, 2]]);
        assert_eq!(triangles.uv, [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]]);
    }

    #[test]
    fn what_is_missing_or_misshapen_is_named() {
        let problem = |entries: &[(&str, Vec<u8>)]| parse(&archive(entries)).err().expect("refused");
        assert!(problem(&[]).contains("no array vertices"));
        let short = npy("<f4", [2, 3], &floats(&[1.0; 3]));
        assert!(problem(&[("vertices.npy", short)]).contains("vertices is no array"));
        assert!(parse(b"no archive").is_err());
    }
}
