//! The strain measure of a solver: linear, corotational or for large deformation.

use crate::error::{ErrorKind, Result};
use crate::mechanics::hyperelastic::HyperelasticLaw;

/// How strain follows from displacement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Kinematics {
    /// Linear strain about the shape at rest (the paper).
    #[default]
    Linear,
    /// Stretch of each tet without its rotation, with the constants of the linear law.
    Corotational,
    /// Large deformation with a hyperelastic law for the isotropic part of the tissue, and its fibres by their
    /// stretch.
    Hyperelastic(HyperelasticLaw),
}

impl Kinematics {
    /// Large deformation of stable neo-Hookean tissue: the reference.
    pub const NEO_HOOKEAN: Self = Self::Hyperelastic(HyperelasticLaw::NEO_HOOKEAN);

    /// Every kinematics.
    pub fn all() -> impl Iterator<Item = Self> {
        [Self::Linear, Self::Corotational]
            .into_iter()
            .chain(HyperelasticLaw::all().map(Self::Hyperelastic))
    }

    /// The kinematics called `name`.
    ///
    /// # Errors
    /// [`crate::MtmError::UnknownName`] with the available names.
    pub fn from_name(name: &str) -> Result<Self> {
        let known: Vec<_> = Self::all().map(|kinematics| (kinematics.name(), kinematics)).collect();
        ErrorKind::Solver.named("kinematics", name, known)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Corotational => "corotational",
            Self::Hyperelastic(law) => law.name(),
        }
    }
}
