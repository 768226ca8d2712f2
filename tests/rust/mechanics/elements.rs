//! Elements and kinematics past the linear tet: patch tests, rotations, derivatives, closed forms, contact.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, GO_ON, Numbers, Vec3, affine, any_stiffness, at, bits, boundary, carried,
    isotropic, joined, largest, largest_difference, plan, plane, rigid, sliding, solve, solver,
    surface, tissues, with_method,
};
use mtm_core::{
    ContactMode, ContactOptions, Element, FibreElastic, FibreLaw, Gap, Kinematics, MassTensors,
    Method, Motion, RigidMotion, StaticOptions, StrainEnergy, TangentKind, TetMesh, Tissue, Voigt,
};
use nalgebra::{DMatrix, Matrix3, SymmetricEigen};

pub(super) const ELEMENTS: [Element; 3] =
    [Element::Linear, Element::NodalPressure, Element::Quadratic];

const LARGE: [Kinematics; 2] = [Kinematics::Corotational, Kinematics::NEO_HOOKEAN];

pub(super) const ALL: [Kinematics; 3] =
    [Kinematics::Linear, Kinematics::Corotational, Kinematics::NEO_HOOKEAN];

pub(super) fn of_element(
    mesh: &Arc<TetMesh>,
    tissue: &Arc<Tissue>,
    element: Element,
) -> Arc<MassTensors> {
    Arc::new(MassTensors::with_element(mesh.clone(), tissue.clone(), element).unwrap())
}

pub(super) fn with_kinematics(kinematics: Kinematics) -> StaticOptions {
    StaticOptions { kinematics, ..with_method(Method::Cholesky) }
}

/// Two materials a hundredfold apart, with and without fibres, in slabs.
fn layered(mesh: &TetMesh) -> Arc<Tissue> {
    let rows: Vec<Voigt> = (0..mesh.n_tets())
        .map(|t| {
            let middle: f64 = mesh.tets()[t].iter().map(|&v| mesh.nodes()[v as usize][0]).sum();
            let stiff = middle > 6.0;
            let moduli = FibreElastic {
                young_along: if stiff { 0.5 } else { 0.005 },
                young_across: if stiff { 0.79 } else { 0.005 },
                poisson: 0.45,
            };
            let row =
                Tissue::transversely_isotropic(&[moduli], &[[0.6, 0.0, 0.8]], FibreLaw::Spencer);
            row.unwrap().stiffness()[0]
        })
        .collect();
    Arc::new(Tissue::from_stiffness(rows).unwrap())
}

fn dense(matrix: &mtm_core::BlockMatrix) -> DMatrix<f64> {
    let n = matrix.n_rows();
    let mut out = DMatrix::zeros(3 * n, 3 * n);
    for j in 0..n {
        let (columns, blocks) = matrix.row(j);
        for (&k, b) in columns.iter().zip(blocks) {
            for r in 0..3 {
                for c in 0..3 {
                    out[(3 * j + r, 3 * k as usize + c)] = b[3 * r + c];
                }
            }
        }
    }
    out
}

/// Patch test (Irons 1966) with finite strain: an affine motion of the hull is followed inside.
#[test]
fn affine_motion_of_the_hull_gives_the_affine_field_inside() {
    let shape = BoxShape::cube(3);
    let mesh = shape.mesh();
    let hull = shape.hull();
    let bounds = boundary(vec![], vec![joined("hull", hull.clone())]);
    let h = Matrix3::new(0.1, -0.05, 0.08, 0.12, -0.1, 0.04, -0.06, 0.02, 0.05);
    for (name, tissue) in tissues() {
        for element in ELEMENTS {
            let tensors = of_element(&mesh, &tissue, element);
            let exact = affine(tensors.element_nodes().positions(), h, Vec3::new(0.3, -0.2, 0.1));
            let motion = plan([("hull", Motion::Nodes(at(&exact, &hull)))]);
            for kinematics in ALL {
                let options = with_kinematics(kinematics);
                let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
                let error = largest_difference(&found.displacements, &exact);
                assert!(error < 1e-9, "{name} {element:?} {kinematics:?}: {error}");
                assert!(found.residual < 1e-9, "{name} {element:?} {kinematics:?}");
            }
        }
    }
}

