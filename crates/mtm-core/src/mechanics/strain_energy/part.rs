//! Some nodes of a body that move while all others stay: the energy of the tets around them, its slope and its
//! tangent.

use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::algebra::blocks::{BlockMatrix, running_sum};
use crate::mechanics::element::MOST_NODES;
use crate::mechanics::hyperelastic::Tangent;
use crate::mechanics::strain_energy::{
    EnergyState, StrainEnergy, TangentKind, add_contracted, left_contracted,
};
use crate::vector::{add, distinct};

/// Row of a node that stays.
const STAYS: u32 = u32::MAX;

/// Nodes that move, as rows, with the tets around them.
pub struct Part<'a> {
    body: &'a StrainEnergy,
    nodes: Vec<u32>,
    tets: Vec<PartTet>,
    /// The zero matrix on the rows.
    pattern: BlockMatrix,
}

/// A tet of a part.
struct PartTet {
    tet: usize,
    /// Row of each of its nodes.
    rows: [u32; MOST_NODES],
}

impl<'a> Part<'a> {
    /// The part of `body` at `nodes`, ascending; none if forces reach further than to the next nodes.
    pub fn new(body: &'a StrainEnergy, nodes: Vec<u32>) -> Option<Self> {
        if body.tensors.patches().is_some() {
            return None;
        }
        let elements = body.nodes();
        let around =
            distinct(nodes.iter().flat_map(|&j| elements.tets_of_node(j as usize)).copied());
        let row_of = |j: &u32| nodes.binary_search(j).map_or(STAYS, |row| row as u32);
        let tets: Vec<PartTet> = around
            .iter()
            .map(|&t| {
                let tet = t as usize;
                let mut rows = [STAYS; MOST_NODES];
                for (row, j) in rows.iter_mut().zip(elements.of_tet(tet)) {
                    *row = row_of(j);
                }
                PartTet { tet, rows }
            })
            .collect();
        let pattern = pattern(&tets, nodes.len());
        Some(Self { body, nodes, tets, pattern })
    }

    /// The nodes, one for each row.
    pub fn nodes(&self) -> &[u32] {
        &self.nodes
    }

    /// Energy of the tets, and internal force on each row, under displacements `u` of all nodes of the body.
    pub fn state(&self, u: &[[f64; 3]]) -> EnergyState {
        let found: Vec<(f64, [[f64; 3]; MOST_NODES])> = self
            .tets
            .par_iter()
            .map(|tet| {
                let mut forces = [[0.0; 3]; MOST_NODES];
                (self.body.respond(tet.tet, u, 0.0, &mut forces), forces)
            })
            .collect();
        let mut state = EnergyState { energy: 0.0, forces: vec![[0.0; 3]; self.nodes.len()] };
        for (tet, (energy, forces)) in self.tets.iter().zip(found) {
            state.energy += energy;
            for (row, force) in tet.rows().zip(forces) {
                if let Some(row) = row {
                    state.forces[row] = add(state.forces[row], force);
                }
            }
        }
        state
    }

    /// Tangent stiffness of the rows under displacements `u` of all nodes of the body, N/mm.
    pub fn stiffness(&self, u: &[[f64; 3]], kind: TangentKind) -> BlockMatrix {
        let elements = self.body.nodes();
        let tangents: Vec<Vec<Tangent>> = self
            .tets
            .par_iter()
            .map(|tet| {
                let found = |f: Matrix3<f64>| self.body.tangent(tet.tet, &f, kind, 0.0);
                self.body.gradients(tet.tet, u).map(found).collect()
            })
            .collect();
        let mut matrix = self.pattern.clone();
        for (tet, tangents) in self.tets.iter().zip(&tangents) {
            let geometry = elements.mesh().geometry(tet.tet);
            for (point, tangent) in tangents.iter().enumerate() {
                let (gradients, _) = elements.gradients(&geometry, point);
                for (row, g) in tet.rows().zip(gradients) {
                    let Some(row) = row else { continue };
                    let left = left_contracted(tangent, g);
                    let range = matrix.row_start[row]..matrix.row_start[row + 1];
                    let columns = &matrix.columns[range.clone()];
                    let blocks = &mut matrix.blocks[range];
                    for (column, g) in tet.rows.iter().zip(gradients) {
                        if let Ok(at) = columns.binary_search(column) {
                            add_contracted(&mut blocks[at], &left, g);
                        }
                    }
                }
            }
        }
        matrix
    }
}

impl PartTet {
    /// Row of each node; none if it stays.
    fn rows(&self) -> impl Iterator<Item = Option<usize>> {
        self.rows.iter().map(|&row| (row != STAYS).then_some(row as usize))
    }
}

/// The zero matrix of `n_rows` rows that `tets` connect.
fn pattern(tets: &[PartTet], n_rows: usize) -> BlockMatrix {
    let mut neighbours = vec![Vec::new(); n_rows];
    for tet in tets {
        for row in tet.rows().flatten() {
            neighbours[row].extend(tet.rows().flatten().map(|column| column as u32));
        }
    }
    let neighbours: Vec<Vec<u32>> = neighbours.into_iter().map(distinct).collect();
    BlockMatrix::from_pattern(running_sum(neighbours.iter().map(Vec::len)), neighbours.concat())
}
