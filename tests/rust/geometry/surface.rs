//! Surfaces, winding numbers and prescribed motions against brute force and closed forms.

use std::collections::HashMap;
use std::f64::consts::PI;

use mtm_core::{Closest, ErrorKind, Feature, MtmError, Surface, SurfaceMotion, WindingTree};
use nalgebra::Vector3;

pub(super) type Vec3 = Vector3<f64>;

/// Deterministic numbers in −1 to 1 (SplitMix64).
pub(super) struct Numbers(pub(super) u64);

impl Numbers {
    pub(super) fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    pub(super) fn points(&mut self, n: usize, scale: f64) -> Vec<[f64; 3]> {
        (0..n).map(|_| [0; 3].map(|_| scale * self.next())).collect()
    }
}

/// Unit sphere: an icosahedron with each triangle split in four `levels` times.
pub(super) fn icosphere(levels: usize) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let g = (1.0 + 5.0_f64.sqrt()) / 2.0;
    let mut vertices: Vec<[f64; 3]> = vec![
        [-1.0, g, 0.0],
        [1.0, g, 0.0],
        [-1.0, -g, 0.0],
        [1.0, -g, 0.0],
        [0.0, -1.0, g],
        [0.0, 1.0, g],
        [0.0, -1.0, -g],
        [0.0, 1.0, -g],
        [g, 0.0, -1.0],
        [g, 0.0, 1.0],
        [-g, 0.0, -1.0],
        [-g, 0.0, 1.0],
    ];
    vertices.iter_mut().for_each(|v| *v = Vec3::from(*v).normalize().into());
    let mut triangles: Vec<[u32; 3]> = vec![
        [0, 11, 5],
        [0, 5, 1],
        [0, 1, 7],
        [0, 7, 10],
        [0, 10, 11],
        [1, 5, 9],
        [5, 11, 4],
        [11, 10, 2],
        [10, 7, 6],
        [7, 1, 8],
        [3, 9, 4],
        [3, 4, 2],
        [3, 2, 6],
        [3, 6, 8],
        [3, 8, 9],
        [4, 9, 5],
        [2, 4, 11],
        [6, 2, 10],
        [8, 6, 7],
        [9, 8, 1],
    ];
    for _ in 0..levels {
        let mut middles = HashMap::new();
        let mut finer = Vec::new();
        for [a, b, c] in triangles {
            let mut middle = |i: u32, j: u32| {
                *middles.entry((i.min(j), i.max(j))).or_insert_with(|| {
                    let sum = Vec3::from(vertices[i as usize]) + Vec3::from(vertices[j as usize]);
                    vertices.push(sum.normalize().into());
                    vertices.len() as u32 - 1
                })
            };
            let (ab, bc, ca) = (middle(a, b), middle(b, c), middle(c, a));
            finer.extend([[a, ab, ca], [b, bc, ab], [c, ca, bc], [ab, bc, ca]]);
        }
        triangles = finer;
    }
    (vertices, triangles)
}

pub(super) fn sphere(levels: usize) -> Surface {
    let (vertices, triangles) = icosphere(levels);
    Surface::new(vertices, triangles).unwrap()
}

/// Cube from 0 to 1; bit i of `diagonals` chooses the diagonal of face i.
fn cube(diagonals: u32) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let vertices = (0..8).map(|i| [i & 1, i >> 1 & 1, i >> 2].map(f64::from)).collect();
    let faces =
        [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    let mut triangles = Vec::new();
    for (i, [a, b, c, d]) in faces.into_iter().enumerate() {
        if diagonals >> i & 1 == 0 {
            triangles.extend([[a, b, c], [a, c, d]]);
        } else {
            triangles.extend([[a, b, d], [b, c, d]]);
        }
    }
    (vertices, triangles)
}

