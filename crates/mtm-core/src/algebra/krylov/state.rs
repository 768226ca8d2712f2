//! The vectors and coefficients of the iteration, and one step of it.

use rayon::prelude::*;

use crate::algebra::error_bound::{Due, PcgOptions, Spectrum};
use crate::algebra::row_sums::{ROWS_PER_SUM, advance, dot, dot_and_largest};
use crate::error::{MtmError, Result, Shortfall};

use super::operator::{Operator, Preconditioner};

/// The solution of `pcg` and its accuracy.
#[derive(Debug, Clone, PartialEq)]
pub struct PcgOutcome {
    /// The solution, one row of three per block row, mm.
    pub solution: Vec<[f64; 3]>,
    /// Iterations done, over all restarts.
    pub iterations: usize,
    /// Estimate of the largest nodal error, mm: `max_j |z_j| / θ_min` with the true residual, `θ_min` half the
    /// smallest Ritz value of `M⁻¹ A`. Not a bound: Ritz values lie above the spectrum.
    pub error_estimate_mm: f64,
    /// Estimate of the error in the energy norm, relative to the energy norm of the solution.
    pub energy_error: f64,
    /// `‖b − A x‖ / ‖b‖`, recomputed at the end. Of little meaning at high contrast.
    pub residual: f64,
    /// Relative residual after each iteration, from the recurrence.
    pub residual_history: Vec<f64>,
    /// Smallest and largest Ritz values of `M⁻¹ A` observed: their ratio is the condition number of the
    /// preconditioned system.
    pub ritz: [f64; 2],
}

/// The end of an iteration at a direction that does not count as constrained.
pub(crate) struct Indefinite {
    /// The solution reached so far.
    pub solution: Vec<[f64; 3]>,
    pub direction: Vec<[f64; 3]>,
    /// The error to report if an indefinite matrix was not expected.
    pub error: MtmError,
    pub residual_history: Vec<f64>,
}

/// The vectors and coefficients of the iteration.
pub(super) struct State<'a> {
    pub(super) a: &'a dyn Operator,
    pub(super) b: &'a [[f64; 3]],
    pub(super) preconditioner: &'a dyn Preconditioner,
    pub(super) x: Vec<[f64; 3]>,
    pub(super) r: Vec<[f64; 3]>,
    pub(super) z: Vec<[f64; 3]>,
    pub(super) p: Vec<[f64; 3]>,
    pub(super) q: Vec<[f64; 3]>,
    pub(super) rz: f64,
    pub(super) r_norm: f64,
    pub(super) largest_z: f64,
    pub(super) spectrum: &'a mut Spectrum,
    b_norm: f64,
    /// Relative residual after each iteration, from the recurrence.
    pub(super) history: Vec<f64>,
}

