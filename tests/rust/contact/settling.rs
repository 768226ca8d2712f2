//! Settling of sliding contact on steep, sharp and knobbly surfaces: nodes end on the surface by true
//! distance, whatever way they came.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, Triangles, Vec3, boundary, isotropic, joined, largest_difference, plan, plane,
    rigid, sliding, solve, stays, surface, tensors, with_method,
};
use mtm_core::{
    Boundary, ContactMode, ContactOptions, Gap, Method, Motion, Plan, Solution, StaticOptions,
    Surface, TetMesh,
};

const POISSON: f64 = 0.45;
/// Distance from the facets that nodes on their curved surface may have, mm: creases sharper than the tissue's
/// mesh are rounded off.
const OFF_FACETS: f64 = 0.2;
/// The same on flanks that meet in sharp ridges and valleys.
const OFF_RIDGES: f64 = 0.35;
/// Distance from the surface that nodes feel, mm.
const ON_SURFACE: f64 = 1e-6;

fn unilateral() -> StaticOptions {
    let contact = ContactOptions { mode: ContactMode::Unilateral, ..meshes::near_exact() };
    StaticOptions { method: Method::Cholesky, contact, ..StaticOptions::default() }
}

/// A plane of (2 n)² cells, 12 mm to each side, lifted to `height(x, y)`.
fn relief(n: usize, height: impl Fn(f64, f64) -> f64) -> Triangles {
    let (vertices, triangles) = plane(n, 12.0, 0.0);
    (vertices.iter().map(|v| [v[0], v[1], height(v[0], v[1])]).collect(), triangles)
}

/// Four cusps and the pits between them, as on a molar: 1.6 mm high, 4 mm apart.
fn molar(n: usize) -> Arc<Surface> {
    let wave = std::f64::consts::TAU / 4.0;
    surface(relief(n, |x, y| 0.4 * ((wave * x).cos() + (wave * (y + 0.3 * x)).cos()) - 0.8))
}

/// A block above `bone`, its lid joined, its base sliding.
fn block_on(bone: &Arc<Surface>, gap: Gap) -> (Arc<TetMesh>, Vec<u32>, Arc<Boundary>) {
    let shape = BoxShape { cells: [6, 6, 4], size: [6.0, 6.0, 4.0], jitter: 0.15 };
    let mesh = meshes::checked(shape.tets());
    let base = shape.side(2, false);
    let slide = sliding("bone", base.clone(), bone, gap);
    let bounds = boundary(vec![], vec![joined("lid", shape.side(2, true)), slide]);
    (mesh, base, bounds)
}

fn moves() -> Vec<(&'static str, Plan)> {
    let shift = |t: [f64; 3]| Motion::Rigid(rigid([0.0, 0.0, 1.0], 0.0, [0.0; 3], t));
    let turn = |axis: [f64; 3]| Motion::Rigid(rigid(axis, 5.0, [3.0, 3.0, 0.0], [0.0, 0.0, -0.3]));
    [
        ("pressed", stays(), shift([0.0, 0.0, 0.8])),
        ("pulled", stays(), shift([0.0, 0.0, -0.8])),
        ("advanced", stays(), shift([1.5, 0.4, 0.3])),
        ("set back", shift([0.0, 0.0, -0.4]), shift([-1.7, 0.0, 0.0])),
        ("pitched", turn([1.0, 0.0, 0.0]), stays()),
        ("yawed", stays(), turn([0.0, 0.0, 1.0])),
    ]
    .into_iter()
    .map(|(name, lid, bone)| (name, plan([("lid", lid), ("bone", bone)])))
    .collect()
}

/// Where the held nodes end in the frame of the bone at rest.
fn on_bone(mesh: &TetMesh, found: &Solution, motion: &Plan) -> Vec<[f64; 3]> {
    let Motion::Rigid(bone) = &motion.iter().find(|(name, _)| name == "bone").unwrap().1 else {
        panic!()
    };
    let c = &found.contact;
    c.nodes
        .iter()
        .zip(&c.active)
        .filter(|(_, held)| **held)
        .map(|(&j, _)| {
            let end =
                Vec3::from(mesh.nodes()[j as usize]) + Vec3::from(found.displacements[j as usize]);
            bone.apply_inverse(end.into())
        })
        .collect()
}

fn off_surface(bone: &Surface, ends: &[[f64; 3]]) -> f64 {
    bone.closest(ends).iter().map(|c| c.distance).fold(0.0, f64::max)
}

/// Settled means: on the surface, in balance, and with no force but the walls'.
fn assert_settled(
    name: &str,
    mesh: &TetMesh,
    (bone, near): (&Surface, f64),
    found: &Solution,
    motion: &Plan,
) {
    let off = off_surface(bone, &on_bone(mesh, found, motion));
    assert!(off <= near, "{name}: {off:e} mm off the surface");
    assert!(found.contact_gap() <= ON_SURFACE, "{name}: gap {:e} mm", found.contact_gap());
    assert!(found.residual <= 1e-7, "{name}: residual {:e}", found.residual);
}

/// Cusps and pits like a molar's: every move settles, bilateral and unilateral, soon.
#[test]
fn tissue_on_a_molar_settles_whatever_the_move() {
    let bone = molar(30);
    let (mesh, _, bounds) = block_on(&bone, Gap::Uniform(0.0));
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    for (name, motion) in moves() {
        let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None)
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_settled(name, &mesh, (&bone, OFF_FACETS), &found, &motion);
        assert!(found.contact_iterations < 50, "{name}: {}", found.contact_iterations);
        let found = solve(&tensors, &bounds, unilateral(), &motion, None)
            .unwrap_or_else(|e| panic!("{name}, unilateral: {e}"));
        assert_settled(name, &mesh, (&bone, OFF_FACETS), &found, &motion);
        let c = &found.contact;
        assert!(c.forces.iter().all(|&f| f >= 0.0) && c.gaps.iter().all(|&g| g >= -ON_SURFACE));
    }
}