/// n × n squares of the plane z = 0 from 0 to 1, normals up.
pub(super) fn plane(n: u32) -> (Vec<[f64; 3]>, Vec<[u32; 3]>) {
    let at = |i: u32, j: u32| i * (n + 1) + j;
    let mut vertices = Vec::new();
    let mut triangles = Vec::new();
    for i in 0..=n {
        for j in 0..=n {
            vertices.push([f64::from(i) / f64::from(n), f64::from(j) / f64::from(n), 0.0]);
            if i < n && j < n {
                triangles.push([at(i, j), at(i + 1, j), at(i + 1, j + 1)]);
                triangles.push([at(i, j), at(i + 1, j + 1), at(i, j + 1)]);
            }
        }
    }
    (vertices, triangles)
}

/// Smallest distance by another method: the foot on the plane if inside, else the nearest edge point.
fn brute_force_distance(surface: &Surface, p: Vec3) -> f64 {
    let mut best = f64::INFINITY;
    for triangle in surface.triangles() {
        let [a, b, c] = triangle.map(|v| Vec3::from(surface.vertices()[v as usize]));
        for (s, e) in [(a, b), (b, c), (c, a)] {
            let t = ((p - s).dot(&(e - s)) / (e - s).norm_squared()).clamp(0.0, 1.0);
            best = best.min((p - s - (e - s) * t).norm());
        }
        let n = (b - a).cross(&(c - a)).normalize();
        let foot = p - n * n.dot(&(p - a));
        let inside =
            [(a, b), (b, c), (c, a)].iter().all(|(s, e)| n.dot(&(e - s).cross(&(foot - s))) >= 0.0);
        if inside {
            best = best.min(n.dot(&(p - a)).abs());
        }
    }
    best
}

pub(super) fn gap(a: [f64; 3], b: [f64; 3]) -> f64 {
    (Vec3::from(a) - Vec3::from(b)).norm()
}

fn with_threads<T: Send>(n: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap().install(work)
}

#[test]
fn closest_point_equals_brute_force_on_a_soup_of_slivers() {
    let mut numbers = Numbers(1);
    let mut vertices = Vec::new();
    let mut triangles = Vec::new();
    for t in 0..300_u32 {
        let at = Vec3::from(numbers.points(1, 1.0)[0]);
        // From well-shaped to needles of 1:1000.
        let thin = [1.0, 1e-1, 1e-3][t as usize % 3];
        let [u, v]: [[f64; 3]; 2] = numbers.points(2, 0.3).try_into().unwrap();
        vertices.push(at.into());
        vertices.push((at + Vec3::from(u)).into());
        vertices.push((at + Vec3::from(u) * 0.4 + Vec3::from(v) * thin).into());
        triangles.push([3 * t, 3 * t + 1, 3 * t + 2]);
    }
    let surface = Surface::new(vertices, triangles).unwrap();
    for p in numbers.points(2000, 2.0) {
        let found = surface.closest_one(p);
        let expected = brute_force_distance(&surface, Vec3::from(p));
        assert!((found.distance - expected).abs() < 1e-12, "{p:?}: {found:?} {expected}");
        assert!((gap(found.point, p) - found.distance).abs() < 1e-13);
        assert!((found.barycentric.iter().sum::<f64>() - 1.0).abs() < 1e-14);
        assert!(found.barycentric.iter().all(|&weight| weight >= 0.0));
        let triangle = surface.triangles()[found.triangle as usize];
        let again = (0..3).fold(Vec3::zeros(), |sum, k| {
            sum + Vec3::from(surface.vertices()[triangle[k] as usize]) * found.barycentric[k]
        });
        assert!((again - Vec3::from(found.point)).norm() < 1e-14);
    }
}

