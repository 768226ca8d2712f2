//! Sliding over grooves, corners, teeth and specks of bone.

use std::sync::Arc;

use super::sliding::{METHODS, POISSON, assert_signorini, block, tangential_share, unilateral};
use crate::meshes::{
    self, BoxShape, GO_ON, Vec3, boundary, isotropic, joined, largest_difference, plan, plane,
    rigid, sliding, solve, solver, stays, surface, tensors, with_method,
};
use mtm_core::{
    Boundary, Gap, MassTensors, Method, Motion, Plan, RigidMotion, Solution, StaticOptions,
    Surface, TetMesh,
};

/// A node amid six joined ones: with cubic symmetry its stiffness is k I, so that it ends at the point
/// of the contact surface that is closest to where it would float. The mesh and k.
fn star(
    centre: Vec3,
    tensors_of: impl Fn(&Arc<TetMesh>) -> Arc<MassTensors>,
) -> (Arc<MassTensors>, f64) {
    let mut nodes: Vec<[f64; 3]> = vec![centre.into()];
    for axis in 0..3 {
        for side in [-1.0, 1.0] {
            let mut x = centre;
            x[axis] += side;
            nodes.push(x.into());
        }
    }
    let mut tets = Vec::new();
    for (x, y, z) in (0..8).map(|i| (1 + (i & 1), 3 + (i >> 1 & 1), 5 + (i >> 2 & 1))) {
        tets.push(meshes::oriented(&nodes, [0, x, y, z]));
    }
    let tensors = tensors_of(&meshes::checked((nodes, tets)));
    let (columns, blocks) = tensors.matrix().row(0);
    let own = blocks[columns.iter().position(|&c| c == 0).unwrap()];
    assert!((own[0] - own[8]).abs() <= 1e-12 * own[0] && own[1].abs() <= 1e-12 * own[0], "{own:?}");
    (tensors, own[0])
}

/// Where the star's node ends, its contact force vector, and the stiffness that holds it.
fn drawn_to(
    goal: Vec3,
    wall: &Arc<Surface>,
    gap: f64,
    options: StaticOptions,
) -> (Vec3, Vec3, f64) {
    let centre = Vec3::new(0.3, 0.1, 1.5);
    let (tensors, k) = star(centre, |mesh| tensors(mesh, &isotropic(0.01, POISSON)));
    let slide = sliding("bone", vec![0], wall, Gap::Uniform(gap));
    let bounds = boundary(vec![], vec![joined("body", (1..7).collect()), slide]);
    let shift = rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], (goal - centre).into());
    let motion = plan([("body", Motion::Rigid(shift)), ("bone", stays())]);
    let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
    let c = &found.contact;
    assert!(found.contact_gap() <= 1e-8, "{:e} mm", found.contact_gap());
    assert!(found.residual <= 1e-6, "{:e}", found.residual);
    let end = centre + Vec3::from(found.displacements[0]);
    (end, Vec3::from(c.normals[0]) * c.forces[0], k)
}

/// Two planes that meet in a valley along y.
fn groove(slope: f64) -> Arc<Surface> {
    let (vertices, triangles) = plane(4, 12.0, 0.0);
    surface((vertices.iter().map(|v| [v[0], v[1], v[0].abs() * slope]).collect(), triangles))
}

/// How far a crease is rounded off, mm: about the lattice spacing, half an edge of the star.
const ROUNDED: f64 = 0.5;

