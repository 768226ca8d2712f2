//! Options of a solver: which method, how accurate, how contact behaves, how much memory.

use crate::contact::ContactOptions;
use crate::error::{ErrorKind, Result};
use crate::mechanics::kinematics::Kinematics;

/// Called now and then; true to stop.
pub type Interrupt<'a> = &'a (dyn Fn() -> bool + Sync);

/// How the linear system is solved.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Method {
    /// Cholesky up to 100 000 unknowns (some 180 000 tets) if its factor fits into memory, otherwise conjugate
    /// gradients.
    Auto,
    /// Sparse Cholesky factor, kept for new plans.
    Cholesky,
    /// Conjugate gradients with multigrid, stopped by an estimate of the error.
    Pcg,
    /// The node-wise iteration of the literature.
    Relaxation,
}

/// Unknowns up to which [`Method::Auto`] chooses Cholesky.
///
/// The cost of a factorisation grows like n^1.3, that of conjugate gradients like n: for one plan they cost the
/// same near 50 000 unknowns, and at 160 000 the factorisation costs twice as much, in memory too. It solves
/// each further plan faster at any size; up to this limit that matters more.
const AUTO_DIRECT_UNKNOWNS: usize = 100_000;

/// Options of a solver.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StaticOptions {
    /// How the linear system is solved.
    pub method: Method,
    /// Estimated error of the iterative methods over the largest prescribed displacement, or over the motion that
    /// loads cause if that is larger, as one cycle of the preconditioner gives it. A solution whose estimated error
    /// exceeds both this and a thousandth of its own largest displacement is refused.
    pub tolerance: f64,
    /// Maximum number of iterations of the iterative methods; their own default if `None`.
    pub max_iterations: Option<usize>,
    /// Options of the contact solver.
    pub contact: ContactOptions,
    /// Memory that a factor may take, bytes; unlimited if `None`.
    pub memory_limit: Option<usize>,
    /// How strain follows from displacement.
    pub kinematics: Kinematics,
}

impl Default for StaticOptions {
    fn default() -> Self {
        Self {
            method: Method::Auto,
            tolerance: 1e-8,
            max_iterations: None,
            contact: ContactOptions::default(),
            memory_limit: None,
            kinematics: Kinematics::Linear,
        }
    }
}

/// Largest tolerance of contact, mm.
const MOST_CONTACT_TOLERANCE: f64 = 1.0;

impl Method {
    /// Every method.
    pub const ALL: [Self; 4] = [Self::Auto, Self::Cholesky, Self::Pcg, Self::Relaxation];

    /// The method called `name`.
    ///
    /// # Errors
    /// [`crate::MtmError::UnknownName`] with the available names.
    pub fn from_name(name: &str) -> Result<Self> {
        ErrorKind::Solver.named("method", name, Self::ALL.map(|method| (method.name(), method)))
    }

    /// Whether it uses a factorisation; [`Method::Auto`] has to be resolved first.
    pub(crate) fn has_factor(self) -> bool {
        match self {
            Self::Cholesky => true,
            Self::Auto | Self::Pcg | Self::Relaxation => false,
        }
    }

    /// Whether it uses node-wise sweeps.
    pub(crate) fn sweeps(self) -> bool {
        match self {
            Self::Relaxation => true,
            Self::Auto | Self::Cholesky | Self::Pcg => false,
        }
    }

    /// The method for a system of so many unknowns: itself, or the choice of [`Method::Auto`].
    pub fn for_unknowns(self, unknowns: usize) -> Self {
        match self {
            Self::Auto if unknowns > AUTO_DIRECT_UNKNOWNS => Self::Pcg,
            Self::Auto => Self::Cholesky,
            named @ (Self::Cholesky | Self::Pcg | Self::Relaxation) => named,
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cholesky => "cholesky",
            Self::Pcg => "pcg",
            Self::Relaxation => "relaxation",
        }
    }
}

impl StaticOptions {
    pub(crate) fn check(&self) -> Result<()> {
        let kind = ErrorKind::Solver;
        let (relative, within) = (self.tolerance, self.contact.tolerance);
        let (is_share, allowed) =
            (relative > 0.0 && relative < 1.0, "above 0 and below 1 (relative)");
        kind.require(is_share, "tolerance", relative, allowed)?;
        let is_small = within > 0.0 && within <= MOST_CONTACT_TOLERANCE;
        kind.require(is_small, "contact_tolerance", within, "above 0, at most 1 mm")?;
        let counts = [
            ("max_iterations", self.max_iterations),
            ("contact_iterations", Some(self.contact.max_iterations)),
        ];
        for (what, value) in counts {
            kind.require(value != Some(0), what, 0.0, "1 or more")?;
        }
        Ok(())
    }
}
