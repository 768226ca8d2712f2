//! Elimination order without METIS, and the supernodes of the factor.

use faer::dyn_stack::{MemStack, StackReq};
use faer::sparse::SymbolicSparseColMatRef;
use faer::sparse::linalg::cholesky::{simplicial, supernodal};
use faer::sparse::linalg::{SymbolicSupernodalParams, amd};

use super::workspace::{buffer, out_of_memory};
use crate::algebra::blocks::BlockMatrix;
use crate::algebra::ordering::{NodeGraph, positions};
use crate::error::Result;

/// Approximate minimum degree order of a graph (Amestoy, Davis & Duff 1996).
pub fn minimum_degree(graph: &NodeGraph) -> Result<Vec<u32>> {
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
pub fn supernodal_structure(
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
