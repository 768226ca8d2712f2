//! Sliding contact against exact answers, its invariants, and the errors it must give.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, GO_ON, ShellShape, Vec3, affine, along_fibre, at, boundary, carried, isotropic,
    joined, largest_difference, near_exact, plan, plane, rigid, sliding, solve, solver, sphere,
    stays, surface, tensors, with_method,
};
use mtm_core::{
    Boundary, ContactMode, ContactOptions, FibreElastic, Gap, Method, Motion, Plan, RigidMotion,
    Solution, StaticOptions, Surface, SurfaceMotion, TetMesh,
};
use nalgebra::Matrix3;

pub(super) const METHODS: [Method; 3] = [Method::Cholesky, Method::Pcg, Method::Relaxation];

pub(super) const POISSON: f64 = 0.45;

pub(super) fn unilateral(method: Method) -> StaticOptions {
    let contact = ContactOptions { mode: ContactMode::Unilateral, ..near_exact() };
    StaticOptions { method, contact, ..StaticOptions::default() }
}

/// Largest share of a sliding node's internal force that lies in the tangent plane of its surface.
pub(super) fn tangential_share(found: &Solution) -> f64 {
    let c = &found.contact;
    let largest = c.forces.iter().fold(0.0_f64, |m, f| m.max(f.abs()));
    c.nodes
        .iter()
        .zip(&c.normals)
        .map(|(&node, &n)| {
            let (f, n) = (Vec3::from(found.forces[node as usize]), Vec3::from(n));
            (f - n * n.dot(&f)).norm() / largest
        })
        .fold(0.0, f64::max)
}

/// A block on a floor, all turned by `turn`: the mesh, the floor's nodes and the lid's.
pub(super) fn block(turn: &RigidMotion) -> (Arc<TetMesh>, Vec<u32>, Vec<u32>) {
    let shape = BoxShape { cells: [5, 5, 4], size: [5.0, 5.0, 4.0], jitter: 0.15 };
    let (nodes, tets) = shape.tets();
    let mesh = meshes::checked((carried(turn, &nodes), tets));
    (mesh, shape.side(2, false), shape.side(2, true))
}

pub(super) fn floor(turn: &RigidMotion, n: usize, skew: f64) -> Arc<Surface> {
    let (vertices, triangles) = plane(n, 12.0, skew);
    surface((carried(turn, &vertices), triangles))
}

/// Uniaxial compression by `strain` above a floor that rises by `rise`, in the block's own axes:
/// u = (−ν ε x, −ν ε y, rise + ε z), carried by `turn`.
fn compression(mesh: &TetMesh, turn: &RigidMotion, strain: f64, rise: f64) -> Vec<[f64; 3]> {
    let q = Matrix3::from_fn(|i, j| turn.matrix()[i][j]);
    let side = -POISSON * strain;
    let h = q * Matrix3::from_diagonal(&Vec3::new(side, side, strain)) * q.transpose();
    let origin = h * Vec3::from(turn.apply([0.0; 3]));
    affine(mesh.nodes(), h, q * Vec3::new(0.0, 0.0, rise) - origin)
}

/// A block whose lid is pressed down slides sideways on its floor: u is affine, the pressure E ε.
fn assert_compression(turn: &RigidMotion, floor: &Arc<Surface>, options: StaticOptions) {
    let (mesh, base, lid) = block(turn);
    let exact = compression(&mesh, turn, -0.05, 0.2);
    // The floor rises, and also shifts and turns in its own plane, which nobody feels.
    let local = rigid([0.0, 0.0, 1.0], 9.0, [2.0, 2.0, 0.0], [0.4, -0.3, 0.2]);
    let q = Matrix3::from_fn(|i, j| turn.matrix()[i][j]);
    let l = Matrix3::from_fn(|i, j| local.matrix()[i][j]);
    let r = q * l * q.transpose();
    let start = Vec3::from(turn.apply([0.0; 3]));
    let shift = q * Vec3::from(local.apply([0.0; 3])) + start - r * start;
    let mut matrix = *RigidMotion::identity().matrix();
    for i in 0..3 {
        for j in 0..3 {
            matrix[i][j] = r[(i, j)];
        }
        matrix[i][3] = shift[i];
    }
    let motion = plan([
        ("lid", Motion::Nodes(at(&exact, &lid))),
        ("floor", Motion::Rigid(RigidMotion::new("floor", &matrix).unwrap())),
    ]);
    let slide = sliding("floor", base, floor, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("lid", lid), slide]);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
    let e = largest_difference(&found.displacements, &exact);
    assert!(e <= 2e-8, "{options:?}: {e:e} mm");
    let force: f64 = found.contact.forces.iter().sum();
    assert!((force - 0.01 * 0.05 * 25.0).abs() <= 1e-8 * force, "{options:?}: {force:e} N");
    assert!(found.contact_gap() <= 1e-9 && tangential_share(&found) <= 1e-6);
}

