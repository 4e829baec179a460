//! A reader of PLY point clouds, ascii or binary little-endian, properties in any order and type.

use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

use super::PlyError;
use crate::cloud::Point;

/// Longest header that is read; those of real files have some hundred bytes.
const MAX_HEADER_BYTES: u64 = 1 << 16;
/// Vertices decoded at a time.
const CHUNK: usize = 1 << 14;
/// The properties that are kept, in the order of a decoded vertex; other names are skipped.
const PROPERTIES: [&[&str]; 9] = [
    &["x"],
    &["y"],
    &["z"],
    &["nx"],
    &["ny"],
    &["nz"],
    &["red", "diffuse_red"],
    &["green", "diffuse_green"],
    &["blue", "diffuse_blue"],
];

/// Reads the vertices of a PLY file.
///
/// Positions must be there; missing normals are zeros, missing colours black. Colours of floating
/// type are taken as 0..1. The vertices must be the first element; others after them are ignored.
/// The number of vertices is checked against the size of the file before any memory is taken.
pub fn read_ply(path: &Path) -> Result<Vec<Point>, PlyError> {
    read(path).map_err(|failure| match failure {
        Failure::Io(source) => PlyError::Read { path: path.to_path_buf(), source },
        Failure::Malformed(problem) => PlyError::Malformed { path: path.to_path_buf(), problem },
    })
}

/// A failure that does not know its file yet.
enum Failure {
    Io(std::io::Error),
    Malformed(String),
}

impl From<std::io::Error> for Failure {
    fn from(error: std::io::Error) -> Self {
        Self::Io(error)
    }
}

fn malformed<T>(problem: impl Into<String>) -> Result<T, Failure> {
    Err(Failure::Malformed(problem.into()))
}

fn read(path: &Path) -> Result<Vec<Point>, Failure> {
    let file = File::open(path)?;
    let file_bytes = file.metadata()?.len();
    let mut reader = BufReader::with_capacity(1 << 18, file);
    let header = Header::read(&mut reader)?;
    let body_bytes = file_bytes.saturating_sub(header.bytes);
    header.check_size(body_bytes)?;
    if header.binary { read_binary(&mut reader, &header) } else { read_ascii(&mut reader, &header) }
}

#[derive(Clone, Copy, PartialEq)]
enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value at the start of `bytes`, which holds at least [`Self::bytes`].
    fn decode(self, bytes: &[u8]) -> f64 {
        match self {
            Self::I8 => bytes[0] as i8 as f64,
            Self::U8 => bytes[0] as f64,
            Self::I16 => i16::from_le_bytes([bytes[0], bytes[1]]) as f64,
            Self::U16 => u16::from_le_bytes([bytes[0], bytes[1]]) as f64,
            Self::I32 => i32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as f64,
            Self::U32 => u32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as f64,
            Self::F32 => f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]) as f64,
            Self::F64 => f64::from_le_bytes([
                bytes[0], bytes[1], bytes[2], bytes[3], bytes[4], bytes[5], bytes[6], bytes[7],
            ]),
        }
    }

    /// What makes a colour of this type one of 0..255.
    fn color_scale(self) -> f64 {
        match self {
            Self::F32 | Self::F64 => 255.0,
            Self::U16 => 255.0 / 65535.0,
            _ => 1.0,
        }
    }
}

/// A property of the vertices.
struct Property {
    scalar: Scalar,
    /// Its place in [`PROPERTIES`]; `None` when it is skipped.
    slot: Option<usize>,
}

struct Header {
    binary: bool,
    vertices: u64,
    properties: Vec<Property>,
    /// Whether nothing follows the vertices.
    vertices_only: bool,
    /// Length of the header itself.
    bytes: u64,
}

