//! How far an iterate of conjugate gradients is from the solution, and when it is near enough.
//!
//! The coefficients of the iteration define a Lanczos matrix of the preconditioned system. Its smallest
//! eigenvalue (Ritz value) turns a residual into an estimate of the error. The estimate is not a bound: Ritz
//! values lie above the spectrum, and a slow motion that is hardly present in the residual affects them late.

/// Fraction of the smallest Ritz value taken as the lower end of the spectrum (Ritz values approach it from
/// above).
const RITZ_SAFETY: f64 = 0.5;
/// Ratio of the extreme Ritz values up to which that fraction is used; above it, the fraction decreases with
/// the square root of the ratio. Soft tissue with muscles has 6 to 8.
const RITZ_SPREAD: f64 = 10.0;
/// Ratio of the extreme Ritz values above which an estimate is not trusted without a trial.
const DOUBTFUL_SPREAD: f64 = 40.0;
/// Multiple of a trial's largest error over preconditioned residual that is taken as that of any solution.
const TRIAL_AMPLIFICATION: f64 = 4.0;
/// Relative change of the smallest Ritz value, over the last [`RITZ_WINDOW`] of all iterations, below
/// which it counts as resolved.
const RITZ_SETTLED: f64 = 0.1;
/// Exponent applied to the decrease of the smallest Ritz value over that window to enlarge the estimates if it
/// is not resolved: the value may decrease by the same factor several more times.
const RITZ_DOUBT: i32 = 4;
/// Share of all iterations over which the smallest Ritz value must remain constant. A share, not a number: with
/// a weak preconditioner it stays on plateaus for a long time before the slowest motion appears.
const RITZ_WINDOW: f64 = 0.3;
/// Minimum number of iterations over which it must remain constant.
const RITZ_WINDOW_MIN: usize = 3;
/// Minimum number of iterations without any decrease of the estimated error that counts as stagnation; the
/// block-Jacobi method may need hundreds before the first decrease.
pub(crate) const STAGNATION_ITERATIONS: usize = 500;
/// How often the iteration may restart from the true residual.
const MAX_RESTARTS: usize = 5;
/// The error at a restart must be below this share of the error at the previous one; otherwise the round-off
/// floor is reached.
pub(crate) const FLOOR_PROGRESS: f64 = 0.5;
/// Relative energy `√(rᵀz / r₀ᵀz₀)` at which only round-off is left.
const ROUND_OFF: f64 = 1e-15;
/// Bisection steps for an extreme eigenvalue of a tridiagonal matrix.
const BISECTIONS: usize = 40;
/// Relative change of an extreme eigenvalue that is ignored.
const EXTREME_CHANGE: f64 = 1e-6;
/// Smallest ratio of extreme eigenvalues that the bisection can resolve.
const SPECTRUM_RANGE: f64 = 1e-14;

/// When [`pcg`](crate::algebra::krylov::pcg) stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PcgOptions {
    /// Largest estimated error of a node, mm; for example 1e-9 of the largest prescribed displacement.
    pub tolerance: f64,
    /// Estimated error in the energy norm, relative to the energy norm of the solution.
    pub energy_tolerance: f64,
    /// Maximum number of iterations.
    pub max_iterations: usize,
    /// Iterations before which no estimate is trusted: the smallest Ritz value must be resolved first.
    pub min_iterations: usize,
    /// Multiple of both tolerances still accepted once round-off stops all further progress.
    pub slack: f64,
}

impl Default for PcgOptions {
    fn default() -> Self {
        Self {
            tolerance: 1e-8,
            energy_tolerance: 1e-6,
            max_iterations: 5000,
            min_iterations: 6,
            slack: 10.0,
        }
    }
}

impl PcgOptions {
    /// The larger of the two estimates over their tolerances; infinite if not a number.
    pub(crate) fn excess(&self, error_mm: f64, energy_error: f64) -> f64 {
        let excess = (error_mm / self.tolerance).max(energy_error / self.energy_tolerance);
        if excess.is_nan() { f64::INFINITY } else { excess }
    }
}

/// When the true residual is computed, and what follows from it.
#[derive(Debug)]
pub(crate) struct StoppingRule<'a> {
    options: &'a PcgOptions,
    /// rᵀz at the start.
    first_rz: f64,
    /// The lowest estimate since the last restart, mm, and its iteration.
    best: (f64, usize),
    /// Excess of the true residual at the last restart.
    verified: f64,
    restarts: usize,
}

/// Why the true residual has to be computed.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Due {
    /// Factor by which the estimates are enlarged: one if the spectrum is resolved, see [`Spectrum::doubt`].
    pub(crate) doubt: f64,
    /// Whether the maximum number of iterations is reached.
    pub(crate) exhausted: bool,
}

/// Consequence of the true residual.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Verdict {
    /// The iterate is the solution.
    Converged,
    /// The iteration continues from the true residual.
    Restart,
    /// Further iterations do not help, or none is left.
    GiveUp,
}

impl<'a> StoppingRule<'a> {
    pub(crate) fn new(options: &'a PcgOptions, first_rz: f64) -> Self {
        Self { options, first_rz, best: (f64::INFINITY, 0), verified: f64::INFINITY, restarts: 0 }
    }