/// Hooke: σ_zz = E ε, u_x = −ν ε x where nothing holds the sides and the floor is smooth.
#[test]
fn block_on_a_plane_spreads_freely() {
    let turn = RigidMotion::identity();
    for method in METHODS {
        assert_compression(&turn, &floor(&turn, 4, 0.0), with_method(method));
        assert_compression(&turn, &floor(&turn, 4, 0.0), unilateral(method));
    }
}

/// The same scene in axes that are not those of the plane.
#[test]
fn block_on_an_inclined_plane_spreads_freely() {
    for (axis, degrees) in [([1.0, 0.0, 0.0], 30.0), ([0.3, -1.0, 0.6], 73.0)] {
        let turn = rigid(axis, degrees, [1.0, -2.0, 3.0], [4.0, 0.5, -7.0]);
        for method in METHODS {
            assert_compression(&turn, &floor(&turn, 4, 0.0), with_method(method));
        }
    }
}

/// One plane cut into 2, 32, 98 or 450 triangles, regular or crooked: the answer is the same, also
/// where it is not affine.
#[test]
fn triangulation_of_a_flat_floor_does_not_matter() {
    let turn = rigid([0.3, -1.0, 0.6], 20.0, [0.0; 3], [0.0; 3]);
    let (mesh, base, lid) = block(&turn);
    let moduli = FibreElastic { young_along: 0.5, young_across: 0.79, poisson: 0.43 };
    let tensors = tensors(&mesh, &along_fibre(moduli, [0.6, 0.0, 0.8]));
    let press = rigid([0.2, 1.0, 0.4], 6.0, [2.0, 2.0, 4.0], [0.5, 0.1, -0.3]);
    let tilt = rigid([1.0, 0.2, 0.1], 5.0, [2.0, 2.0, 0.0], [0.0, 0.0, 0.1]);
    let motion = plan([("lid", Motion::Rigid(press)), ("floor", Motion::Rigid(tilt))]);
    let mut answers: Vec<Solution> = Vec::new();
    for (n, skew) in [(1, 0.0), (4, 0.0), (7, 0.3), (15, 0.3)] {
        let slide = sliding("floor", base.clone(), &floor(&turn, n, skew), Gap::Uniform(0.0));
        let bounds = boundary(vec![], vec![joined("lid", lid.clone()), slide]);
        answers
            .push(solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None).unwrap());
    }
    for other in &answers[1..] {
        let e = largest_difference(&answers[0].displacements, &other.displacements);
        assert!(e <= 1e-9, "{e:e} mm");
    }
}

