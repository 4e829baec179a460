//! Triangle meshes, met without gaps between triangles.

use std::sync::Arc;

use nalgebra::{Point3, Vector3};

use super::bvh::Bvh;
use super::{Bounds, Ray, Span};

/// Triangles per leaf: fewer make the tree large, more make rays slow.
const LEAF_SIZE: usize = 4;

/// A surface of triangles. Its front is where vertices run counter-clockwise.
#[derive(Clone, Debug)]
pub struct TriangleMesh {
    positions: Vec<Point3<f64>>,
    triangles: Vec<[u32; 3]>,
    /// Texture coordinates of each triangle's corners, empty when there are none: u to the right, v up,
    /// the whole texture from 0 to 1.
    uv: Vec<[[f32; 2]; 3]>,
    /// Of each vertex, the mean over its triangles by area.
    normals: Vec<Vector3<f32>>,
    bvh: Bvh,
}

/// Where a ray meets a mesh.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeshHit {
    /// The ray's `t`.
    pub t: f64,
    /// The index of the triangle.
    pub triangle: usize,
    /// Weights of its corners; they add up to 1.
    pub weights: [f64; 3],
    /// Whether the ray came from the side where vertices run counter-clockwise.
    pub front: bool,
}

impl TriangleMesh {
    /// Builds the search tree. Triangles that name a vertex that is not there, have a vertex that is not
    /// finite or no area are left out. `uv` is empty or has one entry per triangle.
    ///
    /// # Panics
    /// When `uv` has another length.
    pub fn new(positions: Vec<Point3<f64>>, triangles: &[[u32; 3]], uv: &[[[f32; 2]; 3]]) -> Self {
        assert!(uv.is_empty() || uv.len() == triangles.len(), "texture coordinates are given per triangle");
        let corners = |triangle: &[u32; 3]| triangle.map(|v| positions.get(v as usize).copied());
        let usable = |triangle: &[u32; 3]| {
            let [Some(a), Some(b), Some(c)] = corners(triangle) else { return false };
            let area = (b - a).cross(&(c - a)).norm_squared();
            area > 0.0 && area.is_finite()
        };
        let kept: Vec<usize> = (0..triangles.len()).filter(|i| usable(&triangles[*i])).collect();
        let uv = if uv.is_empty() { Vec::new() } else { kept.iter().map(|i| uv[*i]).collect() };
        let triangles: Vec<[u32; 3]> = kept.iter().map(|i| triangles[*i]).collect();
        let mut normals = vec![Vector3::<f64>::zeros(); positions.len()];
        let mut bounds = Vec::with_capacity(triangles.len());
        for triangle in &triangles {
            let [a, b, c] = triangle.map(|v| positions[v as usize]);
            let normal = (b - a).cross(&(c - a));
            for v in triangle {
                normals[*v as usize] += normal;
            }
            bounds.push(Bounds { min: a.inf(&b).inf(&c), max: a.sup(&b).sup(&c) });
        }
        let normals =
            normals.iter().map(|n| n.try_normalize(0.0).unwrap_or_else(Vector3::z).cast::<f32>()).collect();
        let bvh = Bvh::new(&bounds, LEAF_SIZE);
        Self { positions, triangles, uv, normals, bvh }
    }

    /// Number of triangles.
    pub fn len(&self) -> usize {
        self.triangles.len()
    }

    /// Whether there are no triangles.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// Whether corners have texture coordinates.
    pub fn has_uv(&self) -> bool {
        !self.uv.is_empty()
    }

    /// A box that holds all triangles; `None` when there are none.
    pub fn bounds(&self) -> Option<Bounds> {
        self.bvh.bounds()
    }

    /// The first hit within `span`.
    ///
    /// A ray that passes between two triangles of one edge meets one of them (Woop, Benthin and Wald,
    /// Watertight Ray/Triangle Intersection, 2013).
    #[inline]
    pub fn intersect(&self, ray: &Ray, span: Span) -> Option<MeshHit> {
        let sheared = Sheared::new(ray);
        let mut nearest = None;
        self.bvh.visit(&ray.origin, &ray.direction, span, |index, max| {
            let hit = self.intersect_triangle(&sheared, index, Span { min: span.min, max });
            nearest = hit.or(nearest);
            Some(hit.map_or(max, |hit| hit.t))
        });
        nearest
    }

    #[inline]
    fn intersect_triangle(&self, ray: &Sheared, triangle: usize, span: Span) -> Option<MeshHit> {
        let [a, b, c] = self.triangles[triangle].map(|v| ray.to_frame(&self.positions[v as usize]));
        // Twice the areas that the ray cuts the triangle into. Both triangles of an edge compute the same
        // number for it, but for the sign.
        let u = c.x * b.y - c.y * b.x;
        let v = a.x * c.y - a.y * c.x;
        let w = b.x * a.y - b.y * a.x;
        if (u < 0.0 || v < 0.0 || w < 0.0) && (u > 0.0 || v > 0.0 || w > 0.0) {
            return None;
        }
        let sum = u + v + w;
        if sum == 0.0 {
            return None;
        }
        let weights = [u / sum, v / sum, w / sum];
        let t = (weights[0] * a.z + weights[1] * b.z + weights[2] * c.z) * ray.scale;
        span.contains(t).then_some(MeshHit { t, triangle, weights, front: sum > 0.0 })
    }

