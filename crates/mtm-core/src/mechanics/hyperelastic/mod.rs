//! Hyperelastic laws of isotropic tissue. To add a law, add a file next to this one and a line in [`LAWS`].

pub mod barrier;
mod formulas;
mod neo_hookean;

use nalgebra::Matrix3;

pub(crate) use formulas::cofactor;
pub use formulas::{PointResponse, PointTangent, Tangent};

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
