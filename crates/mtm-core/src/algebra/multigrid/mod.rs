//! Smoothed aggregation with the six rigid modes, as a preconditioner for [`crate::algebra::krylov::pcg`].
//!
//! Vaněk, Mandel & Brezina 1996: strongly coupled nodes form an aggregate, the rigid motions of the aggregates
//! are the coarse unknowns, one Jacobi step smooths them, and the coarse matrix is the Galerkin product. Every
//! level is scaled by the Cholesky factors of its diagonal blocks, S A Sᵀ with unit diagonal blocks: the
//! block-Jacobi method becomes the identity, and entries of tissues that differ 1e8 times in stiffness fit into
//! single precision together.
//!
//! The scaled matrices and the prolongators are *stored* in single precision (half the memory traffic) but
//! every sum is in double precision. The Galerkin products use the double-precision matrices throughout: the
//! coarse stiffness of a stiff inclusion surrounded by fat results from cancellation.

mod aggregation;
mod block_rows;
mod coarsest;
mod galerkin;
mod parts;
mod prolongator;
mod rigid_modes;
mod scaled_matrix;
mod scaling;
mod small_blocks;
mod smoother;
mod transfer;

use std::sync::{Mutex, PoisonError};

use rayon::prelude::*;

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::krylov::Preconditioner;
use crate::algebra::row_sums::in_pool;
use crate::error::{ErrorKind, MtmError, Result};

use aggregation::Aggregates;
use block_rows::SystemRows;
use coarsest::DenseCholesky;
use galerkin::{CoarseMatrix, galerkin};
use parts::Parts;
pub use parts::SetUpPart;
use prolongator::Prolongator;
use rigid_modes::{MODES, ModeBlock, orthonormalise, rigid_modes};
use scaled_matrix::ScaledMatrix;
use scaling::Scaling;
use small_blocks::{add_transposed_product, times, transposed_times};
use smoother::{Smoother, Vectors};
use transfer::Transfer;

/// Share of rows that must be eliminated by a level to make the next one worthwhile.
const STALL: f64 = 0.8;
/// Number of rows above which the coarsest level is too large for a dense factorisation when coarsening stalls.
const DENSE_LIMIT: usize = 400;

/// Vectors that a pass of the smoother reads or writes: d, r twice, the next d, x twice.
const VECTORS_PER_PASS: usize = 6;

/// How the hierarchy is built and the cycle is run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MultigridOptions {
    /// Relative block norm above which two nodes are strongly connected; halved on each level.
    pub strength: f64,
    /// Degree of the Chebyshev smoother, before and after each coarse correction.
    pub smoother_degree: usize,
    /// Damping of the prolongator smoothing, as a multiple of 1/λ_max.
    pub prolongator_damping: f64,
    /// Number of block rows at which a level is solved directly.
    pub coarsest_rows: usize,
    /// Maximum number of levels.
    pub max_levels: usize,
}

impl Default for MultigridOptions {
    fn default() -> Self {
        Self {
            strength: 0.08,
            smoother_degree: 2,
            // Of 4/3 to 1.6, what takes the fewest iterations on shells and heads (25 to 28).
            prolongator_damping: 1.4,
            coarsest_rows: 64,
            max_levels: 12,
        }
    }
}

/// A symmetric positive definite multigrid cycle for one [`BlockMatrix`].
///
/// Built once per matrix, and applied by any number of threads at once. Both are bitwise independent of the
/// number of threads and of the machine's load.
#[derive(Debug)]
pub struct Multigrid {
    /// S of the finest level: r̃ = S r, z = Sᵀ z̃.
    scaling: Vec<[[f64; 3]; 3]>,
    finest: Level<3>,
    coarse: Vec<Level<MODES>>,
    coarsest: Option<DenseCholesky>,
    smoother: Smoother,
    workspaces: Mutex<Vec<Workspace>>,
    parts: Vec<SetUpPart>,
}

