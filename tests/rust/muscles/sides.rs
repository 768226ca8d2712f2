//! The side of a surface on which samples fall, by exact winding numbers.

use std::sync::Arc;

use mtm_core::internals::{MuscleShape, Sequence, place};
use mtm_core::{
    InsideTest, Muscle, MuscleFibres, OrientedBox, SamplingOptions, Surface, TetMesh,
    sample_muscles, winding_number_exact,
};
use nalgebra::Vector3;

type Vec3 = Vector3<f64>;

type Triangles = (Vec<[f64; 3]>, Vec<[u32; 3]>);

/// A cube from −1 to 1 with its faces cut into n² squares, blown up towards a sphere by `round` (0 to 1).
fn cube(n: u32, round: f64, centre: f64) -> Triangles {
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let start = vertices.len() as u32;
            for i in 0..=n {
                for j in 0..=n {
                    let [u, v] = [i, j].map(|k| 2.0 * f64::from(k) / f64::from(n) - 1.0);
                    let mut p = Vec3::zeros();
                    (p[axis], p[(axis + 1) % 3], p[(axis + 2) % 3]) = (side, u, v);
                    let p = p.lerp(&p.normalize(), round) + Vec3::repeat(centre);
                    vertices.push(p.into());
                }
            }
            for i in 0..n {
                for j in 0..n {
                    let at = |a: u32, b: u32| start + (i + a) * (n + 1) + j + b;
                    let (mut s, mut t) =
                        ([at(0, 0), at(1, 0), at(1, 1)], [at(0, 0), at(1, 1), at(0, 1)]);
                    if side < 0.0 {
                        s.swap(1, 2);
                        t.swap(1, 2);
                    }
                    triangles.extend([s, t]);
                }
            }
        }
    }
    (vertices, triangles)
}

fn joined((mut vertices, mut triangles): Triangles, (more, others): Triangles) -> Triangles {
    let n = vertices.len() as u32;
    vertices.extend(more);
    triangles.extend(others.iter().map(|t| t.map(|v| v + n)));
    (vertices, triangles)
}

fn muscle((vertices, triangles): Triangles) -> Muscle {
    let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
    let boxes = vec![OrientedBox { centre: [0.0; 3], axes, half_extents: [1.0; 3] }];
    Muscle {
        surface: Arc::new(Surface::new(vertices, triangles).unwrap()),
        fibres: Arc::new(MuscleFibres::from_boxes(boxes).unwrap()),
    }
}

/// Tets of cubes of edge `h` about the origin, `n` to either side, shifted by `shift`.
fn lattice(n: i32, h: f64, shift: f64) -> TetMesh {
    let side = 2 * n as u32 + 1;
    let id = |at: [u32; 3]| (at[0] * side + at[1]) * side + at[2];
    let (mut nodes, mut tets) = (Vec::new(), Vec::new());
    for i in 0..side {
        for j in 0..side {
            for k in 0..side {
                nodes.push([i, j, k].map(|x| (f64::from(x) - f64::from(n)) * h + shift));
                if i.max(j).max(k) == side - 1 {
                    continue;
                }
                let paths = [[0, 1, 2], [1, 2, 0], [2, 0, 1], [1, 0, 2], [0, 2, 1], [2, 1, 0]];
                for (p, path) in paths.into_iter().enumerate() {
                    let mut at = [i, j, k];
                    let mut tet = [id(at); 4];
                    for (corner, axis) in path.into_iter().enumerate() {
                        at[axis] += 1;
                        tet[corner + 1] = id(at);
                    }
                    if p >= 3 {
                        tet.swap(1, 2);
                    }
                    tets.push(tet);
                }
            }
        }
    }
    TetMesh::new(nodes, tets).unwrap()
}

/// Fractions of all tets by the exact winding number of every sample, and how many samples of each
/// lie where the hierarchical one, off by 0.01 at most, might see them on the other side.
fn exact(
    mesh: &TetMesh,
    surface: &Surface,
    sign: f64,
    options: &SamplingOptions,
) -> Vec<(f64, f64)> {
    let sequence = Sequence::new(options.samples);
    (0..mesh.n_tets())
        .map(|tet| {
            let corners = mesh.tets()[tet].map(|v| Vec3::from(mesh.nodes()[v as usize]));
            let edges = [1, 2, 3].map(|k| corners[k] - corners[0]);
            let points: Vec<[f64; 3]> = sequence
                .in_tet(options.seed, tet as u32)
                .map(|w| (corners[0] + place(&edges, w)).into())
                .collect();
            let winding = winding_number_exact(surface, &points);
            let n = points.len() as f64;
            let inside = winding.iter().filter(|&&w| sign * w > 0.5).count();
            let unsure = winding.iter().filter(|&&w| (sign * w - 0.5).abs() < 0.01).count();
            (inside as f64 / n, unsure as f64 / n)
        })
        .collect()
}

