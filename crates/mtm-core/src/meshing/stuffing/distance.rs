//! Exact distance transform on a grid, and the parts of a shape that are thinner than a ball.
//!
//! Felzenszwalb & Huttenlocher (2012): squared distances axis by axis as lower envelopes of parabolas.

use rayon::prelude::*;

use super::level::Grid;

/// Squared distance of a voxel that has no target near enough.
const FAR: f32 = f32::INFINITY;

/// Number of lines processed together: a cache line of them.
const TILE: usize = 16;

/// Squared distance of every voxel centre to the nearest centre that is a target, mm².
///
/// Infinite if there are no targets, and where it exceeds `most` (mm²), so that regions far from all targets
/// take little time. Parallel; the result does not depend on the number of threads.
pub fn squared_distance(grid: &Grid, most: f32, target: impl Fn(usize) -> bool + Sync) -> Vec<f32> {
    let [nx, ny, nz] = grid.shape;
    let plane = ny * nz;
    let mut squared = vec![FAR; grid.len()];
    squared.par_chunks_mut(plane).enumerate().for_each(|(i, slab)| {
        for (j, row) in slab.chunks_mut(nz).enumerate() {
            scan(row, grid.spacing[2] as f32, most, |k| target(i * plane + j * nz + k));
        }
        let mut lines = Lines::new(ny, grid.spacing[1], most);
        for k in (0..nz).step_by(TILE) {
            let width = TILE.min(nz - k);
            if lines.load(|j| &slab[j * nz + k..][..width]) {
                lines.transform(width);
                for j in 0..ny {
                    lines.store(j, &mut slab[j * nz + k..][..width]);
                }
            }
        }
    });
    // Along i: all rows of one j together, which no other j shares.
    let mut sheets: Vec<Vec<&mut [f32]>> = (0..ny).map(|_| Vec::with_capacity(nx)).collect();
    for (row, values) in squared.chunks_mut(nz).enumerate() {
        sheets[row % ny].push(values);
    }
    sheets.into_par_iter().for_each_init(
        || Lines::new(nx, grid.spacing[0], most),
        |lines, mut rows| {
            for k in (0..nz).step_by(TILE) {
                let width = TILE.min(nz - k);
                if lines.load(|i| &rows[i][k..][..width]) {
                    lines.transform(width);
                    for (i, row) in rows.iter_mut().enumerate() {
                        lines.store(i, &mut row[k..][..width]);
                    }
                }
            }
        },
    );
    squared
}

/// Voxels of the shape that are not close to any ball of `radius` inside it: its sheets and spikes.
///
/// `squared` is the squared distance of each voxel to the complement, at least where it is below
/// `core_squared`. A voxel is thin if it is further than (1 + `slack`) · radius from every centre of such a
/// ball; a slack of 0.5 excludes edges and corners of 90°.
pub fn thin_parts(grid: &Grid, squared: &[f32], radius: f64, slack: f64) -> Vec<bool> {
    let core = core_squared(grid, radius);
    let reach = ((1.0 + slack) * radius + half_voxel(grid)).powi(2) as f32;
    let to_core = squared_distance(grid, reach, |index| squared[index] >= core);
    squared
        .par_iter()
        .zip(to_core.par_iter())
        .map(|(&inside, &distance)| inside > 0.0 && distance > reach)
        .collect()
}

/// Squared distance to the complement from which on a voxel is the centre of a ball of `radius`, mm².
pub fn core_squared(grid: &Grid, radius: f64) -> f32 {
    (radius + half_voxel(grid)).powi(2) as f32
}

/// Distances are measured between voxel centres: the surface is nearer by about this much.
fn half_voxel(grid: &Grid) -> f64 {
    0.5 * grid.spacing.iter().copied().fold(f64::INFINITY, f64::min)
}

/// Squared distances along one row to its own targets, up to `most`; the others are infinite already.
fn scan(row: &mut [f32], spacing: f32, most: f32, target: impl Fn(usize) -> bool) {
    let n = row.len();
    // From each target as far as `most` or half-way to the next one.
    let spread = |row: &mut [f32], from: usize, to: usize| {
        fill_away(row[from..to].iter_mut().zip(0..), spacing, most);
    };
    let spread_back = |row: &mut [f32], from: usize, to: usize| {
        fill_away(row[from..to].iter_mut().rev().zip(1..), spacing, most);
    };
    let mut last: Option<usize> = None;
    for k in (0..n).filter(|&k| target(k)) {
        match last {
            Some(last) if last + 1 == k => row[last] = 0.0,
            Some(last) => {
                let middle = (last + k) / 2 + 1;
                spread(row, last, middle);
                spread_back(row, middle, k);
            }
            None => spread_back(row, 0, k),
        }
        last = Some(k);
    }
    if let Some(last) = last {
        spread(row, last, n);
    }
}

