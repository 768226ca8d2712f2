//! The system solved by iteration: conjugate gradients with multigrid, or the sweeps of the literature.
//!
//! What an iteration knows of its own error is an estimate. Where stiff and soft tissue are mixed, or the
//! spectrum is wide, a slow motion may hide from it: there a trial solves for a known field first, and its
//! true errors say what the estimates are worth (`benches/error_estimate.rs` measures how often they fail).

use std::sync::OnceLock;

use crate::blocks::BlockMatrix;
use crate::constraints::{Constraint, projected};
use crate::contact::{Sliding, Spring};
use crate::error::{MtmError, Result, Shortfall};
use crate::krylov::{
    Operator, PcgOptions, Preconditioner, Reached, Spectrum, Trial, pcg_near, trial,
};
use crate::mesh::{dot, norm, scaled, sub};
use crate::method::{Interrupt, Method, StaticOptions};
use crate::multigrid::{Multigrid, MultigridOptions};
use crate::projected_product::ProjectedProduct;
use crate::relaxation::{RelaxationOptions, relax};

/// Over-relaxation of the node-wise iteration.
const RELAXATION_FACTOR: f64 = 1.6;
/// Sweeps after which the node-wise iteration gives up.
const MAX_SWEEPS: usize = 200_000;
/// Share of the tolerance to which the error left by the sweeps is measured.
const MEASURED_SHARE: f64 = 0.1;
/// λ/μ from which a stronger smoother pays: at ν = 0.499 it takes 113 iterations instead of 186. ν = 0.48.
const NEARLY_INCOMPRESSIBLE: f64 = 24.0;

/// Ratio of the stiffest tissue to the softest above which estimates are not believed without a trial. The
/// tissue of a face stays below 300.
const DOUBTFUL_CONTRAST: f64 = 1e3;
/// Share of the tolerance to which a trial is solved.
const TRIAL_SHARE: f64 = 0.1;
/// Multiple of the error of a trial that stands for that of any solution, as for a factor.
const TRIAL_SAFETY: f64 = 10.0;

/// Multiple of the estimate by which an iteration stops that is reported: in `benches/error_estimate.rs` one in
/// some thousand was up to 2.2 times too small.
const REPORT_SAFETY: f64 = 4.0;

/// Whether estimates for tissue of such `contrast` need a trial.
pub(crate) fn is_doubtful(contrast: f64) -> bool {
    contrast.is_nan() || contrast > DOUBTFUL_CONTRAST
}

/// Conjugate gradients with an estimate that a trial has confirmed where that is in doubt.
pub(crate) struct Confirmed<'a> {
    pub a: &'a dyn Operator,
    pub preconditioner: &'a dyn Preconditioner,
    /// Where the trial is kept.
    pub trial: &'a OnceLock<Trial>,
    /// Whether there is to be one whatever the spectrum shows.
    pub doubtful: bool,
    /// Tolerance over the length of the motion.
    pub relative: f64,
}

impl Confirmed<'_> {
    /// The trial, made if need be.
    fn trial(&self, options: &PcgOptions, interrupted: Interrupt<'_>) -> Result<&Trial> {
        if let Some(made) = self.trial.get() {
            return Ok(made);
        }
        let goal = TRIAL_SHARE * self.relative;
        let most = options.max_iterations;
        let made = trial(self.a, self.preconditioner, goal, most, interrupted)?;
        Ok(self.trial.get_or_init(|| made))
    }

    /// The solution of A x = `b`, or with `share` a step towards it (see [`pcg_near`]).
    ///
    /// # Errors
    /// Those of [`pcg_near`]; `NotConverged` where a known solution came back with too large an error.
    pub fn solve(
        &self,
        b: &[[f64; 3]],
        start: &[[f64; 3]],
        options: &PcgOptions,
        share: Option<f64>,
        seen: &mut Spectrum,
        interrupted: Interrupt<'_>,
    ) -> Result<Reached> {
        let near = |start: &[[f64; 3]], seen: &mut Spectrum| {
            pcg_near(self.a, b, start, self.preconditioner, options, share, seen, interrupted)
        };
        let known = |seen: &mut Spectrum| -> Result<f64> {
            let trial = self.trial(options, interrupted)?;
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
        if error.is_none() && seen.is_wide() {
            error = Some(known(seen)?);
            reached = near(&reached.outcome().solution, seen)?;
        }
        let (Reached::Solution(found) | Reached::Step(found)) = &mut reached;
        found.error_estimate_mm *= REPORT_SAFETY;
        if let Some(error) = error {
            let size = found.solution.iter().fold(0.0_f64, |m, v| m.max(norm(*v)));
            found.error_estimate_mm = found.error_estimate_mm.max(TRIAL_SAFETY * error * size);
        }
        Ok(reached)
    }
}

