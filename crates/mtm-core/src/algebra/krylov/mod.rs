//! Preconditioned conjugate gradients that stop on an estimate of the error, not on the residual.
//!
//! At a material contrast of 1e6 a relative residual of 1e-6 can leave centimetres of error: a stiff muscle
//! dominates the norm while the fat next to it is still wrong. The iteration here ends when the estimated
//! errors in millimetres and in energy are both small enough, and both are confirmed with the true residual
//! `b − A x` before a solution is returned. If the estimates are likely to miss a slow motion, [`trial`] first
//! measures them on a known solution.

mod operator;
mod state;
mod trial;

use crate::algebra::error_bound::{StoppingRule, Verdict};
use crate::algebra::row_sums::{dot, in_pool};
use crate::error::{ErrorKind, MtmError, Result, check_finite_rows};

pub use crate::algebra::error_bound::PcgOptions;
pub(crate) use crate::algebra::error_bound::Spectrum;
pub use operator::{Operator, Preconditioner};
pub use state::PcgOutcome;
use state::{Indefinite, State};
pub(crate) use trial::{Trial, trial};

/// Number of last iterations whose decrease of the energy estimates the remaining decrease.
const ENERGY_DELAY: usize = 6;

/// Solves `A x = b` by preconditioned conjugate gradients (Hestenes & Stiefel 1952).
///
/// `b`, `x0`: one row of three per block row, N and mm. `interrupted` is called once per iteration, on the
/// calling thread. The result is bitwise identical for any number of threads.
///
/// Stops when `max_j |z_j| / θ_min ≤ tolerance` and the Gauss–Radau estimate of the energy error (Meurant &
/// Tichý 2013, with the smallest Ritz value minus a safety margin as lower end of the spectrum) is within
/// `energy_tolerance`; both must then hold for the true residual as well.
///
/// # Errors
/// [`MtmError::Length`] and [`MtmError::NotFinite`] for input that does not fit,
/// [`MtmError::NotPositiveDefinite`] for a breakdown, [`MtmError::NotConverged`] and
/// [`MtmError::Interrupted`].
pub fn pcg(
    a: &dyn Operator,
    b: &[[f64; 3]],
    x0: &[[f64; 3]],
    preconditioner: &dyn Preconditioner,
    options: &PcgOptions,
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Result<PcgOutcome> {
    let mut seen = Spectrum::default();
    let problem = Problem { a, b, preconditioner, interrupted };
    let reached = pcg_near(&problem, x0, options, None, &mut seen)?;
    reached.into_outcome()
}

/// A system `A x = b` with its preconditioner.
pub(crate) struct Problem<'a> {
    pub a: &'a dyn Operator,
    pub b: &'a [[f64; 3]],
    pub preconditioner: &'a dyn Preconditioner,
    /// Called once per iteration, on the calling thread.
    pub interrupted: &'a (dyn Fn() -> bool + Sync),
}

/// Accuracy required of a solution that is only an intermediate step.
#[derive(Debug, Clone, Copy)]
pub(crate) enum StepAccuracy {
    /// Estimated error, mm, as a share of the error at the start.
    Error(f64),
    /// Error in the energy norm as a share of the decrease due to the iteration: with springs much stiffer than
    /// the preconditioner accounts for, the largest row of z is not a measure of the error.
    Energy(f64),
}

/// Decrease of the energy in the last iterations: their sum estimates what is left (Hestenes & Stiefel 1952;
/// with a delay Strakoš & Tichý 2002).
#[derive(Default)]
struct Decrease {
    whole: f64,
    last: [f64; ENERGY_DELAY],
    count: usize,
}

impl Decrease {
    fn push(&mut self, taken: f64) {
        self.whole += taken;
        self.last[self.count % ENERGY_DELAY] = taken;
        self.count += 1;
    }

    /// Whether the remaining decrease is within the square of `share` of the decrease so far.
    fn is_within(&self, share: f64) -> bool {
        self.count >= ENERGY_DELAY && self.last.iter().sum::<f64>() <= share * share * self.whole
    }
}

