//! Sparse Cholesky factorisation of the block system, and the dense factorisations of sliding contact. The only
//! folder that refers to faer.

mod dense;
mod lifting;
mod normal;
mod numeric;
mod spread;
mod structure;
mod sweep;
mod symmetric;
mod workspace;

use std::sync::Arc;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::sparse::linalg::cholesky::supernodal;
use faer::{Conj, MatMut};

pub use dense::TailFlexibility;
pub use lifting::LowRank;
pub use normal::{
    FactorPreconditioner, NormalFactor, ProductAccuracy, Progress, ROUGH, RowForces, RowKey,
    conjugate_gradients, hopeless,
};
use spread::Spread;
use structure::{minimum_degree, supernodal_structure};
use sweep::{Supernode, Sweep};
pub use symmetric::{DenseFactor, DenseSymmetric, ROWS_TO_SHARE, Rough};
use workspace::{out_of_memory, parallelism};

use crate::algebra::blocks::BlockMatrix;
use crate::algebra::ordering::{
    NodeGraph, elimination_tree, nested_dissection, positions, postorder,
};
use crate::error::{MtmError, Result};

/// Relative error of a known solution above which the system counts as singular to working precision.
const TRIAL_ERROR: f64 = 1e-5;
/// Which rows are eliminated last, so that their Schur complement is at the end of the factor.
pub type Tail<'a> = &'a [u32];

/// Elimination order and structure of the factor: depends only on the sparsity pattern.
pub struct Symbolic {
    /// Row of the system at each position.
    order: Vec<u32>,
    /// Position of each row.
    position: Vec<u32>,
    /// Number of rows kept last.
    n_tail: usize,
    structure: supernodal::SymbolicSupernodalCholesky<usize>,
    tree: numeric::Tree,
}

/// L of P A Pᵀ = L Lᵀ.
pub struct Factor {
    symbolic: Arc<Symbolic>,
    values: Vec<f64>,
    /// Relative error, in the largest component, with which it recovered a known solution: an estimate of the digits
    /// that the condition of the system leaves.
    pub trial_error: f64,
}

impl Symbolic {
    /// The structure of the factor of `matrix`, with the rows `tail` eliminated last.
    ///
    /// The order is nested dissection on the node graph (METIS, or approximate minimum degree without
    /// it), postordered along the elimination tree, expanded to the three unknowns of each node.
    pub fn new(matrix: &BlockMatrix, tail: Tail<'_>) -> Result<Self> {
        let n = matrix.n_rows();
        let mut in_tail = vec![false; n];
        for &j in tail {
            in_tail[j as usize] = true;
        }
        let (graph, rows) = NodeGraph::of_rows(matrix, |j| !in_tail[j]);
        let inner = match nested_dissection(&graph)? {
            Some(order) => order,
            None => minimum_degree(&graph)?,
        };
        let mut order: Vec<u32> = inner.iter().map(|&i| rows[i as usize]).collect();
        order.extend_from_slice(tail);

        // Postorder the rows before the tail; a row whose parent lies in the tail is a root there.
        let n_inner = n - tail.len();
        let mut parents = elimination_tree(matrix, &order);
        parents.truncate(n_inner);
        for parent in &mut parents {
            if *parent >= n_inner {
                *parent = usize::MAX;
            }
        }
        let inner: Vec<u32> = postorder(&parents).iter().map(|&p| order[p as usize]).collect();
        order[..n_inner].copy_from_slice(&inner);

        let structure = supernodal_structure(matrix, &order)?;
        let tree = numeric::Tree::new(&structure, 3 * n_inner);
        let position = positions(&order);
        Ok(Self { order, position, n_tail: tail.len(), structure, tree })
    }

    /// Bytes that a factor takes.
    pub fn factor_bytes(&self) -> usize {
        8 * self.structure.len_val()
    }

    /// The factor of `matrix`, which must have the pattern this structure was made for.
    ///
    /// # Errors
    /// `NotPositiveDefinite` where a pivot is not positive or a known solution is not recovered.
    pub fn factor(self: &Arc<Self>, matrix: &BlockMatrix) -> Result<Factor> {
        let bytes = self.factor_bytes();
        // Requested first, so that too little memory is an error and not an abort; then allocated zeroed from
        // the system, which touches each page once.
        Vec::<f64>::new()
            .try_reserve_exact(self.structure.len_val())
            .map_err(|_| out_of_memory("the Cholesky factor", bytes))?;
        let mut values = vec![0.0; self.structure.len_val()];
        let why = "a pivot of the factorisation is not positive; a part of the body may be a mechanism, or \
                   the material contrast too large for f64";
        let Self { order, position, structure, tree, .. } = &**self;
        numeric::Work { structure, tree, matrix, order, position }
            .factor(&mut values)
            .map_err(|index| MtmError::not_definite(self.order[index / 3] as usize, why))?;
        Factor { symbolic: self.clone(), values, trial_error: 0.0 }.tried(matrix)
    }