#[test]
fn closest_feature_is_face_edge_or_vertex_with_its_barycentric() {
    // A right triangle, an obtuse one, and both seen from below and above.
    for c in [[0.0, 1.0, 0.0], [-1.5, 1.0, 0.0]] {
        let vertices = vec![[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], c];
        let surface = Surface::new(vertices.clone(), vec![[0, 1, 2]]).unwrap();
        let [a, b, c] = [vertices[0], vertices[1], vertices[2]].map(Vec3::from);
        let up = Vec3::z();
        let check = |p: Vec3, feature: Feature, expected: [f64; 3]| {
            for lift in [-0.7, -1e-12, 0.0, 1e-12, 0.7] {
                let found = surface.closest_one((p + up * lift).into());
                assert_eq!(found.feature, feature, "{p:?} {lift}");
                for k in 0..3 {
                    assert!((found.barycentric[k] - expected[k]).abs() < 1e-11, "{found:?}");
                }
                assert_eq!(found.on_border, feature != Feature::Face);
            }
        };
        check((a + b + c) / 3.0, Feature::Face, [1.0 / 3.0; 3]);
        for (k, (s, e)) in [(a, b), (b, c), (c, a)].into_iter().enumerate() {
            let out = (e - s).cross(&up).normalize();
            let middle = (s + e) / 2.0;
            let mut half = [0.5; 3];
            half[(k + 2) % 3] = 0.0;
            check(middle + out, Feature::Edge(k as u8), half);
            check(middle + out * 1e-12, Feature::Edge(k as u8), half);
            check(middle - out * 1e-12, Feature::Face, half);
        }
        for (k, (v, s, e)) in [(a, b, c), (b, c, a), (c, a, b)].into_iter().enumerate() {
            let out = ((v - s).normalize() + (v - e).normalize()).normalize();
            let mut corner = [0.0; 3];
            corner[k] = 1.0;
            for distance in [1e-12, 1e-3, 5.0] {
                check(v + out * distance, Feature::Vertex(k as u8), corner);
            }
        }
    }
}

#[test]
fn ties_go_to_the_smallest_triangle() {
    let (vertices, triangles) = plane(8);
    let surface = Surface::new(vertices.clone(), triangles.clone()).unwrap();
    let mut numbers = Numbers(3);
    let mut points: Vec<[f64; 3]> = vertices.clone();
    points.extend(vertices.iter().map(|v| [v[0], v[1], numbers.next()]));
    // Middles of the diagonals, shared by two triangles.
    points.extend((0..8).map(|i| [(f64::from(i) + 0.5) / 8.0, (f64::from(i) + 0.5) / 8.0, 0.25]));
    for p in points {
        let found = surface.closest_one(p);
        let first = triangles.iter().position(|&triangle| {
            let alone = Surface::new(vertices.clone(), vec![triangle]).unwrap().closest_one(p);
            alone.distance == found.distance
        });
        assert_eq!(found.triangle as usize, first.unwrap(), "{p:?}");
    }
}

#[test]
fn sphere_normals_converge_and_are_continuous() {
    let points: Vec<[f64; 3]> = Numbers(4).points(2000, 2.0);
    let mut last = f64::INFINITY;
    for levels in 2..5 {
        let surface = sphere(levels);
        let worst = surface
            .closest(&points)
            .iter()
            .map(|found| gap(found.normal, Vec3::from(found.point).normalize().into()))
            .fold(0.0, f64::max);
        assert!(worst < 0.6 * last, "level {levels}: {worst} after {last}");
        last = worst;
    }
    assert!(last < 5e-3, "{last}");

    // Across every edge of a coarse sphere the normal of one triangle meets that of the other.
    let surface = sphere(1);
    let mut at_edge: HashMap<[u32; 2], Vec<[f64; 3]>> = HashMap::new();
    for (t, triangle) in surface.triangles().iter().enumerate() {
        for k in 0..3 {
            let next = (k + 1) % 3;
            let mut barycentric = [0.0; 3];
            let (low, high) = if triangle[k] < triangle[next] { (k, next) } else { (next, k) };
            (barycentric[low], barycentric[high]) = (0.3, 0.7);
            let normal = surface.normal_at(t as u32, barycentric);
            assert!((Vec3::from(normal).norm() - 1.0).abs() < 1e-13);
            at_edge.entry([triangle[low], triangle[high]]).or_default().push(normal);
        }
    }
    assert_eq!(at_edge.len(), surface.edges().len());
    assert!(at_edge.values().all(|pair| pair.len() == 2 && gap(pair[0], pair[1]) < 1e-13));
}

