//! Sweeps of one column through the factor: x ← L⁻¹ x and x ← L⁻ᵀ x.
//!
//! The time for one column is that of reading the factor, which two threads do faster than one: independent
//! subtrees of the elimination tree run in parallel. Only the structure decides which, and their contributions
//! to their ancestors are added in a fixed order, so the result is bitwise identical for any number of threads.

use faer::sparse::linalg::cholesky::supernodal::SymbolicSupernodalCholesky;

use super::numeric::Tree;
use super::symmetric::{add_scaled, dot};
use crate::algebra::simd::{Kernel, widest};

/// Supernodes of a factor: structure, and values column by column.
pub type Columns<'a> = (&'a SymbolicSupernodalCholesky<usize>, &'a [f64]);

/// Entries of the factor below which a subtree is not worth another thread: 4 MB, a third of a millisecond.
const LEAST_ENTRIES_FOR_A_THREAD: usize = 1 << 19;
/// The same as a share of the factor: it limits the copies of what lies above the subtrees.
const LEAST_SHARE_FOR_A_THREAD: f64 = 1.0 / 16.0;

/// One supernode: its columns of L, and the rows below them.
pub struct Supernode<'a> {
    /// First column.
    pub begin: usize,
    /// Number of columns.
    pub width: usize,
    /// How many of them, from the first on, sweeps use.
    swept: usize,
    /// Rows below the columns, ascending.
    pub pattern: &'a [usize],
    /// Columns of `rows()` entries; entries above the diagonal are not read.
    pub values: &'a [f64],
}

impl<'a> Supernode<'a> {
    /// Supernode `s` of a factor.
    pub fn new((structure, values): Columns<'a>, s: usize) -> Self {
        let (begin, start) = (structure.supernode_begin()[s], structure.col_ptr_for_val());
        let width = structure.supernode_end()[s] - begin;
        Self {
            begin,
            width,
            swept: width,
            pattern: structure.supernode(s).pattern(),
            values: &values[start[s]..start[s + 1]],
        }
    }

    /// The same, with sweeps through its columns before `end` alone.
    fn before(self, end: usize) -> Self {
        Self { swept: self.width.min(end.saturating_sub(self.begin)), ..self }
    }

    /// Rows of its columns.
    pub fn rows(&self) -> usize {
        self.width + self.pattern.len()
    }

    /// Eliminates its columns from x; columns in which x is zero are not read, so that the cost of a sparse
    /// right-hand side is that of the part it reaches (Gilbert & Peierls 1988).
    pub fn forward(&self, x: &mut Split<'_, &mut [f64]>, front: &mut Vec<f64>) {
        let own = self.begin - x.origin;
        if x.own[own..own + self.swept].iter().all(|&v| v == 0.0) {
            return;
        }
        front.clear();
        front.extend_from_slice(&x.own[own..own + self.width]);
        front.resize(self.rows(), 0.0);
        widest(Eliminate { values: self.values, columns: self.swept, front });
        x.own[own..own + self.width].copy_from_slice(&front[..self.width]);
        for (&row, v) in self.pattern.iter().zip(&front[self.width..]) {
            if row < x.base {
                x.own[row - x.origin] += v;
            } else {
                x.above[row - x.base] += v;
            }
        }
    }

    /// Substitutes the values known above back into its columns of x.
    pub fn backward(&self, x: &mut Split<'_, &[f64]>, front: &mut Vec<f64>) {
        let own = self.begin - x.origin;
        front.clear();
        front.extend_from_slice(&x.own[own..own + self.width]);
        let known = |&row: &usize| {
            if row < x.base { x.own[row - x.origin] } else { x.above[row - x.base] }
        };
        front.extend(self.pattern.iter().map(known));
        widest(Substitute { values: self.values, columns: self.swept, front });
        x.own[own..own + self.width].copy_from_slice(&front[..self.width]);
    }
}

/// The part of x that belongs to one thread: a run of columns from `origin` on, and those from `base` on, which
/// other threads see as well.
pub struct Split<'a, Above> {
    /// The run.
    pub own: &'a mut [f64],
    /// Column of its first entry.
    pub origin: usize,
    /// Forward: contribution of the run to the columns above. Backward: their values.
    pub above: Above,
    /// Column of the first entry of `above`.
    pub base: usize,
}

/// Forward step of a front: its first columns, and their contribution to the rows below.
struct Eliminate<'a> {
    values: &'a [f64],
    columns: usize,
    front: &'a mut [f64],
}

