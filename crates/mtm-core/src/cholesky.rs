//! Sparse Cholesky factorisation of the block system, and the dense factorisations of sliding contact.
//! The only file that names faer.

use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::linalg::cholesky::llt;
use faer::sparse::linalg::SymbolicSupernodalParams;
use faer::sparse::linalg::amd;
use faer::sparse::linalg::cholesky::{simplicial, supernodal};
use faer::sparse::{SparseColMatRef, SymbolicSparseColMatRef};
use faer::{Conj, Mat, MatMut, MatRef, Par};
use rayon::prelude::*;

use crate::blocks::BlockMatrix;
use crate::error::{MtmError, Result};
use crate::ordering::{NodeGraph, elimination_tree, nested_dissection, postorder};

/// Relative error of a known solution above which the system counts as singular to working precision.
const TRIAL_ERROR: f64 = 1e-5;
/// Below this many unknowns threads cost more than they bring.
const PARALLEL_UNKNOWNS: usize = 3000;

/// Which rows are eliminated last, so that their Schur complement is the end of the factor.
pub type Tail<'a> = &'a [u32];

/// Elimination order and structure of the factor: depends on the pattern alone.
pub struct Symbolic {
    /// Row of the system at each position.
    order: Vec<u32>,
    /// Number of rows kept last.
    n_tail: usize,
    structure: supernodal::SymbolicSupernodalCholesky<usize>,
}

/// L of P A Pᵀ = L Lᵀ.
pub struct Factor {
    values: Vec<f64>,
    /// Relative error with which a known solution came back.
    trial_error: f64,
}

impl Factor {
    /// Relative error, in the largest component, with which the factor recovered a known solution: an
    /// estimate of the digits that the condition of the system leaves.
    pub fn trial_error(&self) -> f64 {
        self.trial_error
    }
}

/// Lower triangle of P A Pᵀ in scalar columns.
struct Scalars {
    start: Vec<usize>,
    rows: Vec<usize>,
    values: Vec<f64>,
}

fn parallelism(unknowns: usize) -> Par {
    if unknowns < PARALLEL_UNKNOWNS { Par::Seq } else { Par::rayon(0) }
}

fn buffer(need: StackReq) -> Result<MemBuffer> {
    MemBuffer::try_new(need)
        .map_err(|_| out_of_memory("workspace of the factorisation", need.size_bytes()))
}

