//! PLY, ASCII and binary of either byte order: vertex positions and faces, texture coordinates at
//! vertices (`s t`, `u v`) or at faces (`texcoord`).

use nalgebra::Point3;

use super::Triangles;

pub(super) fn parse(bytes: &[u8]) -> Result<Triangles, String> {
    let (header, body) = Header::parse(bytes)?;
    let mut reader = Body { bytes: body, encoding: header.encoding };
    let mut triangles = Triangles::default();
    let mut vertex_uv = Vec::new();
    for element in &header.elements {
        match element.name.as_str() {
            "vertex" => read_vertices(&mut reader, element, &mut triangles, &mut vertex_uv)?,
            "face" => read_faces(&mut reader, element, &mut triangles)?,
            // Elements behind the faces matter no more.
            _ if !triangles.corners.is_empty() => break,
            _ => skip(&mut reader, element)?,
        }
    }
    if triangles.uv.len() != triangles.corners.len() {
        triangles.uv = if vertex_uv.is_empty() {
            Vec::new()
        } else {
            let at = |v: u32| vertex_uv.get(v as usize).copied().unwrap_or_default();
            triangles.corners.iter().map(|corners| corners.map(at)).collect()
        };
    }
    Ok(triangles)
}

fn read_vertices(
    reader: &mut Body,
    element: &Element,
    triangles: &mut Triangles,
    vertex_uv: &mut Vec<[f32; 2]>,
) -> Result<(), String> {
    let column = |names: &[&str]| element.properties.iter().position(|p| names.contains(&p.name.as_str()));
    let (Some(x), Some(y), Some(z)) = (column(&["x"]), column(&["y"]), column(&["z"])) else {
        return Err("its vertices have no x, y and z".to_owned());
    };
    let uv = column(&["s", "u", "texture_u"]).zip(column(&["t", "v", "texture_v"]));
    let mut row = vec![0.0; element.properties.len()];
    for _ in 0..element.count {
        for (value, property) in row.iter_mut().zip(&element.properties) {
            match property.count {
                None => *value = reader.number(property.scalar)?,
                Some(count) => {
                    let length = reader.length(count)?;
                    for _ in 0..length {
                        reader.number(property.scalar)?;
                    }
                }
            }
        }
        triangles.positions.push(Point3::new(row[x], row[y], row[z]));
        vertex_uv.extend(uv.map(|(u, v)| [row[u] as f32, row[v] as f32]));
    }
    Ok(())
}

fn read_faces(reader: &mut Body, element: &Element, triangles: &mut Triangles) -> Result<(), String> {
    let (mut corners, mut uv, mut list): (Vec<u32>, Vec<f32>, Vec<f64>) = Default::default();
    for _ in 0..element.count {
        corners.clear();
        uv.clear();
        for property in &element.properties {
            let length = property.count.map_or(Ok(1), |count| reader.length(count))?;
            list.clear();
            for _ in 0..length {
                list.push(reader.number(property.scalar)?);
            }
            match property.name.as_str() {
                "vertex_indices" | "vertex_index" => {
                    // An index that is none becomes one that no mesh has.
                    corners.extend(list.iter().map(|v| if *v >= 0.0 { *v as u32 } else { u32::MAX }));
                }
                "texcoord" => uv.extend(list.iter().map(|v| *v as f32)),
                _ => {}
            }
        }
        let pairs = uv.as_chunks::<2>().0;
        for i in 2..corners.len() {
            triangles.corners.push([corners[0], corners[i - 1], corners[i]]);
            if pairs.len() == corners.len() {
                triangles.uv.push([pairs[0], pairs[i - 1], pairs[i]]);
            }
        }
    }
    Ok(())
}

fn skip(reader: &mut Body, element: &Element) -> Result<(), String> {
    for property in (0..element.count).flat_map(|_| &element.properties) {
        let length = property.count.map_or(Ok(1), |count| reader.length(count))?;
        for _ in 0..length {
            reader.number(property.scalar)?;
        }
    }
    Ok(())
}

