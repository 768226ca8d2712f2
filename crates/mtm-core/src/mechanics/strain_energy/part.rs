//! Some nodes of a body that move while all others stay: the energy of the tets around them, its slope and its
//! tangent.

use nalgebra::Matrix3;
use rayon::prelude::*;

use crate::algebra::blocks::BlockMatrix;
use crate::mechanics::element::MOST_NODES;
use crate::mechanics::hyperelastic::Tangent;
use crate::mechanics::strain_energy::{
    EnergyState, StrainEnergy, TangentKind, add_contracted, left_contracted,
};
use crate::vector::add;

/// Row of a node that stays.
const STAYS: u32 = u32::MAX;

/// Nodes that move, as rows, with the tets around them.
pub(crate) struct Part<'a> {
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
        let mut around: Vec<u32> =
            nodes.iter().flat_map(|&j| elements.tets_of_node(j as usize).iter().copied()).collect();
        around.sort_unstable();
        around.dedup();
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
    let (mut row_start, mut columns) = (vec![0], Vec::new());
    for mut row in neighbours {
        row.sort_unstable();
        row.dedup();
        columns.extend(row);
        row_start.push(columns.len());
    }
    BlockMatrix::from_pattern(row_start, columns)
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::mechanics::element::Element;
    use crate::mechanics::kinematics::Kinematics;
    use crate::mechanics::material::Elastic;
    use crate::mechanics::tensors::MassTensors;
    use crate::mechanics::tissue::Tissue;
    use crate::mesh::TetMesh;
    use crate::vector::{dot, sub};

    const ELEMENTS: [Element; 2] = [Element::Linear, Element::Quadratic];
    const KINDS: [TangentKind; 2] = [TangentKind::Definite, TangentKind::Exact];

    /// The eight tets of an octahedron around its centre, node 0.
    fn octahedron(element: Element) -> StrainEnergy {
        let mut nodes = vec![[0.1, 0.0, -0.1]];
        for axis in 0..3 {
            for side in [1.0, -1.0] {
                let mut node = [0.0; 3];
                node[axis] = side;
                nodes.push(node);
            }
        }
        let tets = (0..8_u32)
            .map(|i| {
                let [x, y, z] = [1 + (i & 1), 3 + (i >> 1 & 1), 5 + (i >> 2)];
                let is_left = (i.count_ones() & 1) == 1;
                if is_left { [0, y, x, z] } else { [0, x, y, z] }
            })
            .collect();
        let mesh = Arc::new(TetMesh::new(nodes, tets).expect("eight tets"));
        let rows = vec![Elastic { young: 0.01, poisson: 0.46 }; 8];
        let tissue = Arc::new(Tissue::isotropic(&rows).expect("tissue"));
        let tensors = MassTensors::with_element(mesh, tissue, element).expect("tensors");
        StrainEnergy::new(Arc::new(tensors), Kinematics::NEO_HOOKEAN)
    }

    /// Displacements that deform every tet by another amount.
    fn bent(body: &StrainEnergy) -> Vec<[f64; 3]> {
        let places = body.nodes().positions();
        places.iter().map(|&[x, y, z]| [0.2 * y * z, 0.3 * x - 0.1 * z * z, 0.2 * x * y]).collect()
    }

    #[test]
    fn forces_and_stiffness_are_those_of_the_body() {
        for element in ELEMENTS {
            let body = octahedron(element);
            let u = bent(&body);
            let part = Part::new(&body, vec![0, 3, 5]).expect("no patches");
            let whole = body.state(&u).expect("a state");
            for (&node, force) in part.nodes().iter().zip(part.state(&u).forces) {
                let off = sub(force, whole.forces[node as usize]);
                assert!(dot(off, off).sqrt() < 1e-15, "{element:?}: {off:?} at {node}");
            }
            for kind in KINDS {
                let (one, all) = (part.stiffness(&u, kind), body.stiffness(&u, kind).expect("one"));
                for (row, &node) in part.nodes().iter().enumerate() {
                    let (columns, blocks) = one.row(row);
                    let (of_all, blocks_of_all) = all.row(node as usize);
                    for (&column, block) in columns.iter().zip(blocks) {
                        let other = part.nodes()[column as usize];
                        let at = of_all.binary_search(&other).expect("a neighbour");
                        for (a, b) in block.iter().zip(&blocks_of_all[at]) {
                            assert!((a - b).abs() < 1e-15, "{element:?} {kind:?}: {a} {b}");
                        }
                    }
                    let expected = of_all.iter().filter(|k| part.nodes().contains(k)).count();
                    assert_eq!(columns.len(), expected, "{element:?}");
                }
            }
        }
    }

    #[test]
    fn energy_changes_as_that_of_the_body() {
        for element in ELEMENTS {
            let body = octahedron(element);
            let part = Part::new(&body, vec![0, 3]).expect("no patches");
            let before = bent(&body);
            let mut after = before.clone();
            after[0] = [0.05, 0.1, -0.1];
            after[3] = add(after[3], [0.1, 0.0, 0.05]);
            let of_body = body.state(&after).expect("a state").energy
                - body.state(&before).expect("a state").energy;
            let of_part = part.state(&after).energy - part.state(&before).energy;
            assert!((of_body - of_part).abs() < 1e-15, "{element:?}: {of_body} {of_part}");
            assert!(of_part.abs() > 1e-6, "{element:?}: nothing changed");
        }
    }

    #[test]
    fn averaged_pressure_reaches_too_far() {
        assert!(Part::new(&octahedron(Element::NodalPressure), vec![0]).is_none());
    }
}