#[test]
fn cube_faces_keep_their_normals_for_every_triangulation() {
    for diagonals in [0, 0b10_1011, 0b11_1111] {
        let (vertices, triangles) = cube(diagonals);
        let surface = Surface::new(vertices, triangles).unwrap();
        for p in Numbers(5).points(500, 1.5) {
            let found = surface.closest_one(p);
            let facet = surface.facet_normals()[found.triangle as usize];
            assert!(gap(found.normal, facet) < 1e-13, "{found:?}");
        }
        let corner = surface.vertex_normals()[7];
        assert!(gap(corner, [3.0_f64.sqrt().recip(); 3]) < 1e-13, "{corner:?}");
    }
    // With creases only beyond 90° the corner is rounded instead.
    let (vertices, triangles) = cube(0);
    let round = Surface::with_crease_angle(vertices, triangles, 0.6 * PI).unwrap();
    assert!(gap(round.closest_one([2.0; 3]).normal, [3.0_f64.sqrt().recip(); 3]) < 1e-13);
}

#[test]
fn signed_distance_is_that_of_the_box() {
    let (vertices, triangles) = cube(0b01_0110);
    let surface = Surface::new(vertices, triangles).unwrap();
    for p in Numbers(6).points(2000, 2.0) {
        let q = p.map(|x| (x - 0.5_f64).abs() - 0.5);
        let outside = Vec3::from(q.map(|x| x.max(0.0))).norm();
        let inside = q.into_iter().fold(f64::NEG_INFINITY, f64::max).min(0.0);
        let found = surface.closest_one(p);
        assert!((found.signed_distance - (outside + inside)).abs() < 1e-13, "{p:?} {found:?}");
    }
}

#[test]
fn facts_of_closed_open_and_mixed_surfaces() {
    let (vertices, triangles) = cube(0);
    let closed = Surface::new(vertices.clone(), triangles.clone()).unwrap();
    assert!(closed.is_closed());
    assert_eq!((closed.n_border_edges(), closed.edges().len()), (0, 18));
    assert!((closed.volume().unwrap() - 1.0).abs() < 1e-13);
    assert!((closed.area() - 6.0).abs() < 1e-13);
    let mean = (12.0 + 6.0 * 2.0_f64.sqrt()) / 18.0;
    assert!((closed.mean_edge_length() - mean).abs() < 1e-13);

    let inverted: Vec<[u32; 3]> = triangles.iter().map(|&[a, b, c]| [a, c, b]).collect();
    let inverted = Surface::new(vertices.clone(), inverted).unwrap();
    assert!((inverted.volume().unwrap() + 1.0).abs() < 1e-13);

    let open = Surface::new(vertices.clone(), triangles[1..].to_vec()).unwrap();
    assert!(!open.is_closed());
    assert_eq!((open.n_border_edges(), open.volume()), (3, None));

    let mut flipped = triangles.clone();
    flipped[0].swap(1, 2);
    let flipped = Surface::new(vertices.clone(), flipped).unwrap();
    assert!(!flipped.is_closed());
    assert_eq!(flipped.n_border_edges(), 0);
    // The flipped triangle keeps its own normal and does not bend that of its neighbours.
    assert!(gap(flipped.normal_at(0, [0.2, 0.3, 0.5]), [1.0, 0.0, 0.0]) < 1e-13);
    assert!(gap(flipped.normal_at(1, [0.2, 0.3, 0.5]), [-1.0, 0.0, 0.0]) < 1e-13);

    // A fin on an edge makes it non-manifold; an unused vertex changes nothing.
    let mut fin = (vertices, triangles);
    fin.0.extend([[-1.0, -1.0, 0.0], [9.0; 3]]);
    fin.1.push([0, 4, 8]);
    let fin = Surface::new(fin.0, fin.1).unwrap();
    assert!(!fin.is_closed());
    assert_eq!(fin.n_border_edges(), 2);
    assert_eq!(fin.vertex_normals()[9], [0.0; 3]);
}

