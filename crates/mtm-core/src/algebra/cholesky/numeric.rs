//! Numeric factorisation, multifrontal (Duff & Reid 1983): each supernode gathers its part of the matrix and
//! the updates of its children, factorises its columns densely, and passes the rest to its parent.
//!
//! Independent subtrees run on different threads with sequential dense kernels; the few large fronts at the
//! top, where no other work is left, use all threads in their kernels. Children are added in a fixed order, so
//! the result is bitwise identical for any number of threads.

use std::ops::Range;

use faer::dyn_stack::{MemBuffer, MemStack};
use faer::linalg::cholesky::llt;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;
use faer::{Accum, MatMut, Par};

use crate::algebra::blocks::BlockMatrix;

/// Multiplications below which a subtree is not worth another thread.
const LEAST_WORK_FOR_A_THREAD: f64 = 2e7;
/// Minimum share of the work on the smaller side: it bounds the depth of the sharing.
const LEAST_SHARE_FOR_A_THREAD: f64 = 0.05;
/// Number of rows from which the dense kernels of a front benefit from threads.
pub(super) const LEAST_ROWS_FOR_THREADS: usize = 384;

/// Elimination tree of the supernodes.
pub struct Tree {
    pub(super) children: Vec<Vec<usize>>,
    /// First supernode of each subtree; the subtree is the run from there to its root.
    pub(super) first: Vec<usize>,
    /// Multiplications of each subtree.
    work: Vec<f64>,
    /// Roots among the supernodes before the tail, ascending.
    pub(super) roots: Vec<usize>,
    /// First supernode that holds a tail column: from there on the order is not a postorder.
    pub(super) tail: usize,
}

impl Tree {
    /// The tree of `structure`, whose columns are in postorder before column `n_inner`.
    pub fn new(structure: &SymbolicSupernodalCholesky<usize>, n_inner: usize) -> Self {
        let n = structure.n_supernodes();
        let (begin, end) = (structure.supernode_begin(), structure.supernode_end());
        let mut supernode_of = vec![0; structure.nrows()];
        for s in 0..n {
            supernode_of[begin[s]..end[s]].fill(s);
        }
        let tail = (0..n).find(|&s| end[s] > n_inner).unwrap_or(n);
        let (mut children, mut first) = (vec![Vec::new(); n], (0..n).collect::<Vec<_>>());
        let (mut work, mut roots) = (vec![0.0; n], Vec::new());
        for s in 0..n {
            let pattern = structure.supernode(s).pattern();
            let (width, height) = ((end[s] - begin[s]) as f64, pattern.len() as f64);
            work[s] += width * (width + height) * (width + height);
            let parent = pattern.first().map(|&row| supernode_of[row]);
            if let Some(p) = parent {
                children[p].push(s);
            }
            match parent {
                Some(p) if p < tail => {
                    first[p] = first[p].min(first[s]);
                    work[p] += work[s];
                }
                _ if s < tail => roots.push(s),
                _ => {}
            }
        }
        Self { children, first, work, roots, tail }
    }

    /// Which supernodes hold one of the `unknowns`, or are an ancestor of one that does.
    pub fn above(
        &self,
        structure: &SymbolicSupernodalCholesky<usize>,
        unknowns: impl Iterator<Item = usize>,
    ) -> Vec<bool> {
        let begin = structure.supernode_begin();
        let mut needed = vec![false; begin.len()];
        unknowns.for_each(|at| needed[begin.partition_point(|&b| b <= at) - 1] = true);
        for s in 0..needed.len() {
            needed[s] |= self.children[s].iter().any(|&child| needed[child]);
        }
        needed
    }
}

/// The update that a supernode passes to its parent: the lower triangle of a square by columns, rows of its
/// pattern.
type Update = (usize, Vec<f64>);

/// A factorisation of `matrix`, whose row `order[p]` has the position p.
pub struct Work<'a> {
    pub structure: &'a SymbolicSupernodalCholesky<usize>,
    pub tree: &'a Tree,
    pub matrix: &'a BlockMatrix,
    pub order: &'a [u32],
    pub position: &'a [u32],
}

