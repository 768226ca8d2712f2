//! The levels and the cycle through them.

use std::fmt::Debug;
use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use crate::algebra::blocks::BlockMatrix;

use super::aggregation::Aggregates;
use super::block_rows::SystemRows;
use super::coarsest::DenseCholesky;
use super::galerkin::{CoarseMatrix, galerkin};
use super::precision::{CyclePrecision, Precision, Real};
use super::prolongator::Prolongator;
use super::rigid_modes::{MODES, ModeBlock, orthonormalise};
use super::scaled_matrix::ScaledMatrix;
use super::scaling::Scaling;
use super::small_blocks::{add_transposed_product, times, transposed_times};
use super::smoother::{Smoother, Vectors};
use super::transfer::Transfer;

/// Share of rows that must be eliminated by a level to make the next one worthwhile.
const STALL: f64 = 0.8;
/// Number of rows above which the coarsest level is too large for a dense factorisation when coarsening stalls.
const DENSE_LIMIT: usize = 400;
/// Relative block norm above which two nodes are strongly connected; halved on each level.
const STRENGTH: f64 = 0.08;
/// Damping of the prolongator smoothing, as a multiple of 1/λ_max: of 4/3 to 1.6, what takes the fewest iterations on
/// shells and heads (25 to 28).
const DAMPING: f64 = 1.4;
/// Maximum number of levels.
const MOST_LEVELS: usize = 12;
/// Vectors that a pass of the smoother reads or writes: d, r twice, the next d, x twice.
const VECTORS_PER_PASS: usize = 6;

/// How the hierarchy is built and the cycle is run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MultigridOptions {
    /// Degree of the Chebyshev smoother, before and after each coarse correction.
    pub smoother_degree: usize,
    /// Number of block rows at which a level is solved directly.
    pub coarsest_rows: usize,
    /// Numbers of the cycle.
    pub precision: CyclePrecision,
}

impl Default for MultigridOptions {
    fn default() -> Self {
        Self { smoother_degree: 2, coarsest_rows: 64, precision: CyclePrecision::Double }
    }
}

/// The levels, whose numbers are those of `P`.
#[derive(Debug)]
pub(super) struct Hierarchy<P: Precision> {
    finest: Level<3, P>,
    coarse: Vec<Level<MODES, P>>,
    coarsest: Option<DenseCholesky>,
    smoother: Smoother,
    workspaces: Mutex<Vec<Workspace<P::Real>>>,
}

impl<P: Precision> Hierarchy<P> {
    /// The levels for `a`, whose rows move by `modes` in rigid motions.
    pub(super) fn new(
        a: &BlockMatrix,
        scaling: &Scaling<3>,
        modes: Vec<[[f64; MODES]; 3]>,
        options: &MultigridOptions,
    ) -> Self {
        let mut coarse = Vec::new();
        let mut coarsest = None;
        let (finest, mut next) = Level::new(a, scaling, modes, 0);
        while let Some(mut system) = next {
            let depth = coarse.len() + 1;
            let rows = system.a.n_rows();
            if rows <= options.coarsest_rows || depth + 1 >= MOST_LEVELS {
                if rows <= DENSE_LIMIT {
                    coarsest = Some(DenseCholesky::new(&system.a, &system.scaling));
                } else {
                    coarse.push(Level::lone(&system.a, &system.scaling));
                }
                break;
            }
            let modes = std::mem::take(&mut system.modes);
            let (level, after) = Level::new(&system.a, &system.scaling, modes, depth);
            if after.is_none() && rows <= DENSE_LIMIT {
                coarsest = Some(DenseCholesky::new(&system.a, &system.scaling));
                break;
            }
            coarse.push(level);
            next = after;
        }
        let smoother = Smoother::new(options.smoother_degree);
        Self { finest, coarse, coarsest, smoother, workspaces: Mutex::new(Vec::new()) }
    }
}

/// A cycle through the levels of a hierarchy, in some precision.
pub(super) trait Cycle: Debug + Send + Sync {
    /// Number of rows of each level, the finest first.
    fn level_rows(&self) -> Vec<usize>;

    /// Bytes of the levels.
    fn memory_bytes(&self) -> usize;

    /// Minimum memory traffic of one cycle, bytes: every matrix and vector once per pass over it.
    fn traffic_bytes(&self) -> usize;

