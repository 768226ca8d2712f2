//! Anderson acceleration of a fixed-point iteration on points: the next start is the combination of
//! the last few whose residual would be least were the map linear (Anderson 1965; Walker & Ni 2011).

use std::collections::VecDeque;

use nalgebra::{DMatrix, DVector, SymmetricEigen};

use crate::mesh::{add, dot, norm, scaled, sub};

/// Past steps that are combined: more than the slow modes of a dental arch.
const WINDOW: usize = 12;
/// Eigenvalues of the past residuals' Gram matrix below this share of the largest are rounding.
const INDEPENDENT: f64 = 1e-13;
/// Growth of the residual from which the past no longer describes the map.
const GROWTH: f64 = 2.0;

/// Steps within which the residual is to halve; where it does not, steps go unaccelerated until it has:
/// near a rest that is just gone, or unstable, least residual leads nowhere, and the map itself leads on.
const PATIENCE: usize = 5;
/// Most steps that go unaccelerated before another try.
const PAUSE: usize = 24;
/// A point whose steps go on the same way (cosine) and shrink by no more than this is drifting: its
/// stride doubles each time.
const SAME_WAY: f64 = 0.9;
const STEADY_STEP: f64 = 0.7;
const LONGEST_STRIDE: f64 = 16.0;

/// The past of an iteration x → G(x).
pub(crate) struct Anderson {
    last: Option<Step>,
    /// Differences of successive steps.
    past: VecDeque<Step>,
    strides: Vec<f64>,
    /// Residual to halve, steps since it was, and steps left without acceleration.
    best: f64,
    stale: usize,
    paused: usize,
}

struct Step {
    image: Vec<[f64; 3]>,
    residual: Vec<[f64; 3]>,
}

impl Anderson {
    /// An iteration of `n` points without a past.
    pub fn new(n: usize) -> Self {
        Self {
            last: None,
            past: VecDeque::new(),
            strides: vec![1.0; n],
            best: f64::INFINITY,
            stale: 0,
            paused: 0,
        }
    }

    /// Forgets the past: the map has become another.
    pub fn restart(&mut self) {
        self.last = None;
        self.past.clear();
        self.strides.fill(1.0);
        (self.best, self.stale, self.paused) = (f64::INFINITY, 0, 0);
    }

    /// Where to go on from after G took `start` to `image`, no point further than `reach` from its image.
    pub fn next(&mut self, start: &[[f64; 3]], image: &[[f64; 3]], reach: f64) -> Vec<[f64; 3]> {
        let step = Step { image: image.to_vec(), residual: difference(image, start) };
        if self.pauses(inner(&step.residual, &step.residual).sqrt()) {
            return self.stride(step, reach);
        }
        if let Some(last) = self.last.take() {
            if inner(&step.residual, &step.residual)
                > GROWTH * GROWTH * inner(&last.residual, &last.residual)
            {
                self.past.clear();
            } else {
                self.past.push_back(Step {
                    image: difference(&step.image, &last.image),
                    residual: difference(&step.residual, &last.residual),
                });
            }
        }
        if self.past.len() > WINDOW {
            self.past.pop_front();
        }
        let correction = self.correction(&step.residual);
        self.last = Some(step);
        let furthest = correction.iter().fold(0.0_f64, |m, c| m.max(norm(*c)));
        let share = if furthest > reach { reach / furthest } else { 1.0 };
        image.iter().zip(&correction).map(|(&g, &c)| sub(g, scaled(c, share))).collect()
    }

    /// Whether this step goes unaccelerated, given the size of its residual.
    fn pauses(&mut self, size: f64) -> bool {
        if size < 0.5 * self.best {
            (self.best, self.stale) = (size, 0);
            if self.paused > 0 {
                self.restart();
                self.best = size;
            }
            return false;
        }
        if self.paused > 0 {
            self.paused -= 1;
            if self.paused == 0 {
                self.restart();
            }
            return true;
        }
        self.stale += 1;
        if self.stale < PATIENCE {
            return false;
        }
        let best = self.best;
        self.restart();
        (self.best, self.paused) = (best, PAUSE);
        true
    }

    /// The images, those of drifting points carried on along their steps.
    fn stride(&mut self, step: Step, reach: f64) -> Vec<[f64; 3]> {
        if let Some(last) = &self.last {
            for ((stride, &new), &old) in
                self.strides.iter_mut().zip(&step.residual).zip(&last.residual)
            {
                let (long, before) = (norm(new), norm(old));
                let drifts =
                    long >= STEADY_STEP * before && dot(new, old) > SAME_WAY * long * before;
                *stride = if drifts { (2.0 * *stride).min(LONGEST_STRIDE) } else { 1.0 };
            }
        }
        let next = step
            .image
            .iter()
            .zip(step.residual.iter().zip(&self.strides))
            .map(|(&g, (&r, &stride))| {
                let further = (stride - 1.0).min(reach / norm(r).max(f64::MIN_POSITIVE));
                add(g, scaled(r, further))
            })
            .collect();
        self.last = Some(step);
        next
    }