    /// The reason, if there is one, to compute the true residual after so many iterations.
    ///
    /// `error_mm`: the estimate from the recurrence. `excess`: see [`PcgOptions::excess`]; evaluated only if
    /// all other conditions are met.
    pub(crate) fn due(
        &mut self,
        iterations: usize,
        rz: f64,
        spectrum: &Spectrum,
        error_mm: f64,
        excess: impl FnOnce() -> f64,
    ) -> Option<Due> {
        let floor = rz <= ROUND_OFF * ROUND_OFF * self.first_rz;
        let shown = spectrum.recent.len() >= self.options.min_iterations;
        let doubt = match (floor, shown) {
            (true, _) => 1.0,
            (false, true) => spectrum.doubt(),
            (false, false) => f64::INFINITY,
        };
        if error_mm < self.best.0 {
            self.best = (error_mm, iterations);
        }
        let stagnant = iterations - self.best.1 >= STAGNATION_ITERATIONS.max(iterations / 2);
        let exhausted = iterations >= self.options.max_iterations;
        let met = doubt * error_mm <= self.options.tolerance && doubt * excess() <= 1.0;
        (met || floor || stagnant || exhausted).then_some(Due { doubt, exhausted })
    }

    /// The consequence of the estimates that are based on the true residual.
    pub(crate) fn verdict(
        &mut self,
        due: Due,
        iterations: usize,
        error_mm: f64,
        excess: f64,
    ) -> Verdict {
        // Two restarts in a row from the same true residual: round-off prevents any further decrease.
        let at_floor = self.restarts >= MAX_RESTARTS || excess > FLOOR_PROGRESS * self.verified;
        let allowed = if at_floor && !due.exhausted { self.options.slack } else { 1.0 };
        if due.doubt * excess <= allowed {
            return Verdict::Converged;
        }
        if due.exhausted || at_floor {
            return Verdict::GiveUp;
        }
        self.restarts += 1;
        self.verified = excess;
        self.best = (error_mm, iterations);
        Verdict::Restart
    }
}

/// The Lanczos matrix of `M⁻¹ A` defined by the coefficients of the iteration.
///
/// It may be kept after a solution, for the next system if that differs little.
#[derive(Debug, Default, Clone)]
pub(crate) struct Spectrum {
    alphas: Vec<f64>,
    betas: Vec<f64>,
    diagonal: Vec<f64>,
    off_squared: Vec<f64>,
    /// Smallest Ritz value over all restarts.
    pub(crate) smallest: f64,
    /// Largest Ritz value over all restarts.
    pub(crate) largest: f64,
    /// Extreme Ritz values since the last restart.
    extremes: Option<[f64; 2]>,
    recent: Vec<f64>,
    /// Largest error over preconditioned residual observed in a trial, both in the largest norm of a node; 0
    /// without a trial.
    amplification: f64,
}

impl Spectrum {
    /// Discards the matrix when the search directions are reset, but not the values seen.
    pub(crate) fn restart(&mut self) {
        self.alphas.clear();
        self.betas.clear();
        self.diagonal.clear();
        self.off_squared.clear();
        self.extremes = None;
    }

    /// Records that the error of a known solution was `ratio` times its preconditioned residual.
    pub(crate) fn amplified(&mut self, ratio: f64) {
        self.amplification = self.amplification.max(ratio);
    }

    /// Adopts the result of a trial with the same operator.
    pub(crate) fn learn(&mut self, trial: &Self) {
        if self.amplification >= trial.amplification && self.smallest <= trial.smallest {
            return;
        }
        if self.recent.len() < trial.recent.len() {
            self.recent.clone_from(&trial.recent);
        }
        self.amplified(trial.amplification);
        if trial.smallest > 0.0 {
            let own = if self.smallest > 0.0 { self.smallest } else { f64::INFINITY };
            self.smallest = own.min(trial.smallest);
        }
        self.largest = self.largest.max(trial.largest);
    }

    /// Whether the spectrum is so wide that a slow motion may remain undetected.
    pub(crate) fn is_wide(&self) -> bool {
        self.spread() > DOUBTFUL_SPREAD
    }

    /// Largest Ritz value over the smallest; 1 before the first iteration.
    fn spread(&self) -> f64 {
        if self.smallest > 0.0 { self.largest / self.smallest } else { 1.0 }
    }

    /// T has 1/α_k + β_{k−1}/α_{k−1} on the diagonal and √β_k/α_k next to it.
    pub(crate) fn push(&mut self, alpha: f64, beta: f64) {
        let k = self.alphas.len();
        if k == 0 {
            self.diagonal.push(1.0 / alpha);
        } else {
            let (a, b) = (self.alphas[k - 1], self.betas[k - 1]);
            self.diagonal.push(1.0 / alpha + b / a);
            self.off_squared.push(b / (a * a));
        }
        self.alphas.push(alpha);
        self.betas.push(beta);
        let [low, high] =
            extremes_after(self.extremes, &self.diagonal, &self.off_squared, EXTREME_CHANGE);
        self.extremes = Some([low, high]);
        self.smallest = if self.smallest > 0.0 { self.smallest.min(low) } else { low };
        self.largest = self.largest.max(high);
        self.recent.push(self.smallest);
    }