/// That a known solution came back with an error beyond the tolerance.
fn not_confirmed(trial: &Trial, options: &PcgOptions, relative: f64) -> MtmError {
    MtmError::NotConverged {
        method: "pcg",
        iterations: trial.iterations,
        shortfall: Shortfall {
            quantity: "the error with which a known solution came back",
            value: trial.error,
            limit: options.slack / TRIAL_SAFETY * relative,
            unit: " of the displacements",
        },
        advice: "stiff and soft tissue, or slender parts, are beyond conjugate gradients: use \
                 method=\"cholesky\", or allow a larger tolerance",
    }
}

/// Counters of the iterative solves of one plan.
#[derive(Default)]
pub(crate) struct Effort {
    /// Estimated error of the last solve, mm.
    pub error_estimate: f64,
    /// Iterations of all solves.
    pub iterations: usize,
    /// Residual measure of each.
    pub history: Vec<f64>,
}

/// What the solves of one plan leave to the next, whose constraints differ a little.
#[derive(Default)]
pub(crate) struct Trail {
    /// Displacements of the rows; none before the first solve, unless some are known to be near.
    pub rows: Vec<[f64; 3]>,
    /// What the solves showed of the spectrum.
    seen: Spectrum,
    /// The trial under the first constraints, once there is one.
    trial: OnceLock<Trial>,
    /// Length that the tolerance refers to, mm; none before the first solve.
    reach: Option<f64>,
}

impl Trail {
    /// A trail that begins at displacements of the rows, or at none.
    pub fn starting(rows: Vec<[f64; 3]>) -> Self {
        Self { rows, ..Self::default() }
    }
}

/// A system without a factor: the matrix and a multigrid hierarchy for it.
pub(crate) struct Iterative {
    matrix: BlockMatrix,
    multigrid: Box<Multigrid>,
    /// Whether sweeps solve, and the hierarchy only measures the error they leave.
    sweeps: bool,
    /// Estimated error over the length of the motion.
    tolerance: f64,
    max_iterations: Option<usize>,
    /// Whether estimates need a trial whatever the spectrum shows.
    doubtful: bool,
    /// The trial of the system without constraints, once there is one.
    trial: OnceLock<Trial>,
}

impl Iterative {
    /// The system of `matrix`, to be solved by `method`; sliding rows are held along their normals at rest.
    ///
    /// `positions`: coordinates of the rows; `tissue`: how extreme the tissue is.
    pub fn new(
        matrix: BlockMatrix,
        positions: &[[f64; 3]],
        sliding: Option<&Sliding>,
        tissue: Extremes,
        method: Method,
        options: &StaticOptions,
    ) -> Result<Self> {
        let normals: Vec<(usize, [f64; 3])> = sliding
            .iter()
            .flat_map(|s| s.nodes().iter().zip(s.rest_normals()))
            .map(|(node, &n)| (node.row as usize, n))
            .collect();
        let constraints: Vec<Constraint> =
            normals.iter().map(|&(row, normal)| Constraint { row, normal, offset: 0.0 }).collect();
        let held_matrix = (!constraints.is_empty()).then(|| projected(&matrix, &constraints));
        let multigrid = Box::new(Multigrid::new(
            held_matrix.as_ref().unwrap_or(&matrix),
            positions,
            &normals,
            &multigrid_options(tissue.lame_ratio),
        )?);
        Ok(Self {
            matrix,
            multigrid,
            sweeps: method == Method::Relaxation,
            tolerance: options.tolerance,
            max_iterations: options.max_iterations,
            doubtful: is_doubtful(tissue.contrast),
            trial: OnceLock::new(),
        })
    }

