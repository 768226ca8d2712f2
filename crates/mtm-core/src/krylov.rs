//! Preconditioned conjugate gradients that stop on a bound of the error, not on the residual.
//!
//! At a material contrast of 1e6 a relative residual of 1e-6 can leave centimetres of error: a stiff
//! muscle dominates the norm while the fat beside it is still wrong. The iteration here ends when
//! both the error in millimetres and the error in energy are bounded, and both are checked once more
//! with the true residual `b − A x` before a solution is handed out.

use rayon::prelude::*;

use crate::blocks::{Block, BlockMatrix};
use crate::error::{ErrorKind, MtmError, Result, check_finite_rows};

/// Rows in one partial sum: fixed, so that a dot product has the same bits for any thread count.
const ROWS_PER_SUM: usize = 1024;
/// Fraction of the smallest Ritz value taken as a lower bound of the spectrum (Ritz values approach
/// it from above).
const RITZ_SAFETY: f64 = 0.5;
/// Relative change of the smallest Ritz value, over the last [`RITZ_WINDOW`] of all iterations, below
/// which it counts as resolved.
const RITZ_SETTLED: f64 = 0.1;
/// Share of all iterations over which the smallest Ritz value must stay put. A share, not a number: a
/// weak preconditioner lets it rest on plateaus for long before the slowest motion shows.
const RITZ_WINDOW: f64 = 0.3;
/// Fewest iterations over which it must.
const RITZ_WINDOW_MIN: usize = 3;
/// Fewest iterations without any decrease of the error bound that count as stagnation; the block-Jacobi
/// method may need hundreds before the bound first falls.
const STAGNATION_ITERATIONS: usize = 500;
/// How often the iteration may restart from the true residual.
const MAX_REPLACEMENTS: usize = 5;
/// Share of the last true bound that a restart must get below, or the round-off floor is reached.
const FLOOR_PROGRESS: f64 = 0.5;
/// Relative energy `√(rᵀz / r₀ᵀz₀)` at which nothing but round-off is left.
const ROUND_OFF: f64 = 1e-15;
/// Bisection steps for an extreme eigenvalue of a tridiagonal matrix.
const BISECTIONS: usize = 40;
/// Smallest ratio of extreme eigenvalues that the bisection looks for.
const SPECTRUM_RANGE: f64 = 1e-14;

/// A symmetric positive definite approximation of `A⁻¹`.
pub trait Preconditioner: Sync {
    /// Writes `z = M⁻¹ r`.
    ///
    /// `r`, `z`: one row of three per block row. The bits of `z` must not depend on the threads.
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]);
}

/// The inverse diagonal blocks as a preconditioner: for tiny systems and for comparison.
#[derive(Debug, Clone)]
pub struct BlockJacobi {
    inverses: Vec<Block>,
}

impl BlockJacobi {
    /// The inverted diagonal blocks of `a`.
    ///
    /// # Errors
    /// [`MtmError::NotPositiveDefinite`] with the first row whose diagonal block is not.
    pub fn new(a: &BlockMatrix) -> Result<Self> {
        let inverses = (0..a.n_rows())
            .map(|j| {
                let b = a.diagonal_block(j);
                let m = nalgebra::Matrix3::from_row_slice(b);
                let inverse = nalgebra::Cholesky::new(m).map(|c| c.inverse()).ok_or_else(|| {
                    MtmError::NotPositiveDefinite {
                        node: j,
                        detail: format!("its diagonal block {b:?} is not positive definite"),
                    }
                })?;
                let mut out = [0.0; 9];
                out.copy_from_slice(inverse.as_slice());
                Ok(out)
            })
            .collect::<Result<_>>()?;
        Ok(Self { inverses })
    }
}

impl Preconditioner for BlockJacobi {
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]) {
        z.par_chunks_mut(ROWS_PER_SUM)
            .zip(r.par_chunks(ROWS_PER_SUM).zip(self.inverses.par_chunks(ROWS_PER_SUM)))
            .for_each(|(z, (r, inverses))| {
                for ((z, r), m) in z.iter_mut().zip(r).zip(inverses) {
                    for i in 0..3 {
                        z[i] = m[3 * i] * r[0] + m[3 * i + 1] * r[1] + m[3 * i + 2] * r[2];
                    }
                }
            });
    }
}

