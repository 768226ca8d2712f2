//! Uniform stretch of a bar along, across and oblique to its fibre, by its engineering compliance.

use std::sync::Arc;

use crate::meshes::{
    self, BoxShape, Vec3, affine, along_fibre, boundary, isotropic, joined, largest,
    largest_difference, plan, rigid, solve, tensors, with_method,
};
use mtm_core::{FibreElastic, Method, Motion, TetMesh, Tissue};
use nalgebra::Matrix3;

const MODULI: FibreElastic = FibreElastic { young_along: 0.5, young_across: 0.79, poisson: 0.43 };
/// Traction on the ends, MPa.
const TRACTION: f64 = 0.02;

fn bar() -> BoxShape {
    BoxShape { cells: [8, 3, 3], size: [20.0, 6.0, 6.0], jitter: 0.15 }
}

/// Strain of the transversely isotropic law under stress σ e⊗e, with the compliance written out: in axes with
/// the fibre first, ε = S σ.
fn strain(m: FibreElastic, fibre: Vec3, e: Vec3, stress: f64) -> Matrix3<f64> {
    let FibreElastic { young_along: el, young_across: et, poisson: nu } = m;
    let nu_lt = if el >= et { nu } else { nu * el / et };
    let shear = 1.0 / el + 1.0 / et + 2.0 * nu_lt / el;
    let side = if fibre.x.abs() < 0.9 { Vec3::x() } else { Vec3::y() };
    let b = fibre.cross(&side).normalize();
    let q = Matrix3::from_columns(&[fibre, b, fibre.cross(&b)]);
    let s = q.transpose() * (e * e.transpose() * stress) * q;
    let across = s[(1, 1)] + s[(2, 2)];
    let axial = |i: usize| s[(i, i)] / et - nu / et * (across - s[(i, i)]) - nu_lt / el * s[(0, 0)];
    let local = Matrix3::new(
        s[(0, 0)] / el - nu_lt / el * across,
        0.5 * shear * s[(0, 1)],
        0.5 * shear * s[(0, 2)],
        0.5 * shear * s[(0, 1)],
        axial(1),
        (1.0 + nu) / et * s[(1, 2)],
        0.5 * shear * s[(0, 2)],
        (1.0 + nu) / et * s[(1, 2)],
        axial(2),
    );
    q * local * q.transpose()
}

/// Loads of the traction σ n on every boundary triangle, a third at each corner (exact for constant σ).
fn tractions(mesh: &TetMesh, sigma: Matrix3<f64>) -> Vec<[f64; 3]> {
    let mut loads = vec![[0.0; 3]; mesh.n_nodes()];
    for &triangle in mesh.boundary_triangles() {
        let [a, b, c] = triangle.map(|v| Vec3::from(mesh.nodes()[v as usize]));
        let force = sigma * (b - a).cross(&(c - a)) / 6.0;
        for v in triangle {
            let row = &mut loads[v as usize];
            *row = (Vec3::from(*row) + force).into();
        }
    }
    loads
}

/// Pulls the bar with σ e_x⊗e_x, held at the corners of one tet where the exact solution puts them.
fn assert_stretch(name: &str, tissue: &Arc<Tissue>, strain: Matrix3<f64>) {
    let shape = bar();
    let mesh = shape.mesh();
    let e = Vec3::x();
    let exact = affine(mesh.nodes(), strain, Vec3::zeros());
    let corner = mesh.tets()[0].to_vec();
    let bounds = boundary(vec![], vec![joined("corner", corner.clone())]);
    let motion = plan([("corner", Motion::Nodes(meshes::at(&exact, &corner)))]);
    let loads = tractions(&mesh, e * e.transpose() * TRACTION);
    let tensors = tensors(&mesh, tissue);
    let options = with_method(Method::Cholesky);
    let found = solve(&tensors, &bounds, options, &motion, Some(&loads)).unwrap();
    // Rounding grows with the ratio of the largest to the smallest stiffness of the material.
    let stiffest = tissue.stiffness()[0].iter().flatten().fold(0.0_f64, |m, c| m.max(c.abs()));
    let tolerance = 1e-12 * stiffest / tissue.smallest_eigenvalues()[0];
    let error = largest_difference(&found.displacements, &exact);
    assert!(error <= tolerance * largest(&exact), "{name}: {error:e} of {:e} mm", largest(&exact));
    for row in tensors.stress(&found.displacements).unwrap() {
        assert!((row[0] - TRACTION).abs() <= 10.0 * tolerance * TRACTION, "{name}: {row:?}");
        let rest = row[1..].iter().fold(0.0_f64, |m, s| m.max(s.abs()));
        assert!(rest <= 10.0 * tolerance * TRACTION, "{name}: {row:?}");
    }
}