fn out_of_memory(what: &'static str, bytes: usize) -> MtmError {
    MtmError::OutOfMemory {
        what,
        needed_mb: bytes >> 20,
        limit_mb: None,
        advice: "use method=\"pcg\", which keeps no factor",
    }
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
        Ok(Self { order, n_tail: tail.len(), structure })
    }

    /// Bytes that a factor takes.
    pub fn factor_bytes(&self) -> usize {
        8 * self.structure.len_val()
    }

    /// The factor of `matrix`, which must have the pattern this structure was made for.
    ///
    /// # Errors
    /// `NotPositiveDefinite` where a pivot is not positive or a known solution is not recovered.
    pub fn factor(&self, matrix: &BlockMatrix) -> Result<Factor> {
        let scalars = lower_scalars(matrix, &self.order);
        let n = 3 * self.order.len();
        let par = parallelism(n);
        let bytes = self.factor_bytes();
        // Asked for first, so that too little memory is an error and not an abort; then taken zeroed
        // from the system, which touches each page once.
        Vec::<f64>::new()
            .try_reserve_exact(self.structure.len_val())
            .map_err(|_| out_of_memory("the Cholesky factor", bytes))?;
        let mut values = vec![0.0; self.structure.len_val()];
        let need = supernodal::factorize_supernodal_numeric_llt_scratch::<usize, f64>(
            &self.structure,
            par,
            Default::default(),
        );
        let mut memory = buffer(need)?;
        let pattern = SymbolicSparseColMatRef::new_unsorted_checked(
            n,
            n,
            &scalars.start,
            None,
            &scalars.rows,
        );
        let outcome = supernodal::factorize_supernodal_numeric_llt(
            &mut values,
            SparseColMatRef::new(pattern, &scalars.values),
            Default::default(),
            &self.structure,
            par,
            MemStack::new(&mut memory),
            Default::default(),
        );
        if let Err(llt::factor::LltError::NonPositivePivot { index }) = outcome {
            return Err(MtmError::NotPositiveDefinite {
                node: self.order[index.min(n - 1) / 3] as usize,
                detail:
                    "a pivot of the factorisation is not positive; a part of the body may be a \
                         mechanism, or the material contrast too large for f64"
                        .into(),
            });
        }
        drop(scalars);
        self.tried(matrix, Factor { values, trial_error: 0.0 })
    }

    /// `factor` after it recovered a known solution.
    ///
    /// The residual of a solve does not tell its error; a solution that is known does, at the price of
    /// one product and one solve per factor.
    fn tried(&self, matrix: &BlockMatrix, factor: Factor) -> Result<Factor> {
        let known: Vec<[f64; 3]> = (0..self.order.len())
            .map(|j| [0, 1, 2].map(|i| 1.0 + 0.5 * ((3 * j + i) as f64 * 0.7).sin()))
            .collect();
        let found = self.solve(&factor, &matrix.multiply(&known));
        let trial_error = known
            .iter()
            .zip(&found)
            .flat_map(|(a, b)| (0..3).map(move |i| (a[i] - b[i]).abs()))
            .fold(0.0_f64, |m, e| if e.is_nan() { f64::INFINITY } else { m.max(e) });
        if trial_error <= TRIAL_ERROR {
            return Ok(Factor { trial_error, ..factor });
        }
        let (worst, at) = self.smallest_pivot(matrix, &factor);
        Err(MtmError::NotPositiveDefinite {
            node: at,
            detail: format!(
                "the smallest pivot keeps {worst:.1e} of its diagonal and a known solution comes back \
                 with relative error {trial_error:.1e}; a part of the body is almost a mechanism, or \
                 the material contrast is too large for f64"
            ),
        })
    }

    /// Smallest share of its diagonal entry that a pivot keeps, and its row.
    fn smallest_pivot(&self, matrix: &BlockMatrix, factor: &Factor) -> (f64, usize) {
        let l = supernodal::SupernodalLltRef::new(&self.structure, &factor.values);
        let (mut worst, mut at) = (f64::INFINITY, 0);
        for s in 0..self.structure.n_supernodes() {
            let node = l.supernode(s);
            let (first, val) = (node.start(), node.val());
            for i in 0..val.ncols() {
                let row = self.order[(first + i) / 3] as usize;
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
    pub fn solve(&self, factor: &Factor, b: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut x = self.permuted(b);
        self.forward(factor, &mut x, 1);
        self.backward(factor, &mut x, 1);
        self.unpermuted(&x)
    }

    /// A⁻¹ B for several right-hand sides, each given as rows of three, in place.
    pub fn solve_many(&self, factor: &Factor, columns: &mut [Vec<[f64; 3]>]) {
        if self.order.is_empty() {
            return;
        }
        let mut x: Vec<f64> = columns.iter().flat_map(|b| self.permuted(b)).collect();
        let k = columns.len();
        self.forward(factor, &mut x, k);
        self.backward(factor, &mut x, k);
        for (column, x) in columns.iter_mut().zip(x.chunks_exact(3 * self.order.len())) {
            *column = self.unpermuted(x);
        }
    }

    /// `b` in elimination order.
    pub fn permuted(&self, b: &[[f64; 3]]) -> Vec<f64> {
        self.order.iter().flat_map(|&j| b[j as usize]).collect()
    }

    /// `x` back in the order of the system.
    pub fn unpermuted(&self, x: &[f64]) -> Vec<[f64; 3]> {
        let mut out = vec![[0.0; 3]; self.order.len()];
        for (&j, v) in self.order.iter().zip(x.chunks_exact(3)) {
            out[j as usize] = [v[0], v[1], v[2]];
        }
        out
    }

    /// x ← L⁻¹ x for `k` columns in elimination order.
    pub fn forward(&self, factor: &Factor, x: &mut [f64], k: usize) {
        self.sweep(factor, x, k, |l, x, par, stack| l.l_solve_with_conj(Conj::No, x, par, stack));
    }

    /// x ← L⁻ᵀ x for `k` columns in elimination order.
    pub fn backward(&self, factor: &Factor, x: &mut [f64], k: usize) {
        self.sweep(factor, x, k, |l, x, par, stack| {
            l.l_transpose_solve_with_conj(Conj::No, x, par, stack);
        });
    }

    fn sweep(
        &self,
        factor: &Factor,
        x: &mut [f64],
        k: usize,
        solve: impl FnOnce(
            &supernodal::SupernodalLltRef<'_, usize, f64>,
            MatMut<'_, f64>,
            Par,
            &mut MemStack,
        ),
    ) {
        let n = 3 * self.order.len();
        // One column is bound by memory bandwidth: threads made it two to three times slower.
        let par = if k == 1 { Par::Seq } else { parallelism(n) };
        let need = self.structure.solve_in_place_scratch::<f64>(k, par);
        let mut memory = MemBuffer::new(need);
        let l = supernodal::SupernodalLltRef::new(&self.structure, &factor.values);
        let x = MatMut::from_column_major_slice_mut(x, n, k);
        solve(&l, x, par, MemStack::new(&mut memory));
    }

    /// Flexibility S⁻¹ of the tail rows, S = L_SS L_SSᵀ their Schur complement, order 3·n_tail, mm/N.
    pub fn tail_flexibility(&self, factor: &Factor) -> TailFactor {
        let (size, first) = (3 * self.n_tail, 3 * (self.order.len() - self.n_tail));
        let mut lower = Mat::<f64>::zeros(size, size);
        let l = supernodal::SupernodalLltRef::new(&self.structure, &factor.values);
        for s in 0..self.structure.n_supernodes() {
            let node = l.supernode(s);
            let (start, val, pattern) = (node.start(), node.val(), node.pattern());
            let width = val.ncols();
            for c in (0..width).filter(|c| start + c >= first) {
                let column = start + c - first;
                for r in c..width {
                    lower[(start + r - first, column)] = val[(r, c)];
                }
                for (r, &row) in pattern.iter().enumerate() {
                    lower[(row - first, column)] = val[(width + r, c)];
                }
            }
        }
        let par = parallelism(size);
        let mut inverse = Mat::<f64>::zeros(size, size);
        faer::linalg::triangular_inverse::invert_lower_triangular(
            inverse.as_mut(),
            lower.as_ref(),
            par,
        );
        let mut flexibility = Mat::<f64>::zeros(size, size);
        use faer::linalg::matmul::triangular::{BlockStructure, matmul};
        matmul(
            flexibility.as_mut(),
            BlockStructure::TriangularLower,
            faer::Accum::Replace,
            inverse.as_ref().transpose(),
            BlockStructure::TriangularUpper,
            inverse.as_ref(),
            BlockStructure::TriangularLower,
            1.0,
            par,
        );
        for c in 0..size {
            for r in 0..c {
                flexibility[(r, c)] = flexibility[(c, r)];
            }
        }
        let rows = self.order[self.order.len() - self.n_tail..].to_vec();
        TailFactor { lower, flexibility, first, rows }
    }
}

/// The end of the factor and its inverse, for contact: everything that sliding nodes do to one another.
pub struct TailFactor {
    /// L_SS.
    lower: Mat<f64>,
    /// S⁻¹, mm/N.
    flexibility: Mat<f64>,
    /// First tail unknown in elimination order.
    first: usize,
    /// Row of the system of each tail node.
    rows: Vec<u32>,
}

impl TailFactor {
    /// Row of the system of tail node `i`.
    pub fn row(&self, i: usize) -> usize {
        self.rows[i] as usize
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        16 * self.lower.nrows() * self.lower.nrows()
    }

    /// Displacements of the tail nodes without contact forces, from x = L⁻¹ P b.
    pub fn free_displacements(&self, forward: &[f64]) -> Vec<[f64; 3]> {
        let mut y = forward[self.first..].to_vec();
        let size = y.len();
        faer::linalg::triangular_solve::solve_upper_triangular_in_place(
            self.lower.as_ref().transpose(),
            MatMut::from_column_major_slice_mut(&mut y, size, 1),
            Par::Seq,
        );
        y.chunks_exact(3).map(|v| [v[0], v[1], v[2]]).collect()
    }

    /// Adds L_SS⁻¹ f for forces on the tail nodes to x = L⁻¹ P b, so that a backward sweep gives the
    /// displacements with those forces.
    pub fn add_forces(&self, forward: &mut [f64], forces: &[[f64; 3]]) {
        let mut f = forces.as_flattened().to_vec();
        let size = f.len();
        faer::linalg::triangular_solve::solve_lower_triangular_in_place(
            self.lower.as_ref(),
            MatMut::from_column_major_slice_mut(&mut f, size, 1),
            Par::Seq,
        );
        for (x, v) in forward[self.first..].iter_mut().zip(f) {
            *x += v;
        }
    }

    /// Displacements of the tail nodes under forces on them alone, S⁻¹ f.
    pub fn respond(&self, forces: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let n = forces.len();
        let columns: Vec<(usize, &[f64; 3])> =
            forces.iter().enumerate().filter(|(_, f)| f.iter().any(|&v| v != 0.0)).collect();
        let rows: Vec<[f64; 3]> = (0..n)
            .into_par_iter()
            .map(|i| {
                // S⁻¹ is symmetric: row i is read down its columns, which are contiguous.
                [0, 1, 2].map(|a| {
                    let column = self.flexibility.col(3 * i + a);
                    columns
                        .iter()
                        .map(|(j, f)| (0..3).map(|b| column[3 * j + b] * f[b]).sum::<f64>())
                        .sum()
                })
            })
            .collect();
        rows
    }

    /// Normal flexibility n_iᵀ S⁻¹_ij n_j of the tail nodes `active` with unit normals `normals`.
    pub fn normal_flexibility(&self, active: &[usize], normals: &[[f64; 3]]) -> DenseSymmetric {
        let k = active.len();
        let mut values = vec![0.0; k * k];
        values.par_chunks_mut(k.max(1)).enumerate().for_each(|(c, column)| {
            let j = active[c];
            let n_j = normals[j];
            let [c0, c1, c2] = [0, 1, 2].map(|b| self.flexibility.col(3 * j + b));
            for (r, out) in column.iter_mut().enumerate().skip(c) {
                let i = active[r];
                let n_i = normals[i];
                *out = (0..3)
                    .map(|a| {
                        let row = 3 * i + a;
                        n_i[a] * (c0[row] * n_j[0] + c1[row] * n_j[1] + c2[row] * n_j[2])
                    })
                    .sum();
            }
        });
        DenseSymmetric { size: k, values }
    }
}

/// Dense symmetric matrix, lower triangle by columns.
pub struct DenseSymmetric {
    size: usize,
    values: Vec<f64>,
}

impl DenseSymmetric {
    /// The matrix of order `size` with the given columns (only the lower triangle is read).
    pub fn new(size: usize, values: Vec<f64>) -> Self {
        Self { size, values }
    }

    /// A⁻¹ b by Cholesky; the row of the first pivot that is not positive on failure.
    pub fn solve(mut self, b: &mut [f64]) -> std::result::Result<(), usize> {
        let n = self.size;
        if n == 0 {
            return Ok(());
        }
        let par = parallelism(4 * n);
        let need = llt::factor::cholesky_in_place_scratch::<f64>(n, par, Default::default());
        let mut memory = MemBuffer::new(need);
        let mut a = MatMut::from_column_major_slice_mut(&mut self.values, n, n);
        llt::factor::cholesky_in_place(
            a.as_mut(),
            Default::default(),
            par,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .map_err(|llt::factor::LltError::NonPositivePivot { index }| index)?;
        llt::solve::solve_in_place(
            MatRef::from_column_major_slice(&self.values, n, n),
            MatMut::from_column_major_slice_mut(b, n, 1),
            Par::Seq,
            MemStack::new(&mut memory),
        );
        Ok(())
    }
}

/// Approximate minimum degree order of a graph (Amestoy, Davis & Duff 1996).
fn minimum_degree(graph: &NodeGraph) -> Result<Vec<u32>> {
    let n = graph.n_nodes();
    let start: Vec<usize> = graph.start.iter().map(|&v| v as usize).collect();
    let rows: Vec<usize> = graph.neighbours.iter().map(|&v| v as usize).collect();
    let (mut order, mut position) = (vec![0_usize; n], vec![0_usize; n]);
    let mut memory = buffer(amd::order_maybe_unsorted_scratch::<usize>(n, rows.len()))?;
    amd::order_maybe_unsorted(
        &mut order,
        &mut position,
        SymbolicSparseColMatRef::new_unsorted_checked(n, n, &start, None, &rows),
        Default::default(),
        MemStack::new(&mut memory),
    )
    .map_err(|_| out_of_memory("the elimination order", 8 * rows.len()))?;
    Ok(order.iter().map(|&j| j as u32).collect())
}

/// Supernodes of the factor in the order `order`.
fn supernodal_structure(
    matrix: &BlockMatrix,
    order: &[u32],
) -> Result<supernodal::SymbolicSupernodalCholesky<usize>> {
    let n = 3 * order.len();
    let (start, rows) = upper_pattern(matrix, order);
    let pattern = SymbolicSparseColMatRef::new_unsorted_checked(n, n, &start, None, &rows);
    let (mut tree, mut counts) = (vec![0_isize; n], vec![0_usize; n]);
    let need = StackReq::any_of(&[
        simplicial::prefactorize_symbolic_cholesky_scratch::<usize>(n, rows.len()),
        supernodal::factorize_supernodal_symbolic_cholesky_scratch::<usize>(n),
    ]);
    let mut memory = buffer(need)?;
    let tree = simplicial::prefactorize_symbolic_cholesky(
        &mut tree,
        &mut counts,
        pattern,
        MemStack::new(&mut memory),
    );
    supernodal::factorize_supernodal_symbolic_cholesky(
        pattern,
        tree,
        &counts,
        MemStack::new(&mut memory),
        SymbolicSupernodalParams::default(),
    )
    .map_err(|_| out_of_memory("the structure of the factor", 8 * rows.len()))
}

fn positions(order: &[u32]) -> Vec<u32> {
    let mut position = vec![0_u32; order.len()];
    for (p, &j) in order.iter().enumerate() {
        position[j as usize] = p as u32;
    }
    position
}

/// Upper triangle of the permuted pattern in scalar columns: start and rows.
fn upper_pattern(matrix: &BlockMatrix, order: &[u32]) -> (Vec<usize>, Vec<usize>) {
    let position = positions(order);
    let (mut start, mut rows) = (vec![0], Vec::new());
    let mut above = Vec::new();
    for (p, &j) in order.iter().enumerate() {
        let (columns, _) = matrix.row(j as usize);
        above.clear();
        above.extend(columns.iter().map(|&k| position[k as usize] as usize).filter(|&q| q < p));
        above.sort_unstable();
        for axis in 0..3 {
            rows.extend(above.iter().flat_map(|&q| [3 * q, 3 * q + 1, 3 * q + 2]));
            rows.extend((0..=axis).map(|a| 3 * p + a));
            start.push(rows.len());
        }
    }
    (start, rows)
}

/// Lower triangle of the permuted matrix in scalar columns, filled in parallel.
fn lower_scalars(matrix: &BlockMatrix, order: &[u32]) -> Scalars {
    let (n, position) = (order.len(), positions(order));
    let mut start = Vec::with_capacity(3 * n + 1);
    start.push(0_usize);
    for (p, &j) in order.iter().enumerate() {
        let below =
            matrix.row(j as usize).0.iter().filter(|&&k| position[k as usize] as usize > p).count();
        for axis in 0..3 {
            start.push(start[start.len() - 1] + 3 * below + 3 - axis);
        }
    }
    let total = start[3 * n];
    let (mut rows, mut values) = (vec![0_usize; total], vec![0.0; total]);
    const NODES_PER_TASK: usize = 512;
    let (mut tasks, mut rest_rows, mut rest_values) = (Vec::new(), &mut rows[..], &mut values[..]);
    for first in (0..n).step_by(NODES_PER_TASK) {
        let last = n.min(first + NODES_PER_TASK);
        let length = start[3 * last] - start[3 * first];
        let (r, tail_r) = rest_rows.split_at_mut(length);
        let (v, tail_v) = rest_values.split_at_mut(length);
        (rest_rows, rest_values) = (tail_r, tail_v);
        tasks.push((first, last, r, v));
    }
    tasks.into_par_iter().for_each(|(first, last, rows, values)| {
        let mut at = 0;
        for p in first..last {
            let (columns, blocks) = matrix.row(order[p] as usize);
            let diagonal = matrix.diagonal_block(order[p] as usize);
            for axis in 0..3 {
                for a in axis..3 {
                    (rows[at], values[at]) = (3 * p + a, diagonal[3 * a + axis]);
                    at += 1;
                }
                for (&k, block) in columns.iter().zip(blocks) {
                    let q = position[k as usize] as usize;
                    if q > p {
                        // Entry (q, p) of the matrix is the transpose of the stored block (p, q).
                        for a in 0..3 {
                            (rows[at], values[at]) = (3 * q + a, block[3 * axis + a]);
                            at += 1;
                        }
                    }
                }
            }
        }
    });
    Scalars { start, rows, values }
}
