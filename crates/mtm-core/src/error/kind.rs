//! The families of errors, and which of them are the input's fault.

use crate::error::MtmError;

/// The family an error belongs to; the Python exceptions carry the same names.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ErrorKind {
    /// Nodes, tets, surfaces.
    Mesh,
    /// Tissue constants and stiffness.
    Material,
    /// Node kinds, segments, plans.
    Boundary,
    /// Contact surfaces and the contact solver.
    Contact,
    /// Solver options and outcomes.
    Solver,
    /// Landmarks and points that are to be aligned.
    Registration,
    /// The caller asked to stop.
    Interrupted,
}

impl MtmError {
    /// The family of the error.
    pub fn kind(&self) -> ErrorKind {
        match self {
            Self::Empty { kind, .. }
            | Self::Length { kind, .. }
            | Self::NotFinite { kind, .. }
            | Self::OutOfRange { kind, .. }
            | Self::IndexOutOfRange { kind, .. }
            | Self::NotRigid { kind, .. }
            | Self::NotTogether { kind, .. }
            | Self::UnknownName { kind, .. } => *kind,
            Self::DuplicateNode { .. }
            | Self::InvertedTet { .. }
            | Self::DegenerateTet { .. }
            | Self::DuplicateTet { .. }
            | Self::UnusedNode { .. }
            | Self::DegenerateTriangle { .. } => ErrorKind::Mesh,
            Self::AsymmetricStiffness { .. }
            | Self::IndefiniteMaterial { .. }
            | Self::FibreNotUnit { .. } => ErrorKind::Material,
            Self::NodeOfTwoKinds { .. }
            | Self::Segment { .. }
            | Self::TouchingPair { .. }
            | Self::Plan { .. }
            | Self::Unconstrained { .. } => ErrorKind::Boundary,
            Self::ContactSurface { .. } | Self::ContactNotConverged { .. } => ErrorKind::Contact,
            Self::NotPositiveDefinite { .. }
            | Self::NotConverged { .. }
            | Self::Overflow { .. }
            | Self::NoThreads { .. }
            | Self::OutOfMemory { .. } => ErrorKind::Solver,
            Self::TooFewPoints { .. }
            | Self::CoincidentPoints { .. }
            | Self::FlatPoints { .. }
            | Self::NotDetermined { .. }
            | Self::IcpNotConverged { .. } => ErrorKind::Registration,
            Self::Interrupted => ErrorKind::Interrupted,
        }
    }

    /// Whether the input is at fault (Python: the error is also a `ValueError`), rather than a numerical
    /// outcome.
    pub fn is_input(&self) -> bool {
        !matches!(
            self,
            Self::ContactNotConverged { .. }
                | Self::NotPositiveDefinite { .. }
                | Self::NotConverged { .. }
                | Self::Overflow { .. }
                | Self::IcpNotConverged { .. }
                | Self::OutOfMemory { .. }
                | Self::NoThreads { .. }
                | Self::Interrupted
        )
    }
}