impl Multigrid {
    /// The hierarchy for `a`.
    ///
    /// `nodes`: coordinates of each block row, mm. `normals`: row and unit normal of each sliding row,
    /// whose matrix rows are already projected (P A P + k (I − P)).
    ///
    /// # Errors
    /// [`MtmError::Length`] for a wrong number of nodes, [`MtmError::IndexOutOfRange`] for a normal
    /// past the end, [`MtmError::NotPositiveDefinite`] for a diagonal block that is not.
    pub fn new(
        a: &BlockMatrix,
        nodes: &[[f64; 3]],
        normals: &[(usize, [f64; 3])],
        options: &MultigridOptions,
    ) -> Result<Self> {
        if nodes.len() != a.n_rows() {
            return Err(MtmError::Length {
                what: "node coordinates".to_owned(),
                found: nodes.len(),
                expected: a.n_rows(),
                why: "one per block row of the matrix",
                kind: ErrorKind::Solver,
            });
        }
        if let Some((row, &(index, _))) =
            normals.iter().enumerate().find(|(_, (j, _))| *j >= a.n_rows())
        {
            return Err(MtmError::IndexOutOfRange {
                what: "normals".to_owned(),
                row,
                item: "block row",
                index,
                count: a.n_rows(),
                kind: ErrorKind::Solver,
            });
        }
        in_pool(|| Self::build(a, nodes, normals, options))
    }

    fn build(
        a: &BlockMatrix,
        nodes: &[[f64; 3]],
        normals: &[(usize, [f64; 3])],
        options: &MultigridOptions,
    ) -> Result<Self> {
        let mut parts = Parts::default();
        let modes = parts.timed(
            "rigid modes",
            || rigid_modes(nodes, normals),
            |modes| (24 * nodes.len() + 24 * MODES * modes.len(), 0),
        );
        let scaling =
            parts.timed("scaling", || Scaling::new(a), |made| (3 * 72 * made.factors.len(), 0));
        if let Some(node) = scaling.not_positive {
            return Err(MtmError::NotPositiveDefinite {
                node,
                detail: format!("its diagonal block is {:?}", a.diagonal_block(node)),
            });
        }
        let direct = |rows: usize| rows <= options.coarsest_rows;
        let mut coarse = Vec::new();
        let mut coarsest = None;
        let (finest, mut next) = Level::new(a, &scaling, modes, (options, 0), &mut parts);
        while let Some(mut system) = next {
            let depth = coarse.len() + 1;
            let rows = system.a.n_rows();
            if direct(rows) || depth + 1 >= options.max_levels {
                if rows <= DENSE_LIMIT {
                    coarsest = Some(system.factor(&mut parts));
                } else {
                    coarse.push(Level::lone(&system.a, &system.scaling, &mut parts));
                }
                break;
            }
            let modes = std::mem::take(&mut system.modes);
            let (level, after) =
                Level::new(&system.a, &system.scaling, modes, (options, depth), &mut parts);
            if after.is_none() && rows <= DENSE_LIMIT {
                coarsest = Some(system.factor(&mut parts));
                break;
            }
            coarse.push(level);
            next = after;
        }
        Ok(Self {
            scaling: scaling.inverse_factors,
            finest,
            coarse,
            coarsest,
            smoother: Smoother::new(options.smoother_degree),
            workspaces: Mutex::new(Vec::new()),
            parts: parts.into_vec(),
        })
    }

    /// What the parts of the set-up cost, over all levels.
    pub fn set_up_parts(&self) -> &[SetUpPart] {
        &self.parts
    }

    /// Number of rows of each level, the finest first.
    pub fn level_rows(&self) -> Vec<usize> {
        let mut rows = vec![self.finest.matrix.n_rows()];
        rows.extend(self.coarse.iter().map(|l| l.matrix.n_rows()));
        rows.extend(self.coarsest.as_ref().map(|c| c.size / MODES));
        rows
    }

    /// Bytes held by the hierarchy.
    pub fn memory_bytes(&self) -> usize {
        self.scaling.len() * 72
            + self.finest.memory_bytes()
            + self.coarse.iter().map(Level::memory_bytes).sum::<usize>()
            + self.coarsest.as_ref().map_or(0, |c| 8 * c.size * c.size)
    }

