//! Nodes that move on their own: the energy of a part of a body.

use std::sync::Arc;

use mtm_core::internals::Part;
use mtm_core::{
    Elastic, Element, Kinematics, MassTensors, StrainEnergy, TangentKind, TetMesh, Tissue,
};

const ELEMENTS: [Element; 2] = [Element::Linear, Element::Quadratic];
const KINDS: [TangentKind; 2] = [TangentKind::Definite, TangentKind::Exact];

/// The eight tets of an octahedron around its centre, node 0, and displacements that deform each of them.
fn octahedron(element: Element) -> (StrainEnergy, Vec<[f64; 3]>) {
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
    let u = bent(tensors.element_nodes().positions());
    (StrainEnergy::new(Arc::new(tensors), Kinematics::NEO_HOOKEAN), u)
}

/// Displacements that deform every tet by another amount.
fn bent(places: &[[f64; 3]]) -> Vec<[f64; 3]> {
    places.iter().map(|&[x, y, z]| [0.2 * y * z, 0.3 * x - 0.1 * z * z, 0.2 * x * y]).collect()
}

#[test]
fn forces_and_stiffness_are_those_of_the_body() {
    for element in ELEMENTS {
        let (body, u) = octahedron(element);
        let part = Part::new(&body, vec![0, 3, 5]).expect("no patches");
        let whole = body.state(&u).expect("a state");
        for (&node, force) in part.nodes().iter().zip(part.state(&u).forces) {
            for (a, b) in force.iter().zip(whole.forces[node as usize]) {
                assert!((a - b).abs() < 1e-15, "{element:?}: {a} {b} at {node}");
            }
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
        let (body, before) = octahedron(element);
        let part = Part::new(&body, vec![0, 3]).expect("no patches");
        let mut after = before.clone();
        after[0] = [0.05, 0.1, -0.1];
        after[3][0] += 0.1;
        after[3][2] += 0.05;
        let of_body = body.state(&after).expect("a state").energy
            - body.state(&before).expect("a state").energy;
        let of_part = part.state(&after).energy - part.state(&before).energy;
        assert!((of_body - of_part).abs() < 1e-15, "{element:?}: {of_body} {of_part}");
        assert!(of_part.abs() > 1e-6, "{element:?}: nothing changed");
    }
}

#[test]
fn averaged_pressure_reaches_too_far() {
    assert!(Part::new(&octahedron(Element::NodalPressure).0, vec![0]).is_none());
}
