//! Exact distance transform on a grid, and the parts of a shape that are thinner than a ball.
//!
//! Felzenszwalb & Huttenlocher (2012): squared distances axis by axis as lower envelopes of parabolas.

use rayon::prelude::*;

use super::level::Grid;

/// Squared distance of a voxel from which no target was seen.
const FAR: f32 = f32::INFINITY;

/// Squared distance of every voxel centre to the nearest centre that is a target, mm²; infinite without targets.
pub fn squared_distance(grid: &Grid, target: impl Fn(usize) -> bool + Sync) -> Vec<f32> {
    let [nx, ny, nz] = grid.shape;
    let plane = ny * nz;
    let mut squared = vec![FAR; grid.len()];
    squared.par_chunks_mut(plane).enumerate().for_each(|(i, slab)| {
        let mut envelope = Envelope::new(ny.max(nz));
        for (j, row) in slab.chunks_mut(nz).enumerate() {
            scan(row, grid.spacing[2] as f32, |k| target(i * plane + j * nz + k));
        }
        for k in 0..nz {
            envelope.transform(grid.spacing[1], ny, |j| slab[j * nz + k]);
            for j in 0..ny {
                slab[j * nz + k] = envelope.result[j];
            }
        }
    });
    // Along i: one slab per j is made beside the array, then written back plane by plane.
    let slabs: Vec<Vec<f32>> = (0..ny)
        .into_par_iter()
        .map(|j| {
            let mut envelope = Envelope::new(nx);
            let mut slab = vec![0.0; nx * nz];
            for k in 0..nz {
                envelope.transform(grid.spacing[0], nx, |i| squared[i * plane + j * nz + k]);
                for i in 0..nx {
                    slab[i * nz + k] = envelope.result[i];
                }
            }
            slab
        })
        .collect();
    squared.par_chunks_mut(plane).enumerate().for_each(|(i, out)| {
        for (j, row) in out.chunks_mut(nz).enumerate() {
            row.copy_from_slice(&slabs[j][i * nz..(i + 1) * nz]);
        }
    });
    squared
}

/// Voxels of the shape that no ball of `radius` inside it comes near: its sheets and spikes.
///
/// `squared` is the squared distance of each voxel to the complement. A voxel is thin if it lies farther
/// than (1 + `slack`) · radius from every place where such a ball has its centre; a slack of 0.5 leaves edges
/// and corners of 90° alone.
pub fn thin_parts(grid: &Grid, squared: &[f32], radius: f64, slack: f64) -> Vec<bool> {
    // Distances run from centre to centre: the surface lies about half a voxel nearer.
    let half = 0.5 * grid.spacing.iter().copied().fold(f64::INFINITY, f64::min);
    let core = (radius + half).powi(2) as f32;
    let reach = ((1.0 + slack) * radius + half).powi(2) as f32;
    let to_core = squared_distance(grid, |index| squared[index] >= core);
    squared
        .par_iter()
        .zip(to_core.par_iter())
        .map(|(&inside, &distance)| inside > 0.0 && distance > reach)
        .collect()
}

/// Squared distances along one row to its own targets.
fn scan(row: &mut [f32], spacing: f32, target: impl Fn(usize) -> bool) {
    let mut last: Option<usize> = None;
    for k in 0..row.len() {
        if target(k) {
            last = Some(k);
        }
        row[k] = last.map_or(FAR, |l| ((k - l) as f32 * spacing).powi(2));
    }
    last = None;
    for k in (0..row.len()).rev() {
        if row[k] == 0.0 {
            last = Some(k);
        }
        if let Some(l) = last {
            row[k] = row[k].min(((l - k) as f32 * spacing).powi(2));
        }
    }
}

/// Work space of the lower envelope of parabolas along one line.
struct Envelope {
    heights: Vec<f32>,
    apex: Vec<u32>,
    start: Vec<f64>,
    result: Vec<f32>,
}

impl Envelope {
    fn new(n: usize) -> Self {
        Self {
            heights: vec![0.0; n],
            apex: vec![0; n],
            start: vec![0.0; n + 1],
            result: vec![0.0; n],
        }
    }

    fn transform(&mut self, spacing: f64, n: usize, height: impl Fn(usize) -> f32) {
        for q in 0..n {
            self.heights[q] = height(q);
        }
        let square = spacing * spacing;
        let mut count = 0;
        for q in 0..n {
            if self.heights[q] == FAR {
                continue;
            }
            let fq = f64::from(self.heights[q]) / square + (q * q) as f64;
            let mut from = f64::NEG_INFINITY;
            while count > 0 {
                let p = self.apex[count - 1] as usize;
                let fp = f64::from(self.heights[p]) / square + (p * p) as f64;
                from = (fq - fp) / (2 * (q - p)) as f64;
                if from > self.start[count - 1] {
                    break;
                }
                count -= 1;
                from = f64::NEG_INFINITY;
            }
            self.apex[count] = q as u32;
            self.start[count] = from;
            count += 1;
        }
        if count == 0 {
            self.result[..n].fill(FAR);
            return;
        }
        let mut current = 0;
        for q in 0..n {
            while current + 1 < count && self.start[current + 1] < q as f64 {
                current += 1;
            }
            let p = self.apex[current] as usize;
            let step = q.abs_diff(p) as f64;
            self.result[q] = (step * step * square) as f32 + self.heights[p];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn distances_equal_those_of_brute_force() {
        let grid = Grid::new([7, 5, 9], [1.0, 2.5, 0.7], [0.0; 3]).expect("a grid");
        let targets = [3_usize, 40, 200, 310];
        let fast = squared_distance(&grid, |index| targets.contains(&index));
        for (index, &found) in fast.iter().enumerate() {
            let x = grid.centre(index);
            let exact = targets
                .iter()
                .map(|&t| {
                    let y = grid.centre(t);
                    (0..3).map(|a| (x[a] - y[a]).powi(2)).sum::<f64>()
                })
                .fold(f64::INFINITY, f64::min);
            assert!((f64::from(found) - exact).abs() <= 1e-5 * exact.max(1.0), "voxel {index}");
        }
        assert!(squared_distance(&grid, |_| false).iter().all(|d| d.is_infinite()));
    }

    #[test]
    fn a_sheet_is_thin_and_a_slab_is_not() {
        let grid = Grid::new([30, 30, 30], [1.0; 3], [0.0; 3]).expect("a grid");
        let i_of = |index: usize| index / 900;
        let inside = |index: usize| (5..8).contains(&i_of(index)) || i_of(index) >= 15;
        let squared = squared_distance(&grid, |index| !inside(index));
        let thin = thin_parts(&grid, &squared, 3.0, 0.5);
        for (index, &found) in thin.iter().enumerate() {
            assert_eq!(found, (5..8).contains(&i_of(index)), "voxel {index}");
        }
    }
}
