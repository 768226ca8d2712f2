//! The product of a matrix under constraints.

use mtm_core::BlockMatrix;
use mtm_core::internals::{Constraint, Operator, ProjectedProduct, Spring, projected};

#[test]
fn product_is_that_of_the_projected_matrix() {
    let row_start = vec![0, 2, 5, 7];
    let mut matrix = BlockMatrix::from_pattern(row_start, vec![0, 1, 0, 1, 2, 1, 2]);
    for (i, value) in matrix.blocks.iter_mut().flatten().enumerate() {
        *value = (1.7 * i as f64).sin();
    }
    let at = |row, normal| Constraint { row, normal, offset: 0.3 };
    let constraints = [at(0, [0.6, 0.8, 0.0]), at(2, [0.0, 0.0, 1.0]), at(2, [0.0, 1.0, 0.0])];
    let axis = [0.8, -0.6, 0.0];
    let springs = [(0, Spring { node: 0, axis, stiffness: 2.5, goal: 0.1 })];
    let mut whole = projected(&matrix, &constraints);
    whole.add_to_diagonal(0, axis, 2.5);
    let product = ProjectedProduct::new(&matrix, &constraints, &springs);

    let mut x = vec![[0.3, -1.1, 0.7], [0.2, 0.9, -0.4], [1.3, 0.8, -0.6]];
    product.project(&mut x);
    assert!((0.6 * x[0][0] + 0.8 * x[0][1]).abs() < 1e-15);
    assert!(x[2][1].abs() + x[2][2].abs() < 1e-15);
    let corner = [at(1, [0.6, 0.8, 0.0]), at(1, [-0.8, 0.6, 0.0]), at(1, [0.0, 0.0, 1.0])];
    let mut held = x.clone();
    ProjectedProduct::new(&matrix, &corner, &[]).project(&mut held);
    assert_eq!(held[1], [0.0; 3]);
    let mut y = vec![[0.0; 3]; 3];
    product.multiply_into(&x, &mut y);
    for (y, expected) in y.iter().zip(whole.multiply(&x)) {
        for i in 0..3 {
            assert!((y[i] - expected[i]).abs() < 1e-14, "{y:?} {expected:?}");
        }
    }
}
