//! Aggregates of strongly connected rows: the coarse rows.

use rayon::prelude::*;

use super::block_rows::split_rows;
use super::precision::Stored;
use super::scaled_matrix::ScaledMatrix;
use crate::algebra::blocks::running_sum;

/// No aggregate.
pub(super) const UNASSIGNED: u32 = u32::MAX;

/// Which aggregate each row belongs to, and the rows of each aggregate.
#[derive(Debug)]
pub(super) struct Aggregates {
    pub(super) of_row: Vec<u32>,
    pub(super) count: usize,
    pub(super) member_start: Vec<usize>,
    pub(super) members: Vec<u32>,
}

impl Aggregates {
    /// The aggregates over connections stronger than `strength`: the norm of a scaled block over that
    /// of a diagonal one.
    pub(super) fn new<const N: usize, T: Stored>(a: &ScaledMatrix<N, T>, strength: f64) -> Self {
        // Scaled diagonal blocks are identities of norm √N.
        let threshold = (strength * strength * N as f64) as f32;
        let mut weights = vec![0.0_f32; a.columns.len()];
        split_rows(&mut weights, &a.row_start, a.rows_per_task).into_par_iter().for_each(|part| {
            let first = a.row_start[part.rows.start];
            for i in part.rows.clone() {
                for k in a.row_start[i]..a.row_start[i + 1] {
                    if a.columns[k] as usize == i {
                        continue;
                    }
                    let square: f64 = a.block(k).as_flattened().iter().map(|v| v * v).sum();
                    let square = square as f32;
                    if square > threshold {
                        part.data[k - first] = square;
                    }
                }
            }
        });
        Self::from_weights(&a.row_start, &a.columns, &weights)
    }

    /// Greedy, in row order: a row whose strong neighbours are all free forms an aggregate with them; remaining
    /// rows join the neighbour they are most strongly connected to; rows still left form their own aggregates.
    /// Rows without any strong connection stay outside: the smoother suffices for them.
    fn from_weights(row_start: &[usize], columns: &[u32], weights: &[f32]) -> Self {
        let graph = StrongGraph { row_start, columns, weights };
        let mut of_row = vec![UNASSIGNED; row_start.len() - 1];
        let founded = graph.found(&mut of_row, 0, true);
        graph.join(&mut of_row);
        let count = graph.found(&mut of_row, founded, false) as usize;
        let mut sizes = vec![0; count];
        for &aggregate in &of_row {
            if aggregate != UNASSIGNED {
                sizes[aggregate as usize] += 1;
            }
        }
        let member_start = running_sum(sizes);
        let mut next = member_start.clone();
        let mut members = vec![0; member_start[count]];
        for (i, &aggregate) in of_row.iter().enumerate() {
            if aggregate != UNASSIGNED {
                members[next[aggregate as usize]] = i as u32;
                next[aggregate as usize] += 1;
            }
        }
        Self { of_row, count, member_start, members }
    }
}

/// Strong connections between rows, with their weights.
struct StrongGraph<'a> {
    row_start: &'a [usize],
    columns: &'a [u32],
    weights: &'a [f32],
}

impl StrongGraph<'_> {
    fn n_rows(&self) -> usize {
        self.row_start.len() - 1
    }

    /// The rows strongly connected to row `i`.
    fn strong(&self, i: usize) -> impl Iterator<Item = (usize, f32)> {
        let range = self.row_start[i]..self.row_start[i + 1];
        self.columns[range.clone()]
            .iter()
            .zip(&self.weights[range])
            .filter(|(_, w)| **w > 0.0)
            .map(|(j, w)| (*j as usize, *w))
    }

    /// Aggregates, after the first `count`, of free rows with their free neighbours, if `all_free` only where all
    /// neighbours are; the number of all aggregates.
    fn found(&self, of_row: &mut [u32], mut count: u32, all_free: bool) -> u32 {
        for i in 0..self.n_rows() {
            let is_taken = |j: usize| of_row[j] != UNASSIGNED;
            if is_taken(i) || (all_free && self.strong(i).any(|(j, _)| is_taken(j))) {
                continue;
            }
            let mut founded = false;
            for (j, _) in self.strong(i) {
                if of_row[j] == UNASSIGNED {
                    of_row[j] = count;
                }
                founded = true;
            }
            if founded {
                of_row[i] = count;
                count += 1;
            }
        }
        count
    }

    /// Free rows join the aggregate, of those so far, that they are most strongly connected to.
    fn join(&self, of_row: &mut [u32]) {
        let founders = of_row.to_vec();
        for i in 0..self.n_rows() {
            if founders[i] != UNASSIGNED {
                continue;
            }
            let mut best = (0.0, UNASSIGNED);
            for (j, weight) in self.strong(i) {
                if founders[j] != UNASSIGNED && weight > best.0 {
                    best = (weight, founders[j]);
                }
            }
            of_row[i] = best.1;
        }
    }
}