#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Ascii,
    LittleEndian,
    BigEndian,
}

#[derive(Clone, Copy)]
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

struct Property {
    name: String,
    scalar: Scalar,
    /// The type of a list's length, `None` for a single number.
    count: Option<Scalar>,
}

struct Element {
    name: String,
    count: u64,
    properties: Vec<Property>,
}

struct Header {
    encoding: Encoding,
    elements: Vec<Element>,
}

impl Header {
    /// The header and the bytes behind it.
    fn parse(bytes: &[u8]) -> Result<(Self, &[u8]), String> {
        let mut rest = bytes;
        let mut line = || {
            let end = rest.iter().position(|b| *b == b'\n').ok_or("its header does not end")?;
            let line = std::str::from_utf8(&rest[..end]).map_err(|_| "its header is no text")?;
            rest = &rest[end + 1..];
            Ok::<_, String>(line.trim().to_owned())
        };
        if line()? != "ply" {
            return Err("it does not begin with ply".to_owned());
        }
        let mut encoding = None;
        let mut elements: Vec<Element> = Vec::new();
        loop {
            let line = line()?;
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            match words[..] {
                ["end_header"] => break,
                ["format", name, _version] => {
                    encoding = Some(match name {
                        "ascii" => Encoding::Ascii,
                        "binary_little_endian" => Encoding::LittleEndian,
                        "binary_big_endian" => Encoding::BigEndian,
                        _ => return Err(format!("its format {name} is not known")),
                    });
                }
                ["element", name, count] => {
                    let count = count.parse().map_err(|_| format!("{count} is no number of elements"))?;
                    elements.push(Element { name: name.to_owned(), count, properties: Vec::new() });
                }
                ["property", ref kind @ .., name] => {
                    let element = elements.last_mut().ok_or("a property comes before any element")?;
                    let (scalar, count) = match *kind {
                        [scalar] => (Scalar::parse(scalar)?, None),
                        ["list", count, scalar] => (Scalar::parse(scalar)?, Some(Scalar::parse(count)?)),
                        _ => return Err(format!("cannot read the header line {line:?}")),
                    };
                    element.properties.push(Property { name: name.to_owned(), scalar, count });
                }
                [] | ["comment" | "obj_info", ..] => {}
                _ => return Err(format!("cannot read the header line {line:?}")),
            }
        }
        let encoding = encoding.ok_or("its header names no format")?;
        // A count without properties would loop over nothing, for ever.
        if let Some(element) = elements.iter().find(|e| e.count > 0 && e.properties.is_empty()) {
            return Err(format!("its element {} has no properties", element.name));
        }
        Ok((Self { encoding, elements }, rest))
    }
}

impl Scalar {
    fn parse(name: &str) -> Result<Self, String> {
        Ok(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return Err(format!("the type {name} is not known")),
        })
    }
}

struct Body<'a> {
    bytes: &'a [u8],
    encoding: Encoding,
}