/// A shell on a swelling sphere, outer surface moved alike: u = a x, with the isotropic stress
/// p = 3 K a = E a / (1 − 2ν). Facets are felt as curved by their corners' normals: what is left is the
/// facets' size to the fourth power.
#[test]
fn shell_on_a_swelling_sphere_dilates_uniformly() {
    for (levels, near) in [(2, 1e-2), (3, 3e-3)] {
        let shape = ShellShape { levels, layers: 3, inner: 10.0, outer: 16.0 };
        let mesh = shape.mesh();
        let rest = surface(sphere(levels, 10.0));
        let dilation = 0.03;
        let exact: Vec<[f64; 3]> = mesh.nodes().iter().map(|x| x.map(|v| dilation * v)).collect();
        let swollen = rest.vertices().iter().map(|x| x.map(|v| (1.0 + dilation) * v)).collect();
        let swell = Arc::new(SurfaceMotion::new((*rest).clone(), swollen).unwrap());
        let (inner, outer) = (shape.layer(0), shape.layer(3));
        let motion =
            plan([("skin", Motion::Nodes(at(&exact, &outer))), ("ball", Motion::Surface(swell))]);
        let ball = sliding("ball", inner, &rest, Gap::Uniform(0.0));
        let bounds = boundary(vec![], vec![joined("skin", outer), ball]);
        let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
        for method in METHODS {
            let found = solve(&tensors, &bounds, with_method(method), &motion, None).unwrap();
            let e = largest_difference(&found.displacements, &exact);
            assert!(e <= near, "level {levels}, {method:?}: {e:e} mm");
            // Radial components of the polyhedron's forces: Σ f_i·x_i = ∫ p n·x = 3 p V.
            let virial: f64 = found
                .contact
                .nodes
                .iter()
                .zip(found.contact.normals.iter().zip(&found.contact.forces))
                .map(|(&j, (n, f))| f * Vec3::from(*n).dot(&Vec3::from(mesh.nodes()[j as usize])))
                .sum();
            // Stretched, not pressed: the ball pulls the tissue inward.
            let stress = 0.01 * dilation / (1.0 - 2.0 * POISSON);
            let expected = -3.0 * stress * rest.volume().unwrap();
            assert!(
                (virial - expected).abs() <= 10.0 * near * expected.abs(),
                "{virial} {expected}"
            );
        }
    }
}

/// A ball that rises by one millimetre with its tissue's skin: everything rises with it.
#[test]
fn shell_that_moves_with_its_sphere_is_not_strained() {
    let (mesh, bounds, _) = shell(2);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let shift = rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], [1.0, -0.5, 0.25]);
    let motion = plan([("skin", Motion::Rigid(shift)), ("ball", Motion::Rigid(shift))]);
    for method in METHODS {
        let found = solve(&tensors, &bounds, with_method(method), &motion, None).unwrap();
        let exact = vec![[1.0, -0.5, 0.25]; mesh.n_nodes()];
        let e = largest_difference(&found.displacements, &exact);
        assert!(e <= 1e-8, "{method:?}: {e:e} mm");
    }
}

/// A spherical shell whose skin is joined and whose inner nodes slide on a finer ball.
pub(super) fn shell(levels: usize) -> (Arc<TetMesh>, Arc<Boundary>, Arc<Surface>) {
    let shape = ShellShape { levels, layers: 3, inner: 10.0, outer: 16.0 };
    let ball = surface(sphere(levels + 1, 10.0));
    let slide = sliding("ball", shape.layer(0), &ball, Gap::Rest);
    (shape.mesh(), boundary(vec![], vec![joined("skin", shape.layer(3)), slide]), ball)
}

/// Twist and push of the shell: no closed form, the invariants alone.
pub(super) fn twist() -> Plan {
    plan([
        ("skin", Motion::Rigid(rigid([0.2, 0.1, 1.0], 5.0, [0.0; 3], [0.6, 0.0, 0.3]))),
        ("ball", Motion::Rigid(rigid([1.0, 0.0, 0.0], 3.0, [0.0; 3], [-0.2, 0.1, 0.0]))),
    ])
}

