//! Triangle surfaces: closest point and continuous normal, on the rest shape and on moved ones.
//!
//! The only file that refers to parry, whose bounding-volume hierarchy finds the candidates; the distance to a
//! triangle is computed in [`crate::triangle`].

use std::cell::Cell;
use std::cmp::Ordering;
use std::f64::consts::PI;
use std::sync::Arc;

use parry3d_f64::bounding_volume::Aabb;
use parry3d_f64::math::Vector;
use parry3d_f64::partitioning::{Bvh, BvhBuildStrategy, BvhNode};
use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result, check_coordinates};
use crate::geometry::topology::{NO_TRIANGLE, Topology};
use crate::geometry::triangle::Feature;
use crate::geometry::triangle::{self, Facet, TrianglePoint};
use crate::vector::{Vec3, of_each};

/// Angle between facet normals above which an edge is a crease, rad (60°): edges of boxes and teeth stay sharp,
/// coarse round shapes stay smooth.
pub const CREASE_ANGLE: f64 = PI / 3.0;

/// Padding of a triangle's box relative to the largest coordinate: more than the rounding of a
/// computed closest point, so that no candidate is pruned by rounding, and enough to give flat
/// boxes a volume, by which parry splits them.
const BOX_PADDING: f64 = 8.0 * f64::EPSILON;

/// Factor on squared distances to boxes that keeps them a lower bound despite rounding.
const BOUND_SLACK: f64 = 1.0 - 16.0 * f64::EPSILON;

/// Length of a blended normal below which its direction is lost and the facet normal is used instead.
const NORMAL_CANCELLED: f64 = 1e-6;

/// Triangles per parallel task.
const TRIANGLES_PER_TASK: usize = 1024;

/// An immutable triangle surface with closest-point queries and continuous normals.
///
/// Cloning is cheap: connectivity and shape are shared.
#[derive(Debug, Clone)]
pub struct Surface {
    topology: Arc<Topology>,
    shape: Arc<Shape>,
}

/// What depends on the positions of the vertices.
#[derive(Debug)]
struct Shape {
    vertices: Vec<[f64; 3]>,
    facet_normals: Vec<Vec3>,
    /// Unit normal of each smoothing group.
    group_normals: Vec<Vec3>,
    /// Angle-weighted unit normal over all triangles of a vertex, zero if there are none or their normals
    /// cancel.
    vertex_normals: Vec<Vec3>,
    bvh: Bvh,
    area: f64,
    volume: f64,
    mean_edge: f64,
}

/// Closest point of a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Closest {
    /// The point on the surface, mm.
    pub point: [f64; 3],
    /// Unit normal there, continuous across all edges except creases.
    pub normal: [f64; 3],
    /// Triangle it lies on; of several equally close ones, that with the smallest index.
    pub triangle: u32,
    /// Barycentric coordinates on that triangle, non-negative, sum 1.
    pub barycentric: [f64; 3],
    /// Part of that triangle it lies on.
    pub feature: Feature,
    /// Whether it lies on a border edge or vertex: the true partner may be beyond the border.
    pub on_border: bool,
    /// Distance to the query point, mm, never negative.
    pub distance: f64,
    /// The same distance, mm, negative behind the surface (inside, if it is closed).
    ///
    /// The side is determined by the pseudo-normal of the face, edge or vertex, which is correct for every
    /// point (Bærentzen & Aanæs 2005); that of `normal` may fail next to sharp or coarse edges.
    pub signed_distance: f64,
}

impl Surface {
    /// Surface with creases at `CREASE_ANGLE`.
    ///
    /// `vertices`: mm. `triangles`: indices into them, outward normals by the right-hand rule.
    /// Vertices that no triangle uses are allowed.
    ///
    /// # Errors
    /// [`MtmError::Empty`], [`MtmError::NotFinite`], [`MtmError::IndexOutOfRange`], and
    /// [`MtmError::DegenerateTriangle`] for a triangle that names a vertex twice or has an area
    /// below [`DEGENERATE_AREA`](crate::DEGENERATE_AREA) of its longest edge squared.
    pub fn new(vertices: Vec<[f64; 3]>, triangles: Vec<[u32; 3]>) -> Result<Self> {
        Self::with_crease_angle(vertices, triangles, CREASE_ANGLE)
    }

