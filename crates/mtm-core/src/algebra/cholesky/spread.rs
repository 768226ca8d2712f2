//! Flexibility of chosen rows from the factor, wherever they are in its order.
//!
//! (A⁻¹)_SS = Wᵀ W with W = L⁻¹ E_S, the columns of the identity that belong to the rows S. A column of W has entries
//! at the ancestors of its row alone, and in postorder the columns of a subtree are neighbours. So each supernode
//! solves for a dense block of W, and adds the square of it to a block on the diagonal. Rows kept last are held:
//! what W would carry to them is returned instead.

use std::ops::Range;

use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::{Accum, MatMut, MatRef, Par};

use super::numeric::{LEAST_ROWS_FOR_THREADS, Runs, Tree};
use super::sweep::{Columns, Supernode};

/// The columns of L⁻¹ that belong to some unknowns.
pub(super) struct Spread<'a> {
    pub l: Columns<'a>,
    pub tree: &'a Tree,
    /// The unknowns, by their places in the order of elimination, ascending.
    pub unknowns: &'a [usize],
    /// First unknown that is kept last.
    pub first_of_tail: usize,
}

/// What a supernode passes to its parent: itself, its unknowns, and the rows of its pattern column by column.
type Carried = (usize, Range<usize>, Vec<f64>);

impl Spread<'_> {
    /// Wᵀ W above the tail, column by column, of which the lower triangle counts; and what W carries to the tail,
    /// column by column.
    pub fn square(&self) -> (Vec<f64>, Vec<f64>) {
        let (size, tail) = (self.unknowns.len(), self.l.0.nrows() - self.first_of_tail);
        let (mut square, mut carried) = (vec![0.0; size * size], vec![0.0; size * tail]);
        let mut updates: Vec<Carried> = Vec::new();
        for s in 0..self.tree.tail {
            let below = self.tree.first[s];
            let kept = updates.partition_point(|(child, ..)| *child < below);
            let mine = updates.split_off(kept);
            let [begin, end] = [self.l.0.supernode_begin()[below], self.l.0.supernode_end()[s]];
            let range = self.place(begin)..self.place(end);
            if !range.is_empty() {
                updates.push((s, range.clone(), self.supernode(s, range, mine, &mut square)));
            }
        }
        // The first supernode of the tail may begin above it. What is passed to later ones is of the tail alone.
        let s = self.tree.tail;
        if self.l.0.supernode_begin().get(s).is_some_and(|&begin| begin < self.first_of_tail) {
            let (mine, others) =
                updates.into_iter().partition(|(c, ..)| self.tree.children[s].contains(c));
            updates = others;
            updates.push((s, 0..size, self.supernode(s, 0..size, mine, &mut square)));
        }
        for (s, range, values) in updates {
            let node = Supernode::new(self.l, s);
            let own = node.begin + self.swept(&node)..node.begin + node.width;
            let rows: Vec<usize> = own.chain(node.pattern.iter().copied()).collect();
            for (c, column) in range.zip(values.chunks_exact(rows.len().max(1))) {
                for (row, v) in rows.iter().zip(column) {
                    carried[c * tail + row - self.first_of_tail] += v;
                }
            }
        }
        (square, carried)
    }

    /// How many of the unknowns come before this one.
    fn place(&self, unknown: usize) -> usize {
        self.unknowns.partition_point(|&at| at < unknown)
    }

    /// Columns of a supernode that are not kept last.
    fn swept(&self, node: &Supernode<'_>) -> usize {
        node.width.min(self.first_of_tail - node.begin)
    }

    /// Solves for the block of W at supernode `s`, of the unknowns `range`, and adds its square; returns the update
    /// of the rows below.
    fn supernode(
        &self,
        s: usize,
        range: Range<usize>,
        children: Vec<Carried>,
        square: &mut [f64],
    ) -> Vec<f64> {
        let (node, size, first) = (Supernode::new(self.l, s), self.unknowns.len(), range.start);
        let (rows, swept, columns) = (node.rows(), self.swept(&node), range.len());
        let end = node.begin + node.width;
        let mut front = vec![0.0; rows * columns];
        for (child, range, values) in children {
            let below = self.l.0.supernode(child).pattern();
            let runs = Runs::new(below, node.begin, end, node.pattern);
            let to = front[(range.start - first) * rows..].chunks_exact_mut(rows);
            for (to, from) in to.zip(values.chunks_exact(below.len().max(1))) {
                runs.copy(from, to);
            }
        }
        for c in range.start.max(self.place(node.begin))..range.end {
            front[(c - first) * rows + self.unknowns[c] - node.begin] = 1.0;
        }
        let alone = rows.max(columns) >= LEAST_ROWS_FOR_THREADS;
        let par = if alone { Par::rayon(0) } else { Par::Seq };
        let l = MatRef::from_column_major_slice(node.values, rows, node.width);
        let l = l.subcols(0, swept);
        let (mut top, mut rest) =
            MatMut::from_column_major_slice_mut(&mut front, rows, columns).split_at_row_mut(swept);
        solve_lower_triangular_in_place(l.subrows(0, swept), top.as_mut(), par);
        let below = l.subrows(swept, rows - swept);
        matmul(rest.as_mut(), Accum::Add, below, top.as_ref(), -1.0, par);
        triangular::matmul(
            MatMut::from_column_major_slice_mut(square, size, size)
                .submatrix_mut(first, first, columns, columns),
            BlockStructure::TriangularLower,
            Accum::Add,
            top.as_ref().transpose(),
            BlockStructure::Rectangular,
            top.as_ref(),
            BlockStructure::Rectangular,
            1.0,
            par,
        );
        front.chunks_exact(rows).flat_map(|column| &column[swept..]).copied().collect()
    }
}