/// Kim et al. (2010), section 2.5: sliding nodes end on the moved surface, at the gap they had, and feel
/// no force along it (eq. 2).
#[test]
fn sliding_nodes_end_on_the_moved_surface_without_traction() {
    let shape = ShellShape { levels: 2, layers: 3, inner: 10.0, outer: 16.0 };
    let mesh = shape.mesh();
    let ball = surface(sphere(2, 10.0));
    let slide = sliding("ball", shape.layer(0), &ball, Gap::Uniform(0.0));
    let bounds = boundary(vec![], vec![joined("skin", shape.layer(3)), slide]);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let motion = twist();
    let Motion::Rigid(turned) = &motion[1].1 else { panic!() };
    let centre = Vec3::from(turned.apply([0.0; 3]));
    for method in METHODS {
        let found = solve(&tensors, &bounds, with_method(method), &motion, None).unwrap();
        // Off the sphere itself: its facets lie up to 0.08 mm within.
        let radius = |j: u32| {
            let end =
                Vec3::from(mesh.nodes()[j as usize]) + Vec3::from(found.displacements[j as usize]);
            ((end - centre).norm() - 10.0).abs()
        };
        let off = shape.layer(0).into_iter().map(radius).fold(0.0, f64::max);
        assert!(off <= 0.02, "{method:?}: {off:e} mm off the sphere");
        let share = tangential_share(&found);
        assert!(share <= 1e-6, "{method:?}: tangential share {share:e}");
        assert!(found.residual <= 1e-6, "{method:?}: residual {:e}", found.residual);
    }
}

/// Dense flexibility (Cholesky), refactored system and conjugate gradients give one answer. A tet apart
/// from the shell that only the ball's constraint holds closes the dense way.
#[test]
fn dense_refactored_and_iterative_contact_agree() {
    let shape = ShellShape { levels: 2, layers: 3, inner: 10.0, outer: 16.0 };
    let (mut nodes, mut tets) = shape.tets();
    let first = nodes.len() as u32;
    // Two joined nodes leave one turn about their line; the node at the ball's top stops it.
    nodes.extend([[-1.0, 1.0, 30.0], [1.0, 1.0, 30.0], [0.0, 3.0, 31.0], [0.0, 0.0, 28.0]]);
    tets.push(meshes::oriented(&nodes, [first, first + 1, first + 2, first + 3]));
    let with_island = meshes::checked((nodes, tets));
    let alone = shape.mesh();
    let ball = surface(sphere(3, 10.0));
    let table = surface({
        let (vertices, triangles) = plane(2, 9.0, 0.0);
        (vertices.iter().map(|v| [v[0], v[1], 28.0]).collect(), triangles)
    });
    let mut answers = Vec::new();
    for (mesh, island, method) in [
        (&alone, false, Method::Cholesky),
        (&with_island, true, Method::Cholesky),
        (&alone, false, Method::Pcg),
        (&alone, false, Method::Relaxation),
    ] {
        let mut segments =
            vec![joined("skin", shape.layer(3)), sliding("ball", shape.layer(0), &ball, Gap::Rest)];
        let mut motion = twist();
        if island {
            segments.push(joined("rod", vec![first, first + 1]));
            segments.push(sliding("table", vec![first + 3], &table, Gap::Uniform(0.0)));
            motion.extend(plan([("rod", stays()), ("table", stays())]));
        }
        let tensors = tensors(mesh, &isotropic(0.01, POISSON));
        let bounds = boundary(vec![], segments);
        let solver = solver(&tensors, &bounds, with_method(method)).unwrap();
        let dense = solver.timings().iter().any(|&(stage, s)| stage == "contact_factor" && s > 0.0);
        assert_eq!(dense, method == Method::Cholesky && !island, "{method:?}");
        let found = solver.solve(&motion, None, GO_ON).unwrap();
        answers.push((method, found.displacements[..first as usize].to_vec()));
    }
    for (method, other) in &answers[1..] {
        let e = largest_difference(&answers[0].1, other);
        let allowed = if *method == Method::Cholesky { 1e-9 } else { 1e-6 };
        assert!(e <= allowed, "{method:?}: {e:e} mm");
    }
}