impl Header {
    fn read(reader: &mut impl BufRead) -> Result<Self, Failure> {
        let mut lines = reader.take(MAX_HEADER_BYTES);
        let mut bytes = 0;
        let mut next = || -> Result<String, Failure> {
            let mut line = Vec::new();
            bytes += lines.read_until(b'\n', &mut line)? as u64;
            if line.last() != Some(&b'\n') {
                return malformed("the header does not end");
            }
            Ok(String::from_utf8_lossy(&line).trim().to_owned())
        };
        if next()? != "ply" {
            return malformed("the first line is not \"ply\"");
        }
        let mut binary = None;
        let mut elements: Vec<(String, u64)> = Vec::new();
        let mut properties = Vec::new();
        loop {
            let line = next()?;
            let words: Vec<&str> = line.split_whitespace().collect();
            match words[..] {
                ["end_header"] => break,
                [] | ["comment" | "obj_info", ..] => {}
                ["format", "ascii", _] => binary = Some(false),
                ["format", "binary_little_endian", _] => binary = Some(true),
                ["element", name, count] => match count.parse() {
                    Ok(count) => elements.push((name.to_owned(), count)),
                    Err(_) => return malformed(format!("\"{line}\" has no count")),
                },
                // The properties of what follows the vertices are not needed.
                ["property", ..] if elements.len() > 1 => {}
                ["property", scalar, name] if elements.len() == 1 => {
                    let Some(scalar) = Scalar::parse(scalar) else {
                        return malformed(format!("\"{line}\" has an unknown type"));
                    };
                    let slot = PROPERTIES.iter().position(|names| names.contains(&name));
                    properties.push(Property { scalar, slot });
                }
                _ => return malformed(format!("\"{line}\" is not understood")),
            }
        }
        let Some(binary) = binary else { return malformed("the header names no format") };
        let vertices = match elements.first() {
            Some((name, count)) if name == "vertex" => *count,
            _ => return malformed("the first element is not \"vertex\""),
        };
        for (slot, names) in PROPERTIES.iter().enumerate() {
            let uses = properties.iter().filter(|p| p.slot == Some(slot)).count();
            if uses > 1 || (uses == 0 && slot < 3) {
                return malformed(format!("property \"{}\" is there {uses} times", names[0]));
            }
        }
        Ok(Self { binary, vertices, properties, vertices_only: elements.len() == 1, bytes })
    }

    /// Bytes of a binary vertex.
    fn stride(&self) -> usize {
        self.properties.iter().map(|p| p.scalar.bytes()).sum()
    }

    /// Refuses a count of vertices that the rest of the file cannot hold, or leaves bytes of.
    fn check_size(&self, body: u64) -> Result<(), Failure> {
        // In ascii a value takes a digit and a separator; the last may lack the separator.
        let (least, spare) =
            if self.binary { (self.stride() as u64, 0) } else { (2 * self.properties.len() as u64, 1) };
        let vertices = self.vertices;
        match vertices.checked_mul(least) {
            Some(needed) if needed <= body + spare => {
                if self.binary && self.vertices_only && needed < body {
                    return malformed(format!(
                        "{} bytes follow the last of {vertices} vertices",
                        body - needed
                    ));
                }
                Ok(())
            }
            _ => malformed(format!("{vertices} vertices do not fit in the {body} bytes after the header")),
        }
    }

    fn point(&self, values: &[f64; 9]) -> Point {
        let mut color = [0; 3];
        for property in &self.properties {
            if let Some(slot @ 6..) = property.slot {
                color[slot - 6] = (values[slot] * property.scalar.color_scale()).round() as u8;
            }
        }
        Point {
            position: [values[0], values[1], values[2]],
            normal: [values[3] as f32, values[4] as f32, values[5] as f32],
            color,
            ..Point::default()
        }
    }
}

