//! Boundaries, plans, options and solves that cannot work.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::{cube, refused, tet};
use crate::meshes::{
    self, BoxShape, GO_ON, boundary, isotropic, joined, plan, plane, rigid, sliding, solve, solver,
    stays, surface, tensors, with_method,
};
use mtm_core::{
    Boundary, Conflicts, ContactOptions, Elastic, ErrorKind, Gap, Method, Motion, MtmError,
    RigidMotion, Segment, StaticOptions, StaticSolver, Surface, TetMesh, Tissue,
};

#[test]
fn node_of_two_kinds_is_named_with_both() {
    use MtmError::NodeOfTwoKinds;
    let sheet = surface(plane(2, 9.0, 0.0));
    let slide = || sliding("lip", vec![7, 9], &sheet, Gap::Rest);
    let refuse = |fixed, segments| Boundary::new(fixed, segments, Conflicts::Refuse);
    assert_refused!(
        refuse(vec![1, 7], vec![joined("jaw", vec![3, 7])]),
        NodeOfTwoKinds { node: 7, .. },
        Boundary,
        "node 7",
        "fixed",
        "joined to \"jaw\""
    );
    assert_refused!(
        refuse(vec![9], vec![slide()]),
        NodeOfTwoKinds { node: 9, .. },
        Boundary,
        "fixed",
        "sliding on \"lip\""
    );
    assert_refused!(
        refuse(vec![], vec![slide(), joined("jaw", vec![9])]),
        NodeOfTwoKinds { node: 9, .. },
        Boundary,
        "joined to \"jaw\"",
        "sliding on \"lip\""
    );
    let both = vec![joined("a", vec![1, 2]), joined("b", vec![2, 3])];
    assert_refused!(
        Boundary::new(vec![], both, Conflicts::Resolve),
        NodeOfTwoKinds { node: 2, .. },
        Boundary,
        "\"a\"",
        "\"b\""
    );
    // Resolved: fixed over joined over sliding, counted.
    let bounds = boundary(vec![1], vec![joined("jaw", vec![1, 7]), slide()]);
    assert_eq!(bounds.conflicts(), 2);
    assert_eq!(bounds.segments()[0].joined, [7]);
    assert_eq!(bounds.segments()[1].sliding, [9]);
}

#[test]
fn segments_that_cannot_serve_are_named() {
    let sheet = surface(plane(2, 9.0, 0.0));
    let bare = |name: &str| joined(name, vec![]);
    let without = Segment { sliding: vec![1, 2], ..bare("lip") };
    let with_gap = |gap| sliding("lip", vec![1, 2], &sheet, gap);
    for (segments, parts) in [
        (vec![bare("jaw")], ["\"jaw\"", "neither joined nor sliding"]),
        (vec![joined("jaw", vec![1]), joined("jaw", vec![2])], ["\"jaw\"", "named twice"]),
        (vec![without], ["2 sliding nodes", "no contact surface"]),
        (vec![with_gap(Gap::Uniform(f64::NAN))], ["\"lip\"", "gap of NaN"]),
        (vec![with_gap(Gap::PerNode(vec![0.1]))], ["1 gaps", "2 sliding"]),
        (vec![with_gap(Gap::PerNode(vec![0.1, f64::INFINITY]))], ["gap[1]", "inf"]),
    ] {
        let outcome = Boundary::new(vec![], segments, Conflicts::Resolve);
        assert_refused!(outcome, MtmError::Segment { .. }, Boundary, parts[0], parts[1]);
    }
}

