//! Hyperelastic laws of isotropic tissue. To add a law, add a file next to this one and a line in [`LAWS`].

mod barrier;
mod formulas;
mod neo_hookean;

use nalgebra::Matrix3;

#[cfg(test)]
pub(crate) use formulas::flat;
pub(crate) use formulas::{PointResponse, PointTangent, Tangent, cofactor};

use crate::mechanics::hyperelastic::formulas::Formulas;
use crate::mechanics::material::Lame;

/// The laws, each under its own name of kinematics.
const LAWS: &[&Formulas] = &[&neo_hookean::FORMULAS];

/// A hyperelastic law of isotropic tissue.
#[derive(Clone, Copy)]
pub struct HyperelasticLaw {
    formulas: &'static Formulas,
    /// Whether its tissue resists being squeezed flat.
    has_barrier: bool,
}

impl HyperelasticLaw {
    /// Stable neo-Hookean tissue.
    pub const NEO_HOOKEAN: Self = Self::new(&neo_hookean::FORMULAS);

    const fn new(formulas: &'static Formulas) -> Self {
        Self { formulas, has_barrier: true }
    }

    /// The same without the energy by which tissue resists being squeezed flat.
    pub(crate) const fn without_barrier(self) -> Self {
        Self { has_barrier: false, ..self }
    }

    /// Whether the energy by which tissue resists being squeezed flat is not zero at `f`.
    pub(crate) fn is_at_barrier(self, f: &Matrix3<f64>) -> bool {
        self.has_barrier && barrier::acts_at(f)
    }

    /// The law called `name`.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::all().find(|law| law.name() == name)
    }

    /// Every law.
    pub fn all() -> impl Iterator<Item = Self> {
        LAWS.iter().copied().map(Self::new)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        self.formulas.name
    }

    /// Energy density and stress at `f`.
    pub(crate) fn response(self, lame: Lame, f: &Matrix3<f64>) -> PointResponse {
        let mut out = (self.formulas.response)(lame, f);
        if self.has_barrier {
            barrier::add_response(lame, f, &mut out);
        }
        out
    }

    /// Tangent at `f`.
    pub(crate) fn tangent(self, lame: Lame, f: &Matrix3<f64>) -> PointTangent {
        let mut out = (self.formulas.tangent)(lame, f);
        if self.has_barrier {
            barrier::add_tangent(lame, f, &mut out);
        }
        out
    }
}

impl PartialEq for HyperelasticLaw {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name() && self.has_barrier == other.has_barrier
    }
}

impl Eq for HyperelasticLaw {}

impl std::fmt::Debug for HyperelasticLaw {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Deformation gradients: at rest, sheared, compressed, inverted.
    fn gradients() -> [Matrix3<f64>; 4] {
        let shear = Matrix3::new(1.2, 0.3, -0.1, 0.05, 0.9, 0.2, 0.1, -0.2, 1.1);
        let squeeze = Matrix3::from_diagonal(&nalgebra::Vector3::new(1.4, 0.5, 0.8));
        let invert = Matrix3::from_diagonal(&nalgebra::Vector3::new(1.0, 1.3, -0.3));
        [Matrix3::identity(), shear, squeeze * shear, invert * shear]
    }

    #[test]
    fn every_law_has_no_stress_at_rest_and_the_tangent_of_its_constants() {
        let lame = Lame { lambda_: 0.011, mu: 0.0027 };
        let one = Matrix3::identity();
        for law in HyperelasticLaw::all() {
            assert!(law.response(lame, &one).stress.amax() < 1e-16, "{law:?}");
            let tangent = law.tangent(lame, &one);
            for strain in [one, Matrix3::new(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 2.0)] {
                let e = flat(&strain);
                // ∂²J/∂F² : e : e at F = I is tr² e − e : e.
                let cofactor = tangent.cofactor_stress * (strain.trace().powi(2) - e.dot(&e));
                let found = e.dot(&(tangent.own * e)) + cofactor;
                let exact = 2.0 * lame.mu * e.dot(&e) + lame.lambda_ * strain.trace().powi(2);
                assert!((found - exact).abs() < 1e-15, "{law:?}: {found} {exact}");
            }
        }
    }

    #[test]
    fn the_stress_of_every_law_is_the_slope_of_its_energy() {
        let lame = Lame { lambda_: 0.011, mu: 0.0027 };
        let h = 1e-5;
        for law in HyperelasticLaw::all() {
            for f in gradients() {
                let stress = law.response(lame, &f).stress;
                let allowed = 1e-10 * stress.amax().max(1.0);
                for i in 0..9 {
                    let energy = |step: f64| {
                        let mut moved = f;
                        moved[(i / 3, i % 3)] += step;
                        law.response(lame, &moved).energy
                    };
                    let slope = (energy(h) - energy(-h)) / (2.0 * h);
                    let found = stress[(i / 3, i % 3)];
                    assert!((found - slope).abs() < allowed, "{law:?}: {found} {slope}");
                }
            }
        }
    }
}
