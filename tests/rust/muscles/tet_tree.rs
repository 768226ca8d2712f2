//! The tree of boxes over tets.

use mtm_core::internals::{AlignedBox, TetTree};
use nalgebra::Vector3;

type Vec3 = Vector3<f64>;

/// Tets of a leaf, and those from which two threads build the halves.
const LEAF_TETS: usize = 4;
const PARALLEL_TETS: usize = 4096;

fn cubes(n: usize) -> Vec<AlignedBox> {
    let at = |i: usize| Vec3::new((i * 7 % 31) as f64, (i * 11 % 17) as f64, (i % 5) as f64);
    (0..n).map(|i| AlignedBox { low: at(i), high: at(i) + Vec3::repeat(1.5) }).collect()
}

#[test]
fn every_tet_lies_in_one_leaf_and_in_the_boxes_above_it() {
    for n in [0, 1, LEAF_TETS, LEAF_TETS + 1, 100, 2 * PARALLEL_TETS] {
        let boxes = cubes(n);
        let tree = TetTree::new((0..).zip(boxes.iter().copied()).collect());
        let (mut seen, mut open) = (vec![0; n], vec![0]);
        while let Some(at) = open.pop() {
            let Some(branch) = tree.branch(at) else { continue };
            for &t in tree.tets(branch) {
                assert_eq!(branch.bounds.joined(&boxes[t as usize]), branch.bounds);
            }
            match branch.halves(at) {
                Some(halves) => open.extend(halves),
                None => tree.tets(branch).iter().for_each(|&t| seen[t as usize] += 1),
            }
        }
        assert!(seen.iter().all(|&count| count == 1), "{n} tets");
    }
}