/// A node drawn into a groove rests near its bottom and slides along it: y and the force k (u − t) as if y
/// were free. Drawn onto one wall, away from the crease, it is held by that wall exactly.
#[test]
fn node_in_a_groove_rests_near_its_bottom() {
    let angle = 40.0_f64.to_radians();
    let wall = groove(angle.tan());
    for method in METHODS {
        for options in [with_method(method), unilateral(method)] {
            let goal = Vec3::new(0.1, 0.7, -1.0);
            let (end, force, k) = drawn_to(goal, &wall, 0.0, options);
            assert!(end.x.abs() <= ROUNDED && (end.y - 0.7).abs() <= 1e-7, "{options:?}: {end}");
            assert!((-0.1..=ROUNDED).contains(&end.z), "{options:?}: {end}");
            assert!((force - (end - goal) * k).norm() <= 1e-6 * k, "{options:?}: {force}");

            let goal = Vec3::new(4.0, 0.7, 1.0);
            let n = Vec3::new(-angle.sin(), 0.0, angle.cos());
            let exact = goal - n * n.dot(&goal);
            let (end, force, k) = drawn_to(goal, &wall, 0.0, options);
            assert!((end - exact).norm() <= 1e-7, "{options:?}: {end}");
            assert!((force - (exact - goal) * k).norm() <= 1e-7 * k, "{options:?}: {force}");
        }
        // A node that may lift off is not held where it floats above both walls.
        let goal = Vec3::new(0.1, 0.7, 1.5);
        let (end, force, _) = drawn_to(goal, &wall, 0.0, unilateral(method));
        assert!(force.norm() == 0.0 && (end - goal).norm() <= 1e-7, "{end}");
    }
}

/// Bone far thinner than the tissue resolves, here a ball of a tenth of an edge across: the node slides on the plane
/// through the place where it touches, as far as it is drawn. The field of such bone is a bowl with no direction, and
/// steps on it used to run out.
#[test]
fn node_on_a_speck_of_bone_slides_on_its_tangent_plane() {
    let (speck, triangles) = meshes::sphere(2, 0.05);
    let speck: Vec<[f64; 3]> =
        speck.iter().map(|v| [v[0] + 0.3, v[1] + 0.1, v[2] + 1.45]).collect();
    let speck = surface((speck, triangles));
    let touched = Vec3::new(0.3, 0.1, 1.5);
    for method in METHODS {
        for goal in [Vec3::new(0.9, -0.3, 0.7), Vec3::new(-0.5, 0.6, 2.1)] {
            let (end, force, k) = drawn_to(goal, &speck, 0.0, with_method(method));
            let n = force.normalize();
            assert!(n.z.abs() >= 0.97, "the normal of the ball's top: {n}");
            let exact = goal - n * n.dot(&(goal - touched));
            // The facets lie a little below the ball's top, and the node at its gap of zero on them.
            assert!((end - exact).norm() <= 0.01, "{method:?}: {end} for {exact}");
            assert!((force - (end - goal) * k).norm() <= 1e-6 * k, "{method:?}: {force}");
        }
    }
}

/// Three walls that carry a block about, and nothing else: it is not strained, and its residual is rounding
/// over what the walls' way would cost each node alone, though no force acts in the end.
#[test]
fn block_that_walls_alone_carry_has_a_residual_of_rounding() {
    let shape = BoxShape::cube(3);
    let segments = [0, 1, 2].map(|axis| {
        let (mut vertices, triangles) = plane(4, 6.0, 0.0);
        for v in &mut vertices {
            v.rotate_right((axis + 1) % 3);
        }
        // A node of two walls would be held by both: each edge goes to the first of its walls.
        let own = |p: [usize; 3]| p[axis] == 0 && p[..axis].iter().all(|&i| i > 0);
        let wall = surface((vertices, triangles));
        sliding(["x", "y", "z"][axis], shape.nodes_where(own), &wall, Gap::Uniform(0.0))
    });
    let tensors = tensors(&shape.mesh(), &isotropic(0.01, POISSON));
    let way = rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [0.3, -0.2, 0.5]);
    let motion = plan(["x", "y", "z"].map(|name| (name, Motion::Rigid(way))));
    let bounds = boundary(vec![], segments.to_vec());
    let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None).unwrap();
    let away = vec![[0.3, -0.2, 0.5]; found.displacements.len()];
    assert!(largest_difference(&found.displacements, &away) <= 1e-9);
    assert!(found.contact.forces.iter().all(|f| f.abs() <= 1e-9));
    assert!(found.residual <= 1e-9, "{:e}", found.residual);
}

