//! The system solved by iteration: conjugate gradients with multigrid, or the sweeps of the literature.
//!
//! An iteration can only estimate its own error. If stiff and soft tissue are mixed, or the spectrum is wide,
//! the estimate may miss a slow motion. In these cases a trial with a known solution is solved first, and its
//! true errors calibrate the estimates (`benches/stability/error_estimate.rs` measures how often they fail).

use std::sync::{Arc, OnceLock};

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::constraints::add_offsets;
use crate::algebra::krylov::{
    Operator, PcgOptions, PcgOutcome, Preconditioner, Problem, Reached, Spectrum, StepAccuracy,
    Trial, pcg_near,
};
use crate::algebra::multigrid::{CyclePrecision, Multigrid, MultigridOptions};
use crate::algebra::relaxation::{NO_SWEEPS, relax};
use crate::contact::links::Link;
use crate::error::{MtmError, Result, Shortfall};
use crate::mechanics::tissue::Tissue;
use crate::statics::linear::confirmed::{Confirmed, is_doubtful};
use crate::statics::linear::effort::PlanSolve;
use crate::statics::linear::pressed::Pressed;
use crate::statics::linear::projected_product::ProjectedProduct;
use crate::statics::linear::row_conditions::RowConditions;
use crate::statics::linear::unstable::{at_fault, carry_on};
use crate::statics::options::{Interrupt, Method, StaticOptions};
use crate::vector::{add, dot, norm, scaled, sub};

/// Sweeps after which the node-wise iteration stops with an error.
const MAX_SWEEPS: usize = 200_000;
/// Estimated error of a solution that is worth nothing, over the largest displacement.
const WORTH: f64 = 1e-3;
/// Maximum number of iterations under links that only push.
const MOST_PRESSED: usize = 60;
/// Accuracy, as a share of the tolerance, to which the error left by the sweeps is measured.
const MEASURED_SHARE: f64 = 0.1;
/// λ/μ above which a stronger smoother pays: at ν = 0.499 it takes 113 iterations instead of 186. ν = 0.48.
const NEARLY_INCOMPRESSIBLE: f64 = 24.0;
/// Ratio of the stiffest to the softest tissue up to which sixteen bits describe both.
const SINGLE_CONTRAST: f64 = 1e4;

/// Results kept between the solves of one plan, whose constraints differ only a little.
#[derive(Default)]
pub(crate) struct SolveMemory {
    /// Displacements of the rows; none before the first solve, unless an approximation is known.
    pub rows: Vec<[f64; 3]>,
    /// What the solves have revealed of the spectrum.
    seen: Spectrum,
    /// The trial under the first constraints, once it was run.
    trial: OnceLock<Trial>,
    /// Reference length of the tolerance, mm; none before the first solve.
    reach: Option<f64>,
}

impl SolveMemory {
    /// A trail that starts at the given displacements of the rows, or without any.
    pub fn starting(rows: Vec<[f64; 3]>) -> Self {
        Self { rows, ..Self::default() }
    }

    /// Forgets the last solution, and keeps what is known of the matrix under the same constraints.
    pub fn begin_again(&mut self) {
        self.rows.clear();
        self.reach = None;
    }
}

/// What a solve under contact conditions may leave for the next one.
#[derive(Clone, Copy)]
pub(crate) struct KeptForNext<'a> {
    /// How far springs of negative stiffness may carry any node, mm.
    pub reach: f64,
    /// The accuracy that suffices; none for the tolerance itself.
    pub enough: Option<StepAccuracy>,
    /// Springs between rows.
    pub links: &'a [Link],
}

/// Response of the rows to contact conditions.
pub(crate) struct Advance {
    /// Displacements, mm.
    pub rows: Vec<[f64; 3]>,
    /// Whether they are within the tolerance.
    pub solved: bool,
    /// Whether springs would have carried nodes without limit.
    pub is_carried: bool,
}

