//! The families of errors, and which of them are the input's fault.

use crate::error::{MtmError, Result};

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

/// Errors that need no family.
impl MtmError {
    pub(crate) fn not_definite(node: usize, detail: impl Into<String>) -> Self {
        Self::NotPositiveDefinite { node, detail: detail.into() }
    }

    pub(crate) fn not_determined(what: &'static str, reason: impl Into<String>) -> Self {
        Self::NotDetermined { what, reason: reason.into() }
    }

    /// `bytes` needed, and those that the caller allows, if it is not the system that refuses.
    pub(crate) fn out_of_memory(
        what: &'static str,
        bytes: usize,
        limit: Option<usize>,
        advice: &'static str,
    ) -> Self {
        let limit_mb = limit.map(|limit| limit >> 20);
        Self::OutOfMemory { what, needed_mb: bytes >> 20, limit_mb, advice }
    }
}

/// Errors of a family.
impl ErrorKind {
    pub(crate) fn out_of_range(
        self,
        what: impl Into<String>,
        index: usize,
        value: f64,
        allowed: &'static str,
    ) -> MtmError {
        MtmError::OutOfRange { what: what.into(), index, value, allowed, kind: self }
    }

    /// Rejects a parameter unless `is_allowed`.
    pub(crate) fn require(
        self,
        is_allowed: bool,
        what: &str,
        value: f64,
        allowed: &'static str,
    ) -> Result<()> {
        if is_allowed { Ok(()) } else { Err(self.out_of_range(what, 0, value, allowed)) }
    }

    pub(crate) fn not_finite(self, what: &str, index: usize, value: f64) -> MtmError {
        MtmError::NotFinite { what: what.to_owned(), index, value, kind: self }
    }

    pub(crate) fn length(
        self,
        what: impl Into<String>,
        found: usize,
        expected: usize,
        why: &'static str,
    ) -> MtmError {
        MtmError::Length { what: what.into(), found, expected, why, kind: self }
    }

    /// Rejects an array of another length.
    pub(crate) fn require_length(
        self,
        what: &str,
        found: usize,
        expected: usize,
        why: &'static str,
    ) -> Result<()> {
        if found == expected { Ok(()) } else { Err(self.length(what, found, expected, why)) }
    }

    /// `row` of `what` refers to item `index` of `count`.
    pub(crate) fn no_such(
        self,
        (what, row): (impl Into<String>, usize),
        item: &'static str,
        index: u32,
        count: usize,
    ) -> MtmError {
        let index = index as usize;
        MtmError::IndexOutOfRange { what: what.into(), row, item, index, count, kind: self }
    }

    /// What is called `name` among the `known`.
    pub(crate) fn named<T>(
        self,
        what: &'static str,
        name: &str,
        known: impl IntoIterator<Item = (&'static str, T), IntoIter: Clone>,
    ) -> Result<T> {
        let known = known.into_iter();
        known.clone().find(|choice| choice.0 == name).map(|choice| choice.1).ok_or_else(|| {
            let known = known.map(|choice| choice.0).collect::<Vec<_>>().join(", ");
            MtmError::UnknownName { what, found: name.to_owned(), known, kind: self }
        })
    }

    /// Rejects an empty array.
    pub(crate) fn require_entries(self, what: &'static str, count: usize) -> Result<()> {
        if count > 0 { Ok(()) } else { Err(MtmError::Empty { what, kind: self }) }
    }

    pub(crate) fn not_together(
        self,
        (what, found): (&'static str, &str),
        with: &'static str,
        needed: &'static str,
    ) -> MtmError {
        MtmError::NotTogether { what, found: found.to_owned(), with, needed, kind: self }
    }
}
