//! Sweeps through the part of the factor that a few rows reach: their columns and all ancestors in the
//! elimination tree (Gilbert & Peierls 1988).
//!
//! A force on those rows changes L⁻¹ b only there, and their displacements depend on nothing else.
//! Displacements of sliding nodes under forces on sliding nodes can therefore be computed without the rest of
//! the body.

use faer::linalg::matmul::matmul;
use faer::linalg::matmul::triangular::{self, BlockStructure};
use faer::linalg::triangular_solve::solve_lower_triangular_in_place;
use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;
use faer::{Accum, Mat, MatMut, MatRef, Par};

use super::sweep::{Columns, Split, Supernode};
use super::symmetric::DenseSymmetric;

/// Entries of a product from which its dense kernels benefit from threads.
const LEAST_WORK_FOR_THREADS: usize = 1 << 22;

/// The supernodes that a set of rows reaches, in elimination order.
pub struct Reach {
    supernodes: Vec<usize>,
    /// First unknown of each row of the set in elimination order, in the caller's order.
    places: Vec<usize>,
}

impl Reach {
    /// The reach of unknowns that begin at `places` in elimination order, three a row.
    pub fn new(structure: &SymbolicSupernodalCholesky<usize>, places: Vec<usize>) -> Self {
        let of = supernode_of(structure);
        let mut reached = vec![false; structure.n_supernodes()];
        for &place in &places {
            reached[of[place]] = true;
        }
        for s in 0..reached.len() {
            if let (true, Some(&row)) = (reached[s], structure.supernode(s).pattern().first()) {
                reached[of[row]] = true;
            }
        }
        let supernodes = (0..reached.len()).filter(|&s| reached[s]).collect();
        Self { supernodes, places }
    }

    /// Bytes held.
    pub fn bytes(&self) -> usize {
        8 * (self.supernodes.len() + self.places.len())
    }

    /// Adds a force on each row of the set to `x`, in elimination order.
    pub fn scatter(&self, forces: &[[f64; 3]], x: &mut [f64]) {
        for (&place, f) in self.places.iter().zip(forces) {
            for i in 0..3 {
                x[place + i] += f[i];
            }
        }
    }

    /// The values of `x` on the rows of the set.
    pub fn gather(&self, x: &[f64]) -> Vec<[f64; 3]> {
        self.places.iter().map(|&p| [x[p], x[p + 1], x[p + 2]]).collect()
    }

    /// Sets `x` to zero wherever the rows of the set reach.
    pub fn clear(&self, structure: &SymbolicSupernodalCholesky<usize>, x: &mut [f64]) {
        for &s in &self.supernodes {
            x[structure.supernode_begin()[s]..structure.supernode_end()[s]].fill(0.0);
        }
    }

    /// x ← L⁻¹ x for an x that is zero except at the rows of the set.
    pub fn forward(&self, l: Columns<'_>, x: &mut [f64]) {
        let base = x.len();
        let (mut x, mut front) = (Split { own: x, origin: 0, above: &mut [][..], base }, vec![]);
        for &s in &self.supernodes {
            Supernode::new(l, s).forward(&mut x, &mut front);
        }
    }

    /// x ← L⁻ᵀ x on the reach; the rest of x stays as it is.
    pub fn backward(&self, l: Columns<'_>, x: &mut [f64]) {
        let base = x.len();
        let (mut x, mut front) = (Split { own: x, origin: 0, above: &[][..], base }, vec![]);
        for &s in self.supernodes.iter().rev() {
            Supernode::new(l, s).backward(&mut x, &mut front);
        }
    }

    /// Flexibility n_iᵀ A⁻¹ n_j of the rows of the set along one unit normal each, mm/N, and for each of its
    /// rows the row of the set.
    ///
    /// With Y = L⁻¹ N it is YᵀY. In elimination order the columns of Y in a supernode's subtree are contiguous,
    /// so each supernode works on a dense block and passes the rest to its parent.
    pub fn normal_flexibility(
        &self,
        l: Columns<'_>,
        normals: &[[f64; 3]],
    ) -> (DenseSymmetric, Vec<usize>) {
        let mut rows: Vec<usize> = (0..self.places.len()).collect();
        rows.sort_unstable_by_key(|&i| self.places[i]);
        let n = rows.len();
        let mut gram = vec![0.0; n * n];
        let of = supernode_of(l.0);
        let mut left: Vec<(usize, Left)> = Vec::new();
        let mut next = 0;
        for &s in &self.supernodes {
            let node = Supernode::new(l, s);
            let Supernode { begin, width, pattern, .. } = node;
            let first_child = left.iter().position(|(parent, _)| *parent == s);
            let children = left.split_off(first_child.unwrap_or(left.len()));
            let first = children.first().map_or(next, |(_, child)| child.first);
            let own = next;
            while next < n && self.places[rows[next]] < begin + width {
                next += 1;
            }
            let mut front = Mat::<f64>::zeros(node.rows(), next - first);
            for k in own..next {
                for i in 0..3 {
                    front[(self.places[rows[k]] + i - begin, k - first)] = normals[rows[k]][i];
                }
            }
            for (_, child) in children {
                let child_pattern = l.0.supernode(child.supernode).pattern();
                let places = places_in(child_pattern, begin, width, pattern);
                for c in 0..child.values.ncols() {
                    let to = child.first - first + c;
                    for (r, &place) in places.iter().enumerate() {
                        front[(place, to)] += child.values[(r, c)];
                    }
                }
            }
            let work = node.rows() * width * front.ncols();
            let par = if work < LEAST_WORK_FOR_THREADS { Par::Seq } else { Par::rayon(0) };
            let columns = MatRef::from_column_major_slice(node.values, node.rows(), width);
            let (l_top, l_bottom) = columns.split_at_row(width);
            let (mut top, mut bottom) = front.as_mut().split_at_row_mut(width);
            solve_lower_triangular_in_place(l_top, top.as_mut(), par);
            matmul(bottom.as_mut(), Accum::Add, l_bottom, top.as_ref(), -1.0, par);
            let target = MatMut::from_column_major_slice_mut(&mut gram, n, n);
            triangular::matmul(
                target.submatrix_mut(first, first, next - first, next - first),
                BlockStructure::TriangularLower,
                Accum::Add,
                top.as_ref().transpose(),
                BlockStructure::Rectangular,
                top.as_ref(),
                BlockStructure::Rectangular,
                1.0,
                par,
            );
            if let Some(&row) = pattern.first() {
                let values = bottom.to_owned();
                left.push((of[row], Left { supernode: s, first, values }));
            }
        }
        (DenseSymmetric::from_lower(n, gram), rows)
    }
}