/// A system without a factorisation: the matrix and a multigrid hierarchy for it.
pub(crate) struct Iterative {
    /// The matrix without constraints.
    pub matrix: BlockMatrix,
    /// Its hierarchy, or that of a system with a similar matrix.
    pub multigrid: Arc<Multigrid>,
    /// Whether sweeps solve the system, and the hierarchy only measures their error.
    sweeps: bool,
    /// Estimated error over the length of the motion.
    tolerance: f64,
    max_iterations: Option<usize>,
    /// Whether estimates need a trial whatever the spectrum shows.
    pub doubtful: bool,
    /// The trial of the system without constraints, once there is one.
    trial: OnceLock<Trial>,
}

impl Iterative {
    /// The system of `matrix`, to be solved by `method`, with a multigrid hierarchy for it or for a similar matrix.
    ///
    /// `tissue`: contrast and compressibility of the tissue.
    pub fn new(
        matrix: BlockMatrix,
        multigrid: Arc<Multigrid>,
        tissue: Extremes,
        method: Method,
        options: &StaticOptions,
    ) -> Self {
        Self {
            matrix,
            multigrid,
            sweeps: method.sweeps(),
            tolerance: options.tolerance,
            max_iterations: options.max_iterations,
            doubtful: is_doubtful(tissue.contrast),
            trial: OnceLock::new(),
        }
    }

