//! Order of convergence in L2 on refined meshes: a manufactured solution and Lamé's thick sphere.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, ShellShape, Vec3, along_fibre, at, boundary, isotropic, joined, plan, sliding,
    solve, surface, tensors, with_method,
};
use mtm_core::{FibreElastic, Gap, Method, Motion, SurfaceMotion, TetMesh, Tissue};

/// Weights of a corner and of the others at the four points of the rule that is exact for quadratics
/// (Keast 1986).
const NEAR: f64 = 0.585_410_196_624_968_5;
const FAR: f64 = 0.138_196_601_125_010_5;

/// The four quadrature points of tet `t` with their shape functions.
fn points(mesh: &TetMesh, t: usize) -> [(Vec3, [f64; 4]); 4] {
    let x = mesh.tets()[t].map(|v| Vec3::from(mesh.nodes()[v as usize]));
    [0, 1, 2, 3].map(|near| {
        let mut shape = [FAR; 4];
        shape[near] = NEAR;
        ((0..4).map(|k| x[k] * shape[k]).sum(), shape)
    })
}

/// ‖u_h − u‖ / ‖u‖ in L2.
fn l2_error(mesh: &TetMesh, found: &[[f64; 3]], exact: impl Fn(Vec3) -> Vec3) -> f64 {
    let (mut error, mut size) = (0.0, 0.0);
    for (t, tet) in mesh.tets().iter().enumerate() {
        for (x, shape) in points(mesh, t) {
            let u: Vec3 = (0..4).map(|k| Vec3::from(found[tet[k] as usize]) * shape[k]).sum();
            error += mesh.volumes()[t] * (u - exact(x)).norm_squared();
            size += mesh.volumes()[t] * exact(x).norm_squared();
        }
    }
    (error / size).sqrt()
}

/// ∫ φ_j b dx for a force density b, N/mm³.
fn body_loads(mesh: &TetMesh, b: impl Fn(Vec3) -> Vec3) -> Vec<[f64; 3]> {
    let mut loads = vec![Vec3::zeros(); mesh.n_nodes()];
    for (t, tet) in mesh.tets().iter().enumerate() {
        for (x, shape) in points(mesh, t) {
            let force = b(x) * (0.25 * mesh.volumes()[t]);
            for k in 0..4 {
                loads[tet[k] as usize] += force * shape[k];
            }
        }
    }
    loads.into_iter().map(Into::into).collect()
}

/// Order between successive errors when the spacing halves.
fn orders(errors: &[f64]) -> Vec<f64> {
    errors.windows(2).map(|e| (e[0] / e[1]).log2()).collect()
}

/// Manufactured solution (Roache 2002): u_k = A_k sin(q_k·x + φ_k) with −div C ε(u) as the body force,
/// b_i = Σ_jkl C_ijkl q_kl q_kj u_k, and u itself prescribed on the hull of the unit cube.
fn manufactured_errors(tissue: &Arc<Tissue>) -> Vec<f64> {
    let q = [Vec3::new(2.6, -1.3, 0.7), Vec3::new(0.5, 2.2, 1.4), Vec3::new(-1.1, 0.9, 2.8)];
    let (amplitude, phase) = ([0.01, -0.013, 0.007], [0.3, 1.1, -0.4]);
    let exact =
        |x: Vec3| Vec3::from([0, 1, 2].map(|k| amplitude[k] * (q[k].dot(&x) + phase[k]).sin()));
    let voigt = tissue.stiffness()[0];
    let c = |i: usize, j: usize, k: usize, l: usize| {
        const INDEX: [[usize; 3]; 3] = [[0, 5, 4], [5, 1, 3], [4, 3, 2]];
        voigt[INDEX[i][j]][INDEX[k][l]]
    };
    let force = |x: Vec3| {
        let u = exact(x);
        Vec3::from([0, 1, 2].map(|i| {
            let mut b = 0.0;
            for j in 0..3 {
                for k in 0..3 {
                    for l in 0..3 {
                        b += c(i, j, k, l) * q[k][l] * q[k][j] * u[k];
                    }
                }
            }
            b
        }))
    };
    [4, 8, 16]
        .map(|n| {
            let shape = BoxShape { cells: [n; 3], size: [1.0; 3], jitter: 0.1 };
            let mesh = shape.mesh();
            let hull = shape.hull();
            let u: Vec<[f64; 3]> = mesh.nodes().iter().map(|&x| exact(x.into()).into()).collect();
            let motion = plan([("hull", Motion::Nodes(at(&u, &hull)))]);
            let bounds = boundary(vec![], vec![joined("hull", hull)]);
            let loads = body_loads(&mesh, force);
            let tensors = tensors(&mesh, tissue);
            let options = with_method(Method::Cholesky);
            let found = solve(&tensors, &bounds, options, &motion, Some(&loads)).unwrap();
            l2_error(&mesh, &found.displacements, exact)
        })
        .to_vec()
}

/// Linear tets converge with h² in L2 (Aubin 1967, Nitsche 1968).
#[test]
fn manufactured_solution_converges_with_order_two_in_isotropic_tissue() {
    let errors = manufactured_errors(&isotropic(0.01, 0.3));
    let orders = orders(&errors);
    assert!(orders.iter().all(|&p| p >= 1.9), "errors {errors:?}, orders {orders:?}");
}