    /// Surface whose edges are creases where facet normals differ by more than `crease_angle`.
    ///
    /// `crease_angle`: rad, 0 to π. Normals are continuous across all other edges; across a crease,
    /// a border, an edge of three or more triangles, or between two triangles of opposite
    /// orientation they jump from one facet's to the other's.
    ///
    /// # Errors
    /// Those of [`Surface::new`], and [`MtmError::OutOfRange`] for the angle.
    pub fn with_crease_angle(
        vertices: Vec<[f64; 3]>,
        triangles: Vec<[u32; 3]>,
        crease_angle: f64,
    ) -> Result<Self> {
        let kind = ErrorKind::Mesh;
        let allowed = "0 to pi rad";
        kind.require((0.0..=PI).contains(&crease_angle), "crease angle", crease_angle, allowed)?;
        kind.require_entries("surface vertices", vertices.len())?;
        kind.require_entries("surface triangles", triangles.len())?;
        check_coordinates("surface vertices", &vertices, kind)?;
        for (row, vertex) in triangles.iter().enumerate() {
            if let Some(&index) = vertex.iter().find(|&&v| v as usize >= vertices.len()) {
                let what = ("surface triangles", row);
                return Err(kind.no_such(what, "vertex", index, vertices.len()));
            }
        }
        let facets = facets(&vertices, &triangles)?;
        let normals: Vec<Vec3> = facets.iter().map(|facet| facet.normal).collect();
        let topology = Topology::new(vertices.len(), triangles, &normals, crease_angle);
        let bvh = Bvh::from_leaves(BvhBuildStrategy::Binned, &boxes(&vertices, &topology));
        let shape = Shape::new(vertices, &topology, facets, bvh);
        Ok(Self { topology: Arc::new(topology), shape: Arc::new(shape) })
    }

    /// The same triangles with moved vertices.
    ///
    /// `vertices`: mm, as many as before. Creases stay where they are in the rest shape, so normals change
    /// continuously with the motion.
    ///
    /// # Errors
    /// [`MtmError::Length`], [`MtmError::NotFinite`], [`MtmError::DegenerateTriangle`].
    pub fn moved(&self, vertices: Vec<[f64; 3]>) -> Result<Self> {
        let expected = self.shape.vertices.len();
        let why = "one for each vertex of the surface at rest";
        ErrorKind::Boundary.require_length("moved vertices", vertices.len(), expected, why)?;
        check_coordinates("moved vertices", &vertices, ErrorKind::Boundary)?;
        let facets = facets(&vertices, &self.topology.triangles)?;
        // The tree of the rest shape with new boxes: neighbours stay neighbours.
        let mut bvh = self.shape.bvh.clone();
        for (t, aabb) in boxes(&vertices, &self.topology).into_iter().enumerate() {
            bvh.insert_or_update_partially(aabb, t as u32, 0.0);
        }
        bvh.refit_without_opt();
        let shape = Shape::new(vertices, &self.topology, facets, bvh);
        Ok(Self { topology: Arc::clone(&self.topology), shape: Arc::new(shape) })
    }

    /// The surface after a rigid motion.
    ///
    /// `rigid`: 4×4 row by row, x' = R x + t, used as given; [`crate::geometry::motion::RigidMotion`] checks
    /// one.
    ///
    /// # Errors
    /// Those of [`Surface::moved`].
    pub fn transformed(&self, rigid: &[[f64; 4]; 4]) -> Result<Self> {
        let image = |x: &[f64; 3]| {
            [0, 1, 2].map(|i| {
                let row = &rigid[i];
                row[0] * x[0] + row[1] * x[1] + row[2] * x[2] + row[3]
            })
        };
        self.moved(self.shape.vertices.iter().map(image).collect())
    }

    /// Closest points of the surface, in the order of `points` (mm, finite).
    ///
    /// Parallel; the result does not depend on the number of threads.
    pub fn closest(&self, points: &[[f64; 3]]) -> Vec<Closest> {
        of_each(points, |point| self.closest_one(point))
    }

    /// Closest point of the surface to `point` (mm, finite).
    ///
    /// Exact to rounding: the tree only skips triangles that cannot be closer.
    pub fn closest_one(&self, point: [f64; 3]) -> Closest {
        let (p, query) = (Vec3::from(point), Vector::from(point));
        // Triangle 0 is the candidate until something closer is found, and wins every tie.
        let start = self.closest_on(&p, 0);
        let start_squared = (p - start.point).norm_squared();
        let best = Cell::new((start_squared, 0, start));
        let bound = |node: &BvhNode, _: f64| {
            let outside = (node.mins() - query).max(query - node.maxs()).max(Vector::ZERO);
            outside.length_squared() * BOUND_SLACK
        };
        let leaf = |t: u32, _: f64| {
            let candidate = self.closest_on(&p, t);
            let squared = (p - candidate.point).norm_squared();
            let (best_squared, best_triangle, _) = best.get();
            if squared < best_squared || (squared == best_squared && t < best_triangle) {
                best.set((squared, t, candidate));
            }
            // Above zero, so that a box at distance zero is still entered and all ties are seen.
            Some(squared + f64::MIN_POSITIVE)
        };
        let _: Option<(u32, f64)> =
            self.shape.bvh.find_best(start_squared + f64::MIN_POSITIVE, bound, leaf);
        let (_, t, found) = best.get();
        self.describe(&p, t, &found)
    }