    /// Conjugate gradients with `a` and a preconditioner, whose trial is cached in `trial`.
    fn confirmed<'a>(
        &'a self,
        (a, preconditioner): (&'a dyn Operator, &'a dyn Preconditioner),
        trial: &'a OnceLock<Trial>,
        interrupted: Interrupt<'a>,
    ) -> Confirmed<'a> {
        Confirmed {
            a,
            preconditioner,
            trial,
            doubtful: self.doubtful,
            relative: self.tolerance,
            interrupted,
        }
    }

    /// Bytes of the hierarchy.
    pub fn bytes(&self) -> usize {
        self.multigrid.memory_bytes()
    }

    /// A⁻¹ b.
    pub fn solve(&self, b: &[[f64; 3]], solve: &mut PlanSolve<'_>) -> Result<Vec<[f64; 3]>> {
        if is_zero(b) {
            return Ok(vec![[0.0; 3]; b.len()]);
        }
        let begun = StartedPreconditioner::new(&self.multigrid, b);
        let tolerance = self.tolerance * begun.reach(solve.scale);
        if self.sweeps {
            let found = self.relax_to_bound(&self.matrix, b, tolerance, solve)?;
            self.check_worth(&found, solve)?;
            return Ok(found);
        }
        let confirmed = self.confirmed((&self.matrix, &begun), &self.trial, solve.interrupted);
        let found = self.solution(&confirmed, b, tolerance)?;
        solve.error_estimate = found.error_estimate_mm;
        solve.add(found.residual_history);
        self.check_worth(&found.solution, solve)?;
        Ok(found.solution)
    }

    /// Refuses a solution whose estimated error is not small beside the motion itself.
    ///
    /// The length of the tolerance is known before the solution: one cycle guesses it, and at contrasts near the
    /// limit of f64 it may guess far more than anything moves.
    pub fn check_worth(&self, solution: &[[f64; 3]], solve: &PlanSolve<'_>) -> Result<()> {
        let length = solution.iter().fold(solve.scale, |m, v| m.max(norm(*v)));
        let (value, limit) = (solve.error_estimate, WORTH.max(self.tolerance) * length);
        if value <= limit {
            return Ok(());
        }
        Err(MtmError::NotConverged {
            method: if self.sweeps { "relaxation" } else { "pcg" },
            iterations: solve.iterations,
            shortfall: Shortfall::new("the estimated error of a node", value, limit, " mm"),
            advice: "the material contrast is too large for f64: check the moduli, or use \
                     method=\"cholesky\"",
        })
    }

    /// A⁻¹ b with an error of `allowed`, mm, or of the tolerance times the distance that one cycle moves the
    /// rows, if that is more, and the number of iterations: a step of Newton's method.
    pub fn step(
        &self,
        b: &[[f64; 3]],
        allowed: f64,
        interrupted: Interrupt<'_>,
    ) -> Result<(Vec<[f64; 3]>, usize)> {
        let begun = StartedPreconditioner::new(&self.multigrid, b);
        let far = begun.reach(0.0);
        if far == 0.0 {
            return Ok((vec![[0.0; 3]; b.len()], 0));
        }
        let tolerance = allowed.max(self.tolerance * far);
        let found = if self.doubtful {
            let confirmed = Confirmed {
                relative: tolerance / far,
                ..self.confirmed((&self.matrix, &begun), &self.trial, interrupted)
            };
            self.solution(&confirmed, b, tolerance)?
        } else {
            // Tets squeezed since the hierarchy was set up widen the spectrum: that is no sign of a slow motion.
            let start = vec![[0.0; 3]; b.len()];
            let problem = Problem { a: &self.matrix, b, preconditioner: &begun, interrupted };
            let options = self.options(tolerance);
            pcg_near(&problem, &start, &options, None, &mut Spectrum::default())?.into_outcome()?
        };
        Ok((found.solution, found.iterations))
    }

    /// The solution for `b` by `confirmed`, starting from rest.
    fn solution(
        &self,
        confirmed: &Confirmed<'_>,
        b: &[[f64; 3]],
        tolerance: f64,
    ) -> Result<PcgOutcome> {
        let start = vec![[0.0; 3]; b.len()];
        let seen = &mut Spectrum::default();
        confirmed.solve(b, &start, &self.options(tolerance), None, seen)?.into_outcome()
    }

    /// Components across the normals of w in P A P w = `b`, with springs.
    ///
    /// `b`: see [`projected_rhs`](crate::algebra::constraints::projected_rhs), including the forces of the
    /// springs. `leave`: how far springs may carry rows, and the accuracy that suffices if coarser than the
    /// tolerance; see [`pcg_near`].
    ///
    /// If springs drive nodes by more than the body can resist, the springs responsible are left out, and the
    /// solution is extended downhill, to the reach of the springs, along the unstable direction.
    pub fn solve_projected(
        &self,
        mut b: Vec<[f64; 3]>,
        conditions: RowConditions,
        leave: KeptForNext<'_>,
        trail: &mut SolveMemory,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Advance> {
        if is_zero(&b) {
            let rows = vec![[0.0; 3]; b.len()];
            return Ok(Advance { rows, solved: true, is_carried: false });
        }
        let length = *trail.reach.get_or_insert_with(|| {
            StartedPreconditioner::new(&self.multigrid, &b).reach(solve.scale)
        });
        let length = conditions.constraints.iter().fold(length, |m, c| m.max(c.offset.abs()));
        let tolerance = (self.tolerance * length).max(solve.allowed);
        if self.sweeps {
            let system = conditions.applied_to(&self.matrix);
            let rows = self.relax_to_bound(&system, &b, tolerance, solve)?;
            return Ok(Advance { rows, solved: true, is_carried: false });
        }
        let RowConditions { constraints, mut springs } = conditions;
        let links = leave.links;
        let mut start = trail.rows.clone();
        start.resize(b.len(), [0.0; 3]);
        for k in &constraints {
            start[k.row] = sub(start[k.row], scaled(k.normal, dot(k.normal, start[k.row])));
        }
        let options = self.options(tolerance);
        let multigrid = solve.multigrid.clone().unwrap_or_else(|| self.multigrid.clone());
        let mut unheld = Vec::new();
        let mut left_out = Vec::new();
        let (found, solved) = loop {
            let product =
                ProjectedProduct::new(&self.matrix, &constraints, &springs).with_links(links);
            let confirmed =
                self.confirmed((&product, &*multigrid), &trail.trial, solve.interrupted);
            match confirmed.solve(&b, &start, &options, leave.enough, &mut trail.seen)? {
                Reached::Solution(found) => break (found, true),
                Reached::Step(found) => break (found, false),
                Reached::Indefinite(met) => {
                    let out = at_fault(&self.matrix, &mut springs, &met.direction);
                    if out.is_empty() || leave.reach.is_infinite() {
                        return Err(met.error);
                    }
                    for (row, s) in &out {
                        b[*row] = sub(b[*row], scaled(s.axis, s.stiffness * s.goal));
                    }
                    left_out.extend(out);
                    solve.add(met.residual_history);
                    start = met.solution;
                    unheld.push(met.direction);
                }
            }
        };
        solve.error_estimate = found.error_estimate_mm;
        solve.add(found.residual_history);
        let mut rows = found.solution;
        let mut is_carried = false;
        if !unheld.is_empty() {
            for (row, s) in &left_out {
                b[*row] = add(b[*row], scaled(s.axis, s.stiffness * s.goal));
            }
            springs.extend(left_out);
            let product =
                ProjectedProduct::new(&self.matrix, &constraints, &springs).with_links(links);
            is_carried = carry_on(&product, &b, &unheld, leave.reach, &mut rows);
        }
        Ok(Advance { rows, solved, is_carried })
    }

    /// Rows from `start` on under `conditions` and `links` that only push, until `share` of the first residual is
    /// left. If springs make the body unstable, those of negative stiffness are left out.
    pub fn press(
        &self,
        b: &[[f64; 3]],
        conditions: RowConditions,
        (links, share): (&[Link], f64),
        start: Vec<[f64; 3]>,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Advance> {
        let RowConditions { constraints, mut springs } = conditions;
        let mut rows = start;
        rows.resize(b.len(), [0.0; 3]);
        add_offsets(&mut rows, &constraints);
        let multigrid = solve.multigrid.clone().unwrap_or_else(|| self.multigrid.clone());
        loop {
            if (solve.interrupted)() {
                return Err(MtmError::Interrupted);
            }
            let product = ProjectedProduct::new(&self.matrix, &constraints, &springs);
            let mut forces = self.matrix.multiply(&rows);
            for (f, b) in forces.iter_mut().zip(b) {
                *f = sub(*b, *f);
            }
            for (row, s) in &springs {
                let pull = s.stiffness * (s.goal - dot(s.axis, rows[*row]));
                forces[*row] = add(forces[*row], scaled(s.axis, pull));
            }
            product.project(&mut forces);
            let pressed = Pressed { a: &product, preconditioner: &*multigrid, links };
            let found = pressed.solve(rows, forces, (share, MOST_PRESSED));
            solve.add(found.history);
            rows = found.x;
            if !found.is_indefinite || springs.iter().all(|(_, s)| s.stiffness >= 0.0) {
                return Ok(Advance { rows, solved: true, is_carried: false });
            }
            springs.retain(|(_, s)| s.stiffness >= 0.0);
        }
    }

    fn options(&self, tolerance: f64) -> PcgOptions {
        let defaults = PcgOptions::default();
        let max_iterations = self.max_iterations.unwrap_or(defaults.max_iterations);
        PcgOptions { tolerance, max_iterations, ..defaults }
    }

    /// Sweeps until the error itself is within `tolerance`, mm.
    ///
    /// The length of the sweeps' steps does not show the error: if a stiff body is attached to soft tissue, the
    /// steps become tiny long before the body has moved all the way. Each time the steps suggest that the
    /// sweeps are done, the remaining error A⁻¹ (b − A x) is therefore solved for by conjugate gradients; it is
    /// only measured, not added to the solution.
    fn relax_to_bound(
        &self,
        matrix: &BlockMatrix,
        b: &[[f64; 3]],
        tolerance: f64,
        solve: &mut PlanSolve<'_>,
    ) -> Result<Vec<[f64; 3]>> {
        let most = self.max_iterations.unwrap_or(MAX_SWEEPS);
        let (mut x, mut goal, mut sweeps) = (vec![[0.0; 3]; b.len()], tolerance, 0);
        loop {
            let found = relax(matrix, b, &x, (goal, most - sweeps), solve.interrupted)
                .map_err(|e| gave_up(e, most))?;
            (x, sweeps) = (found.solution, sweeps + found.steps.len());
            solve.add(found.steps);
            let rest: Vec<[f64; 3]> =
                b.iter().zip(matrix.multiply(&x)).map(|(&b, f)| sub(b, f)).collect();
            let options = PcgOptions {
                tolerance: MEASURED_SHARE * tolerance,
                energy_tolerance: MEASURED_SHARE,
                ..PcgOptions::default()
            };
            let start = vec![[0.0; 3]; b.len()];
            let trial = OnceLock::new();
            let confirmed = self.confirmed((matrix, &*self.multigrid), &trial, solve.interrupted);
            let left = Confirmed { relative: MEASURED_SHARE, ..confirmed }
                .solve(&rest, &start, &options, None, &mut Spectrum::default())
                .and_then(Reached::into_outcome)
                .map_err(|e| gave_up(e, sweeps))?;
            let largest = left.solution.iter().fold(0.0_f64, |m, e| m.max(norm(*e)));
            let error = largest + left.error_estimate_mm;
            if error <= tolerance {
                solve.error_estimate = error;
                return Ok(x);
            }
            if sweeps >= most {
                let quantity = "the measured error of a node";
                let shortfall = Shortfall::new(quantity, error, tolerance, " mm");
                return Err(not_swept(most, shortfall));
            }
            goal *= (0.5 * tolerance / error).min(0.5);
        }
    }
}

/// The preconditioner of a system whose first cycle has been run: conjugate gradients that start from rest begin
/// with the same one.
struct StartedPreconditioner<'a> {
    multigrid: &'a Multigrid,
    b: &'a [[f64; 3]],
    /// The cycle applied to `b`, mm.
    first: Vec<[f64; 3]>,
}