impl Work<'_> {
    /// Fills `values` (zeros) with the factor; on failure, the column of the first pivot that is not positive.
    pub fn factor(&self, values: &mut [f64]) -> Result<(), usize> {
        let (tree, start) = (self.tree, self.structure.col_ptr_for_val());
        let (inner, tail) = values.split_at_mut(start[tree.tail]);
        let alone = rayon::current_num_threads() > 1;
        let mut updates = self.subtrees(&tree.roots, inner, 0, alone)?;
        let mut rest = tail;
        for s in tree.tail..self.structure.n_supernodes() {
            let (own, after) = rest.split_at_mut(start[s + 1] - start[s]);
            rest = after;
            let (mine, others) =
                updates.into_iter().partition(|(c, _)| tree.children[s].contains(c));
            updates = others;
            updates.push((s, self.supernode(s, own, mine, alone)?));
        }
        Ok(())
    }

    /// Factorises the subtrees of `roots`, whose values begin with those of supernode `first`; returns their
    /// updates, in order.
    fn subtrees(
        &self,
        roots: &[usize],
        values: &mut [f64],
        first: usize,
        alone: bool,
    ) -> Result<Vec<Update>, usize> {
        let start = self.structure.col_ptr_for_val();
        if let Some(cut) = self.cut(roots) {
            let middle = roots[cut - 1] + 1;
            let (left, right) = values.split_at_mut(start[middle] - start[first]);
            let (a, b) = rayon::join(
                || self.subtrees(&roots[..cut], left, first, false),
                || self.subtrees(&roots[cut..], right, middle, false),
            );
            let (mut a, b) = (a?, b?);
            a.extend(b);
            return Ok(a);
        }
        let mut updates = Vec::with_capacity(roots.len());
        let (mut rest, mut at) = (values, first);
        for &root in roots {
            let (own, after) = rest.split_at_mut(start[root + 1] - start[at]);
            rest = after;
            updates.push((root, self.subtree(root, own, at, alone)?));
            at = root + 1;
        }
        Ok(updates)
    }

    /// How many of `roots` to give to one thread so that two have the same amount of work; nothing if the
    /// smaller share is not worth a thread.
    fn cut(&self, roots: &[usize]) -> Option<usize> {
        let work: f64 = roots.iter().map(|&r| self.tree.work[r]).sum();
        let (mut cut, mut done) = (0, 0.0);
        while cut + 1 < roots.len() && done + 0.5 * self.tree.work[roots[cut]] < 0.5 * work {
            done += self.tree.work[roots[cut]];
            cut += 1;
        }
        let lesser = done.min(work - done);
        (lesser > LEAST_WORK_FOR_A_THREAD.max(LEAST_SHARE_FOR_A_THREAD * work)).then_some(cut)
    }

    /// Factorises the subtree of `root`, whose values begin with those of supernode `first`; returns its update
    /// to its parent.
    ///
    /// The subtree is a run of supernodes in postorder. It is processed in a loop, with the pending updates on
    /// a stack, except at the one place below its heaviest branch where two threads can share it. The depth of
    /// the recursion is therefore that of the sharing, not of the tree.
    fn subtree(
        &self,
        root: usize,
        values: &mut [f64],
        first: usize,
        alone: bool,
    ) -> Result<Vec<f64>, usize> {
        let (tree, start) = (self.tree, self.structure.col_ptr_for_val());
        let mut shared = Some(root);
        while let Some(t) = shared
            && self.cut(&tree.children[t]).is_none()
        {
            let heaviest = tree.children[t]
                .iter()
                .copied()
                .max_by(|&a, &b| tree.work[a].total_cmp(&tree.work[b]));
            shared = heaviest.filter(|&c| tree.work[c] > LEAST_WORK_FOR_A_THREAD);
        }
        let mut updates: Vec<Update> = Vec::new();
        let (mut rest, mut s) = (values, first);
        while s <= root {
            if let Some(t) = shared.filter(|&t| tree.first[t] == s) {
                let (below, after) = rest.split_at_mut(start[t] - start[s]);
                rest = after;
                updates.extend(self.subtrees(&tree.children[t], below, s, alone)?);
                (s, shared) = (t, None);
            }
            let (own, after) = rest.split_at_mut(start[s + 1] - start[s]);
            rest = after;
            let mine = updates.split_off(updates.len() - tree.children[s].len());
            updates.push((s, self.supernode(s, own, mine, alone)?));
            s += 1;
        }
        Ok(updates.pop().map(|(_, update)| update).unwrap_or_default())
    }

    /// Factorises the columns of supernode `s` into `own`; returns the update of its pattern.
    fn supernode(
        &self,
        s: usize,
        own: &mut [f64],
        updates: Vec<Update>,
        alone: bool,
    ) -> Result<Vec<f64>, usize> {
        let node = self.structure.supernode(s);
        let (begin, pattern) = (node.start(), node.pattern());
        let end = self.structure.supernode_end()[s];
        let (width, height) = (end - begin, pattern.len());
        let rows = width + height;
        self.gather(begin, end, pattern, own);
        let children: Vec<(Runs, Vec<f64>)> = updates
            .into_iter()
            .map(|(child, values)| {
                let child = self.structure.supernode(child).pattern();
                (Runs::new(child, begin, end, pattern), values)
            })
            .collect();
        for (runs, values) in &children {
            runs.add(values, 0..runs.own, own, rows, 0);
        }
        let par = if alone && rows >= LEAST_ROWS_FOR_THREADS { Par::rayon(0) } else { Par::Seq };
        let (mut top, mut bottom) =
            MatMut::from_column_major_slice_mut(own, rows, width).split_at_row_mut(width);
        let need = llt::factor::cholesky_in_place_scratch::<f64>(width, par, Default::default());
        let mut memory = MemBuffer::new(need);
        llt::factor::cholesky_in_place(
            top.as_mut(),
            Default::default(),
            par,
            MemStack::new(&mut memory),
            Default::default(),
        )
        .map_err(|llt::factor::LltError::NonPositivePivot { index }| begin + index)?;
        solve_lower_triangular_in_place(top.as_ref(), bottom.as_mut().transpose_mut(), par);
        let mut update = vec![0.0; height * height];
        triangular::matmul(
            MatMut::from_column_major_slice_mut(&mut update, height, height),
            BlockStructure::TriangularLower,
            Accum::Replace,
            bottom.as_ref(),
            BlockStructure::Rectangular,
            bottom.as_ref().transpose(),
            BlockStructure::Rectangular,
            -1.0,
            par,
        );
        for (runs, values) in children {
            runs.add(&values, runs.own..runs.size, &mut update, height, width);
        }
        Ok(update)
    }

    /// Adds the columns `begin..end` of the permuted matrix, on and below the diagonal, to a front.
    fn gather(&self, begin: usize, end: usize, pattern: &[usize], own: &mut [f64]) {
        let (width, rows) = (end - begin, end - begin + pattern.len());
        for p in begin / 3..end / 3 {
            let row = self.order[p] as usize;
            let (columns, blocks) = self.matrix.row(row);
            for (&k, block) in columns.iter().zip(blocks) {
                let q = self.position[k as usize] as usize;
                if q < p {
                    continue;
                }
                let at = if 3 * q < end {
                    3 * q - begin
                } else {
                    width + pattern.partition_point(|&r| r < 3 * q)
                };
                for axis in 0..3 {
                    let column = &mut own[(3 * p + axis - begin) * rows..][..rows];
                    // The stored block is (p, q); the front needs its transpose at (q, p). On the diagonal only
                    // the part on and below it.
                    let from = if q == p { axis } else { 0 };
                    for a in from..3 {
                        column[at + a] += block[3 * axis + a];
                    }
                }
            }
        }
    }
}

