//! Contact that may lift off, and contact that must be refused or give its best answer.

use std::sync::Arc;

use super::sliding::{
    METHODS, POISSON, assert_signorini, block, floor, shell, tangential_share, twist, unilateral,
};
use crate::meshes::{
    self, ShellShape, Vec3, boundary, isotropic, joined, largest_difference, near_exact, plan,
    plane, rigid, sliding, solve, solver, sphere, stays, surface, tensors, with_method,
};
use mtm_core::{
    ContactOptions, ErrorKind, Gap, MassTensors, Method, Motion, MtmError, RigidMotion, Solution,
    StaticOptions, Surface, TetMesh,
};

/// Largest distance of the sliding nodes from `moved`, mm.
fn off_surface(mesh: &TetMesh, nodes: &[u32], found: &Solution, moved: &Surface) -> f64 {
    let ends: Vec<[f64; 3]> = nodes
        .iter()
        .map(|&j| {
            let j = j as usize;
            (Vec3::from(mesh.nodes()[j]) + Vec3::from(found.displacements[j])).into()
        })
        .collect();
    moved.closest(&ends).iter().map(|c| c.distance).fold(0.0, f64::max)
}

#[test]
fn unilateral_contact_neither_penetrates_nor_pulls() {
    let turn = RigidMotion::identity();
    let (mesh, base, lid) = block(&turn);
    let slide = sliding("floor", base, &floor(&turn, 7, 0.2), Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("lid", lid), slide]);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    // The lid tips: one edge is pressed, the other lifted.
    let tip = rigid([0.0, 1.0, 0.0], 8.0, [2.5, 2.5, 4.0], [0.0, 0.0, 0.0]);
    let motion = plan([("lid", Motion::Rigid(tip)), ("floor", stays())]);
    let mut answers = Vec::new();
    for method in METHODS {
        let found = solve(&tensors, &bounds, unilateral(method), &motion, None).unwrap();
        let (held, free) = assert_signorini(&format!("{method:?}"), &found);
        assert!(held > 5 && free > 5, "{method:?}: {held} held, {free} free");
        assert!(tangential_share(&found) <= 1e-6);
        answers.push(found.displacements);
    }
    for other in &answers[1..] {
        let e = largest_difference(&answers[0], other);
        assert!(e <= 1e-6, "{e:e} mm");
    }
    // Held on both sides the same tip pulls: the modes do differ.
    let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None).unwrap();
    assert!(found.contact.forces.iter().any(|&f| f < 0.0));
}

/// A ball that moves within its shell: pressed on one side, lifted on the other.
#[test]
fn unilateral_contact_on_a_sphere_lifts_off_behind_the_ball() {
    let (mesh, bounds, _) = shell(2);
    let tensors = tensors(&mesh, &isotropic(0.01, 0.4));
    let push = rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.0, 0.0, 0.5]);
    let motion = plan([("skin", stays()), ("ball", Motion::Rigid(push))]);
    for method in [Method::Cholesky, Method::Pcg] {
        let found = solve(&tensors, &bounds, unilateral(method), &motion, None).unwrap();
        assert_signorini(&format!("{method:?}"), &found);
        for (i, &node) in found.contact.nodes.iter().enumerate() {
            let z = mesh.nodes()[node as usize][2];
            let held = found.contact.active[i];
            assert!(held == (z > 0.0) || z.abs() < 6.0, "{method:?}: node at z {z}: {held}");
        }
    }
}

/// A lid that rises by t takes the block along: no contact force, u = t.
#[test]
fn unilateral_block_lifts_off_whole() {
    let turn = RigidMotion::identity();
    let (mesh, base, lid) = block(&turn);
    let slide = sliding("floor", base, &floor(&turn, 7, 0.2), Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("lid", lid), slide]);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let rise = rigid([0.0, 1.0, 0.0], 0.0, [0.0; 3], [0.1, 0.0, 0.7]);
    let motion = plan([("lid", Motion::Rigid(rise)), ("floor", stays())]);
    for method in METHODS {
        let found = solve(&tensors, &bounds, unilateral(method), &motion, None).unwrap();
        let e = largest_difference(&found.displacements, &vec![[0.1, 0.0, 0.7]; mesh.n_nodes()]);
        assert!(e <= 1e-7, "{method:?}: {e:e} mm");
        assert!(found.contact.forces.iter().all(|&f| f == 0.0) && found.contact_gap() == 0.0);
        assert!(found.contact.gaps.iter().all(|g| (g - 0.7).abs() <= 1e-7));
    }
}

