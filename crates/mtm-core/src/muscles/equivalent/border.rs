//! The border of a surface as a chain, which alone determines the smooth changes of its winding number.

use std::collections::HashMap;
use std::f64::consts::PI;

use crate::geometry::surface::Surface;
use crate::vector::Vec3;

/// Edges at which the triangles of a surface do not cancel.
///
/// An edge counts by the difference between the numbers of triangles that use it in either direction; vertices
/// at the same position are identified. Without such edges the winding number is an integer everywhere, however
/// the surface overlaps; next to a hole or a flipped triangle it is not.
#[derive(Debug, Clone, Default)]
pub(super) struct Border {
    edges: Vec<BorderEdge>,
}

#[derive(Debug, Clone)]
struct BorderEdge {
    middle: Vec3,
    half_length: f64,
    /// Length times the count of the edge, mm.
    weight: f64,
}

impl Border {
    pub fn new(surface: &Surface) -> Self {
        if surface.is_closed() {
            return Self::default();
        }
        let vertices = surface.vertices();
        let place = places(vertices);
        let mut count: HashMap<(u32, u32), i32> = HashMap::new();
        for triangle in surface.triangles() {
            let [a, b, c] = triangle.map(|v| place[v as usize]);
            for (from, to) in [(a, b), (b, c), (c, a)] {
                *count.entry((from.min(to), from.max(to))).or_default() +=
                    if from < to { 1 } else { -1 };
            }
        }
        let mut open: Vec<_> = count.into_iter().filter(|&(_, n)| n != 0).collect();
        open.sort_unstable();
        let edges = open
            .into_iter()
            .map(|((a, b), n)| {
                let (a, b) = (Vec3::from(vertices[a as usize]), Vec3::from(vertices[b as usize]));
                let length = (b - a).norm();
                let weight = length * f64::from(n.abs());
                BorderEdge { middle: 0.5 * (a + b), half_length: 0.5 * length, weight }
            })
            .collect();
        Self { edges }
    }

    pub fn is_empty(&self) -> bool {
        self.edges.is_empty()
    }

    /// Upper bound of the difference in winding number, apart from its jumps across the surface, between the
    /// centre of a ball and any of its points; infinite above `enough`.
    ///
    /// |∇w| ≤ 1/4π ∮ ds/r² (Biot and Savart), with r the smallest distance of each edge from the ball.
    pub fn change_within(&self, centre: &Vec3, radius: f64, enough: f64) -> f64 {
        let mut sum = 0.0;
        for edge in &self.edges {
            let distance = (edge.middle - centre).norm() - edge.half_length - radius;
            if distance <= 0.0 {
                return f64::INFINITY;
            }
            sum += edge.weight / (distance * distance);
            if sum * radius > 4.0 * PI * enough {
                return f64::INFINITY;
            }
        }
        sum * radius / (4.0 * PI)
    }
}

/// For each vertex, the first one at the same position.
fn places(vertices: &[[f64; 3]]) -> Vec<u32> {
    let mut first: HashMap<[u64; 3], u32> = HashMap::with_capacity(vertices.len());
    // −0 and 0 are the same position.
    let key = |v: &[f64; 3]| v.map(|x| (x + 0.0).to_bits());
    (0..vertices.len() as u32)
        .map(|i| *first.entry(key(&vertices[i as usize])).or_insert(i))
        .collect()
}
