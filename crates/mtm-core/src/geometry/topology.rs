//! How the triangles of a surface are connected: edges, neighbours, border, smoothing groups.

use crate::geometry::forest::Forest;
use crate::vector::Vec3;
use rayon::prelude::*;

/// Means "no neighbour": a border, non-manifold or flipped edge.
pub(crate) const NO_TRIANGLE: u32 = u32::MAX;

/// Cosine by which two normals must differ beyond the crease angle: keeps rounding from creating creases on
/// flat surfaces.
const CREASE_ROUNDING: f64 = 1e-12;

/// Connectivity of a triangle surface and the smoothing groups of its rest shape.
///
/// Edge `k` of a triangle runs from its corner `k` to its corner `(k + 1) % 3`.
#[derive(Debug)]
pub(crate) struct Topology {
    /// Vertices of each triangle.
    pub triangles: Vec<[u32; 3]>,
    /// Each undirected edge once, smaller vertex first, in ascending order.
    pub edges: Vec<[u32; 2]>,
    /// Edges used by one triangle, in that triangle's direction, ascending by their sorted
    /// vertices.
    pub border_edges: Vec<[u32; 2]>,
    /// Triangle across each edge where exactly two oppositely directed triangles meet.
    pub neighbours: Vec<[u32; 3]>,
    /// Whether each edge of a triangle is used by it alone.
    pub on_border: Vec<[bool; 3]>,
    /// Whether each vertex ends a border edge.
    pub border_vertex: Vec<bool>,
    /// Smoothing group of each corner: corners of one group share a vertex and a normal.
    pub groups: Vec<[u32; 3]>,
    /// Vertex of each smoothing group.
    pub group_vertex: Vec<u32>,
    /// First triangle of each smoothing group.
    pub group_triangle: Vec<u32>,
    /// Every directed edge is used once and so is its reverse.
    pub is_closed: bool,
    /// No directed edge is used twice.
    pub is_consistently_oriented: bool,
}

/// One side of a triangle, filed under its undirected edge.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct TriangleSide {
    edge: [u32; 2],
    triangle: u32,
    k: u8,
    ascending: bool,
}

impl Topology {
    /// Connectivity of triangles whose indices lie in `0..n_vertices`.
    ///
    /// Two triangles are smooth across their edge if they are the only ones there, run through it
    /// in opposite directions and their normals differ by at most the crease angle. Round each
    /// vertex, the corners that smooth edges connect form one smoothing group.
    pub fn new(
        n_vertices: usize,
        triangles: Vec<[u32; 3]>,
        normals: &[Vec3],
        crease_angle: f64,
    ) -> Self {
        let sides = TriangleSide::sorted(&triangles);
        let mut edges = Vec::with_capacity(sides.len() / 2 + 1);
        let mut border_edges = Vec::new();
        let mut neighbours = vec![[NO_TRIANGLE; 3]; triangles.len()];
        let mut on_border = vec![[false; 3]; triangles.len()];
        let mut border_vertex = vec![false; n_vertices];
        let mut joints = Forest::new(3 * triangles.len());
        let (mut is_closed, mut is_consistently_oriented) = (true, true);
        let smooth_cosine = crease_angle.cos() - CREASE_ROUNDING;
        for run in sides.chunk_by(|a, b| a.edge == b.edge) {
            edges.push(run[0].edge);
            let ascending = run.iter().filter(|side| side.ascending).count();
            let descending = run.len() - ascending;
            is_closed &= ascending == 1 && descending == 1;
            is_consistently_oriented &= ascending <= 1 && descending <= 1;
            match run {
                [side] => {
                    let [low, high] = side.edge;
                    border_edges.push(if side.ascending { [low, high] } else { [high, low] });
                    on_border[side.triangle as usize][side.k as usize] = true;
                    border_vertex[low as usize] = true;
                    border_vertex[high as usize] = true;
                }
                [one, two] if one.ascending != two.ascending => {
                    neighbours[one.triangle as usize][one.k as usize] = two.triangle;
                    neighbours[two.triangle as usize][two.k as usize] = one.triangle;
                    let cosine =
                        normals[one.triangle as usize].dot(&normals[two.triangle as usize]);
                    if cosine >= smooth_cosine {
                        // The two sides run in opposite directions: start meets end.
                        joints.join(one.corner(0), two.corner(1));
                        joints.join(one.corner(1), two.corner(0));
                    }
                }
                _ => {}
            }
        }

        let (groups, group_vertex, group_triangle) = corner_groups(joints, &triangles);
        Self {
            triangles,
            edges,
            border_edges,
            neighbours,
            on_border,
            border_vertex,
            groups,
            group_vertex,
            group_triangle,
            is_closed,
            is_consistently_oriented,
        }
    }
}

impl TriangleSide {
    /// The sides of `triangles`, those of one edge next to each other.
    fn sorted(triangles: &[[u32; 3]]) -> Vec<Self> {
        let mut sides: Vec<Self> = Vec::with_capacity(3 * triangles.len());
        for (t, triangle) in triangles.iter().enumerate() {
            for k in 0..3 {
                let (from, to) = (triangle[k], triangle[(k + 1) % 3]);
                let (edge, ascending) =
                    if from < to { ([from, to], true) } else { ([to, from], false) };
                sides.push(Self { edge, triangle: t as u32, k: k as u8, ascending });
            }
        }
        sides.par_sort_unstable();
        sides
    }

    /// Corner number `3 * triangle + k` at the start (0) or end (1) of the side.
    fn corner(&self, end: usize) -> usize {
        3 * self.triangle as usize + (usize::from(self.k) + end) % 3
    }
}

/// Group of each corner, numbered by first corner; vertex and first triangle of each group.
fn corner_groups(
    mut joints: Forest,
    triangles: &[[u32; 3]],
) -> (Vec<[u32; 3]>, Vec<u32>, Vec<u32>) {
    let mut groups = vec![[0; 3]; triangles.len()];
    let (mut group_vertex, mut group_triangle) = (Vec::new(), Vec::new());
    for (t, triangle) in triangles.iter().enumerate() {
        for k in 0..3 {
            let corner = 3 * t + k;
            let root = joints.root(corner);
            // The root is the smallest corner of its set, so it was numbered before.
            groups[t][k] = if root == corner {
                group_vertex.push(triangle[k]);
                group_triangle.push(t as u32);
                group_vertex.len() as u32 - 1
            } else {
                groups[root / 3][root % 3]
            };
        }
    }
    (groups, group_vertex, group_triangle)
}
