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
    /// Number of edges used by one triangle.
    pub n_border_edges: usize,
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
        let mut n_border_edges = 0;
        let mut neighbours = vec![[NO_TRIANGLE; 3]; triangles.len()];
        let mut on_border = vec![[false; 3]; triangles.len()];
        let mut border_vertex = vec![false; n_vertices];
        let mut joints = Forest::new(3 * triangles.len());
        let mut is_closed = true;
        let smooth_cosine = crease_angle.cos() - CREASE_ROUNDING;
        for run in sides.chunk_by(|a, b| a.edge == b.edge) {
            edges.push(run[0].edge);
            let ascending = run.iter().filter(|side| side.ascending).count();
            is_closed &= ascending == 1 && run.len() == 2;
            match run {
                [side] => {
                    let [low, high] = side.edge;
                    n_border_edges += 1;
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
            n_border_edges,
            neighbours,
            on_border,
            border_vertex,
            groups,
            group_vertex,
            group_triangle,
            is_closed,
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
fn corner_groups(joints: Forest, triangles: &[[u32; 3]]) -> (Vec<[u32; 3]>, Vec<u32>, Vec<u32>) {
    let numbers = joints.numbered();
    let (mut vertex, mut triangle) = (Vec::new(), Vec::new());
    for (corner, (&group, &v)) in numbers.iter().zip(triangles.as_flattened()).enumerate() {
        if group as usize == vertex.len() {
            vertex.push(v);
            triangle.push((corner / 3) as u32);
        }
    }
    (numbers.as_chunks::<3>().0.to_vec(), vertex, triangle)
}
