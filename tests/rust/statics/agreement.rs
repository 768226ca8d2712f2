//! The methods agree with one another, re-planning with solving, and one thread with two.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, GO_ON, Numbers, Vec3, at, bits, boundary, contrasting, isotropic, joined,
    largest_difference, plan, plane, rigid, sliding, solve, solver, stays, surface, tensors,
    with_method,
};
use mtm_core::{
    Boundary, Change, ContactOptions, FibreElastic, FibreLaw, Gap, MassTensors, Method, Motion,
    Segment, StaticOptions, Surface, SurfaceMotion, TetMesh, Tissue, WindingTree,
    winding_number_exact,
};

const METHODS: [Method; 3] = [Method::Cholesky, Method::Pcg, Method::Relaxation];

/// Fibres in random directions, every tet its own.
fn muscle(n_tets: usize) -> Arc<Tissue> {
    let moduli = FibreElastic { young_along: 0.5, young_across: 0.79, poisson: 0.43 };
    let mut numbers = Numbers(17);
    let fibre: Vec<[f64; 3]> = (0..n_tets).map(|_| numbers.unit()).collect();
    Arc::new(Tissue::transversely_isotropic(&[moduli], &fibre, FibreLaw::Spencer).unwrap())
}

/// A box held at x = 0, its far side joined to "jaw".
fn pulled(shape: BoxShape) -> (Arc<TetMesh>, Arc<Boundary>) {
    let bounds = boundary(shape.side(0, false), vec![joined("jaw", shape.side(0, true))]);
    (shape.mesh(), bounds)
}

/// A slab with its floor sliding on the plane z = 0 of "floor", its lid joined to "lid".
fn slab(cells: [usize; 3]) -> (Arc<TetMesh>, Arc<Boundary>, Arc<Surface>) {
    let size = cells.map(|n| n as f64);
    let shape = BoxShape { cells, size, jitter: 0.15 };
    let floor = surface(plane(9, 3.0 * size[0], 0.2));
    let segments = vec![
        joined("lid", shape.side(2, true)),
        sliding("floor", shape.side(2, false), &floor, Gap::Uniform(0.0)),
    ];
    (shape.mesh(), boundary(vec![], segments), floor)
}

/// One scene, three algorithms, the same K: u differs by no more than the error bound, 1e-6 mm.
#[test]
fn methods_agree_to_a_nanometre() {
    let (mesh, bounds) = pulled(BoxShape::cube(8));
    let motion = rigid([1.0, 0.2, 0.0], 6.0, [8.0, 4.0, 4.0], [0.7, -0.3, 0.2]);
    let motion = plan([("jaw", Motion::Rigid(motion))]);
    for (name, tissue) in [
        ("isotropic", isotropic(0.01, 0.46)),
        ("muscle", muscle(mesh.n_tets())),
        ("contrast 263", contrasting(mesh.n_tets(), 263.0)),
    ] {
        let tensors = tensors(&mesh, &tissue);
        let found = METHODS
            .map(|method| solve(&tensors, &bounds, with_method(method), &motion, None).unwrap());
        for (method, other) in METHODS.iter().zip(&found).skip(1) {
            let e = largest_difference(&found[0].displacements, &other.displacements);
            assert!(e <= 1e-6, "{name}, {method:?}: {e:e} mm");
            assert!(e <= 10.0 * other.error_estimate, "{name}, {method:?}: {e:e} beyond its bound");
        }
    }
}

