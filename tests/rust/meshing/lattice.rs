//! The octree of a lattice.

use mtm_core::internals::{Octree, neighbours};

#[test]
fn balancing_splits_no_more_than_it_must() {
    let mut tree = Octree::new([8, 8, 8], 2, &[true; 512]);
    tree.refine([33, 33, 33], 2);
    tree.balance();
    let leaves = tree.leaves();
    let count = |size| leaves.iter().filter(|leaf| leaf.size == size).count();
    // One coarse cube becomes 7 cubes of half its size and 8 of a quarter; the cubes that touch the
    // small ones across three of its faces, their edges and their corner are halved.
    assert_eq!(count(2), 8);
    assert_eq!(count(4), 7 + 7 * 8);
    assert_eq!(count(8), 512 - 8);
    for leaf in &leaves {
        for place in neighbours(leaf) {
            assert!(tree.leaf_at(place).is_none_or(|other| other.size <= 2 * leaf.size));
        }
    }
}
