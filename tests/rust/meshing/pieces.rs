//! Connected pieces: a flood from each voxel as reference, and the order of their numbers.

use mtm_core::{Grid, Joined, pieces};
use proptest::prelude::*;

/// The pieces of a mask by floods that begin at the first voxel that has no number.
fn flooded(shape: [usize; 3], inside: &[bool], joined: Joined) -> (Vec<i32>, Vec<usize>) {
    let [nx, ny, nz] = shape;
    let index = |[i, j, k]: [usize; 3]| (i * ny + j) * nz + k;
    let (mut labels, mut sizes) = (vec![0; inside.len()], vec![0]);
    for start in 0..inside.len() {
        if !inside[start] || labels[start] != 0 {
            continue;
        }
        let number = sizes.len() as i32;
        labels[start] = number;
        sizes.push(0);
        let mut open = vec![[start / nz / ny, start / nz % ny, start % nz]];
        while let Some(voxel) = open.pop() {
            sizes[number as usize] += 1;
            for step in 0..27 {
                let shift = [step / 9, step / 3 % 3, step % 3];
                let steps = shift.iter().filter(|&&s| s != 1).count();
                if steps == 0 || steps > 1 && joined == Joined::Faces {
                    continue;
                }
                let near = [0, 1, 2].map(|a| (voxel[a] + shift[a]).wrapping_sub(1));
                if near[0] >= nx || near[1] >= ny || near[2] >= nz {
                    continue;
                }
                let at = index(near);
                if inside[at] && labels[at] == 0 {
                    labels[at] = number;
                    open.push(near);
                }
            }
        }
    }
    (labels, sizes)
}

proptest! {
    #[test]
    fn pieces_are_those_of_a_flood(
        shape in [1_usize..7, 1_usize..7, 1_usize..9],
        voxels in prop::collection::vec(any::<u8>(), 6 * 6 * 8),
        part in any::<u8>(),
    ) {
        let grid = Grid::new(shape, [1.0; 3], [0.0; 3]).expect("a grid");
        let inside: Vec<bool> = voxels[..grid.len()].iter().map(|&v| v < part).collect();
        for joined in [Joined::Faces, Joined::Corners] {
            let found = pieces(&grid, &inside, joined);
            let (labels, sizes) = flooded(shape, &inside, joined);
            prop_assert_eq!(&found.labels, &labels);
            prop_assert_eq!(&found.sizes, &sizes);
        }
    }
}

#[test]
fn runs_that_meet_late_are_one_piece() {
    // Two prongs that only the last line joins: the second prong's number is not used.
    let inside = [true, false, true, true, false, true, true, true, true];
    let grid = Grid::new([1, 3, 3], [1.0; 3], [0.0; 3]).expect("a grid");
    let found = pieces(&grid, &inside, Joined::Faces);
    assert_eq!(found.labels, inside.map(i32::from));
    assert_eq!(found.sizes, [0, 7]);
}