impl Kernel for Eliminate<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let rows = self.front.len();
        for c in 0..self.columns {
            let column = &self.values[c * rows + c..(c + 1) * rows];
            let (own, below) = self.front[c..].split_at_mut(1);
            own[0] /= column[0];
            add_scaled(&column[1..], -own[0], below);
        }
    }
}

/// The first columns of front ← L⁻ᵀ of them, given the rows below.
struct Substitute<'a> {
    values: &'a [f64],
    columns: usize,
    front: &'a mut [f64],
}

impl Kernel for Substitute<'_> {
    type Output = ();
    #[inline(always)]
    fn run(self) {
        let rows = self.front.len();
        for c in (0..self.columns).rev() {
            let column = &self.values[c * rows + c..(c + 1) * rows];
            let (own, below) = self.front[c..].split_at_mut(1);
            own[0] = (own[0] - dot(&column[1..], below)) / column[0];
        }
    }
}

/// Sweeps through a factor.
pub struct Sweep<'a> {
    l: Columns<'a>,
    tree: &'a Tree,
    /// Entries of the factor from which a subtree is worth a thread.
    least: usize,
    /// Which supernodes the backward sweep goes through, if not through all.
    needed: Option<&'a [bool]>,
}

impl<'a> Sweep<'a> {
    /// Sweeps through `l`, whose elimination tree is `tree`.
    pub fn new(l: Columns<'a>, tree: &'a Tree) -> Self {
        let share = LEAST_SHARE_FOR_A_THREAD * l.1.len() as f64;
        Self { l, tree, least: LEAST_ENTRIES_FOR_A_THREAD.max(share as usize), needed: None }
    }

    /// The same, in which subtrees of so many entries are worth a thread; None if there are none.
    pub fn with_threads_from(self, least: usize) -> Option<Self> {
        let (sweep, roots) = (Self { least, ..self }, &self.tree.roots);
        (sweep.cut(roots).is_some() || sweep.shared(roots).is_some()).then_some(sweep)
    }

    /// The same, backward through some supernodes alone: with each, all of its ancestors.
    pub fn through(self, needed: &'a [bool]) -> Self {
        Self { needed: Some(needed), ..self }
    }

    /// x ← L⁻¹ x.
    pub fn forward(&self, x: &mut [f64]) {
        self.forward_to(self.l.0.nrows(), x);
    }

    /// x ← L⁻ᵀ x.
    pub fn backward(&self, x: &mut [f64]) {
        self.backward_from(self.l.0.nrows(), x);
    }

    /// Eliminates the columns before `end`, which is the first of the tail or past the last: the remaining
    /// part, from `end` on, is the right-hand side of their Schur complement.
    pub fn forward_to(&self, end: usize, x: &mut [f64]) {
        let (n, base) = (self.l.0.nrows(), self.base());
        let (inner, rest) = x.split_at_mut(base);
        let brought = self.forward_below(&self.tree.roots, inner, base);
        add(rest, &brought);
        let mut front = Vec::new();
        let mut x = Split { own: rest, origin: base, above: &mut [][..], base: n };
        for node in self.tail_before(end) {
            node.forward(&mut x, &mut front);
        }
    }

    /// Columns before `end`, as in [`Self::forward_to`], computed from the known ones from there on.
    pub fn backward_from(&self, end: usize, x: &mut [f64]) {
        let (n, base) = (self.l.0.nrows(), self.base());
        let (inner, rest) = x.split_at_mut(base);
        let mut front = Vec::new();
        let mut x = Split { own: &mut *rest, origin: base, above: &[][..], base: n };
        for node in self.tail_before(end).rev() {
            node.backward(&mut x, &mut front);
        }
        self.backward_below(&self.tree.roots, inner, rest, base);
    }

    /// First column of the supernodes that hold the tail; past the last column if there is no tail.
    fn base(&self) -> usize {
        let begin = self.l.0.supernode_begin();
        begin.get(self.tree.tail).copied().unwrap_or(self.l.0.nrows())
    }