/// A twentieth of a triangle from the surface and everywhere around it: a winding number that rounds to the
/// right integer must be within a quarter of it.
#[test]
fn closed_surfaces_keep_whole_winding_numbers() {
    let long = |(vertices, triangles): Triangles| {
        let flat = |v: &[f64; 3]| [v[0], 0.15 * v[1], 4.0 * v[2]];
        (vertices.iter().map(flat).collect(), triangles)
    };
    let cases: [Triangles; 5] = [
        cube(12, 0.9, 0.0),
        cube(6, 0.0, 0.0),
        long(cube(11, 0.7, 0.0)),
        joined(cube(9, 0.9, 0.0), cube(7, 0.5, 0.4)),
        joined(long(cube(9, 0.2, 0.0)), cube(9, 1.0, 0.2)),
    ];
    for (case, triangles) in cases.into_iter().enumerate() {
        let muscle = muscle(triangles);
        let surface = &muscle.surface;
        let shape = MuscleShape::new(surface, InsideTest::Winding);
        let mut points = lattice(4, 0.31, 0.013).nodes().to_vec();
        for t in 0..surface.triangles().len() {
            let [a, b, c] =
                surface.triangles()[t].map(|v| Vec3::from(surface.vertices()[v as usize]));
            let normal = (b - a).cross(&(c - a));
            let step = 0.05 * normal / normal.norm().sqrt();
            for corner in [a, a.lerp(&b, 0.5), (a + b + c) / 3.0] {
                points.extend([corner + step, corner - step].map(<[f64; 3]>::from));
            }
        }
        let exact = winding_number_exact(surface, &points);
        // Beside an edge of a box a step along one face leads into another: neither side is right there.
        let off = points.iter().zip(exact).filter(|(_, w)| (w - w.round()).abs() < 1e-6);
        for (p, exact) in off {
            let error = (shape.unrounded_winding(&Vec3::from(*p)) - exact).abs();
            assert!(error < 0.25, "case {case}: {error} at {p:?}");
            assert_eq!(shape.winding(&Vec3::from(*p)), exact.round(), "case {case}");
        }
    }
}

/// Closed, overlapping, open, with flipped triangles, unmerged vertices, inside out; tets at random
/// places, and tets whose nodes, faces and centroids lie on the surface.
#[test]
fn every_sample_falls_on_the_side_of_its_exact_winding_number() {
    let ball = || cube(9, 0.9, 0.0);
    let with_hole = || {
        let (vertices, mut triangles) = ball();
        triangles.drain(40..58);
        (vertices, triangles)
    };
    let flipped = || {
        let (vertices, mut triangles) = ball();
        triangles.iter_mut().skip(7).step_by(90).for_each(|t| t.swap(0, 1));
        (vertices, triangles)
    };
    let turned = || {
        let (vertices, mut triangles) = ball();
        triangles.iter_mut().for_each(|t| t.swap(0, 1));
        (vertices, triangles)
    };
    let loose = || {
        let (vertices, triangles) = ball();
        let corners = triangles.iter().flatten().map(|&v| vertices[v as usize]).collect();
        (corners, (0..triangles.len() as u32).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect())
    };
    let cases: [(&str, Triangles, TetMesh); 7] = [
        ("ball", ball(), lattice(3, 0.41, 0.013)),
        ("overlapping", joined(ball(), cube(7, 0.5, 0.4)), lattice(3, 0.51, 0.013)),
        ("with a hole", with_hole(), lattice(3, 0.41, 0.013)),
        ("with flipped triangles", flipped(), lattice(3, 0.41, 0.013)),
        ("inside out", turned(), lattice(3, 0.41, 0.013)),
        ("unmerged", loose(), lattice(3, 0.41, 0.013)),
        ("cube on the lattice", cube(4, 0.0, 0.0), lattice(4, 0.25, 0.0)),
    ];
    let options = SamplingOptions { samples: 24, seed: 5, ..Default::default() };
    for (name, triangles, mesh) in cases {
        let muscle = muscle(triangles);
        let made =
            sample_muscles(&mesh, std::slice::from_ref(&muscle), &options, &|| false).unwrap();
        let sign = if name == "inside out" { -1.0 } else { 1.0 };
        let expected = exact(&mesh, &muscle.surface, sign, &options);
        for (tet, (&found, &(p, unsure))) in made.fraction.iter().zip(&expected).enumerate() {
            assert!((found - p).abs() <= unsure + 1e-12, "{name}: tet {tet}: {found} for {p}");
        }
        assert!(made.fraction.iter().any(|&p| p > 0.0 && p < 1.0) || name == "cube on the lattice");
        let unsure: f64 = expected.iter().map(|e| e.1).sum();
        assert!(unsure < 0.01 * mesh.n_tets() as f64, "{name}: {unsure} tets unsure");
    }
}
