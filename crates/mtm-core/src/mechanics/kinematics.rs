//! Which strain a solver takes: linear, corotational or of large deformation.

use crate::error::{ErrorKind, MtmError, Result};

/// How strain follows from displacement.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[non_exhaustive]
pub enum Kinematics {
    /// Linear strain about the shape at rest (the paper).
    #[default]
    Linear,
    /// Stretch without the rotation of each tet, with the constants of the linear law.
    Corotational,
    /// Stable neo-Hookean tissue with its fibres: the reference for large deformation.
    Hyperelastic,
}

/// Names of the kinematics.
pub const KINEMATICS: &str = "linear, corotational, hyperelastic";

impl Kinematics {
    /// The kinematics called `name`.
    pub fn from_name(name: &str) -> Result<Self> {
        match name {
            "linear" => Ok(Self::Linear),
            "corotational" => Ok(Self::Corotational),
            "hyperelastic" => Ok(Self::Hyperelastic),
            _ => Err(MtmError::UnknownName {
                what: "kinematics",
                found: name.to_owned(),
                known: KINEMATICS,
                kind: ErrorKind::Solver,
            }),
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Linear => "linear",
            Self::Corotational => "corotational",
            Self::Hyperelastic => "hyperelastic",
        }
    }
}