    /// Σ γ_k ΔG_k with γ the least-squares solution of Σ γ_k ΔR_k = R.
    fn correction(&self, residual: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let m = self.past.len();
        let mut out = vec![[0.0; 3]; residual.len()];
        if m == 0 {
            return out;
        }
        // Each difference by its own length: those of late steps are far smaller.
        let scale: Vec<f64> = self
            .past
            .iter()
            .map(|p| 1.0 / inner(&p.residual, &p.residual).sqrt().max(f64::MIN_POSITIVE))
            .collect();
        let gram = DMatrix::from_fn(m, m, |i, j| {
            scale[i] * scale[j] * inner(&self.past[i].residual, &self.past[j].residual)
        });
        let right = DVector::from_fn(m, |i, _| scale[i] * inner(&self.past[i].residual, residual));
        let eigen = SymmetricEigen::new(gram);
        let cut = INDEPENDENT * eigen.eigenvalues.max();
        let mut weights = DVector::zeros(m);
        for k in (0..m).filter(|&k| eigen.eigenvalues[k] > cut) {
            let axis = eigen.eigenvectors.column(k);
            weights += axis * (axis.dot(&right) / eigen.eigenvalues[k]);
        }
        for (k, past) in self.past.iter().enumerate() {
            for (out, &g) in out.iter_mut().zip(&past.image) {
                *out = add(*out, scaled(g, weights[k] * scale[k]));
            }
        }
        out
    }
}

fn difference(a: &[[f64; 3]], b: &[[f64; 3]]) -> Vec<[f64; 3]> {
    a.iter().zip(b).map(|(&a, &b)| sub(a, b)).collect()
}

fn inner(a: &[[f64; 3]], b: &[[f64; 3]]) -> f64 {
    a.iter().zip(b).map(|(a, b)| dot(*a, *b)).sum()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used, clippy::panic)]
    use super::Anderson;

    /// A linear map with k distinct eigenvalues, one beyond −1 where the plain iteration diverges: k + 1
    /// steps find the fixed point.
    #[test]
    fn linear_map_is_solved_in_as_many_steps_as_it_has_rates() {
        let rates = [0.97, 0.9, -1.6, 0.3, -0.5];
        let fixed = [1.0, -2.0, 0.5, 3.0, 0.25];
        let map = |x: &[[f64; 3]]| -> Vec<[f64; 3]> {
            (0..5).map(|i| [fixed[i] + rates[i] * (x[i][0] - fixed[i]), 0.0, 0.0]).collect()
        };
        let mut anderson = Anderson::new(5);
        let mut at = vec![[0.0; 3]; 5];
        for _ in 0..8 {
            at = anderson.next(&at, &map(&at), f64::INFINITY);
        }
        let error = (0..5).map(|i| (at[i][0] - fixed[i]).abs()).fold(0.0, f64::max);
        assert!(error <= 1e-9, "{error:e}");
    }

    /// x' = x + c + a x² has no fixed point for c, a > 0, and hardly moves near 0: least residual stays
    /// there, the pause strides on.
    #[test]
    fn bottleneck_without_a_fixed_point_is_passed() {
        let mut anderson = Anderson::new(1);
        let mut at = -1.0_f64;
        for step in 0..60 {
            let image = at + 1e-3 + 0.1 * at * at;
            at = anderson.next(&[[at, 0.0, 0.0]], &[[image, 0.0, 0.0]], 0.2)[0][0];
            if at > 1.0 {
                assert!(step > 5);
                return;
            }
        }
        panic!("stuck at {at}");
    }

    /// Nothing is carried further than the reach from where the map itself leads.
    #[test]
    fn extrapolation_keeps_within_its_reach() {
        let mut anderson = Anderson::new(1);
        let map = |x: f64| 0.999 * x + 1.0;
        let (mut at, reach) = (0.0, 5.0);
        for _ in 0..4 {
            let next = anderson.next(&[[at, 0.0, 0.0]], &[[map(at), 0.0, 0.0]], reach);
            assert!((next[0][0] - map(at)).abs() <= reach * (1.0 + 1e-12), "{next:?}");
            at = next[0][0];
        }
        assert!(at > 4.0, "{at}");
    }
}
