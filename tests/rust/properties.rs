//! Invariants of random small scenes, and the fuzz targets on seeded bytes.

#[path = "../../fuzz/bodies.rs"]
mod bodies;

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, GO_ON, Numbers, Vec3, affine, at, boundary, joined, largest,
    largest_difference, plan, rigid, solve, solver, tensors, with_method,
};
use mtm_core::{
    Boundary, Elastic, FibreElastic, FibreLaw, MassTensors, Method, Motion, RigidMotion, Spencer,
    Surface, TetMesh, Tissue,
};
use nalgebra::Matrix3;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// A box of a few cubes with sides of its own.
fn boxes() -> impl Strategy<Value = BoxShape> {
    (1..4_usize, 1..4_usize, 1..4_usize, prop::array::uniform3(0.5..20.0_f64), 0.0..0.19_f64)
        .prop_map(|(i, j, k, size, jitter)| BoxShape { cells: [i, j, k], size, jitter })
}

fn unit() -> impl Strategy<Value = [f64; 3]> {
    any::<u64>().prop_map(|seed| Numbers(seed).unit())
}

fn moduli() -> impl Strategy<Value = FibreElastic> {
    (-3.0..3.0_f64, -1.5..1.5_f64, 0.0..0.499_f64).prop_map(|(size, ratio, poisson)| FibreElastic {
        young_along: 10_f64.powf(size + ratio),
        young_across: 10_f64.powf(size - ratio),
        poisson,
    })
}

fn motions() -> impl Strategy<Value = RigidMotion> {
    (unit(), -180.0..180.0_f64, prop::array::uniform3(-10.0..10.0_f64))
        .prop_map(|(axis, degrees, shift)| rigid(axis, degrees, [1.0, 2.0, -1.0], shift))
}

/// A box whose tets are isotropic or muscle, each with constants of its own.
fn body(shape: BoxShape, m: FibreElastic, seed: u64) -> Arc<MassTensors> {
    let mesh = shape.mesh();
    let mut numbers = Numbers(seed);
    let rows: Vec<FibreElastic> = (0..mesh.n_tets())
        .map(|_| {
            let s = 10_f64.powf(numbers.next());
            let young_across = s * m.young_across;
            FibreElastic { young_along: s * m.young_along, young_across, ..m }
        })
        .collect();
    let fibre: Vec<[f64; 3]> = rows.iter().map(|_| numbers.unit()).collect();
    let tissue = Tissue::transversely_isotropic(&rows, &fibre, FibreLaw::Spencer).unwrap();
    tensors(&mesh, &Arc::new(tissue))
}

fn ends(shape: &BoxShape) -> Arc<Boundary> {
    boundary(shape.side(0, false), vec![joined("jaw", shape.side(0, true))])
}

/// The same cases on every run; `PROPTEST_RNG_SEED` chooses others.
fn config(cases: u32) -> ProptestConfig {
    let usual = ProptestConfig::default();
    let rng_seed = match usual.rng_seed {
        RngSeed::Random => RngSeed::Fixed(2010),
        chosen => chosen,
    };
    ProptestConfig { cases, failure_persistence: None, rng_seed, ..usual }
}