/// When [`pcg`] stops.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PcgOptions {
    /// Largest error of a node, mm; for example 1e-9 of the largest prescribed displacement.
    pub tolerance: f64,
    /// Error in the energy norm, relative to the energy norm of the solution.
    pub energy_tolerance: f64,
    /// Iterations after which the method gives up.
    pub max_iterations: usize,
    /// Iterations before which no bound is believed: the smallest Ritz value must be resolved first.
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

/// The solution of [`pcg`] and how good it is.
#[derive(Debug, Clone, PartialEq)]
pub struct PcgOutcome {
    /// The solution, one row of three per block row, mm.
    pub solution: Vec<[f64; 3]>,
    /// Iterations done, over all restarts.
    pub iterations: usize,
    /// Estimated bound of the largest nodal error, mm: `max_j |z_j| / θ_min` with the true residual,
    /// `θ_min` half the smallest Ritz value of `M⁻¹ A`.
    pub error_bound_mm: f64,
    /// Upper bound of the error in the energy norm, relative to the energy norm of the solution.
    pub energy_error: f64,
    /// `‖b − A x‖ / ‖b‖`, computed afresh. Says little at high contrast.
    pub residual: f64,
    /// Relative residual after each iteration, as the recurrence carries it.
    pub residual_history: Vec<f64>,
    /// Smallest and largest Ritz values of `M⁻¹ A` seen: their ratio is the condition number that
    /// the preconditioner left.
    pub ritz: [f64; 2],
}

/// Solves `A x = b` by preconditioned conjugate gradients (Hestenes & Stiefel 1952).
///
/// `b`, `x0`: one row of three per block row, N and mm. `interrupted` is asked once per iteration, on
/// the calling thread. The bits of the result do not depend on the number of threads.
///
/// Stops when `max_j |z_j| / θ_min ≤ tolerance` and when the Gauss–Radau bound of the energy error
/// (Meurant & Tichý 2013, with the smallest Ritz value less a safety margin as lower end of the
/// spectrum) is within `energy_tolerance`; both must then hold for the true residual as well.
///
/// # Errors
/// [`MtmError::Length`] and [`MtmError::NotFinite`] for input that does not fit,
/// [`MtmError::NotPositiveDefinite`] for a breakdown, [`MtmError::NotConverged`] and
/// [`MtmError::Interrupted`].
pub fn pcg(
    a: &BlockMatrix,
    b: &[[f64; 3]],
    x0: &[[f64; 3]],
    preconditioner: &dyn Preconditioner,
    options: &PcgOptions,
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Result<PcgOutcome> {
    let n = a.n_rows();
    for (what, rows) in [("right-hand side", b), ("start vector", x0)] {
        if rows.len() != n {
            return Err(MtmError::Length {
                what: what.to_owned(),
                found: rows.len(),
                expected: n,
                why: "one row per block row of the matrix",
                kind: ErrorKind::Solver,
            });
        }
        check_finite_rows(what, rows, ErrorKind::Solver)?;
    }
    let b_norm = dot(b, b).sqrt();
    if b_norm == 0.0 {
        return Ok(PcgOutcome {
            solution: vec![[0.0; 3]; n],
            iterations: 0,
            error_bound_mm: 0.0,
            energy_error: 0.0,
            residual: 0.0,
            residual_history: Vec::new(),
            ritz: [1.0; 2],
        });
    }

    let mut state = State::new(a, b, x0, preconditioner);
    in_pool(|| state.replace_residual());
    state.restart();
    let first_rz = state.rz;
    let mut iterations = 0;
    let mut history = Vec::new();
    let mut replacements = 0;
    let mut verified = f64::INFINITY;
    let mut best = (f64::INFINITY, 0);
    loop {
        if interrupted() {
            return Err(MtmError::Interrupted);
        }
        let exact = state.rz == 0.0 && state.largest_z == 0.0;
        if !exact {
            in_pool(|| state.step())?;
            iterations += 1;
            history.push(state.r_norm / b_norm);
        }

        let floor = state.rz <= ROUND_OFF * ROUND_OFF * first_rz;
        let resolved = floor || (iterations >= options.min_iterations && state.spectrum.settled());
        let bound = state.error_mm();
        if bound < best.0 {
            best = (bound, iterations);
        }
        let stagnant = iterations - best.1 >= STAGNATION_ITERATIONS.max(iterations / 2);
        let exhausted = iterations >= options.max_iterations;
        let met = resolved && bound <= options.tolerance && state.excess(options) <= 1.0;
        if !(met || floor || stagnant || exhausted) {
            continue;
        }

        // The recurrence drifts from b − A x at the round-off floor: only the true residual counts.
        in_pool(|| state.replace_residual());
        let excess = state.excess(options);
        // Two restarts in a row from the same true residual: round-off lets it go no lower.
        let at_floor = replacements >= MAX_REPLACEMENTS || excess > FLOOR_PROGRESS * verified;
        let allowed = if at_floor && !exhausted { options.slack } else { 1.0 };
        if resolved && excess <= allowed {
            return Ok(PcgOutcome {
                error_bound_mm: state.error_mm(),
                energy_error: state.energy_error(),
                residual: state.r_norm / b_norm,
                ritz: [state.spectrum.smallest, state.spectrum.largest],
                solution: state.x,
                iterations,
                residual_history: history,
            });
        }
        if exhausted || at_floor {
            return Err(MtmError::NotConverged {
                method: "pcg",
                iterations,
                error: state.error_mm(),
                tolerance: options.tolerance,
                advice: "use the Cholesky method, or allow a larger tolerance",
            });
        }
        state.restart();
        replacements += 1;
        verified = excess;
        best = (state.error_mm(), iterations);
    }
}

/// The vectors and coefficients of the iteration.
struct State<'a> {
    a: &'a BlockMatrix,
    b: &'a [[f64; 3]],
    preconditioner: &'a dyn Preconditioner,
    x: Vec<[f64; 3]>,
    r: Vec<[f64; 3]>,
    z: Vec<[f64; 3]>,
    p: Vec<[f64; 3]>,
    q: Vec<[f64; 3]>,
    rz: f64,
    r_norm: f64,
    largest_z: f64,
    spectrum: Spectrum,
}

