//! Conjugate gradients whose error estimate is confirmed, if it is in doubt, by a trial with a known solution.

use std::sync::OnceLock;

use crate::algebra::krylov::{
    Operator, PcgOptions, Preconditioner, Problem, Reached, Spectrum, StepAccuracy, Trial,
    pcg_near, trial,
};
use crate::error::{MtmError, Result, Shortfall};
use crate::statics::options::Interrupt;
use crate::vector::norm;

/// Ratio of the stiffest tissue to the softest above which estimates are not trusted without a trial. The
/// tissue of a face stays below 300.
const DOUBTFUL_CONTRAST: f64 = 1e3;

/// Accuracy, as a share of the tolerance, to which a trial is solved.
const TRIAL_SHARE: f64 = 0.1;

/// Multiple of the error of a trial that is taken as the error of any solution, as for a factorisation.
const TRIAL_SAFETY: f64 = 10.0;

/// Multiple of the estimate at the end of the iteration that is reported: in `benches/stability/error_estimate.rs` about
/// one estimate in a thousand was up to 2.2 times too small.
const REPORT_SAFETY: f64 = 4.0;

/// Whether estimates for tissue of such `contrast` need a trial.
pub(crate) fn is_doubtful(contrast: f64) -> bool {
    contrast.is_nan() || contrast > DOUBTFUL_CONTRAST
}

/// Conjugate gradients whose estimate is confirmed by a trial if it is in doubt.
pub(crate) struct Confirmed<'a> {
    pub a: &'a dyn Operator,
    pub preconditioner: &'a dyn Preconditioner,
    /// Cache of the trial.
    pub trial: &'a OnceLock<Trial>,
    /// Whether a trial is needed whatever the spectrum shows.
    pub doubtful: bool,
    /// Tolerance over the length of the motion.
    pub relative: f64,
    pub interrupted: Interrupt<'a>,
}

impl Confirmed<'_> {
    /// The trial, run on first use.
    fn trial(&self, options: &PcgOptions) -> Result<&Trial> {
        if let Some(made) = self.trial.get() {
            return Ok(made);
        }
        let goal = TRIAL_SHARE * self.relative;
        let most = options.max_iterations;
        let made = trial(self.a, self.preconditioner, goal, most, self.interrupted)?;
        Ok(self.trial.get_or_init(|| made))
    }

    /// The solution of A x = `b`, or, if `enough` is given, a step towards it (see [`pcg_near`]).
    ///
    /// # Errors
    /// Those of [`pcg_near`]; `NotConverged` if the error on a known solution is too large.
    pub fn solve(
        &self,
        b: &[[f64; 3]],
        start: &[[f64; 3]],
        options: &PcgOptions,
        enough: Option<StepAccuracy>,
        seen: &mut Spectrum,
    ) -> Result<Reached> {
        let Self { a, preconditioner, interrupted, .. } = *self;
        let problem = Problem { a, b, preconditioner, interrupted };
        let near = |start: &[[f64; 3]], seen: &mut Spectrum| {
            pcg_near(&problem, start, options, enough, seen)
        };
        let known = |seen: &mut Spectrum| -> Result<f64> {
            let trial = self.trial(options)?;
            if trial.error * TRIAL_SAFETY > options.slack * self.relative {
                return Err(not_confirmed(trial, options, self.relative));
            }
            seen.learn(&trial.seen);
            Ok(trial.error)
        };
        let mut error = None;
        if self.doubtful {
            error = Some(known(seen)?);
        }
        let mut reached = near(start, seen)?;
        if enough.is_some() && seen.is_wide() {
            // An intermediate step needs no trial, but does not count as a solution.
            return Ok(match reached {
                Reached::Solution(found) => Reached::Step(found),
                other => other,
            });
        }
        if let (true, None, Reached::Solution(found)) = (seen.is_wide(), error, &reached) {
            let start = found.solution.clone();
            error = Some(known(seen)?);
            reached = near(&start, seen)?;
        }
        let (Reached::Solution(found) | Reached::Step(found)) = &mut reached else {
            return Ok(reached);
        };
        found.error_estimate_mm *= REPORT_SAFETY;
        if let Some(error) = error {
            let size = found.solution.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
            found.error_estimate_mm = found.error_estimate_mm.max(TRIAL_SAFETY * error * size);
        }
        Ok(reached)
    }
}

/// The error for a known solution that was recovered with an error above the tolerance.
fn not_confirmed(trial: &Trial, options: &PcgOptions, relative: f64) -> MtmError {
    let (quantity, unit) = ("the error in recovering a known solution", " of the displacements");
    let limit = options.slack / TRIAL_SAFETY * relative;
    MtmError::NotConverged {
        method: "pcg",
        iterations: trial.iterations,
        shortfall: Shortfall::new(quantity, trial.error, limit, unit),
        advice: "stiff and soft tissue, or slender parts, are beyond conjugate gradients: use \
                 method=\"cholesky\", or allow a larger tolerance",
    }
}
