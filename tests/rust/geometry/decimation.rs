//! Decimated surfaces against the surfaces that they were made of.

use super::surface::icosphere;
use mtm_core::{Surface, decimated};

/// A square of n × n cells in the plane z = 0, with its border.
fn square(n: u32) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let at = |i: u32, j: u32| i * (n + 1) + j;
    let places = (0..=n).flat_map(|i| (0..=n).map(move |j| [f64::from(i), f64::from(j), 0.0]));
    let cells = (0..n).flat_map(|i| (0..n).map(move |j| (i, j)));
    let triangles = cells.flat_map(|(i, j)| {
        let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
        [[a, b, c], [a, c, d]]
    });
    (places.collect(), triangles.collect())
}

#[test]
fn a_decimated_ball_is_closed_and_has_its_size() {
    let (vertices, triangles) = icosphere(5);
    let (fewer, corners) = decimated(&vertices, &triangles, 2000).unwrap();
    assert_eq!(corners.len(), 2000);
    let (fine, coarse) =
        (Surface::new(vertices, triangles).unwrap(), Surface::new(fewer, corners).unwrap());
    assert!(coarse.is_closed());
    let ratio = coarse.volume().unwrap() / fine.volume().unwrap();
    // With its corners on the ball, the surface would lack 0.3 %.
    assert!((ratio - 1.0).abs() < 3e-3, "{ratio}");
    let farthest = fine.closest(coarse.vertices()).iter().map(|c| c.distance).fold(0.0, f64::max);
    assert!(farthest < 0.01, "{farthest}");
}

#[test]
fn the_border_of_a_flat_square_stays() {
    let (vertices, triangles) = square(20);
    let (fewer, corners) = decimated(&vertices, &triangles, 60).unwrap();
    let coarse = Surface::new(fewer, corners).unwrap();
    assert!(coarse.triangles().len() <= 60);
    assert!((coarse.area() - 400.0).abs() < 4.0, "{}", coarse.area());
    assert!(coarse.vertices().iter().all(|v| v[2].abs() < 1e-9));
}

#[test]
fn a_tetrahedron_is_not_collapsed() {
    let vertices = [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let triangles = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]];
    let (left, corners) = decimated(&vertices, &triangles, 0).unwrap();
    assert_eq!((left.len(), corners.len()), (4, 4));
}

#[test]
fn triangles_of_missing_vertices_are_refused() {
    assert!(decimated(&[[0.0; 3]], &[[0, 1, 2]], 1).is_err());
}