/// The update that a supernode passes to its parent: columns from `first` on, on the rows of its pattern.
struct Left {
    supernode: usize,
    first: usize,
    values: Mat<f64>,
}

/// The supernode that each column belongs to.
fn supernode_of(structure: &SymbolicSupernodalCholesky<usize>) -> Vec<usize> {
    let (begin, end) = (structure.supernode_begin(), structure.supernode_end());
    let mut of = vec![0; structure.nrows()];
    for s in 0..structure.n_supernodes() {
        of[begin[s]..end[s]].fill(s);
    }
    of
}

/// Positions of the rows of a child's pattern in the front of its parent: `width` columns from `begin`, then
/// `pattern`, which holds the rest of them.
fn places_in(child: &[usize], begin: usize, width: usize, pattern: &[usize]) -> Vec<usize> {
    let mut at = 0;
    let place = |&row: &usize| {
        if row < begin + width {
            return row - begin;
        }
        while pattern[at] < row {
            at += 1;
        }
        width + at
    };
    child.iter().map(place).collect()
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::Arc;

    use super::super::{Symbolic, grid::grid};

    #[test]
    fn sweeps_through_the_reach_equal_whole_solves() {
        let matrix = grid(23);
        let symbolic = Arc::new(Symbolic::new(&matrix, &[]).unwrap());
        let factor = symbolic.factor(&matrix).unwrap();
        let rows: Vec<u32> = (0..23).map(|i| 23 * i + (i * i) % 5).rev().collect();
        let reach = factor.reach(&rows);
        let forces: Vec<[f64; 3]> =
            (0..rows.len()).map(|i| [0, 1, 2].map(|a| ((3 * i + a) as f64).cos())).collect();
        let mut b = vec![[0.0; 3]; matrix.n_rows()];
        for (&row, &f) in rows.iter().zip(&forces) {
            b[row as usize] = f;
        }
        let whole = factor.solve(&b);
        let mut x = vec![0.0; 3 * matrix.n_rows()];
        let found = factor.respond(&reach, &forces, &mut x);
        let largest = whole.as_flattened().iter().fold(0.0_f64, |m, v| m.max(v.abs()));
        for (&row, v) in rows.iter().zip(&found) {
            for i in 0..3 {
                assert!((whole[row as usize][i] - v[i]).abs() <= 1e-13 * largest);
            }
        }
        // The workspace is returned unchanged.
        assert!(x.iter().all(|&v| v == 0.0));
    }

    #[test]
    fn normal_flexibility_equals_that_of_whole_solves() {
        let matrix = grid(23);
        let symbolic = Arc::new(Symbolic::new(&matrix, &[]).unwrap());
        let factor = symbolic.factor(&matrix).unwrap();
        let rows: Vec<u32> = (0..23).map(|i| 23 * i + (i * i) % 5).rev().collect();
        let normals: Vec<[f64; 3]> =
            (0..rows.len()).map(|i| [(i as f64).sin(), (i as f64).cos(), 0.5]).collect();
        let reach = factor.reach(&rows);
        let (found, order) = factor.reach_flexibility(&reach, &normals);
        for (c, &j) in order.iter().enumerate() {
            let mut b = vec![[0.0; 3]; matrix.n_rows()];
            b[rows[j] as usize] = normals[j];
            let u = factor.solve(&b);
            for (&i, v) in order[c..].iter().zip(found.column(c)) {
                let exact = crate::vector::dot(normals[i], u[rows[i] as usize]);
                assert!((exact - v).abs() <= 1e-13, "{i} {j}: {exact:e} {v:e}");
            }
        }
    }
}
