//! Matrices with links.

use mtm_core::BlockMatrix;
use mtm_core::internals::{Link, with_links};

#[test]
fn matrix_with_links_multiplies_like_matrix_and_links() {
    let mut matrix = BlockMatrix::from_pattern(vec![0, 2, 4, 5], vec![0, 1, 0, 1, 2]);
    for (i, value) in matrix.blocks.iter_mut().flatten().enumerate() {
        *value = (1.3 * i as f64).sin();
    }
    let link = |ends, stiffness| Link { ends, stiffness, goal: 0.2 };
    let one = link(vec![(2, [0.6, 0.8, 0.0]), (0, [-0.3, 0.1, 0.5])], 3.0);
    let links = [one, link(vec![(1, [0.0, 0.6, 0.8])], 0.7)];
    let x = [[0.3, -1.1, 0.7], [0.2, 0.9, -0.4], [1.3, 0.8, -0.6]];
    let mut expected = matrix.multiply(&x);
    for link in &links {
        link.add(link.stiffness * link.along(&x), &mut expected);
    }
    let found = with_links(&matrix, &links).multiply(&x);
    for (a, b) in found.iter().flatten().zip(expected.iter().flatten()) {
        assert!((a - b).abs() < 1e-14, "{found:?} {expected:?}");
    }
}
