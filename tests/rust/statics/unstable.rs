//! Springs that carry a body on.

use mtm_core::BlockMatrix;
use mtm_core::internals::{ProjectedProduct, Spring, at_fault, carry_on};

fn spring(row: usize, stiffness: f64) -> (usize, Spring) {
    (row, Spring { node: row, axis: [1.0, 0.0, 0.0], stiffness, goal: 0.0 })
}

/// Three independent rows, each with a stiffness of 1 N/mm.
fn unit() -> BlockMatrix {
    let mut matrix = BlockMatrix::from_pattern(vec![0, 1, 2, 3], vec![0, 1, 2]);
    for block in &mut matrix.blocks {
        *block = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0];
    }
    matrix
}

#[test]
fn the_strongest_springs_are_left_out_of_a_direction_that_gives_way() {
    let mut springs = vec![spring(0, -0.3), spring(1, -2.5), spring(2, 0.5), spring(2, -0.1)];
    let out = at_fault(&unit(), &mut springs, &[[1.0, 0.0, 0.0]; 3]);
    assert_eq!(out.iter().map(|(row, _)| *row).collect::<Vec<_>>(), [1]);
    assert_eq!(springs.len(), 3);
}

#[test]
fn a_body_is_carried_on_to_its_minimum_or_as_far_as_springs_reach() {
    let (matrix, along_x) = (unit(), vec![[1.0, 0.0, 0.0], [0.0; 3], [0.0; 3]]);
    let b = vec![[0.3, 0.0, 0.0], [0.0; 3], [0.0; 3]];
    let mut x = vec![[0.0; 3]; 3];
    let held = [spring(0, -0.4)];
    let product = ProjectedProduct::new(&matrix, &[], &held);
    assert!(!carry_on(&product, &b, std::slice::from_ref(&along_x), 2.0, &mut x));
    assert!((x[0][0] - 0.5).abs() < 1e-14, "{x:?}");
    // Beyond the top of a hill, downhill is ahead; before it, downhill is back.
    let unheld = [spring(0, -1.4)];
    let product = ProjectedProduct::new(&matrix, &[], &unheld);
    for (start, end) in [(-0.7, 1.3), (-0.8, -2.8)] {
        x[0][0] = start;
        assert!(carry_on(&product, &b, std::slice::from_ref(&along_x), 2.0, &mut x));
        assert!((x[0][0] - end).abs() < 1e-14, "{x:?}");
    }
}