#[test]
fn plans_that_do_not_fit_are_named() {
    let (shape, tensors) = cube();
    let floor = surface(plane(3, 9.0, 0.0));
    let bounds = boundary(
        shape.side(2, true),
        vec![
            joined("jaw", shape.nodes_where(|p| p[0] == 0 && p[2] == 1)),
            sliding("lip", shape.side(2, false), &floor, Gap::Rest),
        ],
    );
    let solver = solver(&tensors, &bounds, StaticOptions::default()).unwrap();
    let four = || Motion::Nodes(vec![[0.0; 3]; 4]);
    for (plan, parts) in [
        (plan([("jaw", stays())]), ["\"lip\"", "missing"]),
        (meshes::plan([]), ["\"jaw\"", "missing"]),
        (
            meshes::plan([("jaw", stays()), ("lip", stays()), ("chin", stays())]),
            ["\"chin\"", "no such segment"],
        ),
        (
            meshes::plan([("jaw", stays()), ("lip", stays()), ("jaw", stays())]),
            ["\"jaw\"", "named twice"],
        ),
        (
            meshes::plan([("jaw", Motion::Nodes(vec![[0.0; 3]; 3])), ("lip", stays())]),
            ["3 displacements", "4 joined"],
        ),
        (
            meshes::plan([("jaw", four()), ("lip", Motion::Nodes(vec![]))]),
            ["\"lip\"", "contact surface moves"],
        ),
    ] {
        assert_refused!(
            solver.solve(&plan, None, GO_ON),
            MtmError::Plan { .. },
            Boundary,
            parts[0],
            parts[1]
        );
    }
    let operator = solver.plan_operator(None, None, GO_ON).unwrap();
    for (plan, part) in [
        (plan([("jaw", stays())]), "missing"),
        (meshes::plan([("jaw", four()), ("lip", stays())]), "rigid 4×4"),
        (meshes::plan([("jaw", stays()), ("lip", stays()), ("x", stays())]), "no such segment"),
    ] {
        assert_refused!(operator.apply(&plan), MtmError::Plan { .. }, Boundary, part);
    }
    // The same node twice in the list of joined nodes, moved two ways.
    let twice = boundary(shape.side(2, true), vec![joined("jaw", vec![0, 1, 0])]);
    let rows = vec![[0.1, 0.0, 0.0], [0.0; 3], [0.2, 0.0, 0.0]];
    let motion = meshes::plan([("jaw", Motion::Nodes(rows))]);
    assert_refused!(
        solve(&tensors, &twice, StaticOptions::default(), &motion, None),
        MtmError::Plan { .. },
        Boundary,
        "row 2 moves node 0"
    );
}

#[test]
fn matrices_that_are_not_rigid_are_refused_with_the_reason() {
    let turn = rigid([0.0, 0.0, 1.0], 30.0, [0.0; 3], [1.0, 2.0, 3.0]);
    let changed = |change: &dyn Fn(&mut [[f64; 4]; 4])| {
        let mut matrix = *turn.matrix();
        change(&mut matrix);
        matrix
    };
    for (matrix, parts) in [
        (changed(&|m| m[0][0] *= 1.01), ["not rigid", "R^T R"]),
        (changed(&|m| m[0][1] += 1e-3), ["not rigid", "allowed"]),
        (changed(&|m| m[2] = m[2].map(|v| -v)), ["reflection", "determinant -1"]),
        (changed(&|m| m[3][0] = 1.0), ["bottom row", "transpose"]),
        (changed(&|m| m[3][3] = 0.0), ["bottom row", "0 0 0 1"]),
        ([[0.0, 0.0, 0.0, 0.0], [0.0; 4], [0.0; 4], [0.0, 0.0, 0.0, 1.0]], ["not rigid", "1.0"]),
        (changed(&|m| m[0][0] = 1e200), ["not rigid", "4x4"]),
    ] {
        let outcome = RigidMotion::new("jaw", &matrix);
        assert_refused!(outcome, MtmError::Plan { .. }, Boundary, "\"jaw\"", parts[0], parts[1]);
    }
    // The figure tells a millimetre from an inch.
    let error = RigidMotion::new(
        "jaw",
        &changed(&|m| {
            m[..3].iter_mut().for_each(|row| row[..3].iter_mut().for_each(|entry| *entry *= 25.4));
        }),
    );
    assert!(error.unwrap_err().to_string().contains("+2440.000 %"));
}

