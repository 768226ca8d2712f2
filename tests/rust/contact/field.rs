//! The smooth distance field of a contact surface.

use std::sync::Arc;

use mtm_core::Surface;
use mtm_core::internals::{Field, FieldValue};

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [0, 1, 2].map(|i| a[i] - b[i])
}

fn scaled(a: [f64; 3], s: f64) -> [f64; 3] {
    a.map(|v| v * s)
}

fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    (0..3).map(|i| a[i] * b[i]).sum()
}

/// A grid of (2 n)² cells, `half` to each side, lifted to `height(x, y)`.
fn relief(n: i32, half: f64, height: impl Fn(f64, f64) -> f64) -> Surface {
    let (side, step) = (2 * n as u32 + 1, half / f64::from(n));
    let mut vertices = Vec::new();
    for i in -n..=n {
        for j in -n..=n {
            let (x, y) = (f64::from(i) * step, f64::from(j) * step);
            vertices.push([x, y, height(x, y)]);
        }
    }
    let mut triangles = Vec::new();
    for i in 0..side - 1 {
        for j in 0..side - 1 {
            let v = i * side + j;
            triangles.push([v, v + side, v + side + 1]);
            triangles.push([v, v + side + 1, v + 1]);
        }
    }
    Surface::new(vertices, triangles).unwrap()
}

fn value(field: &Field, at: [f64; 3]) -> FieldValue {
    field.at(&[at]).value(at)
}

/// A plane is reproduced to rounding, also beyond its border, where it is extended.
#[test]
fn field_of_a_plane_is_its_height() {
    let plane = relief(3, 6.0, |x, y| 0.3 * x - 0.2 * y);
    let field = Field::new(Arc::new(plane), [0.1, 0.2, 0.3], 1.1);
    let n = scaled([-0.3, 0.2, 1.0], 1.0 / 1.13_f64.sqrt());
    for at in [[0.4, -1.3, 0.9], [2.0, 2.0, -1.5], [9.0, -8.0, 3.0], [0.0; 3]] {
        let found = value(&field, at);
        assert!((found.distance - dot(n, at)).abs() <= 1e-12, "{at:?}: {}", found.distance);
        for i in 0..3 {
            assert!((found.gradient[i] - n[i]).abs() <= 1e-12);
            assert!(found.hessian[i].iter().all(|h| h.abs() <= 1e-11));
        }
    }
}

/// On a coarse ball the facets act as if curved: distance, normal and curvature are those of the ball,
/// although the facets themselves lie 20 times as far from it.
#[test]
fn field_of_a_coarse_bowl_is_that_of_the_sphere() {
    let radius = 20.0_f64;
    let bowl = relief(8, 12.0, |x, y| (radius * radius - x * x - y * y).sqrt() - radius);
    let flat = bowl.closest_one([0.75, 0.75, 1.0]);
    let centre = [0.0, 0.0, -radius];
    let true_distance = |at: [f64; 3]| {
        let away = sub(at, centre);
        (dot(away, away).sqrt() - radius, scaled(away, 1.0 / dot(away, away).sqrt()))
    };
    let facets = (flat.signed_distance - true_distance([0.75, 0.75, 1.0]).0).abs();
    let field = Field::new(Arc::new(bowl), [0.2, -0.3, 0.1], 1.0);
    for at in [[0.75, 0.75, 1.0], [3.1, -2.2, 0.3], [-4.0, 1.0, -0.2]] {
        let (found, (distance, normal)) = (value(&field, at), true_distance(at));
        assert!((found.distance - distance).abs() <= 0.05 * facets, "{at:?} {}", found.distance);
        assert!((0..3).all(|i| (found.gradient[i] - normal[i]).abs() <= 2e-3), "{at:?}");
        let trace: f64 = (0..3).map(|i| found.hessian[i][i]).sum();
        assert!((trace - 2.0 / (radius + distance)).abs() <= 0.02 / radius * 2.0, "{trace}");
    }
}

/// Value, gradient and Hessian are consistent with each other, on a surface with a crease too.
#[test]
fn derivatives_are_those_of_the_value() {
    let field = Field::new(Arc::new(relief(6, 6.0, |x, _| x.abs())), [0.0; 3], 0.8);
    let step = 1e-5;
    for at in [[0.2, 0.3, 0.4], [-1.3, 2.0, 1.0], [0.01, -0.7, 0.2]] {
        let here = value(&field, at);
        for i in 0..3 {
            let side = |s: f64| {
                let mut there = at;
                there[i] += s * step;
                value(&field, there)
            };
            let (ahead, behind) = (side(1.0), side(-1.0));
            let slope = (ahead.distance - behind.distance) / (2.0 * step);
            assert!((slope - here.gradient[i]).abs() <= 1e-8, "{slope}");
            for j in 0..3 {
                let turn = (ahead.gradient[j] - behind.gradient[j]) / (2.0 * step);
                assert!((turn - here.hessian[i][j]).abs() <= 1e-8, "{turn}");
            }
        }
    }
}

/// A field that was evaluated elsewhere before, or by other threads, is bitwise identical.
#[test]
fn samples_do_not_depend_on_their_order() {
    let surface = Arc::new(relief(8, 12.0, |x, y| (0.7 * x).sin() + (0.5 * y).cos()));
    let points: Vec<[f64; 3]> = (0..200)
        .map(|i| f64::from(i) * 0.77)
        .map(|t| [8.0 * t.sin(), 8.0 * (1.3 * t).cos(), 0.5 * (2.1 * t).sin()])
        .collect();
    let at_once = Field::new(surface.clone(), [0.0; 3], 0.9);
    let ready = at_once.at(&points);
    let one_by_one = Field::new(surface, [0.0; 3], 0.9);
    for &point in points.iter().rev() {
        let (a, b) = (ready.value(point), value(&one_by_one, point));
        assert_eq!(a.distance.to_bits(), b.distance.to_bits());
        assert_eq!(a.gradient.map(f64::to_bits), b.gradient.map(f64::to_bits));
    }
}