    /// First unknown of the tail.
    fn first_of_tail(&self) -> usize {
        3 * (self.order.len() - self.n_tail)
    }
}

impl Factor {
    /// Bytes that it takes.
    pub fn bytes(&self) -> usize {
        self.symbolic.factor_bytes()
    }

    /// `b` in elimination order.
    pub fn permuted(&self, b: &[[f64; 3]]) -> Vec<f64> {
        self.symbolic.order.iter().flat_map(|&j| b[j as usize]).collect()
    }

    /// `x` back in the order of the system.
    pub fn unpermuted(&self, x: &[f64]) -> Vec<[f64; 3]> {
        let mut out = vec![[0.0; 3]; self.symbolic.order.len()];
        for (&j, v) in self.symbolic.order.iter().zip(x.chunks_exact(3)) {
            out[j as usize] = [v[0], v[1], v[2]];
        }
        out
    }

    /// The factor, after it has recovered a known solution.
    ///
    /// The residual of a solve is not a measure of its error; a known solution is, at the price of one product
    /// and one solve per factorisation.
    fn tried(mut self, matrix: &BlockMatrix) -> Result<Self> {
        let known: Vec<[f64; 3]> = (0..self.symbolic.order.len())
            .map(|j| [0, 1, 2].map(|i| 1.0 + 0.5 * ((3 * j + i) as f64 * 0.7).sin()))
            .collect();
        let found = self.solve(&matrix.multiply(&known));
        let trial_error = known
            .iter()
            .zip(&found)
            .flat_map(|(a, b)| (0..3).map(move |i| (a[i] - b[i]).abs()))
            .fold(0.0_f64, |m, e| if e.is_nan() { f64::INFINITY } else { m.max(e) });
        if trial_error <= TRIAL_ERROR {
            self.trial_error = trial_error;
            return Ok(self);
        }
        let (worst, at) = self.smallest_pivot(matrix);
        let why = format!(
            "the smallest pivot keeps {worst:.1e} of its diagonal and a known solution comes back \
             with relative error {trial_error:.1e}; a part of the body is almost a mechanism, or \
             the material contrast is too large for f64"
        );
        Err(MtmError::not_definite(at, why))
    }

    /// The smallest pivot relative to its diagonal entry, and its row.
    fn smallest_pivot(&self, matrix: &BlockMatrix) -> (f64, usize) {
        let l = supernodal::SupernodalLltRef::new(&self.symbolic.structure, &self.values);
        let (mut worst, mut at) = (f64::INFINITY, 0);
        for s in 0..self.symbolic.structure.n_supernodes() {
            let node = l.supernode(s);
            let (first, val) = (node.start(), node.val());
            for i in 0..val.ncols() {
                let row = self.symbolic.order[(first + i) / 3] as usize;
                let diagonal = matrix.diagonal_block(row)[4 * ((first + i) % 3)];
                let pivot = val[(i, i)] * val[(i, i)] / diagonal;
                if pivot.is_nan() || pivot < worst {
                    (worst, at) = (if pivot.is_nan() { 0.0 } else { pivot }, row);
                }
            }
        }
        (worst, at)
    }

    /// A⁻¹ b.
    pub fn solve(&self, b: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut x = self.permuted(b);
        self.sweep().forward(&mut x);
        self.sweep().backward(&mut x);
        self.unpermuted(&x)
    }

    /// A⁻¹ B for several right-hand sides, each given as rows of three, in place.
    pub fn solve_many(&self, columns: &mut [Vec<[f64; 3]>]) {
        if self.symbolic.order.is_empty() {
            return;
        }
        let mut x: Vec<f64> = columns.iter().flat_map(|b| self.permuted(b)).collect();
        let (n, k) = (3 * self.symbolic.order.len(), columns.len());
        let par = parallelism(n);
        let mut memory =
            MemBuffer::new(self.symbolic.structure.solve_in_place_scratch::<f64>(k, par));
        supernodal::SupernodalLltRef::new(&self.symbolic.structure, &self.values)
            .solve_in_place_with_conj(
                Conj::No,
                MatMut::from_column_major_slice_mut(&mut x, n, k),
                par,
                MemStack::new(&mut memory),
            );
        for (column, x) in columns.iter_mut().zip(x.chunks_exact(3 * self.symbolic.order.len())) {
            *column = self.unpermuted(x);
        }
    }