#[test]
fn stiffness_is_symmetric_with_six_zero_modes_and_no_negative_one() {
    // The time of dense eigenvalues grows with the cube of the nodes.
    let mesh = BoxShape { cells: [2, 2, 3], ..BoxShape::cube(3) }.mesh();
    let mut list = tissues();
    list.push(("layers", layered(&mesh)));
    list.push(("nearly incompressible", isotropic(0.003, 0.4999)));
    for (name, tissue) in list {
        for element in [Element::NodalPressure, Element::Quadratic] {
            let tensors = of_element(&mesh, &tissue, element);
            let k = dense(tensors.matrix());
            assert!((&k - k.transpose()).amax() < 1e-13 * k.amax(), "{name} {element:?}");
            let mut values = SymmetricEigen::new(k).eigenvalues.as_slice().to_vec();
            values.sort_by(f64::total_cmp);
            let largest = values[values.len() - 1];
            assert!(values[..6].iter().all(|v| v.abs() < 1e-13 * largest), "{name} {element:?}");
            assert!(values[6] > 1e-8 * largest, "{name} {element:?}: {:e}", values[6] / largest);
        }
    }
}

/// A quarter of each tet belongs to each corner, so uniform strain stores the energy of C.
#[test]
fn uniform_strain_stores_the_same_energy_in_every_element() {
    let mesh = BoxShape::cube(3).mesh();
    let h = Matrix3::new(0.03, -0.01, 0.02, 0.015, -0.02, 0.005, -0.007, 0.012, 0.01);
    let tissue = layered(&mesh);
    for kinematics in ALL {
        let energy = |element| {
            let tensors = of_element(&mesh, &tissue, element);
            let u = affine(tensors.element_nodes().positions(), h, Vec3::zeros());
            match kinematics {
                Kinematics::Linear => tensors.energy(&u).unwrap(),
                large => StrainEnergy::new(tensors, large).state(&u).unwrap().energy,
            }
        };
        let expected = energy(Element::Linear);
        for element in [Element::NodalPressure, Element::Quadratic] {
            assert!((energy(element) / expected - 1.0).abs() < 1e-12, "{element:?} {kinematics:?}");
        }
    }
}

#[test]
fn forces_and_stiffness_are_the_derivatives_of_energy() {
    // Central differences of step h: error near h², rounding near 1e-16/h.
    const STEP: f64 = 1e-5;
    let mesh = BoxShape { cells: [2, 2, 1], ..BoxShape::cube(1) }.mesh();
    let mut numbers = Numbers(5);
    let rows: Vec<Voigt> = (0..mesh.n_tets()).map(|t| any_stiffness(t as u64 / 5)).collect();
    let tissue = Arc::new(Tissue::from_stiffness(rows).unwrap());
    for element in ELEMENTS {
        let tensors = of_element(&mesh, &tissue, element);
        let n = tensors.element_nodes().n_nodes();
        let u: Vec<[f64; 3]> = numbers.points(n).iter().map(|v| v.map(|x| 0.08 * x)).collect();
        let d = numbers.points(n);
        let moved = |s: f64| -> Vec<[f64; 3]> {
            u.iter().zip(&d).map(|(u, d)| [0, 1, 2].map(|i| u[i] + s * d[i])).collect()
        };
        for kinematics in LARGE {
            let body = StrainEnergy::new(tensors.clone(), kinematics);
            let (ahead, behind) =
                (body.state(&moved(STEP)).unwrap(), body.state(&moved(-STEP)).unwrap());
            let here = body.state(&u).unwrap();
            let work: f64 =
                here.forces.iter().flatten().zip(d.iter().flatten()).map(|(f, d)| f * d).sum();
            let slope = (ahead.energy - behind.energy) / (2.0 * STEP);
            assert!((work / slope - 1.0).abs() < 1e-7, "{element:?} {kinematics:?} {work} {slope}");
            let product = body.stiffness(&u, TangentKind::Exact).unwrap().multiply(&d);
            let change: Vec<[f64; 3]> = ahead
                .forces
                .iter()
                .zip(&behind.forces)
                .map(|(a, b)| [0, 1, 2].map(|i| (a[i] - b[i]) / (2.0 * STEP)))
                .collect();
            let error = largest_difference(&product, &change) / largest(&change);
            assert!(error < 1e-7, "{element:?} {kinematics:?}: {error}");
        }
    }
}