/// The same with a floor that slides.
#[test]
fn methods_agree_with_sliding_contact() {
    let (mesh, bounds, _) = slab([6, 6, 4]);
    let tensors = tensors(&mesh, &muscle(mesh.n_tets()));
    let tilt = rigid([1.0, 0.5, 0.0], 4.0, [3.0, 3.0, 0.0], [0.0, 0.0, 0.1]);
    let press = rigid([0.0, 0.0, 1.0], 5.0, [3.0, 3.0, 4.0], [0.4, 0.0, -0.3]);
    let motion = plan([("lid", Motion::Rigid(press)), ("floor", Motion::Rigid(tilt))]);
    let found =
        METHODS.map(|method| solve(&tensors, &bounds, with_method(method), &motion, None).unwrap());
    for (method, other) in METHODS.iter().zip(&found).skip(1) {
        let e = largest_difference(&found[0].displacements, &other.displacements);
        assert!(e <= 1e-6, "{method:?}: {e:e} mm");
        let largest = found[0].contact.forces.iter().fold(0.0_f64, |m, f| m.max(f.abs()));
        for (a, b) in found[0].contact.forces.iter().zip(&other.contact.forces) {
            assert!((a - b).abs() <= 1e-5 * largest, "{method:?}: {a:e} and {b:e} N");
        }
    }
}

/// Contact that settles in several steps costs conjugate gradients little more than one plan that knew
/// its end from the start, and ends as exact: the steps before the last are loose.
#[test]
fn contact_costs_conjugate_gradients_two_plain_plans_at_most() {
    let (mesh, bounds, _) = slab([12, 12, 6]);
    let tensors = tensors(&mesh, &muscle(mesh.n_tets()));
    let shape = BoxShape { cells: [12, 12, 6], size: [12.0, 12.0, 6.0], jitter: 0.15 };
    let press = rigid([0.0, 0.0, 1.0], 5.0, [6.0, 6.0, 6.0], [0.4, 0.0, -0.3]);
    let tilt = rigid([1.0, 0.5, 0.0], 4.0, [6.0, 6.0, 0.0], [0.0, 0.0, 0.1]);
    let pcg = || with_method(Method::Pcg);
    let moved = |motion| plan([("lid", Motion::Rigid(press)), ("floor", motion)]);
    let found = solve(&tensors, &bounds, pcg(), &moved(Motion::Rigid(tilt)), None).unwrap();
    assert!(found.contact_iterations >= 3, "{}", found.contact_iterations);
    assert!(found.error_estimate <= 1e-7, "{:e}", found.error_estimate);

    let held = vec![joined("lid", shape.side(2, true))];
    let floor_fixed = boundary(shape.side(2, false), held);
    let alone = plan([("lid", Motion::Rigid(press))]);
    let plain = solve(&tensors, &floor_fixed, pcg(), &alone, None).unwrap();
    assert!(
        found.iterations <= 2 * plain.iterations,
        "{} iterations with contact, {} without",
        found.iterations,
        plain.iterations
    );
}

/// A rigid motion is affine in R − I and t: twelve columns a segment answer any finite motion exactly.
#[test]
fn plan_operator_equals_solve_at_twenty_degrees() {
    let shape = BoxShape::cube(7);
    let mesh = shape.mesh();
    let bounds = boundary(
        shape.side(1, false),
        vec![joined("left", shape.side(0, false)), joined("right", shape.side(0, true))],
    );
    let tensors = tensors(&mesh, &muscle(mesh.n_tets()));
    let skin = shape.side(2, true);
    let mut numbers = Numbers(3);
    for (method, allowed) in [(Method::Cholesky, 1e-9), (Method::Pcg, 1e-6)] {
        let solver = solver(&tensors, &bounds, with_method(method)).unwrap();
        let operator = solver.plan_operator(Some(skin.clone()), None, GO_ON).unwrap();
        for _ in 0..3 {
            let motion = plan([
                (
                    "right",
                    Motion::Rigid(rigid(numbers.unit(), 20.0, [7.0, 3.0, 3.0], numbers.unit())),
                ),
                ("left", Motion::Rigid(rigid(numbers.unit(), -20.0, [0.0; 3], numbers.unit()))),
            ]);
            let solved = solver.solve(&motion, None, GO_ON).unwrap().displacements;
            let e = largest_difference(&operator.apply(&motion).unwrap(), &at(&solved, &skin));
            assert!(e <= allowed, "{method:?}: {e:e} mm");
        }
        let rest = operator.apply(&plan([("left", stays()), ("right", stays())])).unwrap();
        assert!(meshes::largest(&rest) == 0.0, "{method:?}: a plan that stays moves nothing");
    }
}