/// Positions of the rows of a child's pattern in its parent's front, as runs of neighbours.
pub(super) struct Runs {
    /// First row of the child, first row of the front, length.
    runs: Vec<(usize, usize, usize)>,
    /// Rows of the child's pattern.
    size: usize,
    /// How many of them are columns of the parent.
    own: usize,
}

impl Runs {
    /// Of the rows `child`, in the front of the columns `begin..end` with the rows `pattern` below.
    pub fn new(child: &[usize], begin: usize, end: usize, pattern: &[usize]) -> Self {
        let mut runs: Vec<(usize, usize, usize)> = Vec::new();
        let mut next = 0;
        for (i, &row) in child.iter().enumerate() {
            let place = if row < end {
                row - begin
            } else {
                while pattern[next] < row {
                    next += 1;
                }
                end - begin + next
            };
            match runs.last_mut() {
                Some((_, first, length)) if *first + *length == place => *length += 1,
                _ => runs.push((i, place, 1)),
            }
        }
        Self { runs, size: child.len(), own: child.partition_point(|&row| row < end) }
    }

    /// Copies a column with the child's rows to one of the front.
    pub fn copy(&self, child: &[f64], front: &mut [f64]) {
        for &(from, to, length) in &self.runs {
            front[to..to + length].copy_from_slice(&child[from..from + length]);
        }
    }

    /// Adds columns `columns` of the child's update to a target of `height` rows whose first row and column
    /// are those of row `shift` of the front.
    fn add(
        &self,
        child: &[f64],
        columns: Range<usize>,
        target: &mut [f64],
        height: usize,
        shift: usize,
    ) {
        let mut at = 0;
        for j in columns {
            while self.runs[at].0 + self.runs[at].2 <= j {
                at += 1;
            }
            let (first, place, _) = self.runs[at];
            let column = place + (j - first) - shift;
            let source = &child[j * self.size..(j + 1) * self.size];
            let target = &mut target[column * height..(column + 1) * height];
            for &(from, to, length) in &self.runs[at..] {
                let cut = j.saturating_sub(from);
                let (from, to, length) = (from + cut, to + cut - shift, length - cut);
                for (t, v) in target[to..to + length].iter_mut().zip(&source[from..from + length]) {
                    *t += v;
                }
            }
        }
    }
}