/// ε_xx = σ/E, ε_yy = ε_zz = −ν σ/E (Hooke).
#[test]
fn isotropic_bar_stretches_by_stress_over_young() {
    for poisson in [0.0, 0.3, 0.46, 0.499] {
        let e = TRACTION / 0.01;
        let exact = Matrix3::from_diagonal(&Vec3::new(e, -poisson * e, -poisson * e));
        assert_stretch(&format!("ν {poisson}"), &isotropic(0.01, poisson), exact);
    }
}

/// Pulled along the fibre: ε_xx = σ/E_l, ε_yy = ε_zz = −ν_lt σ/E_l.
#[test]
fn bar_along_the_fibre_stretches_by_stress_over_young_along() {
    let nu_lt = MODULI.poisson * MODULI.young_along / MODULI.young_across;
    let e = TRACTION / MODULI.young_along;
    let exact = Matrix3::from_diagonal(&Vec3::new(e, -nu_lt * e, -nu_lt * e));
    assert_stretch("along", &along_fibre(MODULI, [1.0, 0.0, 0.0]), exact);
    assert!((strain(MODULI, Vec3::x(), Vec3::x(), TRACTION) - exact).amax() <= 1e-12 * e);
}

/// Pulled across the fibre (along y): ε_xx = σ/E_t, ε_yy = −ν_lt σ/E_l, ε_zz = −ν_tt σ/E_t.
#[test]
fn bar_across_the_fibre_stretches_by_stress_over_young_across() {
    let nu = MODULI.poisson;
    let e = TRACTION / MODULI.young_across;
    // ν_lt/E_l = ν/E_t, since the stiffer direction is across.
    let exact = Matrix3::from_diagonal(&Vec3::new(e, -nu * e, -nu * e));
    assert_stretch("across", &along_fibre(MODULI, [0.0, 1.0, 0.0]), exact);
}

/// Pulled at an angle θ to the fibre: with the Saint-Venant shear rule the modulus follows
/// 1/E_θ = cos²θ/E_l + sin²θ/E_t, here at 45°, with the shear that goes with it.
#[test]
fn bar_at_45_degrees_stretches_by_the_mean_compliance() {
    let fibre = Vec3::new(1.0, 1.0, 0.0).normalize();
    let exact = strain(MODULI, fibre, Vec3::x(), TRACTION);
    let mean = 0.5 * (1.0 / MODULI.young_along + 1.0 / MODULI.young_across);
    assert!((exact[(0, 0)] - TRACTION * mean).abs() <= 1e-12 * TRACTION * mean, "{exact}");
    assert!(exact[(0, 1)].abs() > 0.1 * exact[(0, 0)].abs(), "shear couples: {exact}");
    assert_stretch("45°", &along_fibre(MODULI, fibre.into()), exact);
}

/// The same at any angle and modulus ratio, from a fibre a thousand times softer to one as much stiffer.
#[test]
fn bar_at_any_angle_stretches_by_the_rotated_compliance() {
    for (el, et) in [(0.5, 0.79), (0.79, 0.5), (1.0, 1e-3), (1e-3, 1.0)] {
        for fibre in [Vec3::new(0.8, 0.1, -0.5), Vec3::new(-0.1, 0.3, 1.0)] {
            let m = FibreElastic { young_along: el, young_across: et, poisson: 0.45 };
            let fibre = fibre.normalize();
            let exact = strain(m, fibre, Vec3::x(), TRACTION);
            assert_stretch(&format!("{el}/{et}"), &along_fibre(m, fibre.into()), exact);
        }
    }
}

/// Turning bar, fibre and load together turns the answer: u'(Q x) = Q u(x).
#[test]
fn stretch_does_not_depend_on_the_axes() {
    let turn = rigid([0.3, -1.0, 0.6], 37.0, [0.0; 3], [0.0; 3]);
    let q = Matrix3::from_fn(|i, j| turn.matrix()[i][j]);
    let fibre = Vec3::new(1.0, 1.0, 0.0).normalize();
    let shape = bar();
    let (nodes, tets) = shape.tets();
    let mut answers = Vec::new();
    for turned in [false, true] {
        let r = if turned { q } else { Matrix3::identity() };
        let nodes: Vec<[f64; 3]> = nodes.iter().map(|&x| (r * Vec3::from(x)).into()).collect();
        let mesh = meshes::checked((nodes, tets.clone()));
        let e = r * Vec3::x();
        let loads = tractions(&mesh, e * e.transpose() * TRACTION);
        let bounds = boundary(shape.side(0, false), vec![]);
        let tensors = tensors(&mesh, &along_fibre(MODULI, (r * fibre).into()));
        let options = with_method(Method::Cholesky);
        let found = solve(&tensors, &bounds, options, &plan([]), Some(&loads)).unwrap();
        answers.push(
            found
                .displacements
                .iter()
                .map(|&u| (r.transpose() * Vec3::from(u)).into())
                .collect::<Vec<[f64; 3]>>(),
        );
    }
    let error = largest_difference(&answers[0], &answers[1]);
    assert!(error <= 1e-12 * largest(&answers[0]), "{error:e} mm");
}
