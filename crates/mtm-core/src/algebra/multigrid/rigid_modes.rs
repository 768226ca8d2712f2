//! The six rigid motions, and their orthonormal basis on each aggregate.

use rayon::prelude::*;

use super::aggregation::Aggregates;

/// Number of rigid motions per aggregate, and so of unknowns per coarse row.
pub(super) const MODES: usize = 6;
/// Length of a rigid mode, relative to its original length, below which an aggregate cannot represent it.
const RANK_TOLERANCE: f64 = 1e-6;

/// A square block in the unknowns of coarse rows.
pub(super) type ModeBlock = [[f64; MODES]; MODES];

/// Translations and rotations about the centroid, in units of the largest distance from it; on sliding rows
/// without their normal component.
pub(super) fn rigid_modes(
    nodes: &[[f64; 3]],
    normals: &[(usize, [f64; 3])],
) -> Vec<[[f64; MODES]; 3]> {
    let n = nodes.len().max(1) as f64;
    let mut centre = [0.0; 3];
    for x in nodes {
        for c in 0..3 {
            centre[c] += x[c] / n;
        }
    }
    let radius = nodes
        .iter()
        .map(|x| (0..3).map(|c| (x[c] - centre[c]).powi(2)).sum::<f64>())
        .fold(0.0, f64::max)
        .sqrt();
    let scale = if radius > 0.0 { 1.0 / radius } else { 1.0 };
    let mut modes: Vec<[[f64; MODES]; 3]> = nodes
        .iter()
        .map(|p| {
            let [x, y, z] = [0, 1, 2].map(|c| (p[c] - centre[c]) * scale);
            [[1.0, 0.0, 0.0, 0.0, z, -y], [0.0, 1.0, 0.0, -z, 0.0, x], [0.0, 0.0, 1.0, y, -x, 0.0]]
        })
        .collect();
    for &(row, normal) in normals {
        for m in 0..MODES {
            let along: f64 = (0..3).map(|c| normal[c] * modes[row][c][m]).sum();
            for c in 0..3 {
                modes[row][c][m] -= along * normal[c];
            }
        }
    }
    modes
}

/// Replaces the modes of each aggregate by an orthonormal basis Q and returns R, the modes in the coarse
/// unknowns. A mode that is linearly dependent on an aggregate has a zero column in Q.
pub(super) fn orthonormalise<const N: usize>(
    aggregates: &Aggregates,
    modes: &mut [[[f64; MODES]; N]],
) -> Vec<ModeBlock> {
    let results: Vec<(Vec<[[f64; MODES]; N]>, ModeBlock)> = (0..aggregates.count)
        .into_par_iter()
        .with_min_len(64)
        .map(|aggregate| {
            let range = aggregates.member_start[aggregate]..aggregates.member_start[aggregate + 1];
            let mut q: Vec<_> =
                aggregates.members[range].iter().map(|&i| modes[i as usize]).collect();
            let r = gram_schmidt(&mut q);
            (q, r)
        })
        .collect();
    for row in modes.iter_mut() {
        *row = [[0.0; MODES]; N];
    }
    let mut coarse = Vec::with_capacity(aggregates.count);
    for (aggregate, (q, r)) in results.into_iter().enumerate() {
        let first = aggregates.member_start[aggregate];
        for (offset, block) in q.into_iter().enumerate() {
            modes[aggregates.members[first + offset] as usize] = block;
        }
        coarse.push(r);
    }
    coarse
}

/// Modified Gram–Schmidt, twice for orthogonality to round-off. Returns R with `modes = Q R`.
fn gram_schmidt<const N: usize>(q: &mut [[[f64; MODES]; N]]) -> ModeBlock {
    let mut r = [[0.0; MODES]; MODES];
    for c in 0..MODES {
        let product = |q: &[[[f64; MODES]; N]], a: usize, b: usize| -> f64 {
            q.iter().flatten().map(|row| row[a] * row[b]).sum()
        };
        let before = product(q, c, c);
        for _ in 0..2 {
            for m in 0..c {
                let h = product(q, m, c);
                r[m][c] += h;
                for row in q.iter_mut().flatten() {
                    row[c] -= h * row[m];
                }
            }
        }
        let norm = product(q, c, c).sqrt();
        let dependent = norm.is_nan() || norm <= RANK_TOLERANCE * before.sqrt();
        let scale = if dependent { 0.0 } else { 1.0 / norm };
        r[c][c] = if dependent { 0.0 } else { norm };
        for row in q.iter_mut().flatten() {
            row[c] *= scale;
        }
    }
    r
}
