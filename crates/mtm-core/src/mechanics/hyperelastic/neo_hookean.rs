//! Stable neo-Hookean tissue (Smith, de Goes & Kim 2018, eq. 14):
//!
//! W = ½ μ' (|F|² − 3) − ½ μ' ln((|F|² + 1)/4) + ½ λ' (J − 1)² − ¾ μ' (J − 1)
//!
//! Equal to that of the source up to a constant: λ' (J − α)²/2 with α = 1 + ¾ μ'/λ'. With the constants μ' =
//! 4/3 μ and λ' = λ + 5/6 μ the linear limit is that of the Lamé constants.

use nalgebra::Matrix3;

use crate::mechanics::hyperelastic::formulas::{
    Formulas, PointResponse, PointTangent, Tangent, cofactor, flat,
};
use crate::mechanics::material::Lame;

/// The law.
pub(super) const FORMULAS: Formulas = Formulas { name: "hyperelastic", response, tangent };

/// λ' and μ', MPa.
fn constants(l: Lame) -> (f64, f64) {
    (l.lambda_ + 5.0 / 6.0 * l.mu, 4.0 / 3.0 * l.mu)
}

/// W, and P = μ' (1 − 1/(|F|² + 1)) F + (λ' (J − 1) − ¾ μ') ∂J/∂F.
fn response(lame: Lame, f: &Matrix3<f64>) -> PointResponse {
    let (lambda_, mu) = constants(lame);
    let (size, j) = (f.norm_squared(), f.determinant());
    PointResponse {
        energy: 0.5 * mu * (size - 3.0) - 0.5 * mu * (0.25 * (size + 1.0)).ln()
            + (0.5 * lambda_ * (j - 1.0) - 0.75 * mu) * (j - 1.0),
        stress: f * (mu * (1.0 - 1.0 / (size + 1.0)))
            + cofactor(f) * (lambda_ * (j - 1.0) - 0.75 * mu),
    }
}

/// μ' (1 − 1/(|F|² + 1)) I + 2 μ'/(|F|² + 1)² F ⊗ F + λ' ∂J/∂F ⊗ ∂J/∂F + (λ' (J − 1) − ¾ μ') ∂²J/∂F².
fn tangent(lame: Lame, f: &Matrix3<f64>) -> PointTangent {
    let (lambda_, mu) = constants(lame);
    let (size, j) = (f.norm_squared(), f.determinant());
    let (f9, c9) = (flat(f), flat(&cofactor(f)));
    let mut own = Tangent::identity() * (mu * (1.0 - 1.0 / (size + 1.0)));
    own += f9 * f9.transpose() * (2.0 * mu / ((size + 1.0) * (size + 1.0)));
    own += c9 * c9.transpose() * lambda_;
    PointTangent { own, cofactor_stress: lambda_ * (j - 1.0) - 0.75 * mu }
}