    /// `z = Sᵀ M⁻¹ S r` for the scaling S of the finest level and the cycle M⁻¹ of the scaled one.
    fn apply(&self, scaling: &[[[f64; 3]; 3]], r: &[[f64; 3]], z: &mut [[f64; 3]]);
}

impl<P: Precision> Cycle for Hierarchy<P> {
    fn level_rows(&self) -> Vec<usize> {
        let mut rows = vec![self.finest.matrix.n_rows()];
        rows.extend(self.coarse.iter().map(|l| l.matrix.n_rows()));
        rows.extend(self.coarsest.as_ref().map(|c| c.size / MODES));
        rows
    }

    fn memory_bytes(&self) -> usize {
        self.finest.memory_bytes()
            + self.coarse.iter().map(Level::memory_bytes).sum::<usize>()
            + self.coarsest.as_ref().map_or(0, |c| 8 * c.size * c.size)
    }

    fn traffic_bytes(&self) -> usize {
        let passes = self.smoother.passes();
        self.finest.traffic_bytes(passes)
            + self.coarse.iter().map(|l| l.traffic_bytes(passes)).sum::<usize>()
            + self.coarsest.as_ref().map_or(0, |c| 2 * 8 * c.size * c.size / 2)
    }

    fn apply(&self, scaling: &[[[f64; 3]; 3]], r: &[[f64; 3]], z: &mut [[f64; 3]]) {
        let pooled = self.workspaces.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut work = pooled.unwrap_or_else(|| self.new_workspace());
        self.cycle(scaling, (r, z), &mut work);
        self.workspaces.lock().unwrap_or_else(PoisonError::into_inner).push(work);
    }
}

impl<P: Precision> Hierarchy<P> {
    fn correct_coarse(&self, depth: usize, work: &mut [Vectors<MODES, P::Real>]) {
        let Some((vectors, rest)) = work.split_first_mut() else { return };
        match self.coarse.get(depth) {
            None => {
                if let Some(direct) = &self.coarsest {
                    direct.solve(&vectors.r, &mut vectors.x);
                }
            }
            Some(level) => {
                self.smoother.smooth_first(&level.matrix, vectors);
                if let Some(transfer) = &level.transfer {
                    if let Some(below) = rest.first_mut() {
                        transfer.restrict(&vectors.r, &mut below.r);
                    }
                    self.correct_coarse(depth + 1, rest);
                    if let Some(below) = rest.first_mut() {
                        transfer.prolong(&mut below.x, &mut vectors.d);
                    }
                    self.smoother.smooth_last(&level.matrix, vectors);
                }
            }
        }
    }

    fn cycle(
        &self,
        scaling: &[[[f64; 3]; 3]],
        (r, z): (&[[f64; 3]], &mut [[f64; 3]]),
        work: &mut Workspace<P::Real>,
    ) {
        let rows = self.finest.matrix.rows_per_task;
        let unit = unit_of(r, rows);
        let fine = &mut work.finest;
        fine.r.par_chunks_mut(rows).zip(r.par_chunks(rows).zip(scaling.par_chunks(rows))).for_each(
            |(out, (r, scaling))| {
                for ((out, r), s) in out.iter_mut().zip(r).zip(scaling) {
                    *out = times(s, r).map(|v| P::Real::of(v / unit));
                }
            },
        );
        self.smoother.smooth_first(&self.finest.matrix, fine);
        if let Some(transfer) = &self.finest.transfer {
            if let Some(below) = work.coarse.first_mut() {
                transfer.restrict(&fine.r, &mut below.r);
            }
            self.correct_coarse(0, &mut work.coarse);
            if let Some(below) = work.coarse.first_mut() {
                transfer.prolong(&mut below.x, &mut fine.d);
            }
            self.smoother.smooth_last(&self.finest.matrix, fine);
        }
        z.par_chunks_mut(rows).zip(fine.x.par_chunks(rows).zip(scaling.par_chunks(rows))).for_each(
            |(z, (x, scaling))| {
                for ((z, x), s) in z.iter_mut().zip(x).zip(scaling) {
                    *z = transposed_times(s, &x.map(|v| unit * v.into()));
                }
            },
        );
    }

