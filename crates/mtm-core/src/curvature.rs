//! Curvature of a surface by its continuous normals: how fast they turn along it.

use nalgebra::Matrix3;

use crate::surface::Surface;
use crate::triangle::Vec3;

/// Length of a blended normal below which its direction is lost.
const CANCELLED: f64 = 1e-6;

/// Principal curvatures of the continuous normal field at a point of a triangle, 1/mm, each with its unit
/// direction across the normal; positive where the surface is convex.
///
/// On a triangle n = b/|b| with b = Σ w_k n_k, so ∂n = (I − n⊗n) Σ n_k⊗∇w_k / |b|, of which the symmetric
/// part in the tangent plane counts. Zero where the blend cancels and the facet's normal stands in.
pub(crate) fn curvatures(
    surface: &Surface,
    triangle: u32,
    barycentric: [f64; 3],
) -> [(f64, [f64; 3]); 2] {
    let t = triangle as usize;
    let corners = surface.corners(t);
    let facet = surface.facet_normal(t);
    let twice_area = 2.0 * surface.facet_areas()[t];
    let ends = surface.corner_normals(t);
    let n = Vec3::from(surface.normal_at(triangle, barycentric));
    let blend = ends[0] * barycentric[0] + ends[1] * barycentric[1] + ends[2] * barycentric[2];
    let length = blend.dot(&n);
    let mut turn = Matrix3::zeros();
    for k in 0..3 {
        // The weight of corner k falls from 1 to 0 across the triangle.
        let opposite = corners[(k + 2) % 3] - corners[(k + 1) % 3];
        let gradient = facet.cross(&opposite) / twice_area;
        turn += ends[k] * gradient.transpose();
    }
    let [x, y] = across(&n);
    if length <= CANCELLED {
        return [(0.0, x.into()), (0.0, y.into())];
    }
    let part = |a: &Vec3, b: &Vec3| a.dot(&(turn * b)) / length;
    let (xx, yy) = (part(&x, &x), part(&y, &y));
    let xy = 0.5 * (part(&x, &y) + part(&y, &x));
    let (sin, cos) = (0.5 * (2.0 * xy).atan2(xx - yy)).sin_cos();
    let (one, two) = (x * cos + y * sin, y * cos - x * sin);
    let (mean, half) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
    [(mean + half, one.into()), (mean - half, two.into())]
}

/// Two unit vectors that make an orthonormal basis with the unit vector `n`.
pub(crate) fn across(n: &Vec3) -> [Vec3; 2] {
    // The axis that n is least along keeps the cross product away from zero.
    let mut axis = Vec3::zeros();
    axis[n.abs().imin()] = 1.0;
    let one = n.cross(&axis).normalize();
    [one, n.cross(&one)]
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::curvatures;
    use crate::mesh::dot;
    use crate::surface::Surface;

    /// Corner normals of a patch cut from a fine saddle z = (a x² − b y²)/2 turn as the surface does: its
    /// principal curvatures at the top are −a and b, along x and y.
    #[test]
    fn curvatures_of_a_saddle_are_those_of_its_equation() {
        let (a, b, step, n) = (0.3, 0.2, 0.05, 8_i32);
        let mut vertices = Vec::new();
        for i in -n..=n {
            for j in -n..=n {
                let (x, y) = (f64::from(i) * step, f64::from(j) * step);
                vertices.push([x, y, 0.5 * (a * x * x - b * y * y)]);
            }
        }
        let (side, mut triangles) = (2 * n as u32 + 1, Vec::new());
        for i in 0..side - 1 {
            for j in 0..side - 1 {
                let v = i * side + j;
                triangles.push([v, v + side, v + side + 1]);
                triangles.push([v, v + side + 1, v + 1]);
            }
        }
        let surface = Surface::new(vertices, triangles).unwrap();
        let top = surface.closest_one([0.01, 0.005, 0.0]);
        let [(most, along_y), (least, along_x)] =
            curvatures(&surface, top.triangle, [1.0 / 3.0; 3]);
        assert!((most - b).abs() <= 0.02 * b, "{most}");
        assert!((least + a).abs() <= 0.02 * a, "{least}");
        assert!(dot(along_y, [0.0, 1.0, 0.0]).abs() > 0.99);
        assert!(dot(along_x, [1.0, 0.0, 0.0]).abs() > 0.99);
    }
}