    /// Supernodes that hold the tail, up to column `end`.
    fn tail_before(&self, end: usize) -> impl DoubleEndedIterator<Item = Supernode<'a>> {
        let begin = &self.l.0.supernode_begin()[self.tree.tail..];
        let count = begin.partition_point(|&b| b < end);
        let l = self.l;
        (self.tree.tail..self.tree.tail + count).map(move |s| Supernode::new(l, s).before(end))
    }

    /// Forward through the subtrees of `roots`, whose columns are `own`; returns their contribution to the
    /// columns from `base` on.
    fn forward_below(&self, roots: &[usize], own: &mut [f64], base: usize) -> Vec<f64> {
        let (n, begin) = (self.l.0.nrows(), self.l.0.supernode_begin());
        let (Some(&first), Some(&last)) = (roots.first(), roots.last()) else {
            return vec![0.0; n - base];
        };
        let first = self.tree.first[first];
        if let Some(cut) = self.cut(roots) {
            let (left, right) = own.split_at_mut(begin[roots[cut - 1] + 1] - begin[first]);
            let (mut a, b) = rayon::join(
                || self.forward_below(&roots[..cut], left, base),
                || self.forward_below(&roots[cut..], right, base),
            );
            add(&mut a, &b);
            return a;
        }
        let (shared, origin) = (self.shared(roots), begin[first]);
        let (mut above, mut front) = (vec![0.0; n - base], Vec::new());
        let mut s = first;
        while s <= last {
            if let Some(t) = shared.filter(|&t| self.tree.first[t] == s) {
                let (below, rest) = own.split_at_mut(begin[t] - origin);
                let below = &mut below[begin[s] - origin..];
                let brought = self.forward_below(&self.tree.children[t], below, begin[t]);
                add(rest, &brought);
                add(&mut above, &brought[base - begin[t]..]);
                s = t;
            }
            let mut x = Split { own: &mut *own, origin, above: &mut above[..], base };
            Supernode::new(self.l, s).forward(&mut x, &mut front);
            s += 1;
        }
        above
    }

    /// Backward through the subtrees of `roots`, whose columns are `own`, given the values of the columns
    /// from `base` on.
    fn backward_below(&self, roots: &[usize], own: &mut [f64], above: &[f64], base: usize) {
        let begin = self.l.0.supernode_begin();
        let (Some(&first), Some(&last)) = (roots.first(), roots.last()) else { return };
        let first = self.tree.first[first];
        if let Some(cut) = self.cut(roots) {
            let (left, right) = own.split_at_mut(begin[roots[cut - 1] + 1] - begin[first]);
            rayon::join(
                || self.backward_below(&roots[..cut], left, above, base),
                || self.backward_below(&roots[cut..], right, above, base),
            );
            return;
        }
        let (shared, origin) = (self.shared(roots), begin[first]);
        let mut front = Vec::new();
        let mut next = last + 1;
        while next > first {
            let s = next - 1;
            if self.needed.is_none_or(|needed| needed[s]) {
                let mut x = Split { own: &mut *own, origin, above, base };
                Supernode::new(self.l, s).backward(&mut x, &mut front);
            }
            next = s;
            if shared == Some(s) {
                // Siblings between the run and the base are not ancestors of any column in the run.
                let (below, rest) = own.split_at_mut(begin[s] - origin);
                let mut known = rest.to_vec();
                known.resize(base - begin[s], 0.0);
                known.extend_from_slice(above);
                next = self.tree.first[s];
                let below = &mut below[begin[next] - origin..];
                self.backward_below(&self.tree.children[s], below, &known, begin[s]);
            }
        }
    }

    /// Entries of L in the subtree of `root`.
    fn entries(&self, root: usize) -> usize {
        let start = self.l.0.col_ptr_for_val();
        start[root + 1] - start[self.tree.first[root]]
    }

    /// How many of `roots` to give to one thread so that two have the same amount of work; nothing if the
    /// smaller share is not worth a thread.
    fn cut(&self, roots: &[usize]) -> Option<usize> {
        let all: usize = roots.iter().map(|&r| self.entries(r)).sum();
        let (mut cut, mut done) = (0, 0);
        while cut + 1 < roots.len() && 2 * done + self.entries(roots[cut]) < all {
            done += self.entries(roots[cut]);
            cut += 1;
        }
        (done.min(all - done) > self.least).then_some(cut)
    }

    /// The supernode below the heaviest of `roots` whose children two threads can share.
    fn shared(&self, roots: &[usize]) -> Option<usize> {
        let mut among = roots;
        loop {
            let heaviest = among.iter().copied().max_by_key(|&r| self.entries(r))?;
            among = &self.tree.children[heaviest];
            if self.cut(among).is_some() {
                return Some(heaviest);
            }
        }
    }
}

fn add(to: &mut [f64], what: &[f64]) {
    for (to, v) in to.iter_mut().zip(what) {
        *to += v;
    }
}