    /// Conjugate gradients with `a`, whose trial is kept in `trial`.
    fn confirmed<'a>(&'a self, a: &'a dyn Operator, trial: &'a OnceLock<Trial>) -> Confirmed<'a> {
        Confirmed {
            a,
            preconditioner: self.multigrid.as_ref(),
            trial,
            doubtful: self.doubtful,
            relative: self.tolerance,
        }
    }

    /// The matrix without constraints.
    pub fn matrix(&self) -> &BlockMatrix {
        &self.matrix
    }

    /// Bytes of the hierarchy.
    pub fn bytes(&self) -> usize {
        self.multigrid.memory_bytes()
    }

    /// A⁻¹ b; `scale` is the length of the prescribed field, mm.
    pub fn solve(
        &self,
        b: &[[f64; 3]],
        scale: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        if is_zero(b) {
            return Ok(vec![[0.0; 3]; b.len()]);
        }
        let tolerance = self.tolerance * self.reach(b, scale);
        if self.sweeps {
            return self.relax_to_bound(&self.matrix, b, tolerance, effort, interrupted);
        }
        let start = vec![[0.0; 3]; b.len()];
        let options = self.options(tolerance);
        let found = self
            .confirmed(&self.matrix, &self.trial)
            .solve(b, &start, &options, None, &mut Spectrum::default(), interrupted)?
            .into_outcome();
        effort.error_estimate = found.error_estimate_mm;
        effort.iterations += found.iterations;
        effort.history.extend(found.residual_history);
        Ok(found.solution)
    }

    /// Components across the normals of w in P A P w = `b`, with springs, and whether they are within the
    /// tolerance.
    ///
    /// `b`: see [`projected_rhs`](crate::constraints::projected_rhs), with the pull of the springs.
    /// `constraints`: orthonormal on each row. `share`: of the error at the start, which suffices as long
    /// as it is more than the tolerance; see [`pcg_near`].
    pub fn solve_projected(
        &self,
        b: &[[f64; 3]],
        constraints: &[Constraint],
        springs: &[(usize, Spring)],
        scale: f64,
        share: Option<f64>,
        trail: &mut Trail,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, bool)> {
        if is_zero(b) {
            return Ok((vec![[0.0; 3]; b.len()], true));
        }
        let reach = *trail.reach.get_or_insert_with(|| self.reach(b, scale));
        let reach = constraints.iter().fold(reach, |m, c| m.max(c.offset.abs()));
        let tolerance = self.tolerance * reach;
        if self.sweeps {
            let mut system = projected(&self.matrix, constraints);
            for (row, spring) in springs {
                system.add_to_diagonal(*row, spring.axis, spring.stiffness);
            }
            let x = self.relax_to_bound(&system, b, tolerance, effort, interrupted)?;
            return Ok((x, true));
        }
        let mut start = trail.rows.clone();
        start.resize(b.len(), [0.0; 3]);
        for k in constraints {
            start[k.row] = sub(start[k.row], scaled(k.normal, dot(k.normal, start[k.row])));
        }
        let product = ProjectedProduct::new(&self.matrix, constraints, springs);
        let options = self.options(tolerance);
        let confirmed = self.confirmed(&product, &trail.trial);
        let reached = confirmed.solve(b, &start, &options, share, &mut trail.seen, interrupted)?;
        let (found, solved) = match reached {
            Reached::Solution(found) => (found, true),
            Reached::Step(found) => (found, false),
        };
        effort.error_estimate = found.error_estimate_mm;
        effort.iterations += found.iterations;
        effort.history.extend(found.residual_history);
        Ok((found.solution, solved))
    }

    /// Length that the tolerance refers to, mm. Loads move the body where bone does not: one cycle tells
    /// how far, to the order of magnitude.
    fn reach(&self, b: &[[f64; 3]], scale: f64) -> f64 {
        let mut first = vec![[0.0; 3]; b.len()];
        self.multigrid.apply(b, &mut first);
        first.iter().fold(scale, |m, v| m.max(norm(*v)))
    }

    fn options(&self, tolerance: f64) -> PcgOptions {
        let defaults = PcgOptions::default();
        let max_iterations = self.max_iterations.unwrap_or(defaults.max_iterations);
        PcgOptions { tolerance, max_iterations, ..defaults }
    }

    /// Sweeps until the error itself is within `tolerance`, mm.
    ///
    /// The steps of the sweeps do not tell: where a stiff body hangs on soft tissue they become tiny long
    /// before it has moved. The error that is left, A⁻¹ (b − A x), is therefore solved for by conjugate
    /// gradients each time the steps say that the sweeps are done, and measured, not used.
    fn relax_to_bound(
        &self,
        matrix: &BlockMatrix,
        b: &[[f64; 3]],
        tolerance: f64,
        effort: &mut Effort,
        interrupted: Interrupt<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        let most = self.max_iterations.unwrap_or(MAX_SWEEPS);
        let (mut x, mut goal, mut sweeps) = (vec![[0.0; 3]; b.len()], tolerance, 0);
        loop {
            let options = RelaxationOptions {
                tolerance: goal,
                factor: RELAXATION_FACTOR,
                max_sweeps: most - sweeps,
            };
            let found =
                relax(matrix, b, &x, &options, interrupted).map_err(|e| gave_up(e, most))?;
            (x, sweeps) = (found.solution, sweeps + found.sweeps);
            effort.iterations += found.sweeps;
            effort.history.extend(found.steps);
            let rest: Vec<[f64; 3]> =
                b.iter().zip(matrix.multiply(&x)).map(|(&b, f)| sub(b, f)).collect();
            let options = PcgOptions {
                tolerance: MEASURED_SHARE * tolerance,
                energy_tolerance: MEASURED_SHARE,
                ..PcgOptions::default()
            };
            let start = vec![[0.0; 3]; b.len()];
            let trial = OnceLock::new();
            let left = Confirmed { relative: MEASURED_SHARE, ..self.confirmed(matrix, &trial) }
                .solve(&rest, &start, &options, None, &mut Spectrum::default(), interrupted)
                .map_err(|e| gave_up(e, sweeps))?
                .into_outcome();
            let largest = left.solution.iter().fold(0.0_f64, |m, e| m.max(norm(*e)));
            let error = largest + left.error_estimate_mm;
            if error <= tolerance {
                effort.error_estimate = error;
                return Ok(x);
            }
            if sweeps >= most {
                return Err(no_rest(most, error, tolerance));
            }
            goal *= (0.5 * tolerance / error).min(0.5);
        }
    }
}

