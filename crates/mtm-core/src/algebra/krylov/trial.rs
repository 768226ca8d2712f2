//! Conjugate gradients on a system whose solution is known.

use crate::algebra::error_bound::{FLOOR_PROGRESS, STAGNATION_ITERATIONS, Spectrum};
use crate::algebra::row_sums::{farthest, in_pool};
use crate::error::{MtmError, Result};

use super::operator::{Operator, Preconditioner};
use super::state::State;

/// Decrease of the error of a trial after which its true residual is computed again.
const TRIAL_FALL: f64 = 0.1;

/// Growth of the number of iterations of a trial after which it is computed at the latest.
const TRIAL_PAUSE: f64 = 1.3;

/// True rᵀz over that of the recurrence above which the recurrence has drifted: the round-off floor.
const DRIFT: f64 = 4.0;

/// Result of conjugate gradients on a system whose solution is known.
#[derive(Debug, Clone)]
pub(crate) struct Trial {
    /// The spectrum, and the relation between errors and residuals.
    pub seen: Spectrum,
    /// Largest nodal error that was reached, relative to the largest displacement.
    pub error: f64,
    pub iterations: usize,
}

/// How accurately conjugate gradients can solve with `a`: a system with a known solution, on which errors are
/// measured instead of estimated.
///
/// In the known field every node moves independently, so that it contains a share of each slow motion, while
/// the residual contains almost none. `goal`: error relative to the largest displacement at which the trial
/// ends; it also ends if rounding prevents a further decrease of the error, and after `max_iterations`.
pub(crate) fn trial(
    a: &dyn Operator,
    preconditioner: &dyn Preconditioner,
    goal: f64,
    max_iterations: usize,
    interrupted: &(dyn Fn() -> bool + Sync),
) -> Result<Trial> {
    let zeros = vec![[0.0; 3]; a.n_rows()];
    let known = known_field(a);
    let (size, mut seen) = (farthest(&known, &zeros), Spectrum::default());
    if size == 0.0 {
        return Ok(Trial { seen, error: 0.0, iterations: 0 });
    }
    let mut b = zeros.clone();
    a.multiply_into(&known, &mut b);
    let mut state = State::new(a, &b, &zeros, preconditioner, &mut seen);
    in_pool(|| state.replace_residual());
    state.restart();
    let (mut best, mut best_at) = (1.0_f64, 0);
    let (mut looked, mut looked_at, mut restarted) = (1.0_f64, 0_usize, f64::INFINITY);
    for iteration in 1..=max_iterations {
        if interrupted() {
            return Err(MtmError::Interrupted);
        }
        if state.rz == 0.0 {
            break;
        }
        in_pool(|| state.step())?;
        let error = farthest(&state.x, &known) / size;
        if error < best {
            (best, best_at) = (error, iteration);
        }
        let stagnant = iteration - best_at >= STAGNATION_ITERATIONS.max(iteration / 2);
        let last = error <= goal || stagnant || iteration == max_iterations;
        let due =
            error <= TRIAL_FALL * looked || iteration as f64 >= TRIAL_PAUSE * looked_at as f64;
        if !(last || due) {
            continue;
        }
        (looked, looked_at) = (error.min(looked), iteration);
        let (rz, largest_z) = in_pool(|| state.true_residual());
        if largest_z > 0.0 {
            state.spectrum.amplified(error * size / largest_z);
        }
        if last {
            break;
        }
        if rz > DRIFT * state.rz {
            if error > FLOOR_PROGRESS * restarted {
                break;
            }
            restarted = error;
            in_pool(|| state.replace_residual());
            state.restart();
        }
    }
    let iterations = state.iterations();
    Ok(Trial { seen, error: best, iterations })
}

/// A field in which every node moves independently.
fn known_field(a: &dyn Operator) -> Vec<[f64; 3]> {
    let wave = |j: usize, i: usize| 1.0 + 0.5 * ((3 * j + i) as f64 * 0.7).sin();
    let mut known: Vec<[f64; 3]> = (0..a.n_rows()).map(|j| [0, 1, 2].map(|i| wave(j, i))).collect();
    a.project(&mut known);
    known
}