    /// The point of a triangle with the weights `barycentric` of its corners, mm.
    pub(crate) fn point_at(&self, triangle: u32, barycentric: [f64; 3]) -> [f64; 3] {
        let [a, b, c] = self.corners(triangle as usize);
        (a * barycentric[0] + b * barycentric[1] + c * barycentric[2]).into()
    }

    /// Unit normal at a point of a triangle, continuous across all edges except creases.
    ///
    /// `triangle`: its index, below the number of triangles. `barycentric`: weights of its corners.
    pub fn normal_at(&self, triangle: u32, barycentric: [f64; 3]) -> [f64; 3] {
        self.blended_normal(triangle as usize, barycentric).into()
    }

    /// Positions of the vertices, mm.
    pub fn vertices(&self) -> &[[f64; 3]] {
        &self.shape.vertices
    }

    /// Vertices of each triangle.
    pub fn triangles(&self) -> &[[u32; 3]] {
        &self.topology.triangles
    }

    /// Unit normal of each triangle by the right-hand rule.
    pub fn facet_normals(&self) -> Vec<[f64; 3]> {
        self.shape.facet_normals.iter().map(|&n| n.into()).collect()
    }

    /// Angle-weighted unit normal of each vertex over all its triangles, creases or not.
    ///
    /// Zero for a vertex that no triangle uses or whose normals cancel.
    pub fn vertex_normals(&self) -> Vec<[f64; 3]> {
        self.shape.vertex_normals.iter().map(|&n| n.into()).collect()
    }

    /// Each undirected edge once, smaller vertex first, ascending.
    pub fn edges(&self) -> &[[u32; 2]] {
        &self.topology.edges
    }

    /// Number of edges that one triangle uses.
    pub fn n_border_edges(&self) -> usize {
        self.topology.n_border_edges
    }

    /// Whether every directed edge is used exactly once, and its reverse exactly once.
    pub fn is_closed(&self) -> bool {
        self.topology.is_closed
    }

    /// Enclosed volume, mm³, negative if the normals point inward; none if the surface is open.
    pub fn volume(&self) -> Option<f64> {
        self.topology.is_closed.then_some(self.shape.volume)
    }

    /// Total area, mm².
    pub fn area(&self) -> f64 {
        self.shape.area
    }

    /// Mean edge length, mm; an edge of two triangles counts once.
    pub fn mean_edge_length(&self) -> f64 {
        self.shape.mean_edge
    }

    /// An ordering of surfaces by their shape alone, so that sums over several of them do not depend on the
    /// order in which they are listed; only identical shapes compare equal.
    pub(crate) fn order(&self, other: &Self) -> Ordering {
        let coordinates = |s: &Self| s.shape.vertices.as_flattened().to_vec();
        let by_area = self.area().total_cmp(&other.area());
        by_area
            .then_with(|| {
                let pairs = coordinates(self).into_iter().zip(coordinates(other));
                pairs.map(|(a, b)| a.total_cmp(&b)).find(|o| o.is_ne()).unwrap_or(Ordering::Equal)
            })
            .then_with(|| self.triangles().cmp(other.triangles()))
    }

    pub(crate) fn corners(&self, triangle: usize) -> [Vec3; 3] {
        triangle::corners(&self.shape.vertices, self.topology.triangles[triangle])
    }

    pub(crate) fn facet_normal(&self, triangle: usize) -> Vec3 {
        self.shape.facet_normals[triangle]
    }

    /// Unit normals at the corners of a triangle, from which normals on it are blended.
    pub(crate) fn corner_normals(&self, triangle: usize) -> [Vec3; 3] {
        self.topology.groups[triangle].map(|g| self.shape.group_normals[g as usize])
    }

    fn closest_on(&self, p: &Vec3, t: u32) -> TrianglePoint {
        let t = t as usize;
        triangle::closest_point(p, &self.corners(t), self.topology.triangles[t])
    }

    fn blended_normal(&self, t: usize, barycentric: [f64; 3]) -> Vec3 {
        let [a, b, c] = self.corner_normals(t);
        let blend = a * barycentric[0] + b * barycentric[1] + c * barycentric[2];
        let length = blend.norm();
        if length > NORMAL_CANCELLED { blend / length } else { self.shape.facet_normals[t] }
    }