impl<'a> State<'a> {
    pub(super) fn new(
        a: &'a dyn Operator,
        b: &'a [[f64; 3]],
        x0: &[[f64; 3]],
        preconditioner: &'a dyn Preconditioner,
        spectrum: &'a mut Spectrum,
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
            spectrum,
            b_norm: dot(b, b).sqrt(),
            history: Vec::new(),
        }
    }

    /// Iterations so far.
    pub(super) fn iterations(&self) -> usize {
        self.history.len()
    }

    /// Recomputes `r = b − A x` and `z = M⁻¹ r`.
    pub(super) fn replace_residual(&mut self) {
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
        self.precondition();
        (self.rz, self.largest_z) = dot_and_largest(&self.r, &self.z);
    }

    /// rᵀz and the largest row of z for the true residual, without changing the iteration.
    pub(super) fn true_residual(&mut self) -> (f64, f64) {
        let (r, z) = (self.r.clone(), self.z.clone());
        let (rz, r_norm, largest_z) = (self.rz, self.r_norm, self.largest_z);
        self.replace_residual();
        let found = (self.rz, self.largest_z);
        (self.r, self.z) = (r, z);
        (self.rz, self.r_norm, self.largest_z) = (rz, r_norm, largest_z);
        found
    }

    /// z = P M⁻¹ P r, P the projection of the operator: the rounding errors outside the subspace may make up
    /// all of a small residual, and the operator is undefined there.
    pub(super) fn precondition(&mut self) {
        self.a.project(&mut self.r);
        self.preconditioner.apply(&self.r, &mut self.z);
        self.a.project(&mut self.z);
    }

    /// `doubt`: see [`Spectrum::doubt`].
    pub(super) fn outcome(self, doubt: f64) -> PcgOutcome {
        PcgOutcome {
            error_estimate_mm: doubt * self.error_mm(),
            energy_error: doubt * self.energy_error(),
            residual: self.r_norm / self.b_norm,
            ritz: [self.spectrum.smallest, self.spectrum.largest],
            solution: self.x,
            iterations: self.history.len(),
            residual_history: self.history,
        }
    }

    /// The end at a direction that does not count as constrained.
    pub(super) fn indefinite(self, error: MtmError) -> Indefinite {
        let Self { x: solution, p: direction, history: residual_history, .. } = self;
        Indefinite { solution, direction, error, residual_history }
    }

    /// Discards the search directions: the next step follows z alone.
    pub(super) fn restart(&mut self) {
        self.p.copy_from_slice(&self.z);
        self.spectrum.restart();
    }

    /// One iteration; returns the decrease of the squared error in the energy norm, N mm.
    pub(super) fn step(&mut self) -> Result<f64> {
        let pq = self.a.multiply_and_dot(&self.p, &mut self.q);
        let is_held = pq > self.a.least_curvature(&self.p);
        if !(is_held && self.rz > 0.0 && pq.is_finite() && self.rz.is_finite()) {
            return Err(self.breakdown(pq));
        }
        let alpha = self.rz / pq;
        self.r_norm = advance(alpha, &self.p, &self.q, &mut self.x, &mut self.r).sqrt();
        self.precondition();
        let (rz, largest_z) = dot_and_largest(&self.r, &self.z);
        if !(rz >= 0.0 && rz.is_finite() && self.r_norm.is_finite() && largest_z.is_finite()) {
            return Err(self.breakdown(pq));
        }
        let (taken, beta) = (alpha * self.rz, rz / self.rz);
        self.rz = rz;
        self.largest_z = largest_z;
        self.spectrum.push(alpha, beta);
        self.history.push(self.r_norm / self.b_norm);
        let z = &self.z;
        self.p.par_chunks_mut(ROWS_PER_SUM).zip(z.par_chunks(ROWS_PER_SUM)).for_each(|(p, z)| {
            for (p, z) in p.iter_mut().zip(z) {
                *p = [z[0] + beta * p[0], z[1] + beta * p[1], z[2] + beta * p[2]];
            }
        });
        Ok(taken)
    }

    /// Whether the last step broke down at a direction of negative curvature, with finite numbers.
    pub(super) fn is_indefinite(&self) -> bool {
        let finite = |v: &Vec<[f64; 3]>| v.iter().flatten().all(|x| x.is_finite());
        self.rz > 0.0
            && self.rz.is_finite()
            && finite(&self.p)
            && finite(&self.q)
            && dot(&self.p, &self.q) <= self.a.least_curvature(&self.p)
    }

    pub(super) fn breakdown(&self, pq: f64) -> MtmError {
        let node = (0..self.r.len())
            .find(|&j| !self.q[j].iter().chain(&self.z[j]).all(|v| v.is_finite()))
            .unwrap_or(0);
        let rz = self.rz;
        let why = format!(
            "conjugate gradients met pᵀAp = {pq:.3e} and rᵀM⁻¹r = {rz:.3e}; check whether a part is not constrained"
        );
        MtmError::not_definite(node, why)
    }

    /// What kept the iteration from converging: of the three conditions, the one furthest from being met.
    pub(super) fn not_converged(&self, due: Due, options: &PcgOptions) -> MtmError {
        let (error, energy) = (due.doubt * self.error_mm(), due.doubt * self.energy_error());
        let by_energy = energy / options.energy_tolerance > error / options.tolerance;
        let shortfall = if by_energy {
            Shortfall::new(
                "the estimated error of the energy",
                energy,
                options.energy_tolerance,
                " of the whole",
            )
        } else {
            Shortfall::new("the estimated error of a node", error, options.tolerance, " mm")
        };
        let advice = if due.exhausted {
            "allow more iterations (max_iterations) or a larger tolerance, or use method=\"cholesky\""
        } else {
            "rounding prevents a smaller error: use method=\"cholesky\", or allow a larger tolerance"
        };
        MtmError::NotConverged { method: "pcg", iterations: self.iterations(), shortfall, advice }
    }

    /// See [`Spectrum::error_mm`].
    pub(super) fn error_mm(&self) -> f64 {
        self.spectrum.error_mm(self.largest_z)
    }

    /// See [`Spectrum::energy_error`]. `‖x‖_A² = bᵀx + (error terms of second order)`.
    pub(super) fn energy_error(&self) -> f64 {
        self.spectrum.energy_error(self.rz, dot(self.b, &self.x).abs())
    }

    /// See [`PcgOptions::excess`].
    pub(super) fn excess(&self, options: &PcgOptions) -> f64 {
        options.excess(self.error_mm(), self.energy_error())
    }
}
