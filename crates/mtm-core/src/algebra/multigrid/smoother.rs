//! The Chebyshev smoother and the vectors it works on.

use rayon::prelude::*;

use crate::algebra::simd::{Kernel, widest};

use super::precision::{Real, Stored};
use super::scaled_matrix::ScaledMatrix;

/// The vectors of one level in the cycle.
#[derive(Debug)]
pub(super) struct Vectors<const N: usize, F> {
    pub(super) x: Vec<[F; N]>,
    pub(super) r: Vec<[F; N]>,
    /// Residual of the smoother's own recurrence.
    s: Vec<[F; N]>,
    pub(super) d: Vec<[F; N]>,
    d_next: Vec<[F; N]>,
}

impl<const N: usize, F: Real> Vectors<N, F> {
    pub(super) fn new(rows: usize) -> Self {
        let zeros = vec![[F::default(); N]; rows];
        Self {
            x: zeros.clone(),
            r: zeros.clone(),
            s: zeros.clone(),
            d: zeros.clone(),
            d_next: zeros,
        }
    }
}

/// The steps before and after each coarse correction.
#[derive(Debug)]
pub(super) struct Smoother {
    steps: Vec<SmootherStep>,
}

impl Smoother {
    /// Chebyshev polynomials of the fourth kind with optimised weights (Lottes 2023, algorithm 2 and table 1):
    /// optimal for a multigrid cycle, and without the need to guess the lower end of the spectrum.
    pub(super) fn new(degree: usize) -> Self {
        const WEIGHTS: [&[f64]; 4] = [
            &[1.125],
            &[1.023_872_875_703_13, 1.264_089_053_710_85],
            &[1.008_425_447_820_28, 1.088_678_392_087_30, 1.337_531_259_096_18],
            &[
                1.003_913_104_277_85,
                1.040_358_111_885_93,
                1.148_634_985_462_54,
                1.382_688_692_410_00,
            ],
        ];
        let degree = degree.clamp(1, WEIGHTS.len());
        let steps = (1..=degree)
            .map(|k| {
                let k_real = k as f64;
                SmootherStep {
                    keep: if k == 1 { 0.0 } else { (2.0 * k_real - 3.0) / (2.0 * k_real + 1.0) },
                    gain: (8.0 * k_real - 4.0) / (2.0 * k_real + 1.0),
                    weight: WEIGHTS[degree - 1][k - 1],
                }
            })
            .collect();
        Self { steps }
    }

    /// Passes over the matrix in one cycle: the first step needs none, the residual one.
    pub(super) fn passes(&self) -> usize {
        2 * self.steps.len()
    }

    /// Smooths from x = 0 and leaves the residual in `r`.
    pub(super) fn smooth_first<const N: usize, T: Stored, F: Real>(
        &self,
        a: &ScaledMatrix<N, T>,
        v: &mut Vectors<N, F>,
    ) {
        let Some((first, later)) = self.steps.split_first() else { return };
        let (gain, weight) = (F::of(first.gain / a.largest_eigenvalue), F::of(first.weight));
        let rows = a.rows_per_task;
        v.x.par_chunks_mut(rows)
            .zip(v.d.par_chunks_mut(rows))
            .zip(v.r.par_chunks(rows).zip(v.s.par_chunks_mut(rows)))
            .for_each(|((x, d), (r, s))| {
                s.copy_from_slice(r);
                for ((x, d), r) in x.iter_mut().zip(d).zip(r) {
                    for c in 0..N {
                        d[c] = gain * r[c];
                        x[c] = weight * d[c];
                    }
                }
            });
        for step in later {
            step.sweep(a, 0.0, &v.d, [&mut v.s, &mut v.d_next, &mut v.x]);
            std::mem::swap(&mut v.d, &mut v.d_next);
        }
        let x = &v.x;
        v.r.par_chunks_mut(rows).enumerate().for_each(|(chunk, r)| {
            widest(Residual { a, first: chunk * rows, x, r });
        });
    }

    /// Adds the coarse correction in `d`, then smooths.
    pub(super) fn smooth_last<const N: usize, T: Stored, F: Real>(
        &self,
        a: &ScaledMatrix<N, T>,
        v: &mut Vectors<N, F>,
    ) {
        let mut correction = 1.0;
        for step in &self.steps {
            step.sweep(a, correction, &v.d, [&mut v.r, &mut v.d_next, &mut v.x]);
            std::mem::swap(&mut v.d, &mut v.d_next);
            correction = 0.0;
        }
    }
}

/// One step of the smoother: d ← keep d + gain/λ_max r, x ← x + weight d.
#[derive(Debug, Clone, Copy)]
struct SmootherStep {
    keep: f64,
    gain: f64,
    weight: f64,
}

impl SmootherStep {
    /// One sweep of [r, d_next, x]: r −= A d, then the new direction from r; x also receives `correction` times
    /// the old direction.
    fn sweep<const N: usize, T: Stored, F: Real>(
        &self,
        a: &ScaledMatrix<N, T>,
        correction: f64,
        d: &[[F; N]],
        [r, d_next, x]: [&mut Vec<[F; N]>; 3],
    ) {
        let rows = a.rows_per_task;
        x.par_chunks_mut(rows)
            .zip(r.par_chunks_mut(rows))
            .zip(d_next.par_chunks_mut(rows))
            .enumerate()
            .for_each(|(chunk, ((x, r), d_next))| {
                let first = chunk * rows;
                widest(SweepRows { step: *self, a, first, correction, d, r, d_next, x });
            });
    }
}

/// A range of rows of r −= A x.
struct Residual<'a, const N: usize, T, F> {
    a: &'a ScaledMatrix<N, T>,
    first: usize,
    x: &'a [[F; N]],
    r: &'a mut [[F; N]],
}

impl<const N: usize, T: Stored, F: Real> Kernel for Residual<'_, N, T, F> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        for (offset, r) in self.r.iter_mut().enumerate() {
            let y = self.a.row_product(self.first + offset, self.x);
            for c in 0..N {
                r[c] -= y[c];
            }
        }
    }
}

/// A range of rows of [`SmootherStep::sweep`]; `d` is whole, the other vectors are restricted to those rows.
struct SweepRows<'a, const N: usize, T, F> {
    step: SmootherStep,
    a: &'a ScaledMatrix<N, T>,
    first: usize,
    correction: f64,
    d: &'a [[F; N]],
    r: &'a mut [[F; N]],
    d_next: &'a mut [[F; N]],
    x: &'a mut [[F; N]],
}

impl<const N: usize, T: Stored, F: Real> Kernel for SweepRows<'_, N, T, F> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let Self { step, a, first, correction, d, r, d_next, x } = self;
        let gain = F::of(step.gain / a.largest_eigenvalue);
        let [keep, weight, correction] = [step.keep, step.weight, correction].map(F::of);
        for (offset, ((x, r), d_next)) in x.iter_mut().zip(r).zip(d_next).enumerate() {
            let i = first + offset;
            let y = a.row_product(i, d);
            for c in 0..N {
                r[c] -= y[c];
                d_next[c] = keep * d[i][c] + gain * r[c];
                x[c] += correction * d[i][c] + weight * d_next[c];
            }
        }
    }
}