    /// Factor by which the estimates are in doubt: one if the smallest Ritz value has converged, a power of its
    /// recent decrease if it has not, infinite if too little is known.
    pub(crate) fn doubt(&self) -> f64 {
        let window = RITZ_WINDOW_MIN.max((RITZ_WINDOW * self.recent.len() as f64) as usize);
        let Some(before) = self.recent.len().checked_sub(window + 1) else {
            return f64::INFINITY;
        };
        let fall = self.recent[before] / self.smallest;
        if fall <= 1.0 + RITZ_SETTLED { 1.0 } else { fall.powi(RITZ_DOUBT) }
    }

    /// A lower end of the spectrum, as far as it is known.
    fn lower_end(&self) -> f64 {
        let safety =
            RITZ_SAFETY * (RITZ_SPREAD / self.spread().min(DOUBTFUL_SPREAD)).sqrt().min(1.0);
        if self.smallest > 0.0 { safety * self.smallest } else { RITZ_SAFETY }
    }

    /// Estimated largest error of a node: e = A⁻¹ r = (M⁻¹A)⁻¹ z.
    ///
    /// `largest_z`: largest row norm of z, mm.
    pub(crate) fn error_mm(&self, largest_z: f64) -> f64 {
        largest_z * (1.0 / self.lower_end()).max(TRIAL_AMPLIFICATION * self.amplification)
    }

    /// Estimate of the error in the energy norm, relative to that of the solution.
    ///
    /// `rz`: rᵀz. `energy`: ‖x‖_A² of the solution, N mm.
    pub(crate) fn energy_error(&self, rz: f64, energy: f64) -> f64 {
        let error = rz * self.radau_factor();
        if error == 0.0 { 0.0 } else { (error / energy).sqrt() }
    }

    /// Gauss–Radau factor γ with ‖e_k‖_A² ≤ γ r_kᵀz_k (Meurant & Tichý 2013, eq. 3.8):
    /// γ_0 = 1/μ, γ_{k+1} = (γ_k − α_k) / (μ (γ_k − α_k) + β_k), never above the plain bound 1/μ.
    fn radau_factor(&self) -> f64 {
        let mu = self.lower_end();
        let mut gamma = 1.0 / mu;
        for (&alpha, &beta) in self.alphas.iter().zip(&self.betas) {
            let rest = gamma - alpha;
            if rest <= 0.0 {
                return 1.0 / mu;
            }
            gamma = rest / (mu * rest + beta);
        }
        gamma.min(1.0 / mu)
    }
}

/// Smallest and largest eigenvalues of a positive definite tridiagonal matrix by bisection on Sturm counts.
///
/// `off_squared`: squares of the off-diagonal entries, one fewer than `diagonal`.
pub fn tridiagonal_extremes(diagonal: &[f64], off_squared: &[f64]) -> [f64; 2] {
    extremes_after(None, diagonal, off_squared, 0.0)
}

/// [`tridiagonal_extremes`] of a matrix that grew by one row since its extremes were `before`: they have moved
/// further apart (Cauchy's interlacing), mostly by less than the relative `change` that is ignored.
fn extremes_after(
    before: Option<[f64; 2]>,
    diagonal: &[f64],
    off_squared: &[f64],
    change: f64,
) -> [f64; 2] {
    let n = diagonal.len();
    let mut bounds = [f64::INFINITY, f64::NEG_INFINITY];
    for i in 0..n {
        let radius = if i > 0 { off_squared[i - 1].sqrt() } else { 0.0 }
            + if i + 1 < n { off_squared[i].sqrt() } else { 0.0 };
        bounds[0] = bounds[0].min(diagonal[i] - radius);
        bounds[1] = bounds[1].max(diagonal[i] + radius);
    }
    bounds[0] = bounds[0].max(SPECTRUM_RANGE * bounds[1]);
    let below = |shift: f64| {
        let mut count = 0;
        let mut pivot = 1.0;
        for i in 0..n {
            let coupling = if i > 0 { off_squared[i - 1] / pivot } else { 0.0 };
            pivot = diagonal[i] - shift - coupling;
            if pivot == 0.0 {
                pivot = -f64::EPSILON * (diagonal[i].abs() + shift.abs()).max(f64::MIN_POSITIVE);
            }
            if pivot < 0.0 {
                count += 1;
            }
        }
        count
    };
    let bisect = |wanted: usize| {
        let [mut low, mut high] = bounds;
        for _ in 0..BISECTIONS {
            // The smallest value can be far below the largest: halve the bracket in the logarithm.
            let middle = (low * high).sqrt();
            if below(middle) >= wanted { high = middle } else { low = middle }
        }
        0.5 * (low + high)
    };
    let Some([low, high]) = before else { return [bisect(1), bisect(n)] };
    let same_low = below(low * (1.0 - change)) == 0;
    let same_high = below(high * (1.0 + change)) == n;
    [if same_low { low } else { bisect(1) }, if same_high { high } else { bisect(n) }]
}