/// A node that ends past the border of an open surface has no partner there: an error says which, where
/// and by how much.
#[test]
fn node_past_the_border_is_refused() {
    let turn = RigidMotion::identity();
    let (mesh, base, lid) = block(&turn);
    let small = surface({
        let (vertices, triangles) = plane(6, 3.0, 0.0);
        (vertices.iter().map(|v| [v[0] + 2.0, v[1] + 2.0, 0.0]).collect(), triangles)
    });
    // The floor reaches from −1 to 5 on both axes, as far as the block: it fits at rest …
    let slide = sliding("floor", base, &small, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("lid", lid), slide]);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let options = with_method(Method::Cholesky);
    solve(&tensors, &bounds, options, &plan([("lid", stays()), ("floor", stays())]), None).unwrap();
    // … and no longer when the floor withdraws by 3 mm.
    let away = rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [-3.0, 0.0, 0.0]);
    let motion = plan([("lid", stays()), ("floor", Motion::Rigid(away))]);
    let error = solve(&tensors, &bounds, options, &motion, None).unwrap_err();
    let MtmError::ContactSurface { segment, problem } = &error else { panic!("{error}") };
    assert_eq!(segment, "floor");
    assert!(problem.contains("node ") && problem.contains("past its border"), "{problem}");
    assert_eq!(error.kind(), ErrorKind::Contact);
}

fn inside_out((vertices, triangles): meshes::Triangles) -> Arc<Surface> {
    surface((vertices, triangles.into_iter().map(|[a, b, c]| [a, c, b]).collect()))
}

/// Normals point out of the bone; a surface turned inside out would pull where it should push.
#[test]
fn inverted_contact_surface_is_refused() {
    let shape = ShellShape { levels: 1, layers: 2, inner: 10.0, outer: 16.0 };
    let tensors_ = tensors(&shape.mesh(), &isotropic(0.01, POISSON));
    let ball = inside_out(sphere(1, 10.0));
    let slide = sliding("ball", shape.layer(0), &ball, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("skin", shape.layer(2)), slide]);
    let error = solver(&tensors_, &bounds, with_method(Method::Cholesky)).err().unwrap();
    assert!(matches!(&error, MtmError::ContactSurface { segment, .. } if segment == "ball"));
    assert!(error.to_string().contains("42 of 42"), "{error}");

    // An open sheet has no inside: its side matters only where nodes may lift off.
    let turn = RigidMotion::identity();
    let (mesh, base, lid) = block(&turn);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let sheet = inside_out(plane(4, 12.0, 0.0));
    let slide = sliding("floor", base, &sheet, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("lid", lid), slide]);
    let error = solver(&tensors, &bounds, unilateral(Method::Cholesky)).err().unwrap();
    assert!(matches!(&error, MtmError::ContactSurface { segment, .. } if segment == "floor"));
    assert!(solver(&tensors, &bounds, with_method(Method::Cholesky)).is_ok());
}

/// A coarse ball under thin layers of tissue: the tets round a sliding node lie mostly beside it and
/// below, and still the surface faces the tissue.
#[test]
fn coarse_convex_contact_surface_faces_the_tissue() {
    let shape = ShellShape { levels: 0, layers: 8, inner: 10.0, outer: 16.0 };
    let ball = surface(sphere(0, 10.0));
    let slide = sliding("ball", shape.layer(0), &ball, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("skin", shape.layer(8)), slide]);
    let tensors = tensors(&shape.mesh(), &isotropic(0.01, POISSON));
    assert!(solver(&tensors, &bounds, unilateral(Method::Cholesky)).is_ok());
}