/// Every rotation written with four decimals or more is read, and what the solver gets is exactly rigid.
#[test]
fn written_rotations_are_made_orthogonal_and_exact_ones_are_kept_bit_for_bit() {
    let mut worst: f64 = 0.0;
    for i in 0..2000 {
        let x = f64::from(i);
        let axis = [(1.7 * x).sin(), (2.3 * x).cos(), (0.9 * x).sin() + 0.1];
        let exact = rigid(axis, 0.7 * x, [3.0, -2.0, 900.0], [1.0, 2.0, 3.0]);
        assert_eq!(RigidMotion::new("jaw", exact.matrix()).unwrap(), exact);
        for decimals in [4, 5, 6, 7] {
            let power = 10_f64.powi(decimals);
            let typed = exact.matrix().map(|row| row.map(|v| (v * power).round() / power));
            let read = RigidMotion::new("jaw", &typed).unwrap();
            let off = |i: usize, j: usize| {
                let m = read.matrix();
                (0..3).map(|k| m[k][i] * m[k][j]).sum::<f64>() - f64::from(u8::from(i == j))
            };
            for (i, j) in [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)] {
                worst = worst.max(off(i, j).abs());
            }
            for (row, (given, kept)) in typed.iter().zip(read.matrix()).enumerate() {
                assert_eq!(given[3], kept[3]);
                // The nearest rotation is no farther from the typed matrix than the true one.
                for (a, b) in given[..3].iter().zip(&kept[..3]) {
                    assert!((a - b).abs() <= 3.0 * 0.5 / power, "row {row}: {a} {b}");
                }
            }
            assert_eq!(RigidMotion::new("jaw", read.matrix()).unwrap(), read);
        }
    }
    assert!(worst < 4e-15, "{worst:e}");
}

#[test]
fn bodies_that_are_not_held_say_which_modes_are_free() {
    use MtmError::Unconstrained;
    let (shape, tensors) = cube();
    let floor = surface(plane(3, 9.0, 0.0));
    let options = StaticOptions::default();
    for (fixed, segments, part) in [
        (vec![], vec![], "all six rigid modes"),
        (vec![0], vec![], "rotation about"),
        // Lattice neighbours along z: a hinge.
        (vec![0, 1], vec![], "rotation about z through (0.0000, 0.0000"),
        (
            vec![],
            vec![sliding("lip", shape.side(2, false), &floor, Gap::Rest)],
            "translation along",
        ),
    ] {
        let bounds = boundary(fixed, segments);
        assert_refused!(
            solver(&tensors, &bounds, options),
            Unconstrained { .. },
            Boundary,
            "the body",
            part,
            "64 nodes"
        );
    }
    // A second body beside the first, held by nothing.
    let (mut nodes, mut tets) = shape.tets();
    nodes.extend(tet().iter().map(|x| [x[0] + 50.0, x[1], x[2]]));
    tets.push([64, 65, 66, 67]);
    let mesh = meshes::checked((nodes, tets));
    let tensors = meshes::tensors(&mesh, &isotropic(0.01, 0.4));
    assert_refused!(
        solver(&tensors, &boundary(shape.side(0, false), vec![]), options),
        Unconstrained { .. },
        Boundary,
        "a part of the body",
        "4 nodes",
        "node 64"
    );
}

#[test]
fn options_out_of_range_are_named() {
    use MtmError::OutOfRange;
    let (shape, tensors) = cube();
    let bounds = boundary(shape.side(0, false), vec![]);
    let default = StaticOptions::default();
    let contact = |contact| StaticOptions { contact, ..default };
    let usual = ContactOptions::default();
    for (options, what) in [
        (StaticOptions { tolerance: 0.0, ..default }, "tolerance"),
        (StaticOptions { tolerance: f64::NAN, ..default }, "tolerance"),
        (StaticOptions { tolerance: 1.0, ..default }, "tolerance"),
        (StaticOptions { max_iterations: Some(0), ..default }, "max_iterations"),
        (contact(ContactOptions { tolerance: -1.0, ..usual }), "contact_tolerance"),
        (contact(ContactOptions { max_iterations: 0, ..usual }), "contact_iterations"),
    ] {
        assert_refused!(solver(&tensors, &bounds, options), OutOfRange { .. }, Solver, what);
    }
}