    /// Minimum memory traffic of one application, bytes: every matrix and vector once per pass over it.
    pub fn traffic_bytes(&self) -> usize {
        let passes = self.smoother.passes();
        // The scaling, r in and z out, and the scaled vector in between.
        let ends = self.scaling.len() * (2 * 72 + 4 * 24);
        ends + self.finest.traffic_bytes(passes)
            + self.coarse.iter().map(|l| l.traffic_bytes(passes)).sum::<usize>()
            + self.coarsest.as_ref().map_or(0, |c| 2 * 8 * c.size * c.size / 2)
    }

    fn correct_coarse(&self, depth: usize, work: &mut [Vectors<MODES>]) {
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
                    if let Some(below) = rest.first() {
                        transfer.prolong(&below.x, &mut vectors.d);
                    }
                    self.smoother.smooth_last(&level.matrix, vectors);
                }
            }
        }
    }

    fn cycle(&self, r: &[[f64; 3]], z: &mut [[f64; 3]], work: &mut Workspace) {
        let rows = self.finest.matrix.rows_per_task;
        let fine = &mut work.finest;
        fine.r
            .par_chunks_mut(rows)
            .zip(r.par_chunks(rows).zip(self.scaling.par_chunks(rows)))
            .for_each(|(out, (r, scaling))| {
                for ((out, r), s) in out.iter_mut().zip(r).zip(scaling) {
                    *out = times(s, r);
                }
            });
        self.smoother.smooth_first(&self.finest.matrix, fine);
        if let Some(transfer) = &self.finest.transfer {
            if let Some(below) = work.coarse.first_mut() {
                transfer.restrict(&fine.r, &mut below.r);
            }
            self.correct_coarse(0, &mut work.coarse);
            if let Some(below) = work.coarse.first() {
                transfer.prolong(&below.x, &mut fine.d);
            }
            self.smoother.smooth_last(&self.finest.matrix, fine);
        }
        z.par_chunks_mut(rows)
            .zip(fine.x.par_chunks(rows).zip(self.scaling.par_chunks(rows)))
            .for_each(|(z, (x, scaling))| {
                for ((z, x), s) in z.iter_mut().zip(x).zip(scaling) {
                    *z = transposed_times(s, x);
                }
            });
    }

    fn new_workspace(&self) -> Workspace {
        let mut coarse: Vec<_> =
            self.coarse.iter().map(|l| Vectors::new(l.matrix.n_rows())).collect();
        coarse.extend(self.coarsest.as_ref().map(|c| Vectors::new(c.size / MODES)));
        Workspace { finest: Vectors::new(self.finest.matrix.n_rows()), coarse }
    }
}

impl Preconditioner for Multigrid {
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]) {
        let pooled = self.workspaces.lock().unwrap_or_else(PoisonError::into_inner).pop();
        let mut work = pooled.unwrap_or_else(|| self.new_workspace());
        in_pool(|| self.cycle(r, z, &mut work));
        self.workspaces.lock().unwrap_or_else(PoisonError::into_inner).push(work);
    }
}

/// The vectors of one cycle, kept for the next.
#[derive(Debug)]
struct Workspace {
    finest: Vectors<3>,
    coarse: Vec<Vectors<MODES>>,
}

/// A coarse matrix with its scaling and the rigid modes in its unknowns.
#[derive(Debug)]
struct CoarseSystem {
    a: CoarseMatrix,
    scaling: Scaling<MODES>,
    modes: Vec<ModeBlock>,
}

impl CoarseSystem {
    /// The dense factor of this system, as the coarsest one.
    fn factor(&self, parts: &mut Parts) -> DenseCholesky {
        let factor = || DenseCholesky::new(&self.a, &self.scaling);
        parts.timed("coarsest factor", factor, |made| {
            (8 * made.size * made.size, made.size * made.size * made.size / 3)
        })
    }
}

/// A level of the cycle and the transfer to the next coarser one, if there is one.
#[derive(Debug)]
struct Level<const N: usize> {
    matrix: ScaledMatrix<N>,
    transfer: Option<Transfer<N>>,
}