fn read_binary(reader: &mut impl Read, header: &Header) -> Result<Vec<Point>, Failure> {
    let stride = header.stride();
    let mut left = header.vertices as usize;
    let mut points = Vec::with_capacity(left);
    let mut buffer = vec![0; stride * CHUNK.min(left)];
    while left > 0 {
        let count = CHUNK.min(left);
        reader.read_exact(&mut buffer[..stride * count])?;
        for vertex in buffer[..stride * count].chunks_exact(stride) {
            let mut values = [0.0; 9];
            let mut rest = vertex;
            for Property { scalar, slot } in &header.properties {
                if let Some(slot) = slot {
                    values[*slot] = scalar.decode(rest);
                }
                rest = &rest[scalar.bytes()..];
            }
            points.push(header.point(&values));
        }
        left -= count;
    }
    Ok(points)
}

fn read_ascii(reader: &mut impl BufRead, header: &Header) -> Result<Vec<Point>, Failure> {
    let mut points = Vec::with_capacity(header.vertices as usize);
    let mut line = String::new();
    for index in 0..header.vertices {
        line.clear();
        reader.read_line(&mut line)?;
        let mut words = line.split_whitespace();
        let mut values = [0.0; 9];
        for Property { slot, .. } in &header.properties {
            let Some(value) = words.next().and_then(|word| word.parse().ok()) else {
                return malformed(format!("vertex {index} lacks a number in \"{}\"", line.trim()));
            };
            if let Some(slot) = slot {
                values[*slot] = value;
            }
        }
        if words.next().is_some() {
            return malformed(format!("vertex {index} has more numbers than properties"));
        }
        points.push(header.point(&values));
    }
    if header.vertices_only {
        let mut rest = reader.bytes();
        if rest.any(|byte| byte.is_ok_and(|b| !b.is_ascii_whitespace())) {
            return malformed(format!("more lines follow the last of {} vertices", header.vertices));
        }
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use proptest::prelude::*;

    use super::*;

    fn read_bytes(bytes: &[u8]) -> Result<Vec<Point>, PlyError> {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("cloud.ply");
        fs::write(&path, bytes).expect("written");
        read_ply(&path)
    }

    fn problem(bytes: &[u8]) -> String {
        match read_bytes(bytes) {
            Err(PlyError::Malformed { problem, .. }) => problem,
            other => panic!("{other:?}"),
        }
    }

    const BINARY: &str = "ply\nformat binary_little_endian 1.0\ncomment x\nelement vertex 2\n\
        property uchar blue\nproperty double z\nproperty short label\nproperty float x\nproperty int y\n\
        property uchar red\nproperty uchar green\nend_header\n";

    fn binary_vertex(x: f32, y: i32, z: f64, [r, g, b]: [u8; 3]) -> Vec<u8> {
        [&[b][..], &z.to_le_bytes(), &[7, 7], &x.to_le_bytes(), &y.to_le_bytes(), &[r, g]].concat()
    }

    #[test]
    fn binary_properties_come_in_any_order_and_type() {
        let body = [binary_vertex(1.5, -2, 3.25, [1, 2, 3]), binary_vertex(0.0, 9, 1e9, [4, 5, 6])].concat();
        let points = read_bytes(&[BINARY.as_bytes(), &body].concat()).expect("well-formed");
        let point = |position, color| Point { position, color, ..Point::default() };
        assert_eq!(points, [point([1.5, -2.0, 3.25], [1, 2, 3]), point([0.0, 9.0, 1e9], [4, 5, 6])]);
    }

    #[test]
    fn ascii_with_faces_after_the_vertices_is_read() {
        let text = "ply\r\nformat ascii 1.0\r\nelement vertex 2\r\nproperty float x\r\nproperty float y\r\n\
            property float z\r\nproperty float nz\r\nproperty float diffuse_red\r\nelement face 1\r\n\
            property list uchar int vertex_indices\r\nend_header\r\n1 2 3 -1 0.5\r\n4 5 6 1 1\r\n3 0 1 1\r\n";
        let points = read_bytes(text.as_bytes()).expect("well-formed");
        assert_eq!(points.len(), 2);
        assert_eq!(
            points[0],
            Point {
                position: [1.0, 2.0, 3.0],
                normal: [0.0, 0.0, -1.0],
                color: [128, 0, 0],
                ..Point::default()
            }
        );
        assert_eq!(points[1].color, [255, 0, 0]);
    }

    #[test]
    fn what_is_wrong_is_named() {
        let body = binary_vertex(1.0, 2, 3.0, [0; 3]);
        let with = |bytes: &[u8]| problem(&[BINARY.as_bytes(), bytes].concat());
        assert_eq!(with(&body), "2 vertices do not fit in the 21 bytes after the header");
        assert_eq!(with(&[&body[..], &body, &[0]].concat()), "1 bytes follow the last of 2 vertices");
        let change = |from: &str, to: &str| problem(BINARY.replace(from, to).as_bytes());
        assert!(change("vertex 2", "vertex 18446744073709551615").contains("do not fit"));
        assert!(change("vertex 2", "vertex -1").contains("has no count"));
        assert!(change("float x", "float u").contains("\"x\" is there 0 times"));
        assert!(change("float x", "list uchar int x").contains("not understood"));
        assert!(change("float x", "half x").contains("unknown type"));
        assert!(change("short label", "float x").contains("\"x\" is there 2 times"));
        assert!(change("element vertex", "element face").contains("not \"vertex\""));
        assert!(change("binary_little_endian", "binary_big_endian").contains("not understood"));
        assert!(change("end_header", "comment").contains("does not end"));
        assert_eq!(problem(b"PLY\n"), "the first line is not \"ply\"");
        let ascii = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n\
            property float z\nend_header\n";
        let with = |body: &str| problem([ascii, body].concat().as_bytes());
        assert_eq!(with("1 2 3,5\n"), "vertex 0 lacks a number in \"1 2 3,5\"");
        assert_eq!(with("1 2 3 4\n"), "vertex 0 has more numbers than properties");
        assert_eq!(with("1 2 3\n4 5 6\n"), "more lines follow the last of 1 vertices");
        assert!(matches!(read_ply(Path::new("/no/cloud.ply")), Err(PlyError::Read { .. })));
    }

    #[test]
    fn colmaps_own_cloud_is_read_and_written_to_the_same_vertices() {
        let path = Path::new(concat!(
            env!("CARGO_MANIFEST_DIR"),
            "/../../shared/data/colmap/testColmap/dense/fused.ply"
        ));
        if !path.exists() {
            eprintln!(
                "SKIPPED colmaps_own_cloud_is_read_and_written_to_the_same_vertices: {} is not there",
                path.display()
            );
            return;
        }
        let points = read_ply(path).expect("COLMAP's file");
        assert_eq!(points.len(), 11);
        // As `od -t f4` shows them.
        assert_eq!(points[8].position, [-1185172.75, 52148.0625, 3400783.0]);
        assert_eq!(points[8].color, [141, 112, 108]);
        let folder = tempfile::tempdir().expect("a folder");
        let copy = folder.path().join("copy.ply");
        let mut writer =
            super::super::PlyWriter::create(&copy, super::super::VertexFormat::default()).expect("created");
        writer.write(&points).expect("written");
        writer.finish().expect("finished");
        let vertices = |path: &Path| {
            let bytes = fs::read(path).expect("read");
            bytes[bytes.len() - 11 * 27..].to_vec()
        };
        assert_eq!(vertices(&copy), vertices(path));
    }

    proptest! {
        #[test]
        fn damaged_files_are_refused_or_read_but_never_panic(
            at in 0..400_usize,
            byte in any::<u8>(),
            length in 0..400_usize,
        ) {
            let body = [binary_vertex(1.5, -2, 3.25, [1, 2, 3]), binary_vertex(0.0, 9, 1e9, [4, 5, 6])].concat();
            let mut bytes = [BINARY.as_bytes(), &body].concat();
            let (at, length) = (at % bytes.len(), length % bytes.len());
            bytes[at] = byte;
            if let Ok(points) = read_bytes(&bytes) {
                prop_assert!(points.len() <= bytes.len());
            }
            prop_assert!(read_bytes(&bytes[..length]).is_err());
        }
    }
}