proptest! {
    #![proptest_config(config(48))]

    /// C = S⁻¹ with the two rules of the law is positive definite at every ratio, ν below 0.5.
    #[test]
    fn every_muscle_material_is_positive_definite(m in moduli(), a in unit()) {
        let tissue = Tissue::transversely_isotropic(&[m], &[a], FibreLaw::Spencer).unwrap();
        prop_assert!(tissue.smallest_eigenvalues()[0] > 0.0);
        let other = Spencer::from_moduli(m, FibreLaw::Spencer);
        let general = Tissue::from_stiffness(vec![other.voigt(a)]).unwrap();
        let (x, y) = (tissue.smallest_eigenvalues()[0], general.smallest_eigenvalues()[0]);
        let scale = tissue.stiffness()[0][0][0].abs() + tissue.stiffness()[0][1][1].abs();
        prop_assert!((x - y).abs() <= 1e-12 * scale.max(x), "{x:e} and {y:e}");
    }

    /// Equal moduli are isotropic whatever the fibre.
    #[test]
    fn fibre_of_an_isotropic_material_does_not_matter(e in 1e-3..1e3_f64, nu in 0.0..0.499_f64, a in unit()) {
        let m = FibreElastic { young_along: e, young_across: e, poisson: nu };
        let one = Tissue::transversely_isotropic(&[m], &[a], FibreLaw::Spencer).unwrap().stiffness();
        let two = Tissue::isotropic(&[Elastic { young: e, poisson: nu }]).unwrap().stiffness();
        for i in 0..6 {
            for j in 0..6 {
                prop_assert!((one[0][i][j] - two[0][i][j]).abs() <= 1e-12 * two[0][0][0]);
            }
        }
    }

    /// u·K v = v·K u and u·K u ≥ 0.
    #[test]
    fn stiffness_is_symmetric_and_positive(shape in boxes(), m in moduli(), seed in any::<u64>()) {
        let tensors = body(shape, m, seed);
        let mut numbers = Numbers(seed ^ 1);
        let n = tensors.mesh().n_nodes();
        let (u, v) = (numbers.points(n), numbers.points(n));
        let product = |a: &[[f64; 3]], b: &[[f64; 3]]| -> f64 {
            let f = tensors.internal_force(b).unwrap();
            a.iter().zip(&f).map(|(a, f)| Vec3::from(*a).dot(&Vec3::from(*f))).sum()
        };
        let (uv, vu, uu, vv) = (product(&u, &v), product(&v, &u), product(&u, &u), product(&v, &v));
        prop_assert!(uu > 0.0 && vv > 0.0);
        prop_assert!((uv - vu).abs() <= 1e-12 * (uu * vv).sqrt(), "{uv:e} and {vu:e}");
        prop_assert!((2.0 * tensors.energy(&u).unwrap() - uu).abs() <= 1e-11 * uu);
    }

    /// Forces of any field balance: Σ f = 0, Σ x × f = 0.
    #[test]
    fn internal_forces_balance(shape in boxes(), m in moduli(), seed in any::<u64>()) {
        let tensors = body(shape, m, seed);
        let u = Numbers(seed).points(tensors.mesh().n_nodes());
        let f = tensors.internal_force(&u).unwrap();
        let (mut sum, mut moment, mut size) = (Vec3::zeros(), Vec3::zeros(), 0.0);
        for (x, f) in tensors.mesh().nodes().iter().zip(&f) {
            let f = Vec3::from(*f);
            sum += f;
            moment += Vec3::from(*x).cross(&f);
            size += f.norm();
        }
        prop_assert!(sum.norm() <= 1e-12 * size);
        prop_assert!(moment.norm() <= 1e-11 * size * tensors.mesh().diagonal());
    }

    /// Any affine hull motion of a uniform body is followed inside.
    #[test]
    fn patch_test_holds(shape in boxes(), m in moduli(), a in unit(), seed in any::<u64>()) {
        let mesh = shape.mesh();
        let tissue = Tissue::transversely_isotropic(&[m], &[a], FibreLaw::Spencer).unwrap();
        let h = Matrix3::from_fn(|i, j| 0.1 * Numbers(seed ^ (3 * i + j) as u64).next());
        let exact = affine(mesh.nodes(), h, Vec3::new(0.1, -0.4, 0.2));
        let hull = shape.hull();
        let motion = plan([("hull", Motion::Nodes(at(&exact, &hull)))]);
        let bounds = boundary(vec![], vec![joined("hull", hull)]);
        let tensors = tensors(&mesh, &Arc::new(tissue));
        let found = solve(&tensors, &bounds, with_method(Method::Cholesky), &motion, None).unwrap();
        let e = largest_difference(&found.displacements, &exact);
        prop_assert!(e <= 1e-8 * largest(&exact), "{e:e} mm");
    }

    /// The answer is linear in the plan's displacements.
    #[test]
    fn answers_superpose(shape in boxes(), m in moduli(), seed in any::<u64>(), s in -3.0..3.0_f64) {
        let tensors = body(shape, m, seed);
        let bounds = ends(&shape);
        let solver = solver(&tensors, &bounds, with_method(Method::Cholesky)).unwrap();
        let k = bounds.segments()[0].joined.len();
        let mut numbers = Numbers(seed ^ 2);
        let (a, b) = (numbers.points(k), numbers.points(k));
        let sum = a.iter().zip(&b).map(|(a, b)| [0, 1, 2].map(|i| a[i] + s * b[i])).collect();
        let [ua, ub, us] = [a, b, sum].map(|rows| {
            solver.solve(&plan([("jaw", Motion::Nodes(rows))]), None, GO_ON).unwrap().displacements
        });
        let both: Vec<[f64; 3]> =
            ua.iter().zip(&ub).map(|(a, b)| [0, 1, 2].map(|i| a[i] + s * b[i])).collect();
        let e = largest_difference(&us, &both);
        prop_assert!(e <= 1e-9 * largest(&us).max(1.0), "{e:e} mm");
    }

    /// Cholesky and conjugate gradients agree within the bound that the latter reports; the operator
    /// equals the solve for any finite rigid motion.
    #[test]
    fn methods_and_operator_agree(shape in boxes(), m in moduli(), seed in any::<u64>(), motion in motions()) {
        let tensors = body(shape, m, seed);
        let bounds = ends(&shape);
        let motion = plan([("jaw", Motion::Rigid(motion))]);
        let direct = solver(&tensors, &bounds, with_method(Method::Cholesky)).unwrap();
        let a = direct.solve(&motion, None, GO_ON).unwrap();
        let b = solve(&tensors, &bounds, with_method(Method::Pcg), &motion, None).unwrap();
        let e = largest_difference(&a.displacements, &b.displacements);
        let size = largest(&a.displacements);
        prop_assert!(e <= 1e-6 * size.max(1.0), "{e:e} mm of {size:e}");
        let operator = direct.plan_operator(None, None, GO_ON).unwrap();
        let e = largest_difference(&operator.apply(&motion).unwrap(), &a.displacements);
        prop_assert!(e <= 1e-9 * size.max(1.0), "{e:e} mm");
        prop_assert!(a.residual <= 1e-9, "residual {:e}", a.residual);
    }

    /// Lengths in another unit: u scales with them, forces with E L².
    #[test]
    fn answers_scale_with_the_unit_of_length(shape in boxes(), m in moduli(), seed in any::<u64>(), p in -3..4_i32) {
        let one = body(shape, m, seed);
        let scale = 10_f64.powi(p);
        let nodes: Vec<[f64; 3]> =
            one.mesh().nodes().iter().map(|x| x.map(|v| scale * v)).collect();
        let mesh = Arc::new(TetMesh::new(nodes, one.mesh().tets().to_vec()).unwrap());
        let two = Arc::new(MassTensors::new(mesh, one.tissue().clone()).unwrap());
        let bounds = ends(&shape);
        let k = bounds.segments()[0].joined.len();
        let rows = Numbers(seed).points(k);
        let moved = rows.iter().map(|v| v.map(|x| scale * x)).collect();
        let options = with_method(Method::Cholesky);
        let a = solve(&one, &bounds, options, &plan([("jaw", Motion::Nodes(rows))]), None).unwrap();
        let b = solve(&two, &bounds, options, &plan([("jaw", Motion::Nodes(moved))]), None).unwrap();
        let back: Vec<[f64; 3]> = b.displacements.iter().map(|u| u.map(|v| v / scale)).collect();
        let e = largest_difference(&a.displacements, &back);
        prop_assert!(e <= 1e-9 * largest(&a.displacements).max(1.0), "{e:e} mm");
        let back: Vec<[f64; 3]> = b.forces.iter().map(|f| f.map(|v| v / (scale * scale))).collect();
        prop_assert!(largest_difference(&a.forces, &back) <= 1e-9 * largest(&a.forces));
    }

    /// A rigid motion and its inverse undo one another and keep lengths.
    #[test]
    fn rigid_motions_keep_distances(motion in motions(), seed in any::<u64>()) {
        let mut numbers = Numbers(seed);
        let [a, b] = [0, 1].map(|_| numbers.point().map(|x| 100.0 * x));
        let (ma, mb) = (Vec3::from(motion.apply(a)), Vec3::from(motion.apply(b)));
        let before = (Vec3::from(a) - Vec3::from(b)).norm();
        prop_assert!(((ma - mb).norm() - before).abs() <= 1e-12 * before.max(100.0));
        let back = motion.apply_inverse(ma.into());
        prop_assert!((Vec3::from(back) - Vec3::from(a)).norm() <= 1e-11);
    }

    /// The closest point is on its triangle and no vertex is closer.
    #[test]
    fn closest_point_is_closest(levels in 0..3_usize, seed in any::<u64>()) {
        let (vertices, triangles) = meshes::sphere(levels, 5.0);
        let surface = Surface::new(vertices, triangles).unwrap();
        for p in Numbers(seed).points(20) {
            let p = p.map(|x| 9.0 * x);
            let c = surface.closest_one(p);
            let corners = surface.triangles()[c.triangle as usize];
            let mut point = Vec3::zeros();
            for k in 0..3 {
                point += Vec3::from(surface.vertices()[corners[k] as usize]) * c.barycentric[k];
            }
            prop_assert!((point - Vec3::from(c.point)).norm() <= 1e-12);
            prop_assert!((Vec3::from(c.normal).norm() - 1.0).abs() <= 1e-12);
            for v in surface.vertices() {
                let d = (Vec3::from(*v) - Vec3::from(p)).norm();
                prop_assert!(d >= c.distance - 1e-12);
            }
        }
    }
}