impl<'a> State<'a> {
    fn new(
        a: &'a BlockMatrix,
        b: &'a [[f64; 3]],
        x0: &[[f64; 3]],
        preconditioner: &'a dyn Preconditioner,
    ) -> Self {
        let zeros = vec![[0.0; 3]; b.len()];
        Self {
            a,
            b,
            preconditioner,
            x: x0.to_vec(),
            r: zeros.clone(),
            z: zeros.clone(),
            p: zeros.clone(),
            q: zeros,
            rz: 0.0,
            r_norm: 0.0,
            largest_z: 0.0,
            spectrum: Spectrum::default(),
        }
    }

    /// Recomputes `r = b − A x` and `z = M⁻¹ r`.
    fn replace_residual(&mut self) {
        self.a.multiply_into(&self.x, &mut self.q);
        let (b, q) = (self.b, &self.q);
        self.r.par_chunks_mut(ROWS_PER_SUM).enumerate().for_each(|(chunk, r)| {
            let first = chunk * ROWS_PER_SUM;
            for (offset, r) in r.iter_mut().enumerate() {
                let j = first + offset;
                *r = [b[j][0] - q[j][0], b[j][1] - q[j][1], b[j][2] - q[j][2]];
            }
        });
        self.r_norm = dot(&self.r, &self.r).sqrt();
        self.preconditioner.apply(&self.r, &mut self.z);
        (self.rz, self.largest_z) = dot_and_largest(&self.r, &self.z);
    }

    /// Forgets the search directions: the next step follows z alone.
    fn restart(&mut self) {
        self.p.copy_from_slice(&self.z);
        self.spectrum.restart();
    }

    /// One iteration.
    fn step(&mut self) -> Result<()> {
        let pq = multiply_and_dot(self.a, &self.p, &mut self.q);
        if !(pq > 0.0 && self.rz > 0.0 && pq.is_finite() && self.rz.is_finite()) {
            return Err(self.breakdown(pq));
        }
        let alpha = self.rz / pq;
        self.r_norm = advance(alpha, &self.p, &self.q, &mut self.x, &mut self.r).sqrt();
        self.preconditioner.apply(&self.r, &mut self.z);
        let (rz, largest_z) = dot_and_largest(&self.r, &self.z);
        if !(rz >= 0.0 && rz.is_finite() && self.r_norm.is_finite() && largest_z.is_finite()) {
            return Err(self.breakdown(pq));
        }
        let beta = rz / self.rz;
        self.rz = rz;
        self.largest_z = largest_z;
        self.spectrum.push(alpha, beta);
        let z = &self.z;
        self.p.par_chunks_mut(ROWS_PER_SUM).zip(z.par_chunks(ROWS_PER_SUM)).for_each(|(p, z)| {
            for (p, z) in p.iter_mut().zip(z) {
                *p = [z[0] + beta * p[0], z[1] + beta * p[1], z[2] + beta * p[2]];
            }
        });
        Ok(())
    }