/// Numerical outcomes: the input is well formed, the answer cannot be had.
#[test]
fn numerical_failures_are_told_from_mistakes() {
    let (shape, tensors) = cube();
    let bounds = boundary(shape.side(0, false), vec![joined("jaw", shape.side(0, true))]);
    let motion = plan([("jaw", Motion::Rigid(rigid([1.0, 0.0, 0.0], 9.0, [0.0; 3], [1.0; 3])))]);
    for (method, name) in [(Method::Pcg, "pcg"), (Method::Relaxation, "relaxation")] {
        let options = StaticOptions { max_iterations: Some(3), ..with_method(method) };
        assert_failed!(
            solve(&tensors, &bounds, options, &motion, None),
            MtmError::NotConverged { .. },
            Solver,
            name,
            "3 iterations",
            "mm was requested"
        );
    }
    let options = StaticOptions { memory_limit: Some(1000), ..with_method(Method::Cholesky) };
    assert_failed!(
        solver(&tensors, &bounds, options),
        MtmError::OutOfMemory { .. },
        Solver,
        "Cholesky factor",
        "pcg"
    );
    // `auto` takes conjugate gradients instead.
    let options = StaticOptions { memory_limit: Some(1000), ..with_method(Method::Auto) };
    assert_eq!(solver(&tensors, &bounds, options).unwrap().method(), Method::Pcg);

    // Stiff tets afloat in soft ones, 1e12 times softer: what holds them is lost in rounding.
    let shape = BoxShape::cube(6);
    let mesh = shape.mesh();
    let rows: Vec<Elastic> = mesh
        .tets()
        .iter()
        .map(|tet| {
            let afloat = tet
                .iter()
                .all(|&v| mesh.nodes()[v as usize].iter().all(|x| (1.5..4.5).contains(x)));
            Elastic { young: if afloat { 3e9 } else { 0.003 }, poisson: 0.45 }
        })
        .collect();
    let tensors = meshes::tensors(&mesh, &Arc::new(Tissue::isotropic(&rows).unwrap()));
    let bounds = boundary(shape.side(0, false), vec![]);
    assert_failed!(
        solver(&tensors, &bounds, with_method(Method::Cholesky)),
        MtmError::NotPositiveDefinite { .. },
        Solver,
        "not positive definite to working precision at node"
    );
}

/// Values that no tissue, image or plan has are refused where they enter, with the limit.
#[test]
fn absurd_values_are_named() {
    use MtmError::{OutOfRange, Plan};
    let (shape, tensors) = cube();
    let bounds = boundary(shape.side(0, false), vec![joined("jaw", shape.side(0, true))]);
    let count = shape.side(0, true).len();
    for value in [1e7, 1e100, 1e300, -f64::MAX] {
        let mut nodes = tet();
        nodes[3][2] = value;
        let mesh = TetMesh::new(nodes.clone(), vec![[0, 1, 2, 3]]);
        assert_refused!(mesh, OutOfRange { index: 3, .. }, Mesh, "nodes[3]", "1e6 mm");
        let surface = Surface::new(nodes, vec![[0, 1, 2], [0, 1, 3]]);
        assert_refused!(surface, OutOfRange { index: 3, .. }, Mesh, "vertices[3]", "1e6 mm");

        let mut rows = vec![[0.0; 3]; count];
        rows[1][0] = value;
        let moved = plan([("jaw", Motion::Nodes(rows))]);
        let found = solve(&tensors, &bounds, StaticOptions::default(), &moved, None);
        assert_refused!(found, OutOfRange { index: 1, .. }, Boundary, "plan[\"jaw\"][1]", "1e6 mm");
        let far =
            rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.0, 10.0 * value.clamp(-1e300, 1e300), 0.0]);
        let moved = plan([("jaw", Motion::Rigid(far))]);
        let found = solve(&tensors, &bounds, StaticOptions::default(), &moved, None);
        assert_refused!(found, Plan { .. }, Boundary, "jaw", "translation", "1e7 mm");
    }
    for value in [1e13, 1e100, f64::MAX, 1e-16, 1e-300] {
        let tissue = Tissue::isotropic(&[Elastic { young: value, poisson: 0.3 }]);
        assert_refused!(tissue, OutOfRange { .. }, Material, "young", "1e-15 to 1e12 MPa");
        let mut c = isotropic(1.0, 0.3).stiffness()[0];
        c.iter_mut().flatten().for_each(|v| *v *= value.min(1e300));
        assert_refused!(Tissue::from_stiffness(vec![c]), OutOfRange { .. }, Material, "stiffness");
    }
    for value in [1e13, 1e160, 1e300, f64::MAX] {
        let mut loads = vec![[0.0; 3]; 64];
        loads[5][1] = value;
        let moved = plan([("jaw", stays())]);
        let found = solve(&tensors, &bounds, StaticOptions::default(), &moved, Some(&loads));
        assert_refused!(found, OutOfRange { index: 5, .. }, Boundary, "loads[5]", "1e12 N");
    }
    let short: Vec<[f64; 3]> = tet().iter().map(|x| x.map(|v| 1e-10 * v)).collect();
    let mesh = TetMesh::new(short, vec![[0, 1, 2, 3]]);
    assert_refused!(mesh, OutOfRange { .. }, Mesh, "longest edge", "1e-9 mm");
}