impl Body<'_> {
    fn number(&mut self, scalar: Scalar) -> Result<f64, String> {
        if self.encoding == Encoding::Ascii {
            return self.word();
        }
        Ok(match scalar {
            Scalar::I8 => f64::from(i8::from_ne_bytes(self.take()?)),
            Scalar::U8 => f64::from(u8::from_ne_bytes(self.take()?)),
            Scalar::I16 => f64::from(i16::from_ne_bytes(self.take()?)),
            Scalar::U16 => f64::from(u16::from_ne_bytes(self.take()?)),
            Scalar::I32 => f64::from(i32::from_ne_bytes(self.take()?)),
            Scalar::U32 => f64::from(u32::from_ne_bytes(self.take()?)),
            Scalar::F32 => f64::from(f32::from_ne_bytes(self.take()?)),
            Scalar::F64 => f64::from_ne_bytes(self.take()?),
        })
    }

    /// The length of a list; longer ones than bytes are left are refused when these run out.
    fn length(&mut self, scalar: Scalar) -> Result<u64, String> {
        let length = self.number(scalar)?;
        if length >= 0.0 { Ok(length as u64) } else { Err(format!("a list has the length {length}")) }
    }

    /// The next bytes in this machine's order.
    fn take<const N: usize>(&mut self) -> Result<[u8; N], String> {
        let (word, rest) = self.bytes.split_first_chunk::<N>().ok_or("it ends too early")?;
        self.bytes = rest;
        let mut word = *word;
        if (self.encoding == Encoding::BigEndian) == cfg!(target_endian = "little") {
            word.reverse();
        }
        Ok(word)
    }

    fn word(&mut self) -> Result<f64, String> {
        let bytes = self.bytes.trim_ascii_start();
        let end = bytes.iter().position(u8::is_ascii_whitespace).unwrap_or(bytes.len());
        if end == 0 {
            return Err("it ends too early".to_owned());
        }
        let (word, rest) = bytes.split_at(end);
        self.bytes = rest;
        let word = String::from_utf8_lossy(word);
        word.parse().map_err(|_| format!("{word:?} is no number"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HEADER: &str = "comment made by hand\nelement vertex 4\nproperty float x\nproperty float y\n\
                          property double z\nproperty uchar red\nelement face 1\n\
                          property list uchar int vertex_indices\nend_header\n";

    fn binary(order: &str) -> Vec<u8> {
        let mut bytes = format!("ply\nformat binary_{order}_endian 1.0\n{HEADER}").into_bytes();
        let big = order == "big";
        let mut word = |word: &[u8]| {
            if big { bytes.extend(word.iter().rev()) } else { bytes.extend(word) }
        };
        for (x, y) in [(0.0_f32, 0.0_f32), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
            word(&x.to_le_bytes());
            word(&y.to_le_bytes());
            word(&0.25_f64.to_le_bytes());
            word(&[200]);
        }
        word(&[4]);
        for corner in 0..4_i32 {
            word(&corner.to_le_bytes());
        }
        bytes
    }

    #[test]
    fn the_three_encodings_give_the_same_mesh() {
        let ascii = format!(
            "ply\r\nformat ascii 1.0\r\n{HEADER}0 0 0.25 200\n1 0 0.25 200\n1 1 0.25 200\n0 1 0.25 200\n4 0 1 2 3\n"
        );
        for bytes in [ascii.into_bytes(), binary("little"), binary("big")] {
            let triangles = parse(&bytes).expect("a PLY");
            assert_eq!(triangles.corners, [[0, 1, 2], [0, 2, 3]]);
            assert_eq!(triangles.positions[2], Point3::new(1.0, 1.0, 0.25));
            assert!(triangles.uv.is_empty());
        }
    }

    #[test]
    fn texture_coordinates_at_vertices_or_faces_are_kept() {
        let at_vertices = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
                           property float z\nproperty float s\nproperty float t\nelement face 1\n\
                           property list uchar int vertex_index\nend_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n";
        let at_faces = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n\
                        property float z\nelement face 1\nproperty list uchar int vertex_indices\n\
                        property list uchar float texcoord\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2 6 0 0 1 0 0 1\n";
        for text in [at_vertices, at_faces] {
            let triangles = parse(text.as_bytes()).expect("a PLY");
            assert_eq!(triangles.uv, [[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]]);
        }
    }

    #[test]
    fn damaged_files_are_refused() {
        let whole = binary("little");
        for end in [0, 3, 40, whole.len() - 30, whole.len() - 1] {
            assert!(parse(&whole[..end]).is_err(), "cut at {end}");
        }
        let text = String::from_utf8_lossy(&whole[..whole.len() - 85]).into_owned();
        let endless = text.replace("vertex 4", "vertex 18446744073709551615");
        assert!(parse(endless.as_bytes()).is_err());
        assert!(parse(b"ply\nformat ascii 1.0\nelement face 9999999999\nend_header\n").is_err());
    }
}