    /// The normal of the front at a hit, of length 1: of the plane of the triangle, or smooth over the
    /// edges.
    pub fn normal(&self, hit: &MeshHit, smooth: bool) -> Vector3<f64> {
        let corners = self.triangles[hit.triangle];
        let [a, b, c] = corners.map(|v| self.positions[v as usize]);
        let flat = (b - a).cross(&(c - a)).normalize();
        if !smooth {
            return flat;
        }
        let sum: Vector3<f64> =
            corners.iter().zip(hit.weights).map(|(v, w)| self.normals[*v as usize].cast::<f64>() * w).sum();
        let mean = sum.try_normalize(1e-6).unwrap_or(flat);
        // Where a crease was smoothed over, the mean may point elsewhere entirely.
        if mean.dot(&flat) > 0.3 { mean } else { flat }
    }

    /// The texture coordinates at a hit; `None` without any.
    pub fn uv(&self, hit: &MeshHit) -> Option<[f64; 2]> {
        let corners = self.uv.get(hit.triangle)?;
        Some([0, 1].map(|axis| {
            corners.iter().zip(hit.weights).map(|(corner, weight)| f64::from(corner[axis]) * weight).sum()
        }))
    }

    /// How far texture coordinates run per unit of length on the surface, on average; 0 without any.
    pub fn uv_per_length(&self) -> f64 {
        let (mut surface, mut texture) = (0.0, 0.0);
        for (triangle, [p, q, r]) in self.triangles.iter().zip(&self.uv) {
            let [a, b, c] = triangle.map(|v| self.positions[v as usize]);
            surface += (b - a).cross(&(c - a)).norm();
            texture += f64::from(((q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0])).abs());
        }
        if surface > 0.0 { (texture / surface).sqrt() } else { 0.0 }
    }
}

/// A ray whose frame has it along z.
struct Sheared {
    origin: Point3<f64>,
    axes: [usize; 3],
    shear: [f64; 2],
    /// What one unit of z is in the ray's `t`.
    scale: f64,
}

impl Sheared {
    fn new(ray: &Ray) -> Self {
        let z = ray.direction.iamax();
        let (mut x, mut y) = ((z + 1) % 3, (z + 2) % 3);
        // Keeps the sense of turning.
        if ray.direction[z] < 0.0 {
            (x, y) = (y, x);
        }
        let along = ray.direction[z];
        let shear = [ray.direction[x] / along, ray.direction[y] / along];
        Self { origin: ray.origin, axes: [x, y, z], shear, scale: along.recip() }
    }

    #[inline]
    fn to_frame(&self, point: &Point3<f64>) -> Vector3<f64> {
        let from = point - self.origin;
        let [x, y, z] = self.axes;
        Vector3::new(from[x] - self.shear[0] * from[z], from[y] - self.shear[1] * from[z], from[z])
    }
}

/// A mesh as the shape of a body: enlarged, and seen with its own texture or not.
#[derive(Clone, Debug)]
pub struct MeshShape {
    /// The triangles.
    pub mesh: Arc<TriangleMesh>,
    /// What one unit of the mesh is in the scene.
    pub scale: f64,
    /// Whether coordinates along the surface are those of the mesh's texture.
    pub textured: bool,
}

impl MeshShape {
    fn to_mesh(&self, ray: &Ray) -> Ray {
        Ray { origin: ray.origin / self.scale, direction: ray.direction / self.scale }
    }

    pub(super) fn intersect(&self, ray: &Ray, span: Span) -> Option<f64> {
        self.mesh.intersect(&self.to_mesh(ray), span).map(|hit| hit.t)
    }

    pub(super) fn bounds(&self) -> Bounds {
        let nothing = Bounds { min: Point3::origin(), max: Point3::origin() };
        let Bounds { min, max } = self.mesh.bounds().unwrap_or(nothing);
        Bounds { min: min * self.scale, max: max * self.scale }
    }