/// With contact the operator is frozen at its reference plan: there it equals `solve`.
#[test]
fn plan_operator_with_contact_equals_solve_at_its_reference() {
    let (mesh, bounds, _) = slab([6, 6, 3]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    let tilt = rigid([1.0, 0.5, 0.0], 20.0, [3.0, 3.0, 0.0], [0.0, 0.0, 0.1]);
    let press = rigid([1.0, 0.4, 0.1], 20.0, [3.0, 3.0, 3.0], [0.2, 0.0, -0.1]);
    let motion = plan([("lid", Motion::Rigid(press)), ("floor", Motion::Rigid(tilt))]);
    let solver = solver(&tensors, &bounds, with_method(Method::Cholesky)).unwrap();
    let solved = solver.solve(&motion, None, GO_ON).unwrap().displacements;
    let operator = solver.plan_operator(None, Some(&motion), GO_ON).unwrap();
    let e = largest_difference(&operator.apply(&motion).unwrap(), &solved);
    assert!(e <= 1e-9, "{e:e} mm");
    // A flat floor that shifts in its own plane keeps its normals: exact away from the reference too.
    let slide = rigid([1.0, 0.5, 0.0], 20.0, [3.0, 3.0, 0.0], [0.0, 0.0, 0.25]);
    let other = plan([("lid", Motion::Rigid(press)), ("floor", Motion::Rigid(slide))]);
    let solved = solver.solve(&other, None, GO_ON).unwrap().displacements;
    let e = largest_difference(&operator.apply(&other).unwrap(), &solved);
    assert!(e <= 1e-9, "moved floor: {e:e} mm");
}

/// A small motion of a pressed lid and of the curved path of its floor, and a small load, add what central
/// differences of whole solutions show; a share of what an iterative solve leaves is all that differs.
#[test]
fn responses_equal_central_differences() {
    let (mesh, bounds, _) = slab([6, 6, 3]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    let about = |degrees: f64, shift: f64| {
        let lid = rigid([1.0, 0.4, 0.1], 20.0, [3.0, 3.0, 3.0], [0.2, shift, -0.1]);
        let floor = rigid([1.0, 0.5, 0.0], 20.0 + degrees, [0.0; 3], [0.0, 0.0, 0.1]);
        plan([("lid", Motion::Rigid(lid)), ("floor", Motion::Rigid(floor))])
    };
    let motion = about(0.0, 0.0);
    // d/dt of a turn about a unit axis through the origin: Ṙ = ω R, with R the turn of the floor.
    let floor = rigid([1.0, 0.5, 0.0], 20.0, [0.0; 3], [0.0, 0.0, 0.1]);
    let [x, y, z, _] = *floor.matrix();
    let degree = 1.0_f64.to_radians() / 1.25_f64.sqrt();
    let turned = |k: f64, u: [f64; 4], l: f64, v: [f64; 4]| {
        [0, 1, 2, 3].map(|i| if i < 3 { degree * (k * u[i] + l * v[i]) } else { 0.0 })
    };
    // ω × along (1, ½, 0): rows of ω R.
    let turn = [turned(0.5, z, 0.0, x), turned(-1.0, z, 0.0, x), turned(1.0, y, -0.5, x)];
    let mut shift = [[0.0; 4]; 3];
    shift[1][3] = 1.0;
    let mut loads = vec![[0.0; 3]; mesh.n_nodes()];
    loads[100] = [1e-3, 0.0, 2e-3];
    let changes = [
        Change::Rates(vec![("floor".into(), turn)]),
        Change::Rates(vec![("lid".into(), shift)]),
        Change::Loads(loads.clone()),
    ];
    for (method, allowed) in [(Method::Cholesky, 1e-5), (Method::Pcg, 1e-3)] {
        let options = StaticOptions {
            contact: ContactOptions { tolerance: 1e-9, ..ContactOptions::default() },
            ..with_method(method)
        };
        let solver = solver(&tensors, &bounds, options).unwrap();
        let solved = solver.solve(&motion, None, GO_ON).unwrap();
        let found = solver.responses((&motion, &solved), &changes, 1e-4, GO_ON).unwrap();
        let step = 1e-3;
        let scaled: Vec<[f64; 3]> = loads.iter().map(|f| f.map(|v| step * v)).collect();
        let against: Vec<[f64; 3]> = loads.iter().map(|f| f.map(|v| -step * v)).collect();
        let ends = [
            (about(step, 0.0), about(-step, 0.0), None, None),
            (about(0.0, step), about(0.0, -step), None, None),
            (motion.clone(), motion.clone(), Some(&scaled[..]), Some(&against[..])),
        ];
        for (k, (ahead, behind, more, less)) in ends.iter().enumerate() {
            let ahead = solver.solve(ahead, *more, GO_ON).unwrap().displacements;
            let behind = solver.solve(behind, *less, GO_ON).unwrap().displacements;
            let difference: Vec<[f64; 3]> = ahead
                .iter()
                .zip(&behind)
                .map(|(a, b)| [0, 1, 2].map(|i| (a[i] - b[i]) / (2.0 * step)))
                .collect();
            let size = meshes::largest(&difference);
            let e = largest_difference(&found[k], &difference);
            assert!(size > 0.0 && e <= allowed * size, "{method:?}, {k}: {e:e} of {size:e}");
        }
    }
}

/// A plan leaves no trace: solving others in between does not change one bit.
#[test]
fn earlier_plans_leave_nothing_behind() {
    let (mesh, bounds, _) = slab([5, 5, 3]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    let first = plan([
        ("lid", Motion::Rigid(rigid([0.0, 0.0, 1.0], 3.0, [2.5; 3], [0.3, 0.0, -0.2]))),
        ("floor", stays()),
    ]);
    let other = plan([
        ("lid", stays()),
        ("floor", Motion::Rigid(rigid([1.0, 0.0, 0.0], 5.0, [2.5, 2.5, 0.0], [0.0, 0.0, 0.4]))),
    ]);
    for method in METHODS {
        let solver = solver(&tensors, &bounds, with_method(method)).unwrap();
        let before = solver.solve(&first, None, GO_ON).unwrap();
        solver.solve(&other, None, GO_ON).unwrap();
        let after = solver.solve(&first, None, GO_ON).unwrap();
        assert_eq!(bits(&before.displacements), bits(&after.displacements), "{method:?}");
        assert_eq!(bits(&before.forces), bits(&after.forces), "{method:?}");
    }
}

/// `work` within a pool of `threads`.
fn with_threads<T: Send>(threads: usize, work: impl FnOnce() -> T + Send) -> T {
    rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(work)
}

/// What `work` returns, after checking that one, two and three threads give the same bits.
fn assert_same_bits(what: &str, work: impl Fn() -> Vec<u64> + Sync) {
    let one = with_threads(1, &work);
    for threads in [2, 3] {
        let more = with_threads(threads, &work);
        let differing = one.iter().zip(&more).filter(|(a, b)| a != b).count();
        assert_eq!(one.len(), more.len(), "{what}");
        assert_eq!(differing, 0, "{what}: {threads} threads change {differing} of {}", one.len());
    }
}

fn solution_bits(
    tensors: &Arc<MassTensors>,
    bounds: &Arc<Boundary>,
    options: StaticOptions,
    motion: &mtm_core::Plan,
) -> Vec<u64> {
    let found = solve(tensors, bounds, options, motion, None).unwrap();
    let mut out = bits(&found.displacements);
    out.extend(bits(&found.forces));
    out.extend(bits(&found.contact.normals));
    out.extend(found.contact.forces.iter().map(|f| f.to_bits()));
    out.push(found.residual.to_bits());
    out.push(found.error_estimate.to_bits());
    out
}

#[test]
fn threads_do_not_change_the_tensors() {
    let mesh = BoxShape::cube(12).mesh();
    let tissue = muscle(mesh.n_tets());
    assert_same_bits("tensors", || {
        let tensors = tensors(&mesh, &tissue);
        let u = Numbers(1).points(mesh.n_nodes());
        let mut out: Vec<u64> =
            tensors.matrix().blocks.iter().flatten().map(|v| v.to_bits()).collect();
        out.extend(bits(&tensors.internal_force(&u).unwrap()));
        out.extend(tensors.stress(&u).unwrap().iter().flatten().map(|v| v.to_bits()));
        out.push(tensors.energy(&u).unwrap().to_bits());
        out
    });
}

/// 13 × 13 × 13 nodes leave 5577 unknowns free of the ends: above the size where the factor goes
/// parallel.
#[test]
fn threads_do_not_change_any_method() {
    let (mesh, bounds) = pulled(BoxShape::cube(12));
    let tensors = tensors(&mesh, &muscle(mesh.n_tets()));
    let motion = rigid([1.0, 0.2, 0.0], 6.0, [12.0, 6.0, 6.0], [0.7, -0.3, 0.2]);
    let motion = plan([("jaw", Motion::Rigid(motion))]);
    assert!(solver(&tensors, &bounds, with_method(Method::Cholesky)).unwrap().n_unknowns() > 5000);
    for method in METHODS {
        assert_same_bits(&format!("{method:?}"), || {
            solution_bits(&tensors, &bounds, with_method(method), &motion)
        });
    }
}

#[test]
fn threads_do_not_change_sliding_by_any_method() {
    let (mesh, bounds, _) = slab([9, 9, 4]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    let tilt = rigid([1.0, 0.5, 0.0], 4.0, [3.0, 3.0, 0.0], [0.0, 0.0, 0.1]);
    let motion = plan([("lid", stays()), ("floor", Motion::Rigid(tilt))]);
    for method in METHODS {
        assert_same_bits(&format!("{method:?}"), || {
            solution_bits(&tensors, &bounds, with_method(method), &motion)
        });
    }
}

/// 33 × 33 sliding nodes: the dense flexibility (3267) and the dense contact solve (1089) go parallel.
#[test]
fn threads_do_not_change_dense_contact() {
    let (mesh, bounds, _) = slab([32, 32, 2]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    let tilt = rigid([1.0, 0.5, 0.0], 1.0, [16.0, 16.0, 0.0], [0.0, 0.0, 0.1]);
    let motion = plan([("lid", stays()), ("floor", Motion::Rigid(tilt))]);
    assert_same_bits("dense contact", || {
        solution_bits(&tensors, &bounds, with_method(Method::Cholesky), &motion)
    });
}

/// Held by its sliding floor alone in z: the dense path is closed, every set of normals is factored.
#[test]
fn threads_do_not_change_refactored_contact() {
    let shape = BoxShape { cells: [12, 12, 8], size: [12.0, 12.0, 8.0], jitter: 0.15 };
    let mesh = shape.mesh();
    let floor = surface(plane(5, 40.0, 0.2));
    // An edge along y holds x and z and two turns; only the floor stops the turn about the edge.
    let edge = shape.nodes_where(|p| p[0] == 0 && p[2] == 8);
    let slide = sliding("floor", shape.side(2, false), &floor, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("edge", edge), slide]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    let press = rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.0, 0.0, -0.3]);
    let motion = plan([("edge", Motion::Rigid(press)), ("floor", stays())]);
    assert_same_bits("refactored contact", || {
        solution_bits(&tensors, &bounds, with_method(Method::Cholesky), &motion)
    });
}

#[test]
fn threads_do_not_change_the_plan_operator() {
    let (mesh, bounds, _) = slab([11, 11, 11]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    for method in [Method::Cholesky, Method::Pcg] {
        assert_same_bits(&format!("operator, {method:?}"), || {
            let solver = solver(&tensors, &bounds, with_method(method)).unwrap();
            let operator = solver.plan_operator(None, None, GO_ON).unwrap();
            operator.matrix().iter().map(|v| v.to_bits()).collect()
        });
    }
    let (mesh, bounds) = pulled(BoxShape::cube(11));
    let tensors = meshes::tensors(&mesh, &isotropic(0.01, 0.45));
    assert_same_bits("operator without contact", || {
        let solver = solver(&tensors, &bounds, with_method(Method::Cholesky)).unwrap();
        let operator = solver.plan_operator(None, None, GO_ON).unwrap();
        operator.matrix().iter().map(|v| v.to_bits()).collect()
    });
}

#[test]
fn threads_do_not_change_surfaces_and_winding_numbers() {
    let (vertices, triangles) = meshes::sphere(4, 20.0);
    let moved: Vec<[f64; 3]> = vertices
        .iter()
        .map(|&v| {
            let x = Vec3::from(v);
            (x + Vec3::new((0.3 * x.y).sin(), 0.0, 0.1 * x.x)).into()
        })
        .collect();
    let points: Vec<[f64; 3]> =
        Numbers(23).points(2000).iter().map(|p| p.map(|x| 30.0 * x)).collect();
    assert_same_bits("surface", || {
        let rest = Surface::new(vertices.clone(), triangles.clone()).unwrap();
        let motion = SurfaceMotion::new(rest.clone(), moved.clone()).unwrap();
        let mut out = Vec::new();
        for c in rest.closest(&points).iter().chain(&motion.moved().closest(&points)) {
            out.extend(bits(&[c.point, c.normal, c.barycentric]));
            out.push(u64::from(c.triangle));
        }
        out.extend(bits(&motion.displacement(&points)));
        let tree = WindingTree::new(&rest);
        let winding = tree.winding_number(&points).into_iter();
        out.extend(winding.chain(winding_number_exact(&rest, &points[..200])).map(f64::to_bits));
        out
    });
}

/// A segment that has both kinds of nodes carries them by one motion.
#[test]
fn joined_and_sliding_nodes_of_one_segment_follow_one_motion() {
    let shape = BoxShape { cells: [6, 4, 4], size: [6.0, 4.0, 4.0], jitter: 0.1 };
    let mesh = shape.mesh();
    let floor = surface(plane(4, 20.0, 0.2));
    let base = shape.side(2, false);
    let (held, slid): (Vec<u32>, Vec<u32>) =
        base.iter().partition(|&&j| mesh.nodes()[j as usize][0] < 2.5);
    let segment = Segment {
        name: "jaw".into(),
        joined: held,
        sliding: slid,
        contact: Some(floor),
        gap: Gap::Uniform(0.0),
    };
    let bounds = boundary(vec![], vec![segment]);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.45));
    let motion = rigid([0.2, 1.0, 0.3], 12.0, [3.0, 2.0, 0.0], [1.0, 2.0, -0.5]);
    for method in METHODS {
        // Nothing else holds the body: it follows, which linear strain sees as a large deformation, so
        // only a translation is exact.
        let shift = rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [1.0, 2.0, -0.5]);
        let plan_ = plan([("jaw", Motion::Rigid(shift))]);
        let found = solve(&tensors, &bounds, with_method(method), &plan_, None).unwrap();
        let exact = vec![[1.0, 2.0, -0.5]; mesh.n_nodes()];
        let e = largest_difference(&found.displacements, &exact);
        assert!(e <= 1e-7, "{method:?}: {e:e} mm");
        let plan_ = plan([("jaw", Motion::Rigid(motion))]);
        let found = solve(&tensors, &bounds, with_method(method), &plan_, None).unwrap();
        assert!(found.contact_gap() <= 1e-6, "{method:?}: {:e} mm", found.contact_gap());
    }
}