/// Three walls that meet in a pit: a node drawn into it rests near the corner, whatever the direction.
#[test]
fn node_in_a_corner_rests_near_it() {
    let angle = 45.0_f64.to_radians();
    let mut vertices = vec![[0.0; 3]];
    for k in 0..3 {
        let turn = f64::from(k) * 120.0_f64.to_radians();
        vertices.push([12.0 * turn.cos(), 12.0 * turn.sin(), 6.0 * angle.tan()]);
    }
    let pit = surface((vertices, vec![[0, 1, 2], [0, 2, 3], [0, 3, 1]]));
    for method in METHODS {
        for options in [with_method(method), unilateral(method)] {
            let goal = Vec3::new(0.05, -0.08, -1.0);
            let (end, force, k) = drawn_to(goal, &pit, 0.0, options);
            assert!(end.norm() <= 1.5 * ROUNDED, "{options:?}: {end}");
            assert!((force - (end - goal) * k).norm() <= 1e-6 * k, "{options:?}: {force}");
        }
    }
}

/// A block pressed on a row of sharp teeth and pushed across them, each node at its distance at rest.
fn on_teeth() -> (Arc<TetMesh>, Arc<Boundary>, Arc<Surface>, Plan) {
    let (mesh, base, lid) = block(&RigidMotion::identity());
    let (vertices, triangles) = plane(12, 12.0, 0.0);
    let height = |x: f64| if (x / 2.0).round() as i64 % 2 == 0 { -1.5 } else { 0.0 };
    let teeth: Vec<[f64; 3]> = vertices.iter().map(|v| [v[0], v[1], height(v[0])]).collect();
    let row = surface((teeth, triangles));
    let at_rest: Vec<[f64; 3]> = base.iter().map(|&j| mesh.nodes()[j as usize]).collect();
    let gaps = row.closest(&at_rest).iter().map(|c| c.signed_distance).collect();
    let slide = sliding("teeth", base, &row, Gap::PerNode(gaps));
    let bounds = boundary(vec![], vec![joined("lid", lid), slide]);
    let shift = rigid([0.0, 0.0, 1.0], 2.0, [2.0, 2.0, 0.0], [0.4, 0.2, -0.6]);
    (mesh, bounds, row, plan([("lid", Motion::Rigid(shift)), ("teeth", stays())]))
}

/// Tissue on a row of teeth converges, with nodes in the valleys, and all ways of solving agree.
#[test]
fn tissue_on_a_row_of_teeth_converges_with_nodes_in_the_valleys() {
    let (mesh, bounds, _, motion) = on_teeth();
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let mut answers: Vec<Solution> = Vec::new();
    for method in [Method::Cholesky, Method::Pcg] {
        let found = solve(&tensors, &bounds, with_method(method), &motion, None).unwrap();
        assert!(found.contact_gap() <= 1e-6, "{method:?}: {:e} mm", found.contact_gap());
        assert!(found.residual <= 1e-6 && tangential_share(&found) <= 1e-6);
        answers.push(found);
    }
    let e = largest_difference(&answers[0].displacements, &answers[1].displacements);
    assert!(e <= 1e-6, "{e:e} mm");
    let found = solve(&tensors, &bounds, unilateral(Method::Cholesky), &motion, None).unwrap();
    assert_signorini("teeth", &found);
}

/// The same bits for any number of threads, with nodes in creases.
#[test]
fn creases_do_not_depend_on_the_number_of_threads() {
    let (mesh, bounds, _, motion) = on_teeth();
    let answers: Vec<Vec<u64>> = [1, 2, 3]
        .map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
                let options = with_method(Method::Cholesky);
                let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
                meshes::bits(&found.displacements)
            })
        })
        .into();
    assert!(answers[0] == answers[1] && answers[0] == answers[2]);
}

/// The plan operator keeps the walls of its reference: there it equals the solution.
#[test]
fn plan_operator_equals_the_solution_in_creases() {
    let (mesh, bounds, _, motion) = on_teeth();
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    for method in [Method::Cholesky, Method::Pcg] {
        let solver = solver(&tensors, &bounds, with_method(method)).unwrap();
        let found = solver.solve(&motion, None, GO_ON).unwrap();
        let operator = solver.plan_operator(None, Some(&motion), GO_ON).unwrap();
        let e = largest_difference(&operator.apply(&motion).unwrap(), &found.displacements);
        assert!(e <= 1e-6, "{method:?}: {e:e} mm");
    }
}
