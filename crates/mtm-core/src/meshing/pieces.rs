//! Connected pieces of a mask on a grid, by runs of voxels along the last axis.
//!
//! Runs that touch are joined in a forest (Rosenfeld & Pfaltz 1966; He et al. 2008 for runs): what is visited more
//! than once are runs, not voxels.

use super::stuffing::level::Grid;
use crate::geometry::forest::Forest;

/// The voxels that make two of them one piece.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Joined {
    /// Those that share a face.
    Faces,
    /// Those that share a face, an edge or a corner.
    Corners,
}

/// The connected pieces of a mask.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Pieces {
    /// Number of each voxel's piece, from 1 on in the order of their first voxels; 0 outside the mask.
    pub labels: Vec<i32>,
    /// Number of voxels of each piece; that of 0 is 0.
    pub sizes: Vec<usize>,
}

/// Voxels `first..past` of a line.
struct Run {
    first: usize,
    past: usize,
}

/// The connected pieces of the voxels that are inside, in C order.
///
/// `inside` has an entry for each voxel of the grid.
pub fn pieces(grid: &Grid, inside: &[bool], joined: Joined) -> Pieces {
    let [nx, ny, nz] = grid.shape;
    let mut runs: Vec<Run> = Vec::new();
    // The runs of line (i, j) are starts[i ny + j]..starts[i ny + j + 1].
    let mut starts = vec![0; nx * ny + 1];
    let mut forest = Forest::default();
    for (line, voxels) in inside.chunks(nz).enumerate() {
        add_runs(voxels, &mut runs);
        forest.grow(runs.len());
        starts[line + 1] = runs.len();
        let (i, j) = (line / ny, line % ny);
        let before = |di: usize, j: usize| (i >= di && j < ny).then(|| (i - di) * ny + j);
        // Lines before this one that share a face with it, or an edge.
        let near = match joined {
            Joined::Faces => [before(1, j), before(0, j.wrapping_sub(1)), None, None],
            Joined::Corners => [
                before(1, j.wrapping_sub(1)),
                before(1, j),
                before(1, j + 1),
                before(0, j.wrapping_sub(1)),
            ],
        };
        let reach = usize::from(joined == Joined::Corners);
        for other in near.into_iter().flatten() {
            let ends = (starts[line]..runs.len(), starts[other]..starts[other + 1]);
            join_lines(&runs, ends, reach, &mut forest);
        }
    }
    numbered(&runs, &starts, forest, nz)
}

/// Adds the runs of one line.
fn add_runs(voxels: &[bool], runs: &mut Vec<Run>) {
    let mut from = 0;
    while let Some(first) = voxels[from..].iter().position(|&v| v).map(|n| from + n) {
        let past = voxels[first..].iter().position(|&v| !v).map_or(voxels.len(), |n| first + n);
        runs.push(Run { first, past });
        from = past;
    }
}

/// Joins the runs of two lines that overlap when each reaches `reach` voxels past its ends.
fn join_lines(
    runs: &[Run],
    (mine, theirs): (std::ops::Range<usize>, std::ops::Range<usize>),
    reach: usize,
    forest: &mut Forest,
) {
    let (mut a, mut b) = (mine.start, theirs.start);
    while a < mine.end && b < theirs.end {
        if runs[a].past + reach <= runs[b].first {
            a += 1;
        } else if runs[b].past + reach <= runs[a].first {
            b += 1;
        } else {
            forest.join(a, b);
            if runs[a].past < runs[b].past {
                a += 1;
            } else {
                b += 1;
            }
        }
    }
}

/// The pieces numbered in the order of their first runs.
fn numbered(runs: &[Run], starts: &[usize], forest: Forest, nz: usize) -> Pieces {
    let numbers: Vec<i32> = forest.numbered().into_iter().map(|number| number as i32 + 1).collect();
    let mut sizes = vec![0; numbers.iter().max().map_or(1, |&last| last as usize + 1)];
    for (&number, Run { first, past }) in numbers.iter().zip(runs) {
        sizes[number as usize] += past - first;
    }
    let mut labels = vec![0_i32; (starts.len() - 1) * nz];
    for (line, voxels) in labels.chunks_mut(nz).enumerate() {
        for run in starts[line]..starts[line + 1] {
            voxels[runs[run].first..runs[run].past].fill(numbers[run]);
        }
    }
    Pieces { labels, sizes }
}