/// At the limits of what is taken, no NaN or infinity is handed out.
#[test]
fn extremes_that_are_taken_stay_finite() {
    let (shape, tensors) = cube();
    let bounds = boundary(shape.side(0, false), vec![]);
    for load in [1e9, 1e12] {
        let loads = vec![[load, 0.0, 0.0]; 64];
        for method in [Method::Cholesky, Method::Pcg, Method::Relaxation] {
            match solve(&tensors, &bounds, with_method(method), &plan([]), Some(&loads)) {
                Err(error) => assert_eq!(error.kind(), ErrorKind::Solver, "{error}"),
                Ok(found) => {
                    let numbers = found.displacements.iter().chain(&found.forces).flatten();
                    assert!(
                        numbers
                            .chain([&found.residual, &found.error_estimate])
                            .all(|v| v.is_finite())
                    );
                }
            }
        }
    }
}

/// Whoever asks for a stop gets one, at set-up and at any time of a solve.
#[test]
fn caller_can_stop_every_method() {
    let shape = BoxShape::cube(5);
    let mesh = shape.mesh();
    let tensors = tensors(&mesh, &isotropic(0.01, 0.4));
    let floor = surface(plane(4, 20.0, 0.2));
    let segments = vec![
        joined("lid", shape.side(2, true)),
        sliding("floor", shape.side(2, false), &floor, Gap::Rest),
    ];
    let bounds = boundary(vec![], segments);
    let tilt = rigid([1.0, 0.0, 0.0], 4.0, [2.0; 3], [0.0; 3]);
    let motion = plan([("lid", stays()), ("floor", Motion::Rigid(tilt))]);
    for method in [Method::Cholesky, Method::Pcg, Method::Relaxation] {
        let options = with_method(method);
        let outcome = StaticSolver::new(tensors.clone(), bounds.clone(), options, &|| true);
        assert_failed!(outcome, MtmError::Interrupted, Interrupted, "interrupted");
        let solver = solver(&tensors, &bounds, options).unwrap();
        for after in [0, 1, 2] {
            let calls = AtomicUsize::new(0);
            let stop = || calls.fetch_add(1, Ordering::Relaxed) >= after;
            let outcome = solver.solve(&motion, None, &stop);
            if outcome.is_ok() {
                assert!(after > 0, "{method:?} never asked");
                continue;
            }
            assert_failed!(outcome, MtmError::Interrupted, Interrupted, "interrupted");
        }
        assert!(solver.solve(&motion, None, GO_ON).is_ok(), "{method:?}: solvable after a stop");
    }
}
