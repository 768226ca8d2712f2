//! The energy by which tissue resists being squeezed flat.

use mtm_core::Lame;
use mtm_core::internals::barrier::{BEGIN, CONTINUED, add_response, add_tangent, barrier};
use mtm_core::internals::{PointResponse, PointTangent, Tangent};
use nalgebra::Matrix3;

#[test]
fn it_begins_without_a_jump_of_its_second_derivative() {
    assert!(barrier(BEGIN).is_none());
    let b = barrier(BEGIN - 1e-6).expect("below");
    assert!(b.value < 1e-17 && b.slope.abs() < 1e-10 && b.curvature < 1e-4);
}

#[test]
fn slope_and_curvature_are_derivatives_across_its_continuation() {
    let h = 1e-6;
    for j in [0.29, 0.1, 0.06, CONTINUED, 0.01, -0.5] {
        let [behind, here, ahead] =
            [j - h, j, j + h].map(|j| barrier(j).expect("below the beginning"));
        let slope = (ahead.value - behind.value) / (2.0 * h);
        assert!((slope / here.slope - 1.0).abs() < 1e-5, "{j}: {slope} {}", here.slope);
        let curvature = (ahead.slope - behind.slope) / (2.0 * h);
        let off = (curvature / here.curvature - 1.0).abs();
        assert!(off < 1e-3, "{j}: {curvature} {}", here.curvature);
    }
}

/// Uniaxial squeezing, F = diag(s, 1, 1), to J = s = 0.1: κ b' = −5 · 0.2 · 2 (3 + 2) = −10.
#[test]
fn stress_and_stiffness_at_a_tenth_of_the_volume_are_the_closed_form() {
    let lame = Lame { lambda_: 3.0, mu: 1.0 };
    let f = Matrix3::from_diagonal(&nalgebra::Vector3::new(0.1, 1.0, 1.0));
    let mut out = PointResponse { energy: 0.0, stress: Matrix3::zeros() };
    add_response(lame, &f, &mut out);
    // κ = 5; b = 0.2² · 2 = 0.08; ∂J/∂F = diag(1, 0.1, 0.1); b'' = 4 (3 + 10) = 52.
    assert!((out.energy - 0.4).abs() < 1e-14, "{}", out.energy);
    let exact = Matrix3::from_diagonal(&nalgebra::Vector3::new(-10.0, -1.0, -1.0));
    assert!((out.stress - exact).amax() < 1e-13, "{}", out.stress);
    let mut tangent = PointTangent { own: Tangent::zeros(), cofactor_stress: 0.0 };
    add_tangent(lame, &f, &mut tangent);
    assert!((tangent.own[(0, 0)] - 260.0).abs() < 1e-11, "{}", tangent.own[(0, 0)]);
    assert!((tangent.cofactor_stress + 10.0).abs() < 1e-13, "{}", tangent.cofactor_stress);
}