#[test]
fn tiny_motions_meet_the_linear_answer() {
    // The quadratic terms are as large as the strain, 1e-6, in forces times the contrast of 100.
    let shape = BoxShape::cube(3);
    let mesh = shape.mesh();
    let tissue = layered(&mesh);
    let segments = vec![joined("bone", shape.side(0, true))];
    let bounds = boundary(shape.side(0, false), segments);
    let motion =
        plan([("bone", Motion::Rigid(rigid([0.0, 0.3, 1.0], 1e-4, [0.0; 3], [0.0, 1e-6, 2e-6])))]);
    for element in ELEMENTS {
        let tensors = of_element(&mesh, &tissue, element);
        let linear =
            solve(&tensors, &bounds, with_kinematics(Kinematics::Linear), &motion, None).unwrap();
        for kinematics in LARGE {
            let found =
                solve(&tensors, &bounds, with_kinematics(kinematics), &motion, None).unwrap();
            let off = largest_difference(&found.displacements, &linear.displacements);
            assert!(
                off < 1e-5 * largest(&linear.displacements),
                "{element:?} {kinematics:?}: {off}"
            );
            let off = largest_difference(&found.forces, &linear.forces);
            assert!(off < 1e-4 * largest(&linear.forces), "{element:?} {kinematics:?}: {off}");
        }
    }
}

#[test]
fn turning_everything_turns_the_answer() {
    let shape = BoxShape::cube(3);
    let mesh = shape.mesh();
    let tissue = layered(&mesh);
    let bounds = boundary(
        vec![],
        vec![joined("skull", shape.side(0, false)), joined("bone", shape.side(0, true))],
    );
    let moved = rigid([0.2, 1.0, 0.3], 20.0, [3.0, 1.5, 1.5], [0.4, 0.2, -0.3]);
    for degrees in [25.0, 170.0] {
        let turn = rigid([1.0, 0.4, -0.7], degrees, [1.0, -2.0, 4.0], [3.0, -1.0, 2.0]);
        let both = {
            let (a, b) = (turn.matrix(), moved.matrix());
            let mut m = [[0.0; 4]; 4];
            for i in 0..4 {
                for j in 0..4 {
                    m[i][j] = (0..4).map(|k| a[i][k] * b[k][j]).sum();
                }
            }
            RigidMotion::new("both", &m).unwrap()
        };
        let here = plan([("skull", meshes::stays()), ("bone", Motion::Rigid(moved))]);
        let there = plan([("skull", Motion::Rigid(turn)), ("bone", Motion::Rigid(both))]);
        for element in ELEMENTS {
            let tensors = of_element(&mesh, &tissue, element);
            let places = tensors.element_nodes().positions();
            for kinematics in LARGE {
                let ready = solver(&tensors, &bounds, with_kinematics(kinematics)).unwrap();
                let ends = |motion| {
                    let found = ready.solve(motion, None, GO_ON).unwrap();
                    let ends: Vec<[f64; 3]> = places
                        .iter()
                        .zip(&found.displacements)
                        .map(|(x, u)| [0, 1, 2].map(|i| x[i] + u[i]))
                        .collect();
                    (ends, found.forces)
                };
                let ((one, forces), (other, turned)) = (ends(&here), ends(&there));
                let off = largest_difference(&carried(&turn, &one), &other) / mesh.diagonal();
                assert!(off < 1e-9, "{element:?} {kinematics:?} {degrees}: {off}");
                let forces: Vec<[f64; 3]> = forces.iter().map(|&f| turn.rotate(f)).collect();
                let off = largest_difference(&forces, &turned) / largest(&forces);
                assert!(off < 1e-9, "{element:?} {kinematics:?} {degrees}: forces {off}");
            }
        }
    }
}

