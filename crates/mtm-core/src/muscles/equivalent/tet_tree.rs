//! A tree of boxes over tets, so that regions far from a muscle are decided many tets at a time.

use crate::muscles::equivalent::aligned_box::AlignedBox;
use crate::vector::Vec3;

/// Number of tets below which a branch is not split: their boxes are checked individually.
const LEAF_TETS: usize = 4;
/// Number of tets above which the two halves of a branch are built by different threads.
const PARALLEL_TETS: usize = 4096;

/// Tets in an order that keeps neighbours together, and the boxes of recursive halves of them.
#[derive(Debug)]
pub struct TetTree {
    /// Depth-first: the first half of a branch follows it.
    branches: Vec<Branch>,
    /// Indices of the tets in the order of the leaves.
    tets: Vec<u32>,
}

/// A run of tets and their box.
#[derive(Debug, Clone)]
pub struct Branch {
    pub bounds: AlignedBox,
    start: u32,
    end: u32,
    /// Index of the second half; 0 for a leaf.
    second: u32,
}

impl TetTree {
    /// Tree over tets with their boxes.
    pub fn new(mut items: Vec<(u32, AlignedBox)>) -> Self {
        let empty = Branch { bounds: AlignedBox::EMPTY, start: 0, end: 0, second: 0 };
        let mut branches = vec![empty; if items.is_empty() { 0 } else { n_branches(items.len()) }];
        if !items.is_empty() {
            build(&mut items, 0, &mut branches, 0);
        }
        Self { branches, tets: items.into_iter().map(|(tet, _)| tet).collect() }
    }

    /// Branch `at`; 0 is the root. None if there is no tet at all.
    pub fn branch(&self, at: usize) -> Option<&Branch> {
        self.branches.get(at)
    }

    /// Tets of a branch.
    pub fn tets(&self, branch: &Branch) -> &[u32] {
        &self.tets[branch.start as usize..branch.end as usize]
    }
}

impl Branch {
    /// Indices of the two halves of branch `at`, which is this one; none for a leaf.
    pub fn halves(&self, at: usize) -> Option<[usize; 2]> {
        (self.second > 0).then_some([at + 1, self.second as usize])
    }
}

/// Number of branches of a tree over `n` tets.
fn n_branches(n: usize) -> usize {
    if n <= LEAF_TETS { 1 } else { 1 + n_branches(n / 2) + n_branches(n - n / 2) }
}

/// Fills `branches`, the first of which has index `at`, with the tree over `items`, which start at `start`.
fn build(items: &mut [(u32, AlignedBox)], start: usize, branches: &mut [Branch], at: usize) {
    let n = items.len();
    let bounds = items.iter().fold(AlignedBox::EMPTY, |all, (_, one)| all.joined(one));
    let mut second = 0;
    let (this, rest) = branches.split_at_mut(1);
    if n > LEAF_TETS {
        // Twice the centres: split along the axis of largest spread.
        let centre = |b: &AlignedBox| -> Vec3 { b.low + b.high };
        let spread = items.iter().fold(AlignedBox::EMPTY, |all, (_, one)| {
            let c = centre(one);
            AlignedBox { low: all.low.inf(&c), high: all.high.sup(&c) }
        });
        let axis = (spread.high - spread.low).imax();
        let half = n / 2;
        items.select_nth_unstable_by(half, |(s, a), (t, b)| {
            centre(a)[axis].total_cmp(&centre(b)[axis]).then(s.cmp(t))
        });
        let (left, right) = items.split_at_mut(half);
        let (first, last) = rest.split_at_mut(n_branches(half));
        let after = at + 1 + first.len();
        second = after as u32;
        let mut build_left = || build(left, start, first, at + 1);
        let mut build_right = || build(right, start + half, last, after);
        if n > PARALLEL_TETS {
            rayon::join(build_left, build_right);
        } else {
            build_left();
            build_right();
        }
    }
    this[0] = Branch { bounds, start: start as u32, end: (start + n) as u32, second };
}