/// Runs on seeded bytes, short and long, tame and wild; returns how many inputs were accepted.
fn seeded(run: impl Fn(&[u8]) -> bool, rounds: u64) -> usize {
    (0..rounds)
        .filter(|&seed| {
            let mut numbers = Numbers(seed);
            let length = 8 + (seed as usize * 37) % 400;
            // Most high bytes ask for something broken: half of the inputs stay below them.
            let top = if seed % 2 == 0 { 256.0 } else { 200.0 };
            let bytes: Vec<u8> =
                (0..length).map(|_| (0.5 * (numbers.next() + 1.0) * top) as u8).collect();
            run(&bytes)
        })
        .count()
}

/// The fuzz target `constructors` on seeded inputs, of which a fair share is good.
#[test]
fn no_bytes_make_a_constructor_panic() {
    let accepted = seeded(bodies::constructors, 6000);
    assert!(accepted >= 600, "only {accepted} of 6000 reach the end");
}

/// The fuzz target `plans` on seeded inputs, of which a fair share is solved.
#[test]
fn no_bytes_make_a_solve_panic_or_return_nan() {
    let solved = seeded(bodies::plans, 6000);
    assert!(solved >= 600, "only {solved} of 6000 are solved");
}

/// With every node prescribed there is nothing to solve, and all that is asked for still comes back.
#[test]
fn body_without_unknowns_is_solved_and_replanned() {
    let shape = BoxShape { cells: [1, 1, 1], size: [1.0; 3], jitter: 0.0 };
    let tensors = tensors(&shape.mesh(), &meshes::isotropic(0.01, 0.4));
    let motion = plan([("jaw", Motion::Rigid(rigid([0.0, 0.0, 1.0], 20.0, [0.0; 3], [1.0; 3])))]);
    for method in [Method::Cholesky, Method::Pcg, Method::Relaxation] {
        let solver = solver(&tensors, &ends(&shape), with_method(method)).unwrap();
        let found = solver.solve(&motion, None, GO_ON).unwrap();
        let operator = solver.plan_operator(None, None, GO_ON).unwrap();
        let e = largest_difference(&operator.apply(&motion).unwrap(), &found.displacements);
        assert!(e <= 1e-14, "{method:?}: {e:e} mm");
    }
}
