//! The mass-tensor iteration of the literature: each node in turn moves to the position where its own forces
//! balance.
//!
//! u_j ← u_j − ω K_jj⁻¹ f_j with f_j = K_jj u_j + Σ_k K_jk u_k − b_j (Cotin et al. 2000; Mollemans et al.
//! 2007), which is block Gauss–Seidel with over-relaxation ω. Kept for comparison: the number of sweeps
//! grows with the mesh and the material contrast.

use nalgebra::Matrix3;

use crate::algebra::blocks::{Block, BlockMatrix};
use crate::error::{MtmError, Result, Shortfall};

/// Number of sweeps over which the contraction of the steps is measured.
const WINDOW: usize = 20;
/// The contraction is taken as at most 1 − this, so that the bound stays finite.
const LEAST_PROGRESS: f64 = 1e-9;

/// Over-relaxation ω, 0 < ω < 2; 1 is the plain iteration.
const FACTOR: f64 = 1.6;

/// Remedy reported if sweeps do not converge.
pub const NO_SWEEPS: &str =
    "use method=\"cholesky\" or \"pcg\"; node-wise relaxation is kept for comparison";

/// Outcome of the iteration.
#[derive(Debug, Clone)]
pub struct RelaxationOutcome {
    /// The solution, mm.
    pub solution: Vec<[f64; 3]>,
    /// Largest step of each sweep, mm.
    pub steps: Vec<f64>,
}

/// Solves A x = b from `start`, until the estimate of the largest nodal error is within `tolerance`, mm.
///
/// # Errors
/// A diagonal block that is not positive definite, no convergence within the sweeps, interruption.
pub fn relax(
    a: &BlockMatrix,
    b: &[[f64; 3]],
    start: &[[f64; 3]],
    (tolerance, max_sweeps): (f64, usize),
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Result<RelaxationOutcome> {
    let inverse = (0..a.n_rows()).map(|j| inverse_block(a, j)).collect::<Result<Vec<Block>>>()?;
    let mut x = start.to_vec();
    let (mut steps, mut bound) = (Vec::new(), f64::INFINITY);
    for sweep in 1..=max_sweeps {
        if interrupted() {
            return Err(MtmError::Interrupted);
        }
        let mut step = 0.0_f64;
        for j in 0..x.len() {
            let f = a.row_product(j, &x);
            let r = [b[j][0] - f[0], b[j][1] - f[1], b[j][2] - f[2]];
            let m = &inverse[j];
            for i in 0..3 {
                let d = m[3 * i] * r[0] + m[3 * i + 1] * r[1] + m[3 * i + 2] * r[2];
                x[j][i] += FACTOR * d;
                step = step.max(d.abs());
            }
        }
        steps.push(step);
        if !step.is_finite() {
            let why = "the relaxation diverged: the stiffness is indefinite";
            return Err(MtmError::not_definite(0, why));
        }
        if step == 0.0 {
            bound = 0.0;
        } else if sweep > WINDOW {
            // ρ/(1−ρ) times the last step, with ρ the measured contraction. Not a bound: a slow mode that has
            // hardly moved yet has no effect on the steps.
            let ratio = step / steps[sweep - 1 - WINDOW];
            let contraction = ratio.powf(1.0 / WINDOW as f64).min(1.0 - LEAST_PROGRESS);
            bound = FACTOR * step * contraction / (1.0 - contraction);
        }
        if bound <= tolerance {
            return Ok(RelaxationOutcome { solution: x, steps });
        }
    }
    Err(MtmError::NotConverged {
        method: "relaxation",
        iterations: max_sweeps,
        shortfall: Shortfall::new("the estimated error of a node", bound, tolerance, " mm"),
        advice: NO_SWEEPS,
    })
}

/// K_jj⁻¹.
fn inverse_block(a: &BlockMatrix, j: usize) -> Result<Block> {
    let block = Matrix3::from_row_slice(a.diagonal_block(j));
    let why = "its vertex tensor is not positive definite";
    let m = block.cholesky().ok_or_else(|| MtmError::not_definite(j, why))?.inverse();
    Ok(std::array::from_fn(|i| m[(i / 3, i % 3)]))
}