    /// Sweeps of vectors in elimination order.
    pub fn sweep(&self) -> Sweep<'_> {
        Sweep::new((&self.symbolic.structure, &self.values), &self.symbolic.tree)
    }

    /// `b` in elimination order, after all rows but those of the tail are eliminated: what is left on these are the
    /// forces to which `b` reduces.
    pub fn swept(&self, b: &[[f64; 3]]) -> Vec<f64> {
        let mut x = self.permuted(b);
        self.sweep().forward_to(self.symbolic.first_of_tail(), &mut x);
        x
    }

    /// Adds `forces` on `rows` to what [`Self::swept`] returned.
    pub fn push(&self, rows: &[u32], forces: &[[f64; 3]], swept: &mut [f64]) {
        let mut x = vec![0.0; swept.len()];
        for (&row, force) in rows.iter().zip(forces) {
            x[3 * self.symbolic.position[row as usize] as usize..][..3].copy_from_slice(force);
        }
        self.sweep().forward_to(self.symbolic.first_of_tail(), &mut x);
        swept.iter_mut().zip(x).for_each(|(to, v)| *to += v);
    }

    /// The part of `swept` on the tail.
    pub fn on_tail<'s>(&self, swept: &'s [f64]) -> &'s [f64] {
        &swept[self.symbolic.first_of_tail()..]
    }

    /// Displacements of `rows` while the tail is held.
    pub fn of_rows(&self, mut swept: Vec<f64>, rows: &[u32]) -> Vec<f64> {
        let position = |&row: &u32| 3 * self.symbolic.position[row as usize] as usize;
        let needed = self.symbolic.tree.above(&self.symbolic.structure, rows.iter().map(position));
        let first = self.symbolic.first_of_tail();
        swept[first..].fill(0.0);
        self.sweep().through(&needed).backward_from(first, &mut swept);
        rows.iter().flat_map(|row| swept[position(row)..][..3].iter().copied()).collect()
    }

    /// Displacements of all rows, given those of the tail.
    pub fn above_tail(&self, mut swept: Vec<f64>, tail: &[f64]) -> Vec<[f64; 3]> {
        let first = self.symbolic.first_of_tail();
        swept[first..].copy_from_slice(tail);
        self.sweep().backward_from(first, &mut swept);
        self.unpermuted(&swept)
    }

    /// Flexibility of `rows`, mm/N, where the rows of the tail are free except for those `held`, by their places
    /// among them.
    ///
    /// # Errors
    /// `NotPositiveDefinite` if the rows of the tail are not held by the body.
    pub fn flexibility(&self, rows: &[u32], held: &[usize]) -> Result<TailFlexibility> {
        let Symbolic { order, position, n_tail, structure, tree } = &*self.symbolic;
        let (first, more) = (self.symbolic.first_of_tail(), 3 * n_tail);
        let at = |&row: &u32| (0..3).map(move |axis| 3 * position[row as usize] as usize + axis);
        let places: Vec<usize> = rows.iter().flat_map(at).collect();
        let mut unknowns = places.clone();
        unknowns.sort_unstable();
        let l = (structure, &self.values[..]);
        let spread = Spread { l, tree, unknowns: &unknowns, first_of_tail: first };
        let (square, carried) = spread.square();
        // Back in the order of the rows.
        let size = places.len();
        let sorted: Vec<usize> =
            places.iter().map(|place| unknowns.partition_point(|at| at < place)).collect();
        let flexibility = DenseSymmetric::from_columns(size, |c, column| {
            for (to, &r) in column.iter_mut().zip(&sorted[c..]) {
                *to = square[r.min(sorted[c]) * size + r.max(sorted[c])];
            }
        });
        drop(square);
        let mut across = vec![0.0; more * size];
        for (s, &c) in sorted.iter().enumerate() {
            (0..more).for_each(|l| across[l * size + s] = -carried[c * more + l]);
        }
        let all = [rows, &order[order.len() - n_tail..]].concat();
        TailFlexibility::new(flexibility, all, (across, self.of_tail()), held)
    }

    /// The part of L in rows and columns of the tail, row by row.
    fn of_tail(&self) -> Vec<f64> {
        let (first, size) = (self.symbolic.first_of_tail(), 3 * self.symbolic.n_tail);
        let mut own = vec![0.0; size * size];
        for s in self.symbolic.tree.tail..self.symbolic.structure.n_supernodes() {
            let node = Supernode::new((&self.symbolic.structure, &self.values), s);
            let (end, rows) = (node.begin + node.width, node.rows());
            for c in (0..node.width).filter(|c| node.begin + c >= first) {
                let column = &node.values[c * rows..(c + 1) * rows];
                let below = (node.begin + c..end).chain(node.pattern.iter().copied());
                for (row, v) in below.zip(&column[c..]) {
                    own[(row - first) * size + node.begin + c - first] = *v;
                }
            }
        }
        own
    }
}