    fn breakdown(&self, pq: f64) -> MtmError {
        let node = (0..self.r.len())
            .find(|&j| !self.q[j].iter().chain(&self.z[j]).all(|v| v.is_finite()))
            .unwrap_or(0);
        MtmError::NotPositiveDefinite {
            node,
            detail: format!(
                "conjugate gradients met pᵀAp = {pq:.3e} and rᵀM⁻¹r = {:.3e}; is a part not held?",
                self.rz
            ),
        }
    }

    /// Estimated largest nodal error: e = A⁻¹ r = (M⁻¹A)⁻¹ z.
    fn error_mm(&self) -> f64 {
        self.largest_z / self.spectrum.lower_end()
    }

    /// Bound of the relative energy error. `‖x‖_A² = bᵀx + (error terms of second order)`.
    fn energy_error(&self) -> f64 {
        let energy = dot(self.b, &self.x).abs();
        let error = self.rz * self.spectrum.radau_factor();
        if error == 0.0 { 0.0 } else { (error / energy).sqrt() }
    }

    /// The bounds over their tolerances, the larger of the two; infinite if not a number.
    fn excess(&self, options: &PcgOptions) -> f64 {
        let excess = (self.error_mm() / options.tolerance)
            .max(self.energy_error() / options.energy_tolerance);
        if excess.is_nan() { f64::INFINITY } else { excess }
    }
}

/// The Lanczos matrix of `M⁻¹ A` that the coefficients of the iteration spell out.
#[derive(Debug, Default)]
struct Spectrum {
    alphas: Vec<f64>,
    betas: Vec<f64>,
    diagonal: Vec<f64>,
    off_squared: Vec<f64>,
    /// Smallest Ritz value, the lowest over all restarts.
    smallest: f64,
    /// Largest Ritz value over all restarts.
    largest: f64,
    recent: Vec<f64>,
}

impl Spectrum {
    fn restart(&mut self) {
        self.alphas.clear();
        self.betas.clear();
        self.diagonal.clear();
        self.off_squared.clear();
    }

    /// T has 1/α_k + β_{k−1}/α_{k−1} on the diagonal and √β_k/α_k beside it.
    fn push(&mut self, alpha: f64, beta: f64) {
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
        let [low, high] = tridiagonal_extremes(&self.diagonal, &self.off_squared);
        self.smallest = if self.smallest > 0.0 { self.smallest.min(low) } else { low };
        self.largest = self.largest.max(high);
        self.recent.push(self.smallest);
    }

    fn settled(&self) -> bool {
        let window = RITZ_WINDOW_MIN.max((RITZ_WINDOW * self.recent.len() as f64) as usize);
        match self.recent.len().checked_sub(window + 1) {
            None => false,
            Some(before) => self.recent[before] <= (1.0 + RITZ_SETTLED) * self.smallest,
        }
    }

