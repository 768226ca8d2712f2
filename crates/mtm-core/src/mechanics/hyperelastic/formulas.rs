//! What makes up a hyperelastic law.

use nalgebra::{Matrix3, SMatrix};

use crate::mechanics::material::Lame;

/// Derivatives of the nine entries of F, row by row.
pub type Tangent = SMatrix<f64, 9, 9>;

/// Energy density and stress at a point.
#[derive(Debug, Clone, Copy)]
pub struct PointResponse {
    /// N mm/mm³.
    pub energy: f64,
    /// First Piola–Kirchhoff stress ∂W/∂F, MPa.
    pub stress: Matrix3<f64>,
}

/// ∂²W/∂F² at a point in two parts: the cofactor part has the same form for every law.
#[derive(Debug, Clone, Copy)]
pub struct PointTangent {
    /// Everything but the cofactor part, MPa.
    pub own: Tangent,
    /// Factor of ∂²J/∂F², MPa.
    pub cofactor_stress: f64,
}

/// The formulas of a law. At F = I the stress is zero and the tangent that of the Lamé constants.
pub(crate) struct Formulas {
    /// The name by which the kinematics is chosen.
    pub name: &'static str,
    /// Energy density and stress at a deformation gradient F.
    pub response: fn(Lame, &Matrix3<f64>) -> PointResponse,
    /// Tangent at a deformation gradient F.
    pub tangent: fn(Lame, &Matrix3<f64>) -> PointTangent,
}

/// ∂J/∂F.
pub(crate) fn cofactor(f: &Matrix3<f64>) -> Matrix3<f64> {
    Matrix3::from_fn(|i, j| {
        let (a, b, c, d) = ((i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3);
        f[(a, c)] * f[(b, d)] - f[(a, d)] * f[(b, c)]
    })
}

/// Entries row by row.
pub(crate) fn flat(m: &Matrix3<f64>) -> SMatrix<f64, 9, 1> {
    SMatrix::<f64, 9, 1>::from_fn(|i, _| m[(i / 3, i % 3)])
}