impl<'a> StartedPreconditioner<'a> {
    fn new(multigrid: &'a Multigrid, b: &'a [[f64; 3]]) -> Self {
        let mut first = vec![[0.0; 3]; b.len()];
        multigrid.apply(b, &mut first);
        Self { multigrid, b, first }
    }

    /// Reference length of the tolerance, mm, at least `scale`. Loads move the body even where bone does not: one
    /// cycle gives the order of magnitude of that motion.
    fn reach(&self, scale: f64) -> f64 {
        self.first.iter().fold(scale, |m, v| m.max(norm(*v)))
    }
}

impl Preconditioner for StartedPreconditioner<'_> {
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]) {
        if r == self.b {
            z.copy_from_slice(&self.first);
        } else {
            self.multigrid.apply(r, z);
        }
    }
}

/// The hierarchy for `matrix`, whose rows at `positions` are held along `normals`, for tissue with these
/// extremes.
pub(crate) fn hierarchy(
    matrix: &BlockMatrix,
    positions: &[[f64; 3]],
    normals: &[(usize, [f64; 3])],
    tissue: Extremes,
) -> Result<Multigrid> {
    let defaults = MultigridOptions::default();
    let compressible = tissue.lame_ratio < NEARLY_INCOMPRESSIBLE;
    let options = MultigridOptions {
        smoother_degree: if compressible { 1 } else { 2 } * defaults.smoother_degree,
        precision: if compressible && tissue.contrast <= SINGLE_CONTRAST {
            CyclePrecision::Single
        } else {
            CyclePrecision::Double
        },
        ..defaults
    };
    Multigrid::new(matrix, positions, normals, &options)
}

/// Extreme material ratios of a tissue.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Extremes {
    /// Largest λ/μ.
    pub lame_ratio: f64,
    /// Stiffest over softest.
    pub contrast: f64,
}

impl Extremes {
    /// Those of `tissue`.
    pub fn of(tissue: &Tissue) -> Self {
        Self { lame_ratio: tissue.largest_lame_ratio(), contrast: tissue.contrast() }
    }
}

/// The error for sweeps that ended before the error was within the tolerance.
fn not_swept(iterations: usize, shortfall: Shortfall) -> MtmError {
    MtmError::NotConverged { method: "relaxation", iterations, shortfall, advice: NO_SWEEPS }
}

/// An error of a relaxation step, in terms of the caller's tolerance.
fn gave_up(error: MtmError, sweeps: usize) -> MtmError {
    match error {
        MtmError::NotConverged { shortfall, .. } => not_swept(sweeps, shortfall),
        other => other,
    }
}

/// Whether there is no load at all: any iteration would divide by its norm.
fn is_zero(b: &[[f64; 3]]) -> bool {
    b.iter().flatten().all(|&v| v == 0.0)
}