#[test]
fn border_of_an_open_plane_is_flagged() {
    let (vertices, triangles) = plane(5);
    let surface = Surface::new(vertices, triangles).unwrap();
    assert_eq!(surface.n_border_edges(), 20);
    let on_border = |p| surface.closest_one(p).on_border;
    assert!(!on_border([0.5, 0.45, 1.0]) && !on_border([1e-12, 0.5, 1.0]));
    assert!(on_border([-1e-12, 0.5, 1.0]) && on_border([0.0, 0.5, 1.0]));
    assert!(on_border([-3.0, 0.2, 0.0]) && on_border([2.0, 2.0, -1.0]));
    let inner_vertex = surface.closest_one([0.4, 0.4, 0.3]);
    assert!(!inner_vertex.on_border);
    assert_eq!(inner_vertex.normal, [0.0, 0.0, 1.0]);
    assert!(inner_vertex.signed_distance > 0.0);
    assert!(surface.closest_one([0.4, 0.4, -0.3]).signed_distance < 0.0);
}

#[test]
fn moved_surface_equals_one_built_afresh() {
    let (mut vertices, triangles) = icosphere(3);
    let rest = Surface::new(vertices.clone(), triangles.clone()).unwrap();
    vertices.iter_mut().for_each(|v| *v = [2.0 * v[1], v[2] + 5.0 + 0.1 * v[1] * v[1], v[0]]);
    let moved = rest.moved(vertices.clone()).unwrap();
    let fresh = Surface::new(vertices, triangles).unwrap();
    let mut points = Numbers(7).points(1000, 3.0);
    points.iter_mut().for_each(|p| p[1] += 5.0);
    assert_eq!(moved.closest(&points), fresh.closest(&points));
    assert_eq!((moved.area(), moved.volume()), (fresh.area(), fresh.volume()));
    assert_eq!(moved.vertex_normals(), fresh.vertex_normals());
}

#[test]
fn creases_stay_where_the_rest_shape_has_them() {
    // Two squares in a plane folded up by 80°: a fresh surface has a crease there, the moved one has not.
    let flat =
        vec![[-1., 0., 0.], [0., 0., 0.], [1., 0., 0.], [-1., 1., 0.], [0., 1., 0.], [1., 1., 0.]];
    let triangles = vec![[0, 1, 4], [0, 4, 3], [1, 2, 5], [1, 5, 4]];
    let (sin, cos) = 80.0_f64.to_radians().sin_cos();
    let mut folded = flat.clone();
    (folded[2], folded[5]) = ([cos, 0.0, sin], [cos, 1.0, sin]);
    let moved = Surface::new(flat, triangles.clone()).unwrap().moved(folded.clone()).unwrap();
    let fresh = Surface::new(folded, triangles).unwrap();
    let (left, right) = ([0.0, 0.5, 0.5], [0.5, 0.0, 0.5]);
    assert!(gap(moved.normal_at(0, left), moved.normal_at(3, right)) < 1e-13);
    assert!(gap(fresh.normal_at(0, left), fresh.normal_at(3, right)) > 1.0);
}

#[test]
fn results_do_not_depend_on_the_number_of_threads() {
    let points = Numbers(12).points(3000, 1.5);
    let run = |threads: usize| {
        with_threads(threads, || {
            let (vertices, triangles) = icosphere(4);
            let surface = Surface::new(vertices.clone(), triangles).unwrap();
            let motion = SurfaceMotion::new(
                surface.clone(),
                vertices.iter().map(|v| [v[0] + 0.1 * v[1] * v[1], v[1], v[2]]).collect(),
            );
            let closest: Vec<Closest> = surface.closest(&points);
            let winding = WindingTree::new(&surface).winding_number(&points);
            (closest, winding, motion.unwrap().displacement(&points))
        })
    };
    assert_eq!(run(1), run(2));
}

