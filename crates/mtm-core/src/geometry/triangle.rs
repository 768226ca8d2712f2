//! Geometry of one triangle: closest point, corner angles, flat normal, degeneracy.

use crate::vector::Vec3;

/// Area of a triangle over its longest edge squared, below which it has no usable normal.
///
/// At this limit rounding of double-precision corners turns the normal by about 1e-6 rad.
pub const DEGENERATE_AREA: f64 = 1e-10;

/// Part of a triangle that a closest point lies on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Feature {
    /// The inside of the triangle.
    Face,
    /// Edge `k`, from corner `k` to corner `(k + 1) % 3`, without its ends.
    Edge(u8),
    /// Corner `k`.
    Vertex(u8),
}

/// Closest point of one triangle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct TrianglePoint {
    /// The point, mm.
    pub point: Vec3,
    /// Its barycentric coordinates, non-negative, sum 1.
    pub barycentric: [f64; 3],
    /// Part of the triangle it lies on.
    pub feature: Feature,
}

/// Closest point to `p` of the triangle with these corners (Ericson 2005, section 5.1.5).
///
/// The inside tests are written as triple products, which keep their digits on slivers where Ericson's products
/// of dot products cancel. A point on an edge is computed from the end with the smaller vertex index, so two
/// triangles that share the edge give bitwise identical results.
pub(crate) fn closest_point(p: &Vec3, corners: &[Vec3; 3], indices: [u32; 3]) -> TrianglePoint {
    let [a, b, c] = corners;
    let (ab, ac) = (b - a, c - a);
    let (ap, bp, cp) = (p - a, p - b, p - c);
    let (d1, d2) = (ab.dot(&ap), ac.dot(&ap));
    if d1 <= 0.0 && d2 <= 0.0 {
        return at_corner(corners, 0);
    }
    let (d3, d4) = (ab.dot(&bp), ac.dot(&bp));
    if d3 >= 0.0 && d4 <= d3 {
        return at_corner(corners, 1);
    }
    let (d5, d6) = (ab.dot(&cp), ac.dot(&cp));
    if d6 >= 0.0 && d5 <= d6 {
        return at_corner(corners, 2);
    }
    // Twice the areas that the projection of p spans with the edges, times |n|.
    let n = ab.cross(&ac);
    let wc = n.dot(&ab.cross(&ap));
    if wc <= 0.0 && d1 >= 0.0 && d3 <= 0.0 {
        return on_edge(p, corners, indices, 0);
    }
    let wb = n.dot(&ap.cross(&ac));
    if wb <= 0.0 && d2 >= 0.0 && d6 <= 0.0 {
        return on_edge(p, corners, indices, 2);
    }
    let wa = n.dot(&bp.cross(&cp));
    if wa <= 0.0 && d4 - d3 >= 0.0 && d5 - d6 >= 0.0 {
        return on_edge(p, corners, indices, 1);
    }
    // Rounding alone can leave a small negative weight here: the clamp keeps the point on the
    // triangle.
    let (wa, wb, wc) = (wa.max(0.0), wb.max(0.0), wc.max(0.0));
    let sum = wa + wb + wc;
    let (v, w) = (wb / sum, wc / sum);
    TrianglePoint {
        point: a + ab * v + ac * w,
        barycentric: [wa / sum, v, w],
        feature: Feature::Face,
    }
}

fn at_corner(corners: &[Vec3; 3], k: usize) -> TrianglePoint {
    let mut barycentric = [0.0; 3];
    barycentric[k] = 1.0;
    TrianglePoint { point: corners[k], barycentric, feature: Feature::Vertex(k as u8) }
}

fn on_edge(p: &Vec3, corners: &[Vec3; 3], indices: [u32; 3], k: usize) -> TrianglePoint {
    let next = (k + 1) % 3;
    let (from, to) = if indices[k] < indices[next] { (k, next) } else { (next, k) };
    let edge = corners[to] - corners[from];
    let t = ((p - corners[from]).dot(&edge) / edge.norm_squared()).clamp(0.0, 1.0);
    let mut barycentric = [0.0; 3];
    barycentric[from] = 1.0 - t;
    barycentric[to] = t;
    TrianglePoint { point: corners[from] + edge * t, barycentric, feature: Feature::Edge(k as u8) }
}

/// Flat shape of one triangle.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Facet {
    /// Unit normal by the right-hand rule.
    pub normal: Vec3,
    /// Area, mm².
    pub area: f64,
    /// Angle at each corner, rad.
    pub angles: [f64; 3],
}

/// Normal, area and angles of a triangle; the area alone as an error if the triangle is degenerate
/// ([`DEGENERATE_AREA`]).
pub(crate) fn facet(corners: &[Vec3; 3]) -> std::result::Result<Facet, f64> {
    let [a, b, c] = corners;
    let (ab, bc, ca) = (b - a, c - b, a - c);
    let n = ab.cross(&-ca);
    let twice_area = n.norm();
    let longest = ab.norm_squared().max(bc.norm_squared()).max(ca.norm_squared());
    // Not `<=`: an area that overflows to NaN must be rejected too.
    if !(twice_area > 2.0 * DEGENERATE_AREA * longest && twice_area.is_finite()) {
        return Err(0.5 * twice_area);
    }
    // |e × f| is the same at every corner, so one cross product serves all three angles.
    let angle = |e: &Vec3, f: &Vec3| twice_area.atan2(-e.dot(f));
    Ok(Facet {
        normal: n / twice_area,
        area: 0.5 * twice_area,
        angles: [angle(&ab, &ca), angle(&bc, &ab), angle(&ca, &bc)],
    })
}

/// The corners of a triangle.
pub(crate) fn corners(vertices: &[[f64; 3]], triangle: [u32; 3]) -> [Vec3; 3] {
    triangle.map(|v| Vec3::from(vertices[v as usize]))
}