/// Contact by the kept flexibility of hundreds of sliding nodes, as conjugate gradients on the whole body find it,
/// and for any number of threads alike.
#[test]
fn contact_of_many_nodes_agrees_with_conjugate_gradients() {
    let shape = ShellShape { levels: 3, layers: 2, inner: 10.0, outer: 16.0 };
    let mesh = shape.mesh();
    let ball = surface(sphere(4, 10.0));
    let slide = sliding("ball", shape.layer(0), &ball, Gap::Rest);
    let bounds = boundary(vec![], vec![joined("skin", shape.layer(2)), slide]);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let by_factor = solver(&tensors, &bounds, with_method(Method::Cholesky)).unwrap();
    assert!(by_factor.timings().iter().any(|&(stage, s)| stage == "contact_factor" && s > 0.0));
    let found = by_factor.solve(&twist(), None, GO_ON).unwrap();
    assert!(found.contact.nodes.len() > 600);
    assert!(found.contact_gap() <= 1e-6 && found.residual <= 1e-9, "{:e}", found.residual);
    let other = solve(&tensors, &bounds, with_method(Method::Pcg), &twist(), None).unwrap();
    let e = largest_difference(&found.displacements, &other.displacements);
    assert!(e <= 1e-6, "{e:e} mm");
    let operator = by_factor.plan_operator(None, Some(&twist()), GO_ON).unwrap();
    let e = largest_difference(&operator.apply(&twist()).unwrap(), &found.displacements);
    assert!(e <= 1e-6, "{e:e} mm");
    let alone = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let again = alone.install(|| {
        solve(&tensors, &bounds, with_method(Method::Cholesky), &twist(), None).unwrap()
    });
    assert!(meshes::bits(&found.displacements) == meshes::bits(&again.displacements));
    let lifted = solve(&tensors, &bounds, unilateral(Method::Cholesky), &twist(), None).unwrap();
    assert_signorini("by the factor", &lifted);
}

/// A surface moved vertex by vertex as a rigid body is a rigid motion.
#[test]
fn surface_motion_of_a_rigid_move_equals_the_rigid_motion() {
    let (mesh, bounds, ball) = shell(2);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let motion = twist();
    let Motion::Rigid(turned) = &motion[1].1 else { panic!() };
    let moved = carried(turned, ball.vertices());
    let follow = SurfaceMotion::new((*ball).clone(), moved).unwrap();
    let mut other = motion.clone();
    other[1].1 = Motion::Surface(Arc::new(follow));
    let options = with_method(Method::Cholesky);
    let a = solve(&tensors, &bounds, options, &motion, None).unwrap();
    let b = solve(&tensors, &bounds, options, &other, None).unwrap();
    let e = largest_difference(&a.displacements, &b.displacements);
    // The lattices of the two fields lie differently on the surface.
    assert!(e <= 5e-3, "{e:e} mm");
}

/// |x + u − c| = g: a floor g below the nodes at rest changes nothing; a wish for another gap lifts them.
#[test]
fn prescribed_gap_is_kept() {
    let turn = RigidMotion::identity();
    let (mesh, base, lid) = block(&turn);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let below = {
        let (vertices, triangles) = plane(6, 12.0, 0.2);
        surface((vertices.iter().map(|v| [v[0], v[1], -0.3]).collect(), triangles))
    };
    let exact = compression(&mesh, &turn, -0.02, 0.1);
    let press = Motion::Nodes(at(&exact, &lid));
    let n = base.len();
    let mut rising = vec![0.4; n];
    rising.rotate_left(1);
    for (floor, gap) in [
        (&floor(&turn, 6, 0.2), Gap::Uniform(0.1)),
        (&below, Gap::Uniform(0.4)),
        (&below, Gap::PerNode(rising)),
    ] {
        let slide = sliding("floor", base.clone(), floor, gap.clone());
        let bounds = boundary(vec![], vec![joined("lid", lid.clone()), slide]);
        let motion = plan([("lid", press.clone()), ("floor", stays())]);
        let options = with_method(Method::Cholesky);
        let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
        let e = largest_difference(&found.displacements, &exact);
        assert!(e <= 1e-9, "{gap:?}: {e:e} mm");
    }
    let slide = sliding("floor", base.clone(), &below, Gap::Rest);
    let bounds = boundary(vec![], vec![joined("lid", lid.clone()), slide]);
    let motion = plan([("lid", stays()), ("floor", stays())]);
    let options = with_method(Method::Cholesky);
    let found = solve(&tensors, &bounds, options, &motion, None).unwrap();
    assert!(meshes::largest(&found.displacements) <= 1e-14, "at rest nothing moves");
}