impl<const N: usize> Level<N> {
    /// The level without a coarser one.
    fn lone(a: &impl SystemRows<N>, scaling: &Scaling<N>, parts: &mut Parts) -> Self {
        let read = a.columns().len() * (4 + 8 * N * N) + a.n_rows() * 8 * N * N;
        let mut matrix = parts.timed(
            "scaled matrix",
            || ScaledMatrix::new(a, scaling),
            |made| (read + made.memory_bytes(), 4 * N * N * N * made.columns.len()),
        );
        let cost = matrix.eigenvalue_cost();
        parts.timed("largest eigenvalue", || matrix.find_largest_eigenvalue(), |()| cost);
        Self { matrix, transfer: None }
    }

    /// The level and the system below it, if there is one.
    fn new(
        a: &impl SystemRows<N>,
        scaling: &Scaling<N>,
        mut modes: Vec<[[f64; MODES]; N]>,
        (options, depth): (&MultigridOptions, usize),
        parts: &mut Parts,
    ) -> (Self, Option<CoarseSystem>) {
        let mut level = Self::lone(a, scaling, parts);
        let matrix = &level.matrix;
        let strength = options.strength * 0.5_f64.powi(depth.try_into().unwrap_or(i32::MAX));
        let aggregates = parts.timed(
            "strength and aggregates",
            || Aggregates::new(matrix, strength),
            |_| {
                (matrix.memory_bytes() + 8 * matrix.columns.len(), 2 * N * N * matrix.columns.len())
            },
        );
        if aggregates.count == 0 || aggregates.count as f64 > STALL * matrix.n_rows() as f64 {
            return (level, None);
        }
        let mode_bytes = 8 * N * MODES * modes.len();
        let coarse_modes = parts.timed(
            "tentative prolongator",
            || {
                // Modes in scaled unknowns: x̃ = Lᵀ x.
                modes.par_iter_mut().zip(&scaling.factors).with_min_len(1024).for_each(|(m, l)| {
                    let mut out = [[0.0; MODES]; N];
                    add_transposed_product(&mut out, l, m);
                    *m = out;
                });
                orthonormalise(&aggregates, &mut modes)
            },
            |_| (4 * mode_bytes, 0),
        );
        let damping = options.prolongator_damping / matrix.largest_eigenvalue;
        let p = parts.timed(
            "smoothed prolongator",
            || Prolongator::smoothed(matrix, &aggregates, &modes, damping, scaling),
            |p| {
                let flops = 2 * MODES * N * N * (matrix.columns.len() + p.columns.len());
                (matrix.memory_bytes() + mode_bytes + p.memory_bytes(), flops)
            },
        );
        drop(modes);
        let p_bytes = p.memory_bytes();
        let transposed = parts.timed(
            "transposed pattern",
            || p.transposed(),
            |t| (4 * p.columns.len() + 8 * t.positions.len(), 0),
        );
        let a_bytes = a.columns().len() * (4 + 8 * N * N);
        let coarse = parts.timed(
            "Galerkin product",
            || galerkin(a, &p, &transposed),
            |coarse| (a_bytes + p_bytes + coarse.columns.len() * 8 * MODES * MODES, coarse.flops),
        );
        let coarse_scaling = Scaling::new(&coarse);
        level.transfer = Some(parts.timed(
            "transfer",
            || Transfer::new(p, transposed, scaling, &coarse_scaling, level.matrix.rows_per_task),
            |made| (p_bytes + made.memory_bytes(), 0),
        ));
        let system = CoarseSystem { a: coarse, scaling: coarse_scaling, modes: coarse_modes };
        (level, Some(system))
    }

    fn memory_bytes(&self) -> usize {
        self.matrix.memory_bytes() + self.transfer.as_ref().map_or(0, Transfer::memory_bytes)
    }

    fn traffic_bytes(&self, passes: usize) -> usize {
        let vector = self.matrix.n_rows() * N * 8;
        let smoothing = passes * (self.matrix.memory_bytes() + VECTORS_PER_PASS * vector);
        let transfer = self.transfer.as_ref().map_or(0, |t| t.memory_bytes() + 2 * vector);
        smoothing + transfer
    }
}