/// Nodes millimetres off a knobbly contact surface slide on it shifted to where they lie: at rest nothing
/// moves, and every move settles. The surface at their distance would fold.
#[test]
fn nodes_far_from_their_surface_slide_on_it_shifted() {
    let bone = molar(30);
    let (mesh, base, bounds) = block_on(&bone, Gap::Rest);
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let at_rest: Vec<[f64; 3]> = base.iter().map(|&j| mesh.nodes()[j as usize]).collect();
    let feet = bone.closest(&at_rest);
    assert!(feet.iter().any(|c| c.distance > 0.7), "some nodes lie above the pits");
    for (name, motion) in moves() {
        let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None)
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        let ends = on_bone(&mesh, &found, &motion);
        let shifted: Vec<[f64; 3]> = ends
            .iter()
            .zip(at_rest.iter().zip(&feet))
            .map(|(&end, (&x, c))| (Vec3::from(end) - (Vec3::from(x) - Vec3::from(c.point))).into())
            .collect();
        let off = off_surface(&bone, &shifted);
        assert!(off <= OFF_FACETS, "{name}: {off:e} mm");
        assert!(found.residual <= 1e-7, "{name}: {:e}", found.residual);
    }
    let still = plan([("lid", stays()), ("bone", stays())]);
    let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &still, None).unwrap();
    assert!(meshes::largest(&found.displacements) <= 1e-14, "at rest nothing moves");
}

/// All ways of solving settle alike: springs and constraints are the same in each.
#[test]
fn methods_settle_on_the_same_answer() {
    let bone = molar(20);
    let (mesh, _, bounds) = block_on(&bone, Gap::Uniform(0.0));
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    let (_, motion) = moves().swap_remove(2);
    let direct = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None).unwrap();
    let pcg = solve(&tensors, &bounds, with_method(Method::Pcg), &motion, None).unwrap();
    let e = largest_difference(&direct.displacements, &pcg.displacements);
    assert!(e <= 1e-5, "{e:e} mm");
}

/// Solved loosely, contact settles as loosely: it is not asked to settle nearer than the solves repeat, and
/// takes no longer than where they are exact.
#[test]
fn contact_settles_as_far_as_the_solves_are() {
    let bone = molar(20);
    let (mesh, _, bounds) = block_on(&bone, Gap::Uniform(0.0));
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    for (name, motion) in moves() {
        let exact = solve(&tensors, &bounds, with_method(Method::Pcg), &motion, None).unwrap();
        let far = meshes::largest(&exact.displacements);
        for tolerance in [1e-2, 1e-4] {
            let options = StaticOptions { tolerance, ..with_method(Method::Pcg) };
            let found = solve(&tensors, &bounds, options, &motion, None)
                .unwrap_or_else(|e| panic!("{name}, {tolerance:e}: {e}"));
            let e = largest_difference(&exact.displacements, &found.displacements);
            assert!(e <= 3.0 * tolerance * far, "{name}: {e:e} mm");
            assert!(found.contact_gap() <= 0.2 * tolerance * far, "{name}");
            assert!(found.contact_iterations <= exact.contact_iterations + 1, "{name}");
        }
    }
}

/// A pit whose walls fall at 55°, between plateaus: nodes pressed in and pushed across end on the walls, at
/// the bottom or on the rims, never on the extension of a wall.
#[test]
fn node_in_a_steep_pit_ends_on_its_surface() {
    let slope = 55.0_f64.to_radians().tan();
    let (vertices, triangles) =
        relief(24, |x, y| ((x - 3.0).abs().max((y - 3.0).abs()) - 2.0).clamp(-1.0, 0.0) * slope);
    let bone = surface((vertices, triangles));
    let (mesh, _, bounds) = block_on(&bone, Gap::Uniform(0.0));
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    for (name, motion) in moves() {
        let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None)
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_settled(name, &mesh, (&bone, OFF_RIDGES), &found, &motion);
    }
}

/// Saw teeth of 50° both ways, with sharp ridges and valleys.
#[test]
fn tissue_on_a_saw_settles_on_its_flanks_ridges_and_valleys() {
    let slope = 50.0_f64.to_radians().tan();
    let teeth = |x: f64| (x.rem_euclid(2.0) - 1.0).abs() * slope - slope;
    let bone = surface(relief(12, |x, _| teeth(x)));
    let (mesh, _, bounds) = block_on(&bone, Gap::Uniform(0.0));
    let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
    for (name, motion) in moves() {
        let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None)
            .unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_settled(name, &mesh, (&bone, OFF_RIDGES), &found, &motion);
    }
}

/// The same bits for any number of threads, springs included.
#[test]
fn settling_does_not_depend_on_the_number_of_threads() {
    let bone = molar(20);
    let (mesh, _, bounds) = block_on(&bone, Gap::Uniform(0.0));
    let (_, motion) = moves().swap_remove(2);
    let answers = [1, 3].map(|threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let tensors = tensors(&mesh, &isotropic(0.01, POISSON));
            let options = with_method(Method::Cholesky);
            meshes::bits(&solve(&tensors, &bounds, options, &motion, None).unwrap().displacements)
        })
    });
    assert!(answers[0] == answers[1]);
}