/// Writes squared distances of values so many steps away from a target, up to the first beyond `most`.
fn fill_away<'a>(values: impl Iterator<Item = (&'a mut f32, u32)>, spacing: f32, most: f32) {
    for (value, steps) in values {
        *value = (steps as f32 * spacing).powi(2);
        if *value > most {
            *value = FAR;
            break;
        }
    }
}

/// Lines of one length, next to each other, along which squared distances are propagated.
struct Lines {
    /// Line after line.
    values: Vec<f32>,
    n: usize,
    most: f32,
    envelope: Envelope,
}

impl Lines {
    fn new(n: usize, spacing: f64, most: f32) -> Self {
        Self { values: vec![FAR; TILE * n], n, most, envelope: Envelope::new(n, spacing) }
    }

    /// Loads lines from rows across them; false, without that, where all entries are far or all targets.
    fn load<'a>(&mut self, row: impl Fn(usize) -> &'a [f32]) -> bool {
        let (mut least, mut greatest) = ([FAR; TILE], [0.0; TILE]);
        for q in 0..self.n {
            for ((low, high), &value) in least.iter_mut().zip(&mut greatest).zip(row(q)) {
                *low = value.min(*low);
                *high = value.max(*high);
            }
        }
        if least.iter().all(|&low| low == FAR) || greatest.iter().all(|&high| high == 0.0) {
            return false;
        }
        for q in 0..self.n {
            for (line, &value) in row(q).iter().enumerate() {
                self.values[line * self.n + q] = value;
            }
        }
        true
    }

    fn transform(&mut self, width: usize) {
        for line in self.values.chunks_exact_mut(self.n).take(width) {
            self.envelope.transform(line);
            line.iter_mut().filter(|d| **d > self.most).for_each(|d| *d = FAR);
        }
    }

    /// Writes the values of the lines at position `q`.
    fn store(&self, q: usize, row: &mut [f32]) {
        for (line, value) in row.iter_mut().enumerate() {
            *value = self.values[line * self.n + q];
        }
    }
}

/// Lower envelope of parabolas along one line.
struct Envelope {
    spacing: f64,
    heights: Vec<f32>,
    /// The parabolas on the envelope.
    parabolas: Vec<Parabola>,
}

/// A parabola of unit curvature, in squared steps of the line.
#[derive(Clone, Copy)]
struct Parabola {
    apex: usize,
    /// Its height above 0 at position 0.
    at_zero: f64,
    /// Position from which on it is the lowest.
    start: f64,
}

impl Envelope {
    fn new(n: usize, spacing: f64) -> Self {
        Self { spacing, heights: vec![FAR; n], parabolas: Vec::with_capacity(n) }
    }

    fn transform(&mut self, line: &mut [f32]) {
        let (n, square) = (line.len(), self.spacing * self.spacing);
        self.heights.copy_from_slice(line);
        let heights = &self.heights;
        self.parabolas.clear();
        for q in 0..n {
            let height = heights[q];
            // Among targets, each target is nearest only to itself.
            let is_enclosed = height == 0.0
                && (q == 0 || heights[q - 1] == 0.0)
                && (q + 1 == n || heights[q + 1] == 0.0);
            if height == FAR || is_enclosed {
                continue;
            }
            let at_zero = f64::from(height) / square + (q * q) as f64;
            let mut start = f64::NEG_INFINITY;
            while let Some(last) = self.parabolas.last() {
                start = (at_zero - last.at_zero) / (2 * (q - last.apex)) as f64;
                if start > last.start {
                    break;
                }
                self.parabolas.pop();
                start = f64::NEG_INFINITY;
            }
            self.parabolas.push(Parabola { apex: q, at_zero, start });
        }
        let mut from = 0;
        for (at, parabola) in self.parabolas.iter().enumerate() {
            // A position on the border of two belongs to the first.
            let next = self.parabolas.get(at + 1).map_or(f64::INFINITY, |next| next.start);
            let end = if next < 0.0 { 0 } else { n.min((next as usize).saturating_add(1)) };
            for q in from..end {
                let step = q.abs_diff(parabola.apex) as f64;
                line[q] = (step * step * square) as f32 + heights[parabola.apex];
            }
            from = from.max(end);
        }
        line.iter_mut().zip(heights).filter(|(_, h)| **h == 0.0).for_each(|(d, _)| *d = 0.0);
    }
}
