//! Depth maps as bytes: what the store keeps and what travels between processes.
//!
//! ```text
//! magic 8 | width u32 | height u32 | fx fy skew cx cy f64 | R 9 x f64 (by columns) | t 3 x f64
//!         | payload, row by row from the top; all little-endian
//! ```

use bytes::BufMut;
use nalgebra::{Matrix3, Vector3};
use planesweep_fusion::{FilteredMapError, Funnel, VertexFormat};
use planesweep_scene::{Camera, CameraError, DepthMap, DepthMapError, Intrinsics, Pose, Raster};
use thiserror::Error;

const DEPTH_MAP: [u8; 8] = *b"PSDEPTH1";
const POINTS: [u8; 8] = *b"PSPOINT2";
/// Longest side of a map that is read; a header that says more is damaged.
const MAX_SIDE: u32 = 1 << 17;

/// Why bytes are no map.
#[derive(Debug, Error, PartialEq)]
pub enum BlobError {
    /// The first bytes are not those of this kind of map.
    #[error("blob is not a {expected}")]
    Kind {
        /// What was to be read.
        expected: &'static str,
    },
    /// There are fewer or more bytes than the header says.
    #[error("blob has {got} bytes where its header says {expected}")]
    Length {
        /// By the header.
        expected: u64,
        /// There are.
        got: u64,
    },
    /// The camera in the header is none.
    #[error("blob has no valid camera")]
    Camera(#[from] CameraError),
    /// The filtered map in it is none.
    #[error(transparent)]
    FilteredMap(#[from] FilteredMapError),
    /// The parts do not fit together.
    #[error("blob is no depth map")]
    DepthMap(#[from] DepthMapError),
}

/// A depth map as bytes, [`depth_map_bytes`] of them.
pub fn encode_depth_map(map: &DepthMap, out: &mut dyn BufMut) {
    put_header(out, DEPTH_MAP, &map.camera);
    put_floats(out, map.depth.values());
    put_floats(out, map.confidence.values());
    put_colors(out, map.color.values());
}

/// How many bytes a depth map has.
pub fn depth_map_bytes(map: &DepthMap) -> usize {
    HEADER_BYTES + map.width() * map.height() * DEPTH_MAP_PIXEL_BYTES
}

/// A depth map from the bytes of `encode_depth_map`.
pub fn decode_depth_map(bytes: &[u8]) -> Result<DepthMap, BlobError> {
    let mut reader = Reader { bytes, total: bytes.len() };
    let camera = reader.header(DEPTH_MAP, "depth map", DEPTH_MAP_PIXEL_BYTES)?;
    let depth = reader.floats(&camera)?;
    let confidence = reader.floats(&camera)?;
    let color = reader.colors(&camera)?;
    Ok(DepthMap::new(camera, depth, confidence, color)?)
}

/// The points of one view as bytes: its funnel, then `vertices` as the PLY file will hold them.
pub fn encode_points(funnel: &Funnel, format: VertexFormat, vertices: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(POINTS_HEADER_BYTES + vertices.len());
    bytes.extend_from_slice(&POINTS);
    bytes.extend([u8::from(format.double), u8::from(format.quality)]);
    put_funnel(&mut bytes, funnel);
    bytes.extend_from_slice(vertices);
    bytes
}

/// What [`encode_points`] made bytes of; the vertices are whole ones.
pub fn decode_points(bytes: &[u8]) -> Result<(Funnel, VertexFormat, &[u8]), BlobError> {
    let mut reader = Reader { bytes, total: bytes.len() };
    if reader.array()? != POINTS {
        return Err(BlobError::Kind { expected: "view's points" });
    }
    let [double, quality] = reader.array()?.map(|flag: u8| flag != 0);
    let format = VertexFormat { double, quality };
    let funnel = reader.funnel()?;
    match reader.bytes.len() % format.vertex_bytes() {
        0 => Ok((funnel, format, reader.bytes)),
        part => Err(BlobError::Length { expected: (bytes.len() - part) as u64, got: bytes.len() as u64 }),
    }
}

const HEADER_BYTES: usize = 8 + 2 * 4 + (5 + 9 + 3) * 8;
const FUNNEL_BYTES: usize = 6 * 8;
const POINTS_HEADER_BYTES: usize = 8 + 2 + FUNNEL_BYTES;
const DEPTH_MAP_PIXEL_BYTES: usize = 4 + 4 + 3;

fn put_header(out: &mut dyn BufMut, magic: [u8; 8], camera: &Camera) {
    let k = &camera.intrinsics;
    out.put_slice(&magic);
    out.put_u32_le(k.width);
    out.put_u32_le(k.height);
    let inner = [k.fx, k.fy, k.skew, k.cx, k.cy];
    let pose = camera.pose.rotation.iter().chain(camera.pose.translation.iter());
    for value in inner.iter().chain(pose) {
        out.put_f64_le(*value);
    }
}

fn put_floats(out: &mut dyn BufMut, values: &[f32]) {
    // In pieces that stay in the processor's nearest cache.
    let mut piece = [[0; 4]; 1024];
    for values in values.chunks(piece.len()) {
        for (bytes, value) in piece.iter_mut().zip(values) {
            *bytes = value.to_le_bytes();
        }
        out.put_slice(piece[..values.len()].as_flattened());
    }
}

/// The colours alone: confidences are there as floats.
fn put_colors(out: &mut dyn BufMut, colors: &[[u8; 4]]) {
    let mut piece = [[0; 3]; 1024];
    for colors in colors.chunks(piece.len()) {
        for (bytes, [r, g, b, _]) in piece.iter_mut().zip(colors) {
            *bytes = [*r, *g, *b];
        }
        out.put_slice(piece[..colors.len()].as_flattened());
    }
}

fn put_funnel(bytes: &mut Vec<u8>, funnel: &Funnel) {
    let Funnel { pixels, with_depth, photometric, visible, geometric, emitted } = *funnel;
    for count in [pixels, with_depth, photometric, visible, geometric, emitted] {
        bytes.extend_from_slice(&count.to_le_bytes());
    }
}

fn pixels_of(camera: &Camera) -> usize {
    camera.intrinsics.width as usize * camera.intrinsics.height as usize
}

fn raster<T>(camera: &Camera, values: Vec<T>) -> Raster<T> {
    Raster::new(camera.intrinsics.width as usize, camera.intrinsics.height as usize, values)
        .expect("as many values as pixels were taken")
}

struct Reader<'a> {
    bytes: &'a [u8],
    total: usize,
}

impl<'a> Reader<'a> {
    fn take(&mut self, length: usize) -> Result<&'a [u8], BlobError> {
        let (taken, rest) = self.bytes.split_at_checked(length).ok_or(BlobError::Length {
            expected: (self.total - self.bytes.len() + length) as u64,
            got: self.total as u64,
        })?;
        self.bytes = rest;
        Ok(taken)
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], BlobError> {
        let mut array = [0; N];
        array.copy_from_slice(self.take(N)?);
        Ok(array)
    }

    fn u32(&mut self) -> Result<u32, BlobError> {
        self.array().map(u32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, BlobError> {
        self.array().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, BlobError> {
        self.array().map(f64::from_le_bytes)
    }

    fn funnel(&mut self) -> Result<Funnel, BlobError> {
        let mut counts = [0; 6];
        for count in &mut counts {
            *count = self.u64()?;
        }
        let [pixels, with_depth, photometric, visible, geometric, emitted] = counts;
        Ok(Funnel { pixels, with_depth, photometric, visible, geometric, emitted })
    }

    /// Reads the header and checks that the rest is `pixel_bytes` for each pixel.
    fn header(
        &mut self,
        magic: [u8; 8],
        expected: &'static str,
        pixel_bytes: usize,
    ) -> Result<Camera, BlobError> {
        if self.bytes.get(..8) != Some(&magic) {
            return Err(BlobError::Kind { expected });
        }
        self.take(8)?;
        let (width, height) = (self.u32()?, self.u32()?);
        let [fx, fy, skew, cx, cy] = [self.f64()?, self.f64()?, self.f64()?, self.f64()?, self.f64()?];
        let mut pose = [0.0; 12];
        for value in &mut pose {
            *value = self.f64()?;
        }
        let intrinsics = Intrinsics { width, height, fx, fy, skew, cx, cy }.checked()?;
        let rotation = Matrix3::from_column_slice(&pose[..9]);
        let pose = Pose::new(rotation, Vector3::from_column_slice(&pose[9..]))?;
        let payload = (width.min(MAX_SIDE) as u64) * (height.min(MAX_SIDE) as u64) * pixel_bytes as u64;
        if width > MAX_SIDE || height > MAX_SIDE || self.bytes.len() as u64 != payload {
            let expected = payload + HEADER_BYTES as u64;
            return Err(BlobError::Length { expected, got: self.total as u64 });
        }
        Ok(Camera { intrinsics, pose })
    }

    fn floats(&mut self, camera: &Camera) -> Result<Raster<f32>, BlobError> {
        let bytes = self.take(4 * pixels_of(camera))?;
        let (values, _) = bytes.as_chunks::<4>();
        Ok(raster(camera, values.iter().map(|value| f32::from_le_bytes(*value)).collect()))
    }

    fn colors(&mut self, camera: &Camera) -> Result<Raster<[u8; 3]>, BlobError> {
        let (values, _) = self.take(3 * pixels_of(camera))?.as_chunks::<3>();
        Ok(raster(camera, values.to_vec()))
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;
    use proptest::prelude::*;

    use super::*;

    fn camera(width: u32, height: u32) -> Camera {
        let intrinsics = Intrinsics { width, height, fx: 9.5, fy: 9.25, skew: 0.125, cx: 3.5, cy: 2.0 };
        let pose = Pose::look_at(&Point3::new(1.0, 2.0, 3.0), &Point3::origin(), &Vector3::y());
        Camera { intrinsics, pose }
    }

    fn depth_map() -> DepthMap {
        let (depth, confidence) = (|x, y| (x + 8 * y) as f32, |x, y| (x * y) as f32 / 35.0);
        let color = |x, y| [x as u8, y as u8, 7];
        DepthMap::new(
            camera(8, 6),
            Raster::from_fn(8, 6, depth),
            Raster::from_fn(8, 6, confidence),
            Raster::from_fn(8, 6, color),
        )
        .expect("sizes agree")
    }

    fn depth_map_as_bytes() -> Vec<u8> {
        let mut bytes = Vec::new();
        encode_depth_map(&depth_map(), &mut bytes);
        bytes
    }

    fn funnel() -> Funnel {
        Funnel { pixels: 48, with_depth: 47, photometric: 20, visible: 19, geometric: 9, emitted: 3 }
    }

    #[test]
    fn maps_survive_the_bytes() {
        let bytes = depth_map_as_bytes();
        assert_eq!(bytes.len(), depth_map_bytes(&depth_map()));
        assert_eq!(decode_depth_map(&bytes), Ok(depth_map()));
    }

    #[test]
    fn points_keep_their_funnel_and_partial_vertices_are_refused() {
        for format in [VertexFormat::default(), VertexFormat { double: true, quality: true }] {
            let vertices = vec![3; 2 * format.vertex_bytes()];
            let bytes = encode_points(&funnel(), format, &vertices);
            assert_eq!(decode_points(&bytes), Ok((funnel(), format, &vertices[..])));
            assert!(decode_points(&bytes[..bytes.len() - 1]).is_err());
            assert!(decode_points(&bytes[..9]).is_err());
        }
    }

    #[test]
    fn one_kind_is_not_taken_for_the_other() {
        let points = encode_points(&funnel(), VertexFormat::default(), &[]);
        assert_eq!(decode_depth_map(&points), Err(BlobError::Kind { expected: "depth map" }));
        assert!(decode_points(&depth_map_as_bytes()).is_err());
    }

    #[test]
    fn a_header_that_promises_too_much_is_refused_before_allocation() {
        let mut bytes = depth_map_as_bytes();
        bytes[8..16].fill(0xff);
        assert!(matches!(decode_depth_map(&bytes), Err(BlobError::Length { .. })));
    }

    proptest! {
        #[test]
        fn truncation_and_damage_never_panic(cut in 0_usize..700, at in 0_usize..700, value: u8) {
            let mut bytes = depth_map_as_bytes();
            let at = at % bytes.len();
            bytes[at] = value;
            bytes.truncate(bytes.len() - cut.min(bytes.len()));
            prop_assert!(cut == 0 || decode_depth_map(&bytes).is_err());
        }
    }
}