/// The same with the fibre oblique to the mesh.
#[test]
fn manufactured_solution_converges_with_order_two_in_muscle() {
    let moduli = FibreElastic { young_along: 0.5, young_across: 0.79, poisson: 0.43 };
    let fibre = Vec3::new(0.4, -0.8, 0.5).normalize().into();
    let errors = manufactured_errors(&along_fibre(moduli, fibre));
    let orders = orders(&errors);
    assert!(orders.iter().all(|&p| p >= 1.9), "errors {errors:?}, orders {orders:?}");
}

const YOUNG: f64 = 0.01;
const POISSON: f64 = 0.4;
const INNER: f64 = 10.0;
const OUTER: f64 = 16.0;
const PRESSURE: f64 = 0.002;

/// Lamé (1852): thick sphere under inner pressure p, outer surface free, with a³p/(b³ − a³) = k:
/// u_r = k/E [(1 − 2ν) r + (1 + ν) b³ / (2 r²)].
fn lame(x: Vec3) -> Vec3 {
    let r = x.norm();
    let (a3, b3) = (INNER.powi(3), OUTER.powi(3));
    let k = a3 * PRESSURE / (b3 - a3);
    let u = k / YOUNG * ((1.0 - 2.0 * POISSON) * r + (1.0 + POISSON) * b3 / (2.0 * r * r));
    x * (u / r)
}

fn shells() -> [ShellShape; 3] {
    [(1, 2), (2, 4), (3, 8)].map(|(levels, layers)| ShellShape {
        levels,
        layers,
        inner: INNER,
        outer: OUTER,
    })
}

/// Thick sphere: the outer surface follows Lamé's displacement, the inner one carries the pressure.
#[test]
fn thick_sphere_under_pressure_converges_with_order_two() {
    let errors = shells().map(|shape| {
        let mesh = shape.mesh();
        let mut loads = vec![Vec3::zeros(); mesh.n_nodes()];
        for &triangle in mesh.boundary_triangles() {
            let [a, b, c] = triangle.map(|v| Vec3::from(mesh.nodes()[v as usize]));
            if (a + b + c).norm() / 3.0 > 0.5 * (INNER + OUTER) {
                continue;
            }
            // The normal out of the tissue points to the centre; pressure pushes the other way.
            let force = -(b - a).cross(&(c - a)) * (PRESSURE / 6.0);
            for v in triangle {
                loads[v as usize] += force;
            }
        }
        let loads: Vec<[f64; 3]> = loads.into_iter().map(Into::into).collect();
        let outer = shape.layer(shape.layers);
        let u: Vec<[f64; 3]> = mesh.nodes().iter().map(|&x| lame(x.into()).into()).collect();
        let motion = plan([("outer", Motion::Nodes(at(&u, &outer)))]);
        let bounds = boundary(vec![], vec![joined("outer", outer)]);
        let tensors = tensors(&mesh, &isotropic(YOUNG, POISSON));
        let options = with_method(Method::Cholesky);
        let found = solve(&tensors, &bounds, options, &motion, Some(&loads)).unwrap();
        l2_error(&mesh, &found.displacements, lame)
    });
    let orders = orders(&errors);
    assert!(orders[1] >= 1.9, "errors {errors:?}, orders {orders:?}");
}

/// Thick sphere, outer surface as before; the inner one slides on a sphere that swells by Lamé's inner
/// displacement: the contact pressure is Lamé's, and u converges with h².
#[test]
fn thick_sphere_sliding_on_a_swelling_sphere_converges_with_order_two() {
    let mut pressures = Vec::new();
    let errors = shells().map(|shape| {
        let mesh = shape.mesh();
        let u: Vec<[f64; 3]> = mesh.nodes().iter().map(|&x| lame(x.into()).into()).collect();
        let (inner, outer) = (shape.layer(0), shape.layer(shape.layers));
        let rest = surface(meshes::sphere(shape.levels, INNER));
        let swollen = rest.vertices().iter().map(|&x| (Vec3::from(x) + lame(x.into())).into());
        let motion = SurfaceMotion::new((*rest).clone(), swollen.collect()).unwrap();
        let motions = plan([
            ("outer", Motion::Nodes(at(&u, &outer))),
            ("ball", Motion::Surface(Arc::new(motion))),
        ]);
        let ball = sliding("ball", inner, &rest, Gap::Uniform(0.0));
        let bounds = boundary(vec![], vec![joined("outer", outer), ball]);
        let tensors = tensors(&mesh, &isotropic(YOUNG, POISSON));
        let options = with_method(Method::Cholesky);
        let found = solve(&tensors, &bounds, options, &motions, None).unwrap();
        let area = rest.area();
        pressures.push(found.contact.forces.iter().sum::<f64>() / area);
        l2_error(&mesh, &found.displacements, lame)
    });
    let orders = orders(&errors);
    assert!(orders[1] >= 1.9, "errors {errors:?}, orders {orders:?}");
    let errors: Vec<f64> = pressures.iter().map(|p| (p / PRESSURE - 1.0).abs()).collect();
    assert!(errors[2] <= 0.025 && errors[2] < errors[1], "pressures {pressures:?}");
}