/// How [`pcg_near`] ended.
pub(crate) enum Reached {
    /// Within the tolerances, confirmed with the true residual.
    Solution(PcgOutcome),
    /// Near enough for a step; the estimate is that of the recurrence.
    Step(PcgOutcome),
    /// The matrix is indefinite, or nearly so.
    Indefinite(Box<Indefinite>),
}

impl Reached {
    /// The result, if the matrix is definite.
    pub(crate) fn into_outcome(self) -> Result<PcgOutcome> {
        match self {
            Self::Solution(outcome) | Self::Step(outcome) => Ok(outcome),
            Self::Indefinite(met) => Err(met.error),
        }
    }
}

impl PcgOutcome {
    /// The solution of `n` rows without a right-hand side.
    fn at_rest(n: usize) -> Self {
        Self {
            solution: vec![[0.0; 3]; n],
            iterations: 0,
            error_estimate_mm: 0.0,
            energy_error: 0.0,
            residual: 0.0,
            residual_history: Vec::new(),
            ritz: [1.0; 2],
        }
    }
}

/// Checks that there are `n` finite `rows` called `what`.
fn check_rows(what: &str, rows: &[[f64; 3]], n: usize) -> Result<()> {
    ErrorKind::Solver.require_length(what, rows.len(), n, "one row per block row of the matrix")?;
    check_finite_rows(what, rows, ErrorKind::Solver)
}

/// [`pcg`] for one of several systems that differ little, with the same preconditioner.
///
/// `seen`: what earlier systems revealed of the spectrum. With `enough`, the solution is only an intermediate
/// step: the iteration ends as soon as that accuracy is reached (the estimate of the step is then as good as
/// what was seen), unless it lies within the tolerances.
pub(crate) fn pcg_near(
    problem: &Problem<'_>,
    x0: &[[f64; 3]],
    options: &PcgOptions,
    enough: Option<StepAccuracy>,
    seen: &mut Spectrum,
) -> Result<Reached> {
    let &Problem { a, b, preconditioner, interrupted } = problem;
    for (what, rows) in [("right-hand side", b), ("start vector", x0)] {
        check_rows(what, rows, a.n_rows())?;
    }
    if dot(b, b) == 0.0 {
        return Ok(Reached::Solution(PcgOutcome::at_rest(a.n_rows())));
    }

    let mut state = State::new(a, b, x0, preconditioner, seen);
    in_pool(|| state.replace_residual());
    state.restart();
    let goal = match enough {
        Some(StepAccuracy::Error(share)) => share * state.error_mm(),
        _ => 0.0,
    };
    let mut decrease = Decrease::default();
    let mut rule = StoppingRule::new(options, state.rz);
    loop {
        if interrupted() {
            return Err(MtmError::Interrupted);
        }
        if state.rz != 0.0 || state.largest_z != 0.0 {
            match in_pool(|| state.step()) {
                Ok(taken) => decrease.push(taken),
                Err(error) if state.is_indefinite() => {
                    return Ok(Reached::Indefinite(Box::new(state.indefinite(error))));
                }
                Err(error) => return Err(error),
            }
        }
        let is_enough = match enough {
            Some(StepAccuracy::Error(_)) => goal > options.tolerance && state.error_mm() <= goal,
            Some(StepAccuracy::Energy(share)) => decrease.is_within(share),
            None => false,
        };
        if is_enough {
            return Ok(Reached::Step(state.outcome(1.0)));
        }
        let iterations = state.iterations();
        let excess = || state.excess(options);
        let due = rule.due(iterations, state.rz, state.spectrum, state.error_mm(), excess);
        let Some(due) = due else { continue };
        // At the round-off floor the recurrence drifts from b − A x: only the true residual is reliable.
        in_pool(|| state.replace_residual());
        match rule.verdict(due, iterations, state.error_mm(), state.excess(options)) {
            Verdict::Converged => return Ok(Reached::Solution(state.outcome(due.doubt))),
            Verdict::GiveUp => return Err(state.not_converged(due, options)),
            Verdict::Restart => state.restart(),
        }
    }
}