/// Confined stretch s: P = ¾-consistent stable neo-Hookean law in closed form (Smith et al. 2018, eq. 14).
#[test]
fn confined_and_free_stretch_follow_the_closed_form() {
    let (young, poisson) = (0.01, 0.4);
    let (lambda_, mu) = (
        young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson)),
        young / (2.0 * (1.0 + poisson)),
    );
    let (neo_lambda, neo_mu) = (lambda_ + 5.0 / 6.0 * mu, 4.0 / 3.0 * mu);
    let alpha = 1.0 + 0.75 * neo_mu / neo_lambda;
    // Stress along stretch a with stretches b across, both ways.
    let stress = |a: f64, b: f64| {
        let size = a * a + 2.0 * b * b;
        neo_mu * (1.0 - 1.0 / (size + 1.0)) * a + neo_lambda * (a * b * b - alpha) * b * b
    };
    let across = |a: f64, b: f64| {
        let size = a * a + 2.0 * b * b;
        neo_mu * (1.0 - 1.0 / (size + 1.0)) * b + neo_lambda * (a * b * b - alpha) * a * b
    };
    let shape = BoxShape::cube(2);
    let mesh = shape.mesh();
    let tissue = isotropic(young, poisson);
    for s in [0.6, 1.5] {
        let mut b = 1.0_f64;
        for _ in 0..100 {
            let slope = (across(s, b + 1e-7) - across(s, b - 1e-7)) / 2e-7;
            b -= across(s, b) / slope;
        }
        assert!(across(s, b).abs() < 1e-14);
        for element in ELEMENTS {
            let tensors = of_element(&mesh, &tissue, element);
            for (name, wide) in [("confined", 1.0), ("free", b)] {
                // With the hull moved as the closed form says, all that is left to find is the force.
                let h = Matrix3::from_diagonal(&Vec3::new(s - 1.0, wide - 1.0, wide - 1.0));
                let hull = shape.hull();
                let field = affine(mesh.nodes(), h, Vec3::zeros());
                let bounds = boundary(vec![], vec![joined("hull", hull.clone())]);
                let motion = plan([("hull", Motion::Nodes(at(&field, &hull)))]);
                let options = with_kinematics(Kinematics::NEO_HOOKEAN);
                let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
                let places = tensors.element_nodes().positions();
                let total = |axis: usize| -> f64 {
                    let far = shape.size[axis];
                    let on = |x: &[f64; 3]| (x[axis] - far).abs() < 1e-9;
                    let rows = places.iter().zip(&found.forces).filter(|(x, _)| on(x));
                    rows.map(|(_, f)| f[axis]).sum::<f64>() / 4.0
                };
                let expected = [stress(s, wide), across(s, wide)];
                for (axis, expected) in expected.into_iter().enumerate() {
                    let off = (total(axis) - expected).abs() / young;
                    assert!(off < 1e-10, "{element:?} {name} {s} axis {axis}: {off}");
                }
            }
        }
    }
}

/// A block on a moved plane, pressed by loads: contact and Newton together, forces in balance.
#[test]
fn sliding_blocks_rest_on_the_moved_plane_with_forces_in_balance() {
    let shape = BoxShape { cells: [4, 3, 2], size: [4.0, 3.0, 2.0], jitter: 0.1 };
    let mesh = shape.mesh();
    let tissue = isotropic(0.01, 0.45);
    let floor = surface(plane(3, 12.0, 0.0));
    let bounds = boundary(
        shape.side(2, true),
        vec![sliding("floor", shape.side(2, false), &floor, Gap::Uniform(0.0))],
    );
    let tilt = rigid([1.0, 0.3, 0.0], 12.0, [2.0, 1.5, 0.0], [0.0, 0.0, 0.15]);
    let motion = plan([("floor", Motion::Rigid(tilt))]);
    for element in ELEMENTS {
        let tensors = of_element(&mesh, &tissue, element);
        for kinematics in ALL {
            for mode in [ContactMode::Bilateral, ContactMode::Unilateral] {
                let contact = ContactOptions { mode, ..meshes::near_exact() };
                let options = StaticOptions { contact, ..with_kinematics(kinematics) };
                let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
                let name = format!("{element:?} {kinematics:?} {mode:?}");
                assert!(found.contact_gap() < 1e-8, "{name}: gap {}", found.contact_gap());
                assert!(found.residual < 1e-7, "{name}: residual {}", found.residual);
                let total = found.forces.iter().fold(Vec3::zeros(), |s, f| s + Vec3::from(*f));
                assert!(total.norm() < 1e-9 * largest(&found.forces), "{name}: {total}");
                let pushes = found.contact.forces.iter().filter(|f| **f > 0.0).count();
                assert!(pushes > 0, "{name}");
                if mode == ContactMode::Unilateral {
                    assert!(found.contact.forces.iter().all(|&f| f >= 0.0), "{name}");
                    assert!(found.contact.gaps.iter().all(|&g| g > -1e-8), "{name}");
                    assert!(found.contact.active.iter().any(|a| !a), "{name}: none lifted off");
                }
            }
        }
    }
}