    fn new_workspace(&self) -> Workspace<P::Real> {
        let mut coarse: Vec<_> =
            self.coarse.iter().map(|l| Vectors::new(l.matrix.n_rows())).collect();
        coarse.extend(self.coarsest.as_ref().map(|c| Vectors::new(c.size / MODES)));
        Workspace { finest: Vectors::new(self.finest.matrix.n_rows()), coarse }
    }
}

/// The power of two next to the largest number of `r`: divided by it, forces in any unit fit into single precision.
fn unit_of(r: &[[f64; 3]], rows: usize) -> f64 {
    let largest = r
        .par_chunks(rows)
        .map(|r| r.as_flattened().iter().fold(0.0_f64, |most, v| most.max(v.abs())))
        .reduce(|| 0.0, f64::max);
    let exponent = largest.log2().floor();
    if exponent.is_finite() { exponent.exp2() } else { 1.0 }
}

/// The vectors of one cycle, kept for the next.
#[derive(Debug)]
struct Workspace<F> {
    finest: Vectors<3, F>,
    coarse: Vec<Vectors<MODES, F>>,
}

/// A coarse matrix with its scaling and the rigid modes in its unknowns.
#[derive(Debug)]
struct CoarseSystem {
    a: CoarseMatrix,
    scaling: Scaling<MODES>,
    modes: Vec<ModeBlock>,
}

/// A level of the cycle and the transfer to the next coarser one, if there is one.
#[derive(Debug)]
struct Level<const N: usize, P: Precision> {
    matrix: ScaledMatrix<N, P::Stored>,
    transfer: Option<Transfer<N, P>>,
}

/// Modes in scaled unknowns: x̃ = Lᵀ x.
fn scale_modes<const N: usize>(modes: &mut [[[f64; MODES]; N]], scaling: &Scaling<N>) {
    modes.par_iter_mut().zip(&scaling.factors).with_min_len(1024).for_each(|(m, l)| {
        let mut out = [[0.0; MODES]; N];
        add_transposed_product(&mut out, l, m);
        *m = out;
    });
}

impl<const N: usize, P: Precision> Level<N, P> {
    /// The level without a coarser one.
    fn lone(a: &impl SystemRows<N>, scaling: &Scaling<N>) -> Self {
        Self { matrix: ScaledMatrix::new(a, scaling), transfer: None }
    }

    /// The level and the system below it, if there is one.
    fn new(
        a: &impl SystemRows<N>,
        scaling: &Scaling<N>,
        mut modes: Vec<[[f64; MODES]; N]>,
        depth: usize,
    ) -> (Self, Option<CoarseSystem>) {
        let mut level = Self::lone(a, scaling);
        let matrix = &level.matrix;
        let strength = STRENGTH * 0.5_f64.powi(depth.try_into().unwrap_or(i32::MAX));
        let aggregates = Aggregates::new(matrix, strength);
        if aggregates.count == 0 || aggregates.count as f64 > STALL * matrix.n_rows() as f64 {
            return (level, None);
        }
        scale_modes(&mut modes, scaling);
        let coarse_modes = orthonormalise(&aggregates, &mut modes);
        let damping = DAMPING / matrix.largest_eigenvalue;
        let p = Prolongator::smoothed(matrix, &aggregates, &modes, damping, scaling);
        drop(modes);
        let transposed = p.transposed();
        let coarse = galerkin(a, &p, &transposed);
        let coarse_scaling = Scaling::new(&coarse);
        let rows = level.matrix.rows_per_task;
        level.transfer = Some(Transfer::new(p, transposed, scaling, &coarse_scaling, rows));
        let system = CoarseSystem { a: coarse, scaling: coarse_scaling, modes: coarse_modes };
        (level, Some(system))
    }

    fn memory_bytes(&self) -> usize {
        self.matrix.memory_bytes() + self.transfer.as_ref().map_or(0, Transfer::memory_bytes)
    }

    fn traffic_bytes(&self, passes: usize) -> usize {
        let vector = self.matrix.n_rows() * N * size_of::<P::Real>();
        let smoothing = passes * (self.matrix.memory_bytes() + VECTORS_PER_PASS * vector);
        let transfer = self.transfer.as_ref().map_or(0, |t| t.memory_bytes() + 2 * vector);
        smoothing + transfer
    }
}
