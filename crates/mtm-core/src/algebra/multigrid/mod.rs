//! Smoothed aggregation with the six rigid modes, as a preconditioner for [`crate::algebra::krylov::pcg`].
//!
//! Vaněk, Mandel & Brezina 1996: strongly coupled nodes form an aggregate, the rigid motions of the aggregates
//! are the coarse unknowns, one Jacobi step smooths them, and the coarse matrix is the Galerkin product. Every
//! level is scaled by the Cholesky factors of its diagonal blocks, S A Sᵀ with unit diagonal blocks: the
//! block-Jacobi method becomes the identity, and entries of tissues that differ 1e8 times in stiffness fit into
//! single precision together.
//!
//! The scaled matrices and the prolongators are *stored* in shorter numbers than those of the sums
//! ([`CyclePrecision`]): the cycle waits for memory. The Galerkin products use the double-precision matrices
//! throughout: the coarse stiffness of a stiff inclusion surrounded by fat results from cancellation.

mod aggregation;
mod block_rows;
mod coarsest;
mod galerkin;
mod hierarchy;
pub(crate) mod precision;
mod prolongator;
mod rigid_modes;
mod scaled_matrix;
mod scaling;
mod small_blocks;
mod smoother;
mod transfer;

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::krylov::Preconditioner;
use crate::algebra::row_sums::in_pool;
use crate::error::{ErrorKind, MtmError, Result};

pub use hierarchy::MultigridOptions;
use hierarchy::{Cycle, Hierarchy};
pub use precision::CyclePrecision;
use precision::{Double, Single};
use rigid_modes::rigid_modes;
use scaling::Scaling;

/// A symmetric positive definite multigrid cycle for one [`BlockMatrix`].
///
/// Built once per matrix, and applied by any number of threads at once. Both are bitwise independent of the
/// number of threads and of the machine's load.
#[derive(Debug)]
pub struct Multigrid {
    /// S of the finest level: r̃ = S r, z = Sᵀ z̃.
    scaling: Vec<[[f64; 3]; 3]>,
    levels: Box<dyn Cycle>,
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
        let why = "one per block row of the matrix";
        ErrorKind::Solver.require_length("node coordinates", nodes.len(), a.n_rows(), why)?;
        if let Some(row) = normals.iter().position(|(j, _)| *j >= a.n_rows()) {
            let (what, index) = (("normals", row), normals[row].0 as u32);
            return Err(ErrorKind::Solver.no_such(what, "block row", index, a.n_rows()));
        }
        in_pool(|| Self::build(a, nodes, normals, options))
    }

    fn build(
        a: &BlockMatrix,
        nodes: &[[f64; 3]],
        normals: &[(usize, [f64; 3])],
        options: &MultigridOptions,
    ) -> Result<Self> {
        let modes = rigid_modes(nodes, normals);
        let scaling = Scaling::new(a);
        if let Some(node) = scaling.not_positive {
            let why = format!("its diagonal block is {:?}", a.diagonal_block(node));
            return Err(MtmError::not_definite(node, why));
        }
        let levels: Box<dyn Cycle> = match options.precision {
            CyclePrecision::Double => {
                Box::new(Hierarchy::<Double>::new(a, &scaling, modes, options))
            }
            CyclePrecision::Single => {
                Box::new(Hierarchy::<Single>::new(a, &scaling, modes, options))
            }
        };
        Ok(Self { scaling: scaling.inverse_factors, levels })
    }

    /// Number of rows of each level, the finest first.
    pub fn level_rows(&self) -> Vec<usize> {
        self.levels.level_rows()
    }

    /// Bytes held by the hierarchy.
    pub fn memory_bytes(&self) -> usize {
        self.scaling.len() * 72 + self.levels.memory_bytes()
    }

    /// Minimum memory traffic of one application, bytes: every matrix and vector once per pass over it.
    pub fn traffic_bytes(&self) -> usize {
        // The scaling, r in and z out, and the scaled vector in between.
        self.scaling.len() * (2 * 72 + 4 * 24) + self.levels.traffic_bytes()
    }
}

impl Preconditioner for Multigrid {
    fn apply(&self, r: &[[f64; 3]], z: &mut [[f64; 3]]) {
        in_pool(|| self.levels.apply(&self.scaling, r, z));
    }
}
