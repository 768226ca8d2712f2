//! Nodes inside tets of other tissue.

use mtm_core::TetMesh;
use mtm_core::internals::{Overlap, depth_in};

const CORNERS: [[f64; 3]; 4] = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

#[test]
fn depth_is_the_distance_from_the_nearest_face() {
    assert!((depth_in(&CORNERS, [0.1, 0.3, 0.3]) - 0.1).abs() < 1e-15);
    let near_the_slope = (1.0 - 0.9) / 3.0_f64.sqrt();
    assert!((depth_in(&CORNERS, [0.3, 0.3, 0.3]) - near_the_slope).abs() < 1e-15);
    assert!(depth_in(&CORNERS, [0.5, 0.5, 0.5]) < 0.0);
    let flat = [[0.0; 3], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0]];
    assert_eq!(depth_in(&flat, [1.0, 0.0, 0.0]), 0.0);
}

#[test]
fn a_node_of_another_part_is_found_in_the_tet_that_holds_it() {
    let mut nodes = CORNERS.to_vec();
    nodes.extend(CORNERS.map(|c| [c[0] + 2.0, c[1], c[2]]));
    let mesh = TetMesh::new(nodes, vec![[0, 1, 2, 3], [4, 5, 6, 7]]);
    let Ok(mesh) = mesh else { unreachable!("a valid mesh") };
    let overlap = Overlap::new(&mesh, (0..8).collect());
    let mut u = vec![[0.0; 3]; 8];
    assert_eq!(overlap.inside(&mesh, &u), []);
    for u in &mut u[4..] {
        *u = [-1.9, 0.2, 0.3];
    }
    // Node 4 is at (0.1, 0.2, 0.3).
    let inside = overlap.inside(&mesh, &u);
    assert_eq!(inside.iter().map(|(node, _)| *node).collect::<Vec<_>>(), [4]);
    assert!((inside[0].1 - 0.1).abs() < 1e-12);
}