    fn lower_end(&self) -> f64 {
        if self.smallest > 0.0 { RITZ_SAFETY * self.smallest } else { RITZ_SAFETY }
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
/// `off_squared`: squares of the entries beside the diagonal, one fewer than `diagonal`.
pub(crate) fn tridiagonal_extremes(diagonal: &[f64], off_squared: &[f64]) -> [f64; 2] {
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
    [bisect(1), bisect(n)]
}

/// Runs `f` on a thread of the pool, so that the parallel loops inside start without a hand-over.
pub(crate) fn in_pool<R: Send>(f: impl FnOnce() -> R + Send) -> R {
    rayon::scope(|_| f())
}

/// `xᵀy`, summed in fixed chunks.
pub(crate) fn dot<const N: usize>(x: &[[f64; N]], y: &[[f64; N]]) -> f64 {
    let partial: Vec<f64> = x
        .par_chunks(ROWS_PER_SUM)
        .zip(y.par_chunks(ROWS_PER_SUM))
        .map(|(x, y)| chunk_dot(x, y))
        .collect();
    partial.iter().sum()
}

fn chunk_dot<const N: usize>(x: &[[f64; N]], y: &[[f64; N]]) -> f64 {
    let mut sums = [0.0; N];
    for (x, y) in x.iter().zip(y) {
        for i in 0..N {
            sums[i] += x[i] * y[i];
        }
    }
    sums.iter().sum()
}

/// `rᵀz` and the largest Euclidean row norm of `z`.
fn dot_and_largest(r: &[[f64; 3]], z: &[[f64; 3]]) -> (f64, f64) {
    let partial: Vec<(f64, f64)> = r
        .par_chunks(ROWS_PER_SUM)
        .zip(z.par_chunks(ROWS_PER_SUM))
        .map(|(r, z)| {
            let largest = z.iter().fold(0.0, |m: f64, z| {
                let square = z[0] * z[0] + z[1] * z[1] + z[2] * z[2];
                if square > m || square.is_nan() { square } else { m }
            });
            (chunk_dot(r, z), largest)
        })
        .collect();
    let sum = partial.iter().map(|p| p.0).sum();
    let largest =
        partial.iter().fold(0.0, |m: f64, p| if p.1 > m || p.1.is_nan() { p.1 } else { m });
    (sum, largest.sqrt())
}

/// `q = A p` and `pᵀq` in one sweep.
fn multiply_and_dot(a: &BlockMatrix, p: &[[f64; 3]], q: &mut [[f64; 3]]) -> f64 {
    let partial: Vec<f64> = q
        .par_chunks_mut(ROWS_PER_SUM)
        .enumerate()
        .map(|(chunk, q)| {
            let first = chunk * ROWS_PER_SUM;
            for (offset, out) in q.iter_mut().enumerate() {
                *out = a.row_product(first + offset, p);
            }
            chunk_dot(&p[first..first + q.len()], q)
        })
        .collect();
    partial.iter().sum()
}

/// `x += α p`, `r −= α q`; returns `rᵀr`.
fn advance(
    alpha: f64,
    p: &[[f64; 3]],
    q: &[[f64; 3]],
    x: &mut [[f64; 3]],
    r: &mut [[f64; 3]],
) -> f64 {
    let partial: Vec<f64> = x
        .par_chunks_mut(ROWS_PER_SUM)
        .zip(r.par_chunks_mut(ROWS_PER_SUM))
        .zip(p.par_chunks(ROWS_PER_SUM).zip(q.par_chunks(ROWS_PER_SUM)))
        .map(|((x, r), (p, q))| {
            for (((x, r), p), q) in x.iter_mut().zip(r.iter_mut()).zip(p).zip(q) {
                for i in 0..3 {
                    x[i] += alpha * p[i];
                    r[i] -= alpha * q[i];
                }
            }
            chunk_dot(r, r)
        })
        .collect();
    partial.iter().sum()
}

/// Small elastic systems for the tests of the iterative methods.
#[cfg(test)]
#[allow(clippy::unwrap_used)]
pub(crate) mod test_systems {
    use std::collections::BTreeMap;

    use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

    use crate::blocks::BlockMatrix;

    /// A reduced elastic system.
    pub(crate) struct System {
        pub(crate) a: BlockMatrix,
        pub(crate) b: Vec<[f64; 3]>,
        pub(crate) nodes: Vec<[f64; 3]>,
        pub(crate) normals: Vec<(usize, [f64; 3])>,
    }

    /// What to build: a box of cubes of 1 mm, six tets each, held at z = 0 and pulled at the top.
    #[derive(Clone, Copy)]
    pub(crate) struct BoxCase {
        pub(crate) cells: [usize; 3],
        /// Stiffness of two inclusions (one afloat, one held) over that of the rest.
        pub(crate) contrast: f64,
        pub(crate) nu: f64,
        /// Whether the nodes at x = 0 slide on a tilted plane.
        pub(crate) sliding: bool,
        /// Copies of the box far apart.
        pub(crate) islands: usize,
    }

    impl Default for BoxCase {
        fn default() -> Self {
            Self { cells: [6, 5, 6], contrast: 263.0, nu: 0.46, sliding: false, islands: 1 }
        }
    }

    const YOUNG: f64 = 0.003;
    const NORMAL: [f64; 3] = [0.8, 0.6, 0.0];

    pub(crate) fn block_matrix(rows: &[BTreeMap<usize, Matrix3<f64>>]) -> BlockMatrix {
        let mut a = BlockMatrix {
            row_start: vec![0],
            columns: Vec::new(),
            blocks: Vec::new(),
            diagonal: Vec::new(),
        };
        for (i, row) in rows.iter().enumerate() {
            for (&j, block) in row {
                if i == j {
                    a.diagonal.push(a.blocks.len());
                }
                a.columns.push(u32::try_from(j).unwrap());
                let mut flat = [0.0; 9];
                flat.copy_from_slice(block.transpose().as_slice());
                a.blocks.push(flat);
            }
            a.row_start.push(a.blocks.len());
        }
        a
    }

    pub(crate) fn elastic_box(case: BoxCase) -> System {
        let [nx, ny, nz] = case.cells;
        let per_island = (nx + 1) * (ny + 1) * (nz + 1);
        let id = |i: usize, j: usize, k: usize| (i * (ny + 1) + j) * (nz + 1) + k;
        let mut nodes = vec![Vector3::zeros(); per_island * case.islands];
        let mut tets = Vec::new();
        for island in 0..case.islands {
            let offset = island * per_island;
            for i in 0..=nx {
                for j in 0..=ny {
                    for k in 0..=nz {
                        nodes[offset + id(i, j, k)] =
                            Vector3::new(i as f64 + 1000.0 * island as f64, j as f64, k as f64);
                    }
                }
            }
            for i in 0..nx {
                for j in 0..ny {
                    for k in 0..nz {
                        for path in
                            [[0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]]
                        {
                            let mut at = [i, j, k];
                            let mut tet = [offset + id(i, j, k); 4];
                            for (corner, axis) in path.into_iter().enumerate() {
                                at[axis] += 1;
                                tet[corner + 1] = offset + id(at[0], at[1], at[2]);
                            }
                            let afloat = i > 0 && i < 3 && j > 0 && j < 3 && k > 1 && k < 4;
                            let held = i > 3 && j > 2 && k < 3;
                            tets.push((tet, afloat || held));
                        }
                    }
                }
            }
        }
        let mut full = vec![BTreeMap::<usize, Matrix3<f64>>::new(); nodes.len()];
        for (tet, stiff) in tets {
            let young = if stiff { YOUNG * case.contrast } else { YOUNG };
            let mu = young / (2.0 * (1.0 + case.nu));
            let lambda = young * case.nu / ((1.0 + case.nu) * (1.0 - 2.0 * case.nu));
            let x = tet.map(|n| nodes[n]);
            let edges = Matrix3::from_columns(&[x[1] - x[0], x[2] - x[0], x[3] - x[0]]);
            let volume = edges.determinant().abs() / 6.0;
            let inverse = edges.try_inverse().unwrap();
            let mut g = [Vector3::zeros(); 4];
            for c in 0..3 {
                g[c + 1] = inverse.row(c).transpose();
                g[0] -= g[c + 1];
            }
            for p in 0..4 {
                for q in 0..4 {
                    let block = (g[p] * g[q].transpose() * lambda
                        + g[q] * g[p].transpose() * mu
                        + Matrix3::identity() * (mu * g[p].dot(&g[q])))
                        * volume;
                    *full[tet[p]].entry(tet[q]).or_insert_with(Matrix3::zeros) += block;
                }
            }
        }
        let free: Vec<usize> = (0..nodes.len()).filter(|&n| nodes[n].z > 0.5).collect();
        let mut row_of = vec![usize::MAX; nodes.len()];
        for (row, &n) in free.iter().enumerate() {
            row_of[n] = row;
        }
        let normal = Vector3::from(NORMAL);
        let slides = |n: usize| case.sliding && nodes[n].x % 1000.0 < 0.5;
        let projector = |n: usize| {
            if slides(n) {
                Matrix3::identity() - normal * normal.transpose()
            } else {
                Matrix3::identity()
            }
        };
        let mut rows = vec![BTreeMap::new(); free.len()];
        let mut b = vec![[0.0; 3]; free.len()];
        for (row, &n) in free.iter().enumerate() {
            for (&m, block) in &full[n] {
                if row_of[m] == usize::MAX {
                    continue;
                }
                let mut projected = projector(n) * block * projector(m);
                if n == m && slides(n) {
                    projected += normal * normal.transpose() * (block.trace() / 3.0);
                }
                rows[row].insert(row_of[m], projected);
            }
            if nodes[n].z > nz as f64 - 0.5 {
                let pull = projector(n) * Vector3::new(3e-4, 1e-4, 5e-4 + 1e-4 * nodes[n].y);
                b[row] = pull.into();
            }
        }
        let normals = free
            .iter()
            .enumerate()
            .filter(|(_, n)| slides(**n))
            .map(|(row, _)| (row, NORMAL))
            .collect();
        System {
            a: block_matrix(&rows),
            b,
            nodes: free.iter().map(|&n| nodes[n].into()).collect(),
            normals,
        }
    }

    /// The solution by a dense Cholesky factor with two steps of iterative refinement.
    pub(crate) fn dense_solution(a: &BlockMatrix, b: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let n = 3 * a.n_rows();
        let mut dense = DMatrix::zeros(n, n);
        for i in 0..a.n_rows() {
            let (columns, blocks) = a.row(i);
            for (&j, block) in columns.iter().zip(blocks) {
                for c in 0..9 {
                    dense[(3 * i + c / 3, 3 * j as usize + c % 3)] = block[c];
                }
            }
        }
        let factor = nalgebra::Cholesky::new(dense).unwrap();
        let mut x = vec![[0.0; 3]; a.n_rows()];
        for _ in 0..3 {
            let ax = a.multiply(&x);
            let r = DVector::from_iterator(
                n,
                b.as_flattened().iter().zip(ax.as_flattened()).map(|(b, y)| b - y),
            );
            let dx = factor.solve(&r);
            for (x, dx) in x.as_flattened_mut().iter_mut().zip(dx.iter()) {
                *x += dx;
            }
        }
        x
    }

    /// Largest distance between rows.
    pub(crate) fn largest_difference(x: &[[f64; 3]], y: &[[f64; 3]]) -> f64 {
        x.iter()
            .zip(y)
            .map(|(x, y)| (Vector3::from(*x) - Vector3::from(*y)).norm())
            .fold(0.0, f64::max)
    }

    /// A vector that looks random and is the same everywhere.
    pub(crate) fn scattered(n: usize, seed: usize) -> Vec<[f64; 3]> {
        (0..n)
            .map(|i| {
                [0, 1, 2].map(|c| {
                    let t =
                        ((3 * i + c + 1) as f64 * (seed as f64 + 0.618_033_988_75)).sin() * 43758.5;
                    t - t.floor() - 0.5
                })
            })
            .collect()
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::test_systems::*;
    use super::*;

    fn solve(s: &System, options: &PcgOptions) -> Result<PcgOutcome> {
        let x0 = vec![[0.0; 3]; s.b.len()];
        pcg(&s.a, &s.b, &x0, &BlockJacobi::new(&s.a)?, options, &|| false)
    }

    #[test]
    fn block_jacobi_reaches_the_dense_solution_within_its_bound() {
        for (contrast, nu) in [(1.0, 0.3), (263.0, 0.46), (1e6, 0.46), (263.0, 0.499)] {
            let s = elastic_box(BoxCase { contrast, nu, ..BoxCase::default() });
            let exact = dense_solution(&s.a, &s.b);
            let size = largest_difference(&exact, &vec![[0.0; 3]; exact.len()]);
            let out =
                solve(&s, &PcgOptions { tolerance: 1e-7 * size, ..Default::default() }).unwrap();
            let error = largest_difference(&out.solution, &exact);
            println!(
                "{contrast:e} {nu} {}: {error:e} {:e}",
                out.iterations,
                out.error_bound_mm / size
            );
            assert!(out.error_bound_mm <= 1e-6 * size);
            assert!(
                error <= out.error_bound_mm + 1e-13 * contrast * size,
                "{contrast} {nu} {error:e}"
            );
        }
    }

    #[test]
    fn energy_bound_holds() {
        let s = elastic_box(BoxCase { contrast: 1e4, ..BoxCase::default() });
        let exact = dense_solution(&s.a, &s.b);
        for tolerance in [1e-1, 1e-2, 1e-3, 1e-4] {
            let options =
                PcgOptions { tolerance: 1e9, energy_tolerance: tolerance, ..Default::default() };
            let out = solve(&s, &options).unwrap();
            let e: Vec<[f64; 3]> = out
                .solution
                .iter()
                .zip(&exact)
                .map(|(x, y)| [x[0] - y[0], x[1] - y[1], x[2] - y[2]])
                .collect();
            let error = (dot(&e, &s.a.multiply(&e)) / dot(&s.b, &exact)).sqrt();
            assert!(error <= out.energy_error, "{error:e} > {:e}", out.energy_error);
            assert!(out.energy_error <= tolerance);
        }
    }

    #[test]
    fn a_start_near_the_solution_saves_iterations() {
        let s = elastic_box(BoxCase { contrast: 10.0, ..BoxCase::default() });
        let exact = dense_solution(&s.a, &s.b);
        let jacobi = BlockJacobi::new(&s.a).unwrap();
        let options = PcgOptions { tolerance: 1e-6, ..Default::default() };
        let out = pcg(&s.a, &s.b, &exact, &jacobi, &options, &|| false).unwrap();
        let cold = solve(&s, &options).unwrap();
        assert!(out.iterations < cold.iterations, "{} {}", out.iterations, cold.iterations);
        assert!(largest_difference(&out.solution, &exact) <= 1e-6);
    }

    #[test]
    fn nothing_to_solve_gives_zero() {
        let s = elastic_box(BoxCase::default());
        let zero = vec![[0.0; 3]; s.b.len()];
        let jacobi = BlockJacobi::new(&s.a).unwrap();
        let out = pcg(&s.a, &zero, &s.b, &jacobi, &PcgOptions::default(), &|| false).unwrap();
        assert_eq!(out.solution, zero);
    }

    #[test]
    fn unreachable_tolerance_is_an_error_and_never_nan() {
        let s = elastic_box(BoxCase::default());
        let options = PcgOptions { tolerance: 1e-40, ..Default::default() };
        assert!(matches!(solve(&s, &options), Err(MtmError::NotConverged { .. })));
        let few = PcgOptions { max_iterations: 3, tolerance: 1e-12, ..Default::default() };
        assert!(matches!(solve(&s, &few), Err(MtmError::NotConverged { .. })));
    }

    #[test]
    fn indefinite_matrix_is_refused() {
        let mut s = elastic_box(BoxCase::default());
        let position = s.a.diagonal[10];
        s.a.blocks[position][0] = 1e-9;
        s.a.blocks[position][4] = 1e-9;
        s.a.blocks[position][8] = 1e-9;
        let outcome = solve(&s, &PcgOptions::default());
        assert!(matches!(outcome, Err(MtmError::NotPositiveDefinite { .. })), "{outcome:?}");
    }

    #[test]
    fn mechanism_never_gives_nan() {
        // Two blocks tied to one another and to nothing else, pulled apart and along.
        let k = nalgebra::Matrix3::identity();
        let a = block_matrix(&[
            [(0, k), (1, -k)].into_iter().collect(),
            [(0, -k), (1, k)].into_iter().collect(),
        ]);
        let b = [[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
        let jacobi = BlockJacobi::new(&a).unwrap();
        let out = pcg(&a, &b, &[[0.0; 3]; 2], &jacobi, &PcgOptions::default(), &|| false);
        assert!(out.is_err(), "{out:?}");
    }

    #[test]
    fn caller_can_stop_it() {
        let s = elastic_box(BoxCase::default());
        let calls = AtomicUsize::new(0);
        let stop = || calls.fetch_add(1, Ordering::Relaxed) >= 4;
        let x0 = vec![[0.0; 3]; s.b.len()];
        let jacobi = BlockJacobi::new(&s.a).unwrap();
        let out = pcg(&s.a, &s.b, &x0, &jacobi, &PcgOptions::default(), &stop);
        assert_eq!(out, Err(MtmError::Interrupted));
    }

    #[test]
    fn extremes_of_a_known_tridiagonal_matrix() {
        // 2 on the diagonal, −1 beside it: eigenvalues 2 − 2 cos(kπ/(n+1)).
        let n = 50;
        let [low, high] = tridiagonal_extremes(&vec![2.0; n], &vec![1.0; n - 1]);
        let angle = std::f64::consts::PI / (n + 1) as f64;
        assert!((low / (2.0 - 2.0 * angle.cos()) - 1.0).abs() < 1e-8);
        assert!((high / (2.0 + 2.0 * angle.cos()) - 1.0).abs() < 1e-8);
    }
}