/// Too few iterations for a surface that keeps turning under its nodes: an error, not a half answer.
#[test]
fn contact_that_does_not_settle_is_an_error_with_its_nodes() {
    let (mesh, bounds, _) = shell(2);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let contact = ContactOptions { max_iterations: 1, ..near_exact() };
    for method in METHODS {
        let options = StaticOptions { contact, ..with_method(method) };
        let error = solve(&tensors, &bounds, options, &twist(), None).unwrap_err();
        let MtmError::ContactNotConverged { iterations, nodes, gap, .. } = &error else {
            panic!("{error}")
        };
        assert_eq!(*iterations, 1);
        assert!(!nodes.is_empty() && nodes.len() <= 10 && *gap > 0.0, "{error}");
        assert!(nodes.iter().all(|&j| j < 162), "sliding nodes are the first 162: {nodes:?}");
        assert!(!error.is_input());
    }
}

/// Newton steps that run out within what a face shows give a result that is exact throughout the body, with its
/// gap, whether or not its steps were solved roughly until then; further away, an error with both figures.
#[test]
fn steps_that_run_out_near_a_solution_give_a_result() {
    let (mesh, bounds, _) = shell(2);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let limit = 1e-4 * mesh.diagonal();
    for method in [Method::Cholesky, Method::Pcg] {
        let exact = solve(&tensors, &bounds, with_method(method), &twist(), None).unwrap();
        let mut results = 0;
        for max_iterations in 1..exact.contact_iterations {
            let contact = ContactOptions { max_iterations, ..near_exact() };
            let options = StaticOptions { contact, ..with_method(method) };
            match solve(&tensors, &bounds, options, &twist(), None) {
                Ok(found) => {
                    results += 1;
                    assert!(!found.contact.converged);
                    assert!(found.contact_gap().max(found.contact.unbalanced) <= limit);
                    let e = largest_difference(&found.displacements, &exact.displacements);
                    assert!(e <= 10.0 * limit, "{method:?}, {max_iterations}: {e:e} mm");
                }
                Err(MtmError::ContactNotConverged { gap, unbalanced, .. }) => {
                    assert!(gap.max(unbalanced) > limit, "{method:?}: {gap:e}, {unbalanced:e}");
                }
                Err(error) => panic!("{error}"),
            }
        }
        assert!(results > 0, "{method:?}");
    }
}

/// Spikes as tall as they are wide under a body pushed across them: whatever comes out is settled or an
/// error, never a state between.
#[test]
fn spiky_contact_surface_settles_or_is_refused() {
    let turn = RigidMotion::identity();
    let (mesh, base, lid) = block(&turn);
    let (vertices, triangles) = plane(24, 12.0, 0.0);
    let spikes: Vec<[f64; 3]> = vertices
        .iter()
        .enumerate()
        .map(|(i, v)| [v[0], v[1], if i % 2 == 0 { 0.0 } else { -1.0 }])
        .collect();
    let spiky = surface((spikes, triangles));
    let slide = sliding("floor", base.clone(), &spiky, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("lid", lid), slide]);
    let tensors: Arc<MassTensors> = tensors(&mesh, &isotropic(0.01, POISSON));
    let shift = rigid([0.0, 0.0, 1.0], 3.0, [2.0, 2.0, 0.0], [0.7, 0.3, -0.4]);
    let motion = plan([("lid", Motion::Rigid(shift)), ("floor", stays())]);
    for options in [with_method(Method::Cholesky), unilateral(Method::Cholesky)] {
        match solve(&tensors, &bounds, options, &motion, None) {
            Ok(found) => {
                let held = found.contact.nodes.iter().zip(&found.contact.active);
                let held: Vec<u32> = held.filter(|(_, a)| **a).map(|(&j, _)| j).collect();
                let off = off_surface(&mesh, &held, &found, &spiky);
                assert!(
                    off <= 0.5,
                    "{off:e} mm off spikes of 1 mm, which are finer than the tissue"
                );
                assert!(found.contact.converged && tangential_share(&found) <= 1e-5);
            }
            Err(error) => assert!(matches!(error, MtmError::ContactNotConverged { .. }), "{error}"),
        }
    }
}