/// How extreme a tissue is.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extremes {
    /// Largest λ/μ.
    pub lame_ratio: f64,
    /// Stiffest over softest.
    pub contrast: f64,
}

/// Options of the cycle for tissue with the given largest λ/μ.
fn multigrid_options(lame_ratio: f64) -> MultigridOptions {
    let defaults = MultigridOptions::default();
    if lame_ratio < NEARLY_INCOMPRESSIBLE {
        return defaults;
    }
    MultigridOptions { smoother_degree: 2 * defaults.smoother_degree, ..defaults }
}

/// What to do where sweeps do not end.
const NO_SWEEPS: &str =
    "use method=\"cholesky\" or \"pcg\"; node-wise relaxation is kept for comparison";

/// That the sweeps ended before the error was within the tolerance.
fn no_rest(sweeps: usize, error: f64, tolerance: f64) -> MtmError {
    MtmError::NotConverged {
        method: "relaxation",
        iterations: sweeps,
        shortfall: Shortfall {
            quantity: "the measured error of a node",
            value: error,
            limit: tolerance,
            unit: " mm",
        },
        advice: NO_SWEEPS,
    }
}

/// An error of a step of the relaxation, in the terms that the caller asked in.
fn gave_up(error: MtmError, sweeps: usize) -> MtmError {
    match error {
        MtmError::NotConverged { shortfall, .. } => MtmError::NotConverged {
            method: "relaxation",
            iterations: sweeps,
            shortfall,
            advice: NO_SWEEPS,
        },
        other => other,
    }
}

/// Whether nothing pulls: any iteration would only divide by it.
fn is_zero(b: &[[f64; 3]]) -> bool {
    b.iter().flatten().all(|&v| v == 0.0)
}
