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
pub const BEGIN: f64 = 0.3;
/// Share of the volume, J₁, below which the energy is a quadratic function of J.
pub const CONTINUED: f64 = 0.02;
/// κ relative to λ + 2 μ, the stiffness against squeezing without motion across.
const STIFFNESS: f64 = 1.0;

/// b/κ and its derivatives with respect to J.
#[allow(missing_docs)]
pub struct Barrier {
    pub value: f64,
    pub slope: f64,
    pub curvature: f64,
}

/// b and its derivatives at `j`; none where they vanish.
pub fn barrier(j: f64) -> Option<Barrier> {
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
pub fn add_response(lame: Lame, f: &Matrix3<f64>, out: &mut PointResponse) {
    if let Some(b) = barrier(f.determinant()) {
        out.energy += stiffness(lame) * b.value;
        out.stress += cofactor(f) * (stiffness(lame) * b.slope);
    }
}

/// Adds κ b'' ∂J/∂F ⊗ ∂J/∂F + κ b' ∂²J/∂F² at `f` to a law's tangent.
pub fn add_tangent(lame: Lame, f: &Matrix3<f64>, out: &mut PointTangent) {
    if let Some(b) = barrier(f.determinant()) {
        let c = flat(&cofactor(f));
        out.own += c * c.transpose() * (stiffness(lame) * b.curvature);
        out.cofactor_stress += stiffness(lame) * b.slope;
    }
}
