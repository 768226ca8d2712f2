//! The unknowns of a body: their nodes, and the vectors and matrices restricted to them.

use rayon::prelude::*;

use crate::algebra::blocks::{BlockMatrix, running_sum};
use crate::boundary::NodeKind;
pub(crate) use crate::contact::pairs::NO_ROW;

/// Blocks per parallel task of a copy.
const BLOCKS_PER_TASK: usize = 4096;

/// Free and sliding nodes as rows of the system.
pub(crate) struct Reduction {
    /// Node of each row.
    pub unknowns: Vec<u32>,
    /// Row of each node, or [`NO_ROW`].
    pub row_of: Vec<u32>,
}

impl Reduction {
    /// The unknowns among nodes of `kinds`.
    pub fn new(kinds: &[NodeKind]) -> Self {
        let mut row_of = vec![NO_ROW; kinds.len()];
        let mut unknowns = Vec::new();
        for (j, kind) in kinds.iter().enumerate() {
            if matches!(kind, NodeKind::Free | NodeKind::Sliding(_)) {
                row_of[j] = unknowns.len() as u32;
                unknowns.push(j as u32);
            }
        }
        Self { unknowns, row_of }
    }

    /// The rows of `values`, which has one per node.
    pub fn rows(&self, values: &[[f64; 3]]) -> Vec<[f64; 3]> {
        self.unknowns.iter().map(|&j| values[j as usize]).collect()
    }

    /// Values of every node: `all`, with `rows` at the unknown nodes.
    pub fn filled(&self, all: &[[f64; 3]], rows: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let mut out = all.to_vec();
        for (&j, v) in self.unknowns.iter().zip(rows) {
            out[j as usize] = *v;
        }
        out
    }

    /// Rows and columns of `matrix` that belong to unknown nodes.
    pub fn matrix(&self, matrix: &BlockMatrix) -> BlockMatrix {
        self.pattern(matrix).taken_from(matrix)
    }

    /// Where the rows and columns of unknown nodes are in matrices with the pattern of `matrix`.
    pub fn pattern(&self, matrix: &BlockMatrix) -> ReducedPattern {
        let Self { unknowns, row_of } = self;
        let kept = |j: u32| {
            let range = matrix.row_start[j as usize]..matrix.row_start[j as usize + 1];
            range
                .map(|at| (row_of[matrix.columns[at] as usize], at))
                .filter(|(row, _)| *row != NO_ROW)
        };
        let lengths: Vec<usize> = unknowns.par_iter().map(|&j| kept(j).count()).collect();
        let row_start = running_sum(lengths);
        let (columns, sources) = unknowns.par_iter().flat_map_iter(|&j| kept(j)).unzip();
        ReducedPattern { row_start, columns, sources }
    }
}

/// The pattern of a matrix of unknown nodes, within that of all nodes.
pub(crate) struct ReducedPattern {
    row_start: Vec<usize>,
    columns: Vec<u32>,
    /// Position of each block in the matrix of all nodes.
    sources: Vec<usize>,
}

impl ReducedPattern {
    /// The rows and columns of unknown nodes of `matrix`.
    pub fn taken_from(&self, matrix: &BlockMatrix) -> BlockMatrix {
        let mut out = BlockMatrix::from_pattern(self.row_start.clone(), self.columns.clone());
        let blocks = out.blocks.par_iter_mut().zip(&self.sources);
        blocks.with_min_len(BLOCKS_PER_TASK).for_each(|(block, &at)| *block = matrix.blocks[at]);
        out
    }
}
