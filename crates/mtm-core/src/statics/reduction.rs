//! The unknowns of a body: their nodes, and the vectors and matrices restricted to them.

use rayon::prelude::*;

use crate::algebra::blocks::{Block, BlockMatrix};
use crate::boundary::NodeKind;
pub(crate) use crate::contact::pairs::NO_ROW;

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
        let Self { unknowns, row_of } = self;
        let kept = |j: u32| {
            let (columns, blocks) = matrix.row(j as usize);
            columns
                .iter()
                .map(|&k| row_of[k as usize])
                .zip(blocks)
                .filter(|(row, _)| *row != NO_ROW)
        };
        let lengths: Vec<usize> = unknowns.par_iter().map(|&j| kept(j).count()).collect();
        let mut row_start = Vec::with_capacity(unknowns.len() + 1);
        row_start.push(0);
        for length in lengths {
            row_start.push(row_start[row_start.len() - 1] + length);
        }
        let columns = unknowns.par_iter().flat_map_iter(|&j| kept(j).map(|(row, _)| row)).collect();
        let mut out = BlockMatrix::from_pattern(row_start, columns);
        out.row_tasks().into_par_iter().for_each(|task| {
            let (first, mut blocks) = (task.first, task.blocks);
            for &j in &unknowns[first..first + task.start.len() - 1] {
                let row: Vec<&Block> = kept(j).map(|(_, block)| block).collect();
                let (head, tail) = blocks.split_at_mut(row.len());
                for (out, block) in head.iter_mut().zip(row) {
                    *out = *block;
                }
                blocks = tail;
            }
        });
        out
    }
}