/// Signorini's conditions (1933): g ≥ 0, f ≥ 0, f g = 0 at every node.
pub(super) fn assert_signorini(name: &str, found: &Solution) -> (usize, usize) {
    let c = &found.contact;
    let largest = c.forces.iter().fold(0.0_f64, |m, f| m.max(f.abs()));
    for i in 0..c.nodes.len() {
        assert!(c.forces[i] >= 0.0, "{name}: node {} pulled by {:e} N", c.nodes[i], c.forces[i]);
        assert!(c.gaps[i] >= -1e-6, "{name}: node {} penetrates {:e} mm", c.nodes[i], c.gaps[i]);
        let apart = c.gaps[i] > 1e-6 && c.forces[i] > 1e-12 * largest;
        assert!(!apart, "{name}: {:e} N over {:e} mm", c.forces[i], c.gaps[i]);
    }
    let held = c.active.iter().filter(|a| **a).count();
    (held, c.nodes.len() - held)
}

/// A node exactly on its surface at rest is off it by rounding after a turn, in no direction that means
/// anything: once it ended in a division by its distance, zero. Any turn of the ball leaves finite answers.
#[test]
fn nodes_exactly_on_their_surface_at_rest_turn_with_it() {
    let shape = ShellShape { levels: 2, layers: 2, inner: 10.0, outer: 16.0 };
    let ball = surface(sphere(2, 10.0));
    let slide = sliding("ball", shape.layer(0), &ball, Gap::Rest);
    let bounds = boundary(vec![], vec![joined("skin", shape.layer(2)), slide]);
    let tensors = tensors(&shape.mesh(), &isotropic(0.01, POISSON));
    let solver = solver(
        &tensors,
        &bounds,
        StaticOptions { method: Method::Cholesky, ..StaticOptions::default() },
    )
    .unwrap();
    for k in 0..24 {
        let t = f64::from(k);
        let turn = rigid(
            [t.sin(), (2.0 * t).cos(), 0.3],
            0.05 * t,
            [0.1 * t, -65.0, -40.0],
            [0.2, 0.1, -0.3],
        );
        let motion = plan([("skin", stays()), ("ball", Motion::Rigid(turn))]);
        let found = solver.solve(&motion, None, GO_ON).unwrap();
        assert!(found.contact.converged && found.residual <= 1e-4, "{k}: {:e}", found.residual);
        assert!(found.displacements.as_flattened().iter().all(|v| v.is_finite()), "{k}");
    }
}

/// About its reference the operator goes on as the solutions do, to first order: over half the way its error is
/// a quarter.
#[test]
fn plan_operator_follows_contact_to_first_order() {
    let (mesh, bounds, _) = shell(2);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let reference = twist();
    let on = |share: f64| {
        let more = rigid(
            [0.3, 1.0, -0.2],
            4.0 * share,
            [1.0, 0.0, 2.0],
            [0.2 * share, 0.5 * share, 0.3 * share],
        );
        let Motion::Rigid(ball) = &twist()[1].1 else { panic!() };
        let both = RigidMotion::new("ball", &product(more.matrix(), ball.matrix())).unwrap();
        plan([("skin", twist()[0].1.clone()), ("ball", Motion::Rigid(both))])
    };
    for method in [Method::Cholesky, Method::Pcg] {
        let solver = solver(&tensors, &bounds, with_method(method)).unwrap();
        let operator = solver.plan_operator(None, Some(&reference), GO_ON).unwrap();
        let error = |share: f64| {
            let exact = solver.solve(&on(share), None, GO_ON).unwrap().displacements;
            largest_difference(&exact, &operator.apply(&on(share)).unwrap())
        };
        let (whole, half) = (error(1.0), error(0.5));
        assert!(error(0.0) <= 1e-5 && whole > 1e-3, "{method:?}: {whole:e}");
        assert!(half <= 0.32 * whole, "{method:?}: {half:e} of {whole:e} mm");
    }
}

fn product(a: &[[f64; 4]; 4], b: &[[f64; 4]; 4]) -> [[f64; 4]; 4] {
    [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| (0..4).map(|k| a[i][k] * b[k][j]).sum()))
}
