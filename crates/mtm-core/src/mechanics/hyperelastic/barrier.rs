//! The energy by which tissue of every law resists being squeezed flat.
//!
//! A law that is finite at J = 0 lets tissue turn inside out between bones. Below J₀ = 0.3, every law therefore has
//! the additional energy
//!
//! κ b = κ (J₀ − J)³/J, κ = λ + 2 μ,
//!
//! which grows without bound as J → 0. Its first two derivatives vanish at J₀, so tissue that keeps more of its
//! volume is not affected. A step of Newton's method may pass through inverted states: below J₁ = 0.02, b is its
//! quadratic expansion about J₁. The pressure is κ b' = 67 (λ + 2 μ) at J₁, where that of stable neo-Hookean tissue
//! is about λ + 2 μ.
//!
//! From rest, Newton's method takes up to half as many steps again under this energy, and does not converge for a
//! block that turns by 170°. It is therefore added only when the equilibrium without it is known.

use nalgebra::Matrix3;

use crate::mechanics::hyperelastic::formulas::{PointResponse, PointTangent, cofactor, flat};
use crate::mechanics::material::Lame;

/// Share of the volume, J₀, below which tissue resists.
const BEGIN: f64 = 0.3;
/// Share of the volume, J₁, below which the energy is a quadratic function of J.
const CONTINUED: f64 = 0.02;
/// κ relative to λ + 2 μ, the stiffness against squeezing without motion across.
const STIFFNESS: f64 = 1.0;

/// b/κ and its derivatives with respect to J.
struct Barrier {
    value: f64,
    slope: f64,
    curvature: f64,
}

/// b and its derivatives at `j`; none where they vanish.
fn barrier(j: f64) -> Option<Barrier> {
    if j >= BEGIN {
        return None;
    }
    // With g = J₀ − J and r = g/J: b = g² r, b' = −g r (3 + r), b'' = 2 r (3 + 3 r + r²).
    let at = j.max(CONTINUED);
    let (g, r) = (BEGIN - at, (BEGIN - at) / at);
    let (value, slope) = (g * g * r, -g * r * (3.0 + r));
    let curvature = 2.0 * r * (3.0 + r * (3.0 + r));
    let d = j - at;
    Some(Barrier {
        value: value + d * (slope + 0.5 * d * curvature),
        slope: slope + d * curvature,
        curvature,
    })
}

/// Whether the energy is not zero at `f`.
pub(super) fn acts_at(f: &Matrix3<f64>) -> bool {
    f.determinant() < BEGIN
}

/// κ, MPa.
fn stiffness(lame: Lame) -> f64 {
    STIFFNESS * (lame.lambda_ + 2.0 * lame.mu)
}

/// Adds b and κ b' ∂J/∂F at `f` to a law's energy and stress.
pub(super) fn add_response(lame: Lame, f: &Matrix3<f64>, out: &mut PointResponse) {
    if let Some(b) = barrier(f.determinant()) {
        out.energy += stiffness(lame) * b.value;
        out.stress += cofactor(f) * (stiffness(lame) * b.slope);
    }
}

/// Adds κ b'' ∂J/∂F ⊗ ∂J/∂F + κ b' ∂²J/∂F² at `f` to a law's tangent.
pub(super) fn add_tangent(lame: Lame, f: &Matrix3<f64>, out: &mut PointTangent) {
    if let Some(b) = barrier(f.determinant()) {
        let c = flat(&cofactor(f));
        out.own += c * c.transpose() * (stiffness(lame) * b.curvature);
        out.cofactor_stress += stiffness(lame) * b.slope;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mechanics::hyperelastic::formulas::Tangent;

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
}