    /// The normal and the coordinates along the surface where a ray first meets it, at `point`.
    pub(super) fn surface(&self, ray: &Ray, point: &Point3<f64>) -> (Vector3<f64>, [f64; 2]) {
        let everything = Span { min: 0.0, max: f64::INFINITY };
        let Some(hit) = self.mesh.intersect(&self.to_mesh(ray), everything) else {
            return (Vector3::z(), [0.0; 2]);
        };
        let normal = self.mesh.normal(&hit, true);
        let along = match self.mesh.uv(&hit).filter(|_| self.textured) {
            Some(uv) => uv,
            None => match normal.iamax() {
                0 => [point.y, point.z],
                1 => [point.x, point.z],
                _ => [point.x, point.y],
            },
        };
        (normal, along)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A closed, bumpy surface around the origin; its vertices are shared, so it has no gaps.
    fn closed() -> TriangleMesh {
        let (rings, sectors) = (14, 17);
        let mut positions = vec![Point3::new(0.0, 0.0, -1.0)];
        for ring in 1..rings {
            for sector in 0..sectors {
                let polar = std::f64::consts::PI * f64::from(ring) / f64::from(rings);
                let around = std::f64::consts::TAU * f64::from(sector) / f64::from(sectors);
                let radius = 1.0 + 0.2 * (3.0 * around).sin() * polar.sin();
                let ring = radius * polar.sin();
                positions.push(Point3::new(ring * around.cos(), ring * around.sin(), -radius * polar.cos()));
            }
        }
        positions.push(Point3::new(0.0, 0.0, 1.0));
        let top = positions.len() as u32 - 1;
        let (rings, sectors) = (rings as u32, sectors as u32);
        let at = |ring: u32, sector: u32| 1 + (ring - 1) * sectors + sector % sectors;
        let mut triangles = Vec::new();
        for s in 0..sectors {
            triangles.push([0, at(1, s + 1), at(1, s)]);
            triangles.push([top, at(rings - 1, s), at(rings - 1, s + 1)]);
            for r in 1..rings - 1 {
                triangles.push([at(r, s), at(r, s + 1), at(r + 1, s + 1)]);
                triangles.push([at(r, s), at(r + 1, s + 1), at(r + 1, s)]);
            }
        }
        TriangleMesh::new(positions, &triangles, &[])
    }

    const EVERYTHING: Span = Span { min: 0.0, max: f64::INFINITY };

    proptest! {
        /// Rays from the middle through vertices and edges are where a leak would show.
        #[test]
        fn no_ray_leaves_a_closed_mesh(a in 0_usize..223, b in 0_usize..223, share in 0.0_f64..=1.0) {
            let mesh = closed();
            let aim = mesh.positions[a].coords.lerp(&mesh.positions[b].coords, share);
            prop_assume!(aim.norm() > 1e-3);
            let origin = Point3::new(0.01, -0.02, 0.03);
            let ray = Ray { origin, direction: aim - origin.coords };
            let hit = mesh.intersect(&ray, EVERYTHING).expect("the mesh is closed");
            prop_assert!(!hit.front, "the inside is the back");
            // Seen from outside at the same place, the front comes first.
            let outside = Ray { origin: ray.at(10.0 / ray.direction.norm()), direction: -ray.direction };
            prop_assert!(mesh.intersect(&outside, EVERYTHING).expect("hit from outside").front);
        }

        #[test]
        fn the_tree_finds_what_a_plain_search_finds(
            origin in prop::array::uniform3(-2.0_f64..2.0),
            target in prop::array::uniform3(-1.0_f64..1.0),
        ) {
            let mesh = closed();
            let ray = Ray { origin: origin.into(), direction: Point3::from(target) - Point3::from(origin) };
            let sheared = Sheared::new(&ray);
            let plain = (0..mesh.len())
                .filter_map(|i| mesh.intersect_triangle(&sheared, i, EVERYTHING))
                .min_by(|a, b| a.t.total_cmp(&b.t));
            prop_assert_eq!(mesh.intersect(&ray, EVERYTHING).map(|hit| hit.t), plain.map(|hit| hit.t));
        }
    }

    #[test]
    fn what_is_no_triangle_is_left_out() {
        let positions = vec![
            Point3::origin(),
            Point3::new(1.0, 0.0, 0.0),
            Point3::new(0.0, 1.0, 0.0),
            Point3::new(f64::NAN, 0.0, 0.0),
        ];
        let mesh = TriangleMesh::new(positions, &[[0, 1, 2], [0, 1, 1], [0, 1, 9], [0, 1, 3]], &[]);
        assert_eq!(mesh.len(), 1);
        assert!(TriangleMesh::new(Vec::new(), &[], &[]).bounds().is_none());
    }

    #[test]
    fn a_hit_carries_weights_texture_coordinates_and_the_side() {
        let positions = vec![Point3::origin(), Point3::new(2.0, 0.0, 0.0), Point3::new(0.0, 2.0, 0.0)];
        let mesh = TriangleMesh::new(positions, &[[0, 1, 2]], &[[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]]);
        let down = Ray { origin: Point3::new(0.5, 1.0, 3.0), direction: Vector3::new(0.0, 0.0, -2.0) };
        let hit = mesh.intersect(&down, EVERYTHING).expect("hit");
        assert_eq!((hit.t, hit.front), (1.5, true));
        assert_eq!(hit.weights, [0.25, 0.25, 0.5]);
        assert_eq!(mesh.uv(&hit), Some([0.25, 0.5]));
        assert_eq!(mesh.normal(&hit, false), Vector3::z());
        let up = Ray { origin: Point3::new(0.5, 1.0, -3.0), direction: Vector3::z() };
        assert!(!mesh.intersect(&up, EVERYTHING).expect("hit from below").front);
        assert!((mesh.uv_per_length() - 0.5).abs() < 1e-12);
    }
}