    fn describe(&self, p: &Vec3, triangle: u32, found: &TrianglePoint) -> Closest {
        let (topology, shape) = (&*self.topology, &*self.shape);
        let t = triangle as usize;
        let facet_normal = shape.facet_normals[t];
        let (on_border, pseudo_normal) = match found.feature {
            Feature::Face => (false, facet_normal),
            Feature::Edge(k) => {
                let k = k as usize;
                let across = match topology.neighbours[t][k] {
                    NO_TRIANGLE => Vec3::zeros(),
                    neighbour => shape.facet_normals[neighbour as usize],
                };
                (topology.on_border[t][k], facet_normal + across)
            }
            Feature::Vertex(k) => {
                let vertex = topology.triangles[t][k as usize] as usize;
                (topology.border_vertex[vertex], shape.vertex_normals[vertex])
            }
        };
        let offset = p - found.point;
        let distance = offset.norm();
        let behind = offset.dot(&pseudo_normal) < 0.0;
        Closest {
            point: found.point.into(),
            normal: self.blended_normal(t, found.barycentric).into(),
            triangle,
            barycentric: found.barycentric,
            feature: found.feature,
            on_border,
            distance,
            signed_distance: if behind { -distance } else { distance },
        }
    }
}

impl Shape {
    fn new(vertices: Vec<[f64; 3]>, topology: &Topology, facets: Vec<Facet>, bvh: Bvh) -> Self {
        let mut group_sums = vec![Vec3::zeros(); topology.group_vertex.len()];
        let mut vertex_sums = vec![Vec3::zeros(); vertices.len()];
        let (mut area, mut volume) = (0.0, 0.0);
        // Volumes of tets to a point near the surface: the digits of a distant origin would be
        // lost.
        let origin = triangle::corners(&vertices, topology.triangles[0])[0];
        for (t, facet) in facets.iter().enumerate() {
            let corners = triangle::corners(&vertices, topology.triangles[t]);
            for k in 0..3 {
                group_sums[topology.groups[t][k] as usize] += facet.normal * facet.angles[k];
            }
            area += facet.area;
            volume += facet.area * facet.normal.dot(&(corners[0] - origin)) / 3.0;
        }
        for (group, &vertex) in topology.group_vertex.iter().enumerate() {
            vertex_sums[vertex as usize] += group_sums[group];
        }
        let unit = |sum: Vec3, fallback: Vec3| {
            let length = sum.norm();
            if length > NORMAL_CANCELLED { sum / length } else { fallback }
        };
        let group_normals = group_sums
            .iter()
            .zip(&topology.group_triangle)
            .map(|(&sum, &t)| unit(sum, facets[t as usize].normal))
            .collect();
        let vertex_normals = vertex_sums.into_iter().map(|sum| unit(sum, Vec3::zeros())).collect();
        let edge_length = |&[a, b]: &[u32; 2]| {
            (Vec3::from(vertices[b as usize]) - Vec3::from(vertices[a as usize])).norm()
        };
        let mean_edge =
            topology.edges.iter().map(edge_length).sum::<f64>() / topology.edges.len() as f64;
        Self {
            facet_normals: facets.iter().map(|facet| facet.normal).collect(),
            group_normals,
            vertex_normals,
            bvh,
            area,
            volume,
            mean_edge,
            vertices,
        }
    }
}

/// Shape of each triangle, or the first degenerate one as an error.
fn facets(vertices: &[[f64; 3]], triangles: &[[u32; 3]]) -> Result<Vec<Facet>> {
    let shapes: Vec<std::result::Result<Facet, f64>> = triangles
        .par_iter()
        .with_min_len(TRIANGLES_PER_TASK)
        .map(|&[a, b, c]| {
            let corners = triangle::corners(vertices, [a, b, c]);
            if a == b || b == c || c == a { Err(0.0) } else { triangle::facet(&corners) }
        })
        .collect();
    let degenerate = |t: usize, area: f64| MtmError::DegenerateTriangle {
        what: "surface".to_owned(),
        triangle: t,
        area,
        vertices: triangles[t],
    };
    shapes
        .into_iter()
        .enumerate()
        .map(|(t, facet)| facet.map_err(|area| degenerate(t, area)))
        .collect()
}

/// Box of each triangle, padded by [`BOX_PADDING`].
fn boxes(vertices: &[[f64; 3]], topology: &Topology) -> Vec<Aabb> {
    let largest = vertices.iter().flatten().fold(0.0_f64, |largest, x| largest.max(x.abs()));
    let padding = Vector::splat(largest * BOX_PADDING);
    topology
        .triangles
        .par_iter()
        .with_min_len(TRIANGLES_PER_TASK)
        .map(|triangle| {
            let [a, b, c] = triangle.map(|v| Vector::from(vertices[v as usize]));
            Aabb::new(a.min(b).min(c) - padding, a.max(b).max(c) + padding)
        })
        .collect()
}
