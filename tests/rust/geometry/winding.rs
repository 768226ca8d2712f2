//! Winding numbers against the exact sum and against what is inside by construction.

use super::surface::{Numbers, Vec3, icosphere, sphere};
use mtm_core::{Surface, WindingTree, winding_number_exact};

#[test]
fn winding_number_tells_inside_from_outside() {
    let surface = sphere(4);
    let tree = WindingTree::new(&surface);
    for p in Numbers(9).points(2000, 1.5) {
        let r = Vec3::from(p).norm();
        let expected = if r < 0.997 { 1.0 } else { 0.0 };
        if !(0.997..=1.0).contains(&r) {
            let found = tree.winding_number_one(p);
            assert!((found - expected).abs() < 1e-2, "{p:?}: {found}");
        }
    }
}

#[test]
fn winding_number_survives_a_hole_and_a_flipped_triangle() {
    let (vertices, mut triangles) = icosphere(3);
    triangles.drain(0..20);
    triangles[500].swap(0, 1);
    let surface = Surface::new(vertices, triangles).unwrap();
    let tree = WindingTree::new(&surface);
    let points: Vec<[f64; 3]> = Numbers(10).points(1000, 1.5);
    for (p, found) in points.iter().zip(tree.winding_number(&points)) {
        let r = Vec3::from(*p).norm();
        if !(0.8..1.2).contains(&r) {
            assert_eq!(found > 0.5, r < 1.0, "{p:?}: {found}");
        }
    }
}

#[test]
fn hierarchical_winding_number_is_close_to_the_exact_sum() {
    let surface = sphere(4);
    let mut points = Numbers(11).points(500, 1.2);
    points.extend(surface.vertices().iter().take(200).map(|v| v.map(|x| x * 0.98)));
    let exact = winding_number_exact(&surface, &points);
    let worst = |beta: f64| {
        let tree = WindingTree::with_beta(&surface, beta).unwrap();
        let found = tree.winding_number(&points);
        assert!(found.iter().chain(&exact).all(|w| w.is_finite()));
        found.iter().zip(&exact).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
    };
    let errors = [2.0, 4.0, 1e9].map(worst);
    assert!(errors[0] < 1e-2 && errors[1] < 0.2 * errors[0] && errors[2] < 1e-13, "{errors:?}");
}

#[test]
fn winding_number_counts_overlaps_and_is_finite_on_the_surface() {
    let (mut vertices, mut triangles) = icosphere(2);
    let n = vertices.len() as u32;
    vertices.extend(vertices.clone().iter().map(|v| [v[0] + 0.5, v[1], v[2]]));
    triangles.extend(triangles.clone().iter().map(|t| t.map(|v| v + n)));
    let surface = Surface::new(vertices.clone(), triangles).unwrap();
    let tree = WindingTree::new(&surface);
    assert!((tree.winding_number_one([0.25, 0.0, 0.0]) - 2.0).abs() < 1e-2);
    assert!(tree.winding_number(&vertices).iter().all(|w| w.is_finite()));
    let far = [1e6, -2e6, 3e5];
    let (found, exact) = (tree.winding_number_one(far), winding_number_exact(&surface, &[far])[0]);
    assert!(found.abs() < 1e-12 && exact.abs() < 1e-12, "{found} {exact}");
}
