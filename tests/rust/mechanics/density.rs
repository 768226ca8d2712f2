//! The energy density at a point: derivatives, stiffness at rest, definite tangents, rotations.

use mtm_core::internals::{Density, volumetric, without_negative};
use mtm_core::{Elastic, FibreElastic, FibreLaw, Kinematics, Spencer, TetMaterial};
use nalgebra::{Matrix3, SVector};

/// Rows and columns of strain components in Voigt order.
const PAIRS: [(usize, usize); 6] = [(0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)];

/// Entries row by row.
fn flat(m: &Matrix3<f64>) -> SVector<f64, 9> {
    SVector::from_fn(|i, _| m[(i / 3, i % 3)])
}

/// Deformation gradients: at rest, sheared, rotated by a right angle, compressed, inverted.
fn gradients() -> Vec<Matrix3<f64>> {
    let shear = Matrix3::new(1.2, 0.3, -0.1, 0.05, 0.9, 0.2, 0.1, -0.2, 1.1);
    let turn = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let squeeze = Matrix3::from_diagonal(&nalgebra::Vector3::new(1.4, 0.5, 0.8));
    let invert = Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.3, -0.3));
    let small = Matrix3::identity() + 1e-3 * (shear - Matrix3::identity());
    vec![Matrix3::identity(), small, shear, turn * shear, squeeze * shear, invert * shear]
}

fn materials() -> Vec<TetMaterial<'static>> {
    let moduli = FibreElastic { young_along: 2.0, young_across: 0.7, poisson: 0.43 };
    let c = Spencer::from_moduli(moduli, FibreLaw::Spencer);
    let a = nalgebra::Vector3::new(0.6, -0.3, 0.7).normalize();
    vec![
        TetMaterial::Isotropic(Elastic { young: 1.3, poisson: 0.45 }.into()),
        TetMaterial::Spencer(c, a.into()),
    ]
}

#[test]
fn stress_and_tangent_are_the_derivatives_of_energy() {
    // Central differences of step h: error near h² and rounding near 1e-16/h.
    const STEP: f64 = 1e-5;
    const TOLERANCE: f64 = 1e-8;
    for kinematics in Kinematics::all().skip(1) {
        for material in materials() {
            let density = Density::new(&material, kinematics);
            for f in gradients() {
                for pressure in [0.0, 0.7] {
                    let total = |f: &Matrix3<f64>| {
                        density.response(f, kinematics, 0.0).energy
                            + pressure * volumetric(f, kinematics).value
                    };
                    let stress = density.response(&f, kinematics, pressure).stress;
                    let tangent = density.tangent(&f, kinematics, pressure);
                    // Inverted tissue is up to 1e4 times as stiff.
                    let allowed = TOLERANCE * tangent.amax().max(1.0);
                    for entry in 0..9 {
                        let mut step = Matrix3::zeros();
                        step[(entry / 3, entry % 3)] = STEP;
                        let slope = (total(&(f + step)) - total(&(f - step))) / (2.0 * STEP);
                        let off = slope - stress[(entry / 3, entry % 3)];
                        assert!(off.abs() < allowed, "{kinematics:?} {f} stress {off}");
                        let ahead = density.response(&(f + step), kinematics, pressure).stress;
                        let behind = density.response(&(f - step), kinematics, pressure).stress;
                        let column = flat(&((ahead - behind) / (2.0 * STEP)));
                        let off = (column - tangent.column(entry)).amax();
                        assert!(off < allowed, "{kinematics:?} {f} tangent {off}");
                    }
                }
            }
        }
    }
}

#[test]
fn the_tangent_at_rest_is_the_stiffness() {
    for kinematics in Kinematics::all().skip(1) {
        for material in materials() {
            let density = Density::new(&material, kinematics);
            let rest = density.response(&Matrix3::identity(), kinematics, 0.0);
            assert!(rest.energy.abs() < 1e-15 && rest.stress.amax() < 1e-15);
            let tangent = density.tangent(&Matrix3::identity(), kinematics, 0.0);
            let c = material.voigt();
            for (row, (i, j)) in PAIRS.into_iter().enumerate() {
                for (col, (k, l)) in PAIRS.into_iter().enumerate() {
                    let off = tangent[(3 * i + j, 3 * k + l)] - c[row][col];
                    assert!(off.abs() < 1e-14, "{kinematics:?} {row} {col}: {off}");
                }
            }
        }
    }
}

#[test]
fn the_definite_tangent_has_no_negative_curvature_and_differs_only_where_there_was_some() {
    for kinematics in Kinematics::all().skip(1) {
        for material in materials() {
            let density = Density::new(&material, kinematics);
            let is_isotropic = matches!(material, TetMaterial::Isotropic(_));
            let mut altered = 0;
            for f in gradients() {
                for pressure in [0.0, -0.7] {
                    let exact = density.tangent(&f, kinematics, pressure);
                    let kept = density.definite(&f, kinematics, pressure);
                    let least = kept.symmetric_eigenvalues().min();
                    assert!(least > -1e-13 * kept.amax(), "{kinematics:?} {f} {least}");
                    if is_isotropic {
                        // The eigenvalues of the whole tangent, not of its blocks.
                        let off = (kept - without_negative(&exact, kinematics)).amax();
                        assert!(off < 1e-9 * exact.amax(), "{kinematics:?} {f} {off}");
                    }
                    let change = (kept - exact).amax() / exact.amax();
                    if exact.symmetric_eigenvalues().min() > 0.0 {
                        assert!(change < 1e-9, "{kinematics:?} {f} {change}");
                    }
                    altered += usize::from(change > 1e-3);
                }
            }
            assert!(altered >= 4, "{kinematics:?}: only {altered} tangents were indefinite");
        }
    }
}

#[test]
fn energy_does_not_change_and_stress_turns_with_a_rotation() {
    let turn = *nalgebra::Rotation3::from_euler_angles(1.1, -2.0, 0.4).matrix();
    for kinematics in Kinematics::all().skip(1) {
        for material in materials() {
            let density = Density::new(&material, kinematics);
            for f in gradients() {
                let here = density.response(&f, kinematics, 0.3);
                let there = density.response(&(turn * f), kinematics, 0.3);
                assert!((here.energy - there.energy).abs() < 1e-13 * here.energy.max(1.0));
                let allowed = 1e-13 * here.stress.amax().max(1.0);
                assert!((turn * here.stress - there.stress).amax() < allowed);
                // Balance of moments: P Fᵀ is symmetric.
                let moment = here.stress * f.transpose();
                assert!((moment - moment.transpose()).amax() < allowed);
            }
        }
    }
}