/// Nodes that slide over a moved dome: factor and conjugate gradients come to one rest, with forces along the
/// normals; a solution that was stopped early lies on the dome all the same.
#[test]
fn large_deformation_over_a_dome_settles_alike_by_every_method() {
    let shape = BoxShape { cells: [5, 4, 2], size: [5.0, 4.0, 2.0], jitter: 0.1 };
    let mesh = shape.mesh();
    let tissue = layered(&mesh);
    let (mut vertices, triangles) = plane(24, 12.0, 0.0);
    for v in &mut vertices {
        v[2] = -(v[0] * v[0] + v[1] * v[1]) / 40.0;
    }
    let dome = surface((vertices, triangles));
    let bounds = boundary(
        shape.side(2, true),
        vec![sliding("dome", shape.side(2, false), &dome, Gap::Rest)],
    );
    let tilt = rigid([1.0, 0.3, 0.0], 8.0, [2.5, 2.0, 0.0], [0.3, 0.0, 0.3]);
    let motion = plan([("dome", Motion::Rigid(tilt))]);
    for element in ELEMENTS {
        let tensors = of_element(&mesh, &tissue, element);
        for kinematics in LARGE {
            let run = |method, tolerance| {
                let options = StaticOptions { tolerance, kinematics, ..with_method(method) };
                let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
                assert!(found.contact_gap() < 1e-6, "gap {}", found.contact_gap());
                found
            };
            let name = format!("{element:?} {kinematics:?}");
            let by_factor = run(Method::Cholesky, 1e-8);
            assert!(by_factor.residual < 1e-7, "{name}: residual {}", by_factor.residual);
            let moved = largest(&by_factor.displacements);
            let by_cg = run(Method::Pcg, 1e-8);
            let apart = largest_difference(&by_factor.displacements, &by_cg.displacements);
            assert!(apart < 1e-6 * moved, "{name}: {apart} of {moved}");
            let early = run(Method::Pcg, 0.1);
            let apart = largest_difference(&by_factor.displacements, &early.displacements);
            assert!(apart < 0.1 * moved, "{name}: stopped early {apart} of {moved}");
            assert!(apart <= early.error_estimate, "{name}: {apart} over {}", early.error_estimate);
            assert!(early.iterations < by_cg.iterations, "{name}: stopped no earlier");
        }
    }
}

#[test]
fn bits_do_not_depend_on_threads() {
    let shape = BoxShape::cube(3);
    let mesh = shape.mesh();
    let tissue = layered(&mesh);
    let bounds = boundary(shape.side(0, false), vec![joined("bone", shape.side(0, true))]);
    let motion = plan([(
        "bone",
        Motion::Rigid(rigid([0.0, 1.0, 0.2], 15.0, [3.0, 2.0, 2.0], [0.5, 0.0, 0.3])),
    )]);
    for element in ELEMENTS {
        for kinematics in ALL {
            let run = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                pool.install(|| {
                    let tensors = of_element(&mesh, &tissue, element);
                    let options = with_kinematics(kinematics);
                    let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
                    (bits(&found.displacements), bits(&found.forces))
                })
            };
            assert_eq!(run(1), run(3), "{element:?} {kinematics:?}");
        }
    }
}

#[test]
fn conjugate_gradients_agree_with_the_factor() {
    let shape = BoxShape::cube(3);
    let mesh = shape.mesh();
    let tissue = isotropic(0.01, 0.45);
    let bounds = boundary(shape.side(0, false), vec![joined("bone", shape.side(0, true))]);
    let motion = plan([(
        "bone",
        Motion::Rigid(rigid([0.0, 1.0, 0.2], 20.0, [3.0, 2.0, 2.0], [0.5, 0.0, 0.3])),
    )]);
    for element in ELEMENTS {
        let tensors = of_element(&mesh, &tissue, element);
        for kinematics in ALL {
            let by = |method| {
                let options = StaticOptions { method, ..with_kinematics(kinematics) };
                solve(&tensors, &bounds, options, &motion, None).unwrap().displacements
            };
            let off = largest_difference(&by(Method::Cholesky), &by(Method::Pcg));
            assert!(off < 1e-6, "{element:?} {kinematics:?}: {off}");
        }
    }
}

/// Squeezed by a third and turned by a right angle at once: the first guess inverts tets.
#[test]
fn newton_recovers_from_inverted_tets() {
    let shape = BoxShape::cube(3);
    let mesh = shape.mesh();
    let bounds = boundary(shape.side(2, false), vec![joined("bone", shape.side(2, true))]);
    let motion = plan([(
        "bone",
        Motion::Rigid(rigid([0.0, 0.0, 1.0], 90.0, [1.5, 1.5, 0.0], [0.0, 0.0, -1.0])),
    )]);
    for element in ELEMENTS {
        let tensors = of_element(&mesh, &isotropic(0.01, 0.45), element);
        for kinematics in LARGE {
            let found =
                solve(&tensors, &bounds, with_kinematics(kinematics), &motion, None).unwrap();
            assert!(found.residual < 1e-8, "{element:?} {kinematics:?}: {}", found.residual);
        }
    }
}