#[test]
fn bad_surfaces_are_refused_with_the_place() {
    let (vertices, triangles) = cube(0);
    let refused =
        |v: &[[f64; 3]], t: &[[u32; 3]]| Surface::new(v.to_vec(), t.to_vec()).unwrap_err();
    assert!(matches!(refused(&[], &triangles), MtmError::Empty { kind: ErrorKind::Mesh, .. }));
    assert!(matches!(refused(&vertices, &[]), MtmError::Empty { kind: ErrorKind::Mesh, .. }));
    let mut bad = vertices.clone();
    bad[3][1] = f64::INFINITY;
    assert!(matches!(refused(&bad, &triangles), MtmError::NotFinite { index: 3, .. }));
    let mut bad = triangles.clone();
    bad[4][2] = 8;
    let error = refused(&vertices, &bad);
    assert!(matches!(error, MtmError::IndexOutOfRange { row: 4, index: 8, count: 8, .. }));
    bad[4][2] = bad[4][0];
    assert!(matches!(refused(&vertices, &bad), MtmError::DegenerateTriangle { triangle: 4, .. }));
    let line = [[0.0; 3], [1.0, 1.0, 1.0], [3.0, 3.0, 3.0]];
    let error = refused(&line, &[[0, 1, 2]]);
    assert!(matches!(error, MtmError::DegenerateTriangle { triangle: 0, .. }));
    let huge = [[0.0; 3], [1e300, 0.0, 0.0], [0.0, 1e300, 0.0]];
    assert!(matches!(refused(&huge, &[[0, 1, 2]]), MtmError::OutOfRange { index: 1, .. }));
    for angle in [-0.1, 4.0, f64::NAN] {
        let error = Surface::with_crease_angle(vertices.clone(), triangles.clone(), angle);
        assert!(matches!(error, Err(MtmError::OutOfRange { .. })), "{angle}");
    }

    let surface = Surface::new(vertices.clone(), triangles).unwrap();
    let error = surface.moved(vertices[1..].to_vec()).unwrap_err();
    assert!(matches!(error, MtmError::Length { found: 7, expected: 8, .. }));
    assert_eq!(error.kind(), ErrorKind::Boundary);
    let mut bad = vertices.clone();
    bad[2][0] = f64::NAN;
    let error = SurfaceMotion::new(surface.clone(), bad).unwrap_err();
    assert!(matches!(error, MtmError::NotFinite { index: 2, kind: ErrorKind::Boundary, .. }));
    let error = surface.moved(vec![[0.0; 3]; 8]).unwrap_err();
    assert!(matches!(error, MtmError::DegenerateTriangle { triangle: 0, .. }));
    for beta in [0.5, f64::NAN, f64::INFINITY] {
        let error = WindingTree::with_beta(&surface, beta);
        assert!(matches!(error, Err(MtmError::OutOfRange { .. })), "{beta}");
    }
}

#[test]
fn tiny_and_stacked_surfaces_are_searched() {
    // One and two triangles are special cases of the tree; twenty with one centre cannot be split by place.
    let one =
        Surface::new(vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], vec![[0, 1, 2]]).unwrap();
    assert!((one.closest_one([0.2, 0.2, 3.0]).distance - 3.0).abs() < 1e-13);
    let (vertices, triangles) = plane(1);
    let two = Surface::new(vertices.clone(), triangles).unwrap();
    assert_eq!(two.closest_one([0.1, 0.8, -1.0]).triangle, 1);
    let lifted = two.moved(vertices.iter().map(|v| [v[0], v[1], 2.0]).collect()).unwrap();
    assert!((lifted.closest_one([0.1, 0.8, -1.0]).distance - 3.0).abs() < 1e-13);
    let stacked = Surface::new(one.vertices().to_vec(), vec![[0, 1, 2]; 20]).unwrap();
    assert_eq!(stacked.closest_one([0.2, 0.2, 0.0]).triangle, 0);
    let w = WindingTree::new(&stacked).winding_number_one([0.2, 0.2, -0.01]);
    assert!(w > 9.0 && w < 10.0, "{w}");
}
