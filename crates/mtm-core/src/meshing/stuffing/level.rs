//! Level images: a scalar on a regular grid, positive in the tissue, zero on its surface.

use rayon::prelude::*;

use crate::error::{ErrorKind, MtmError, Result};

/// Value far outside the grid, and of a clipped level far outside the tissue.
const OUTSIDE: f32 = -1.0;
/// Smallest absolute value at a voxel centre of a level made from labels. Smoothing rounds the steps between
/// voxels, but must not change the label of any voxel: sheets and gaps one voxel thick are preserved.
const LABEL_FLOOR: f32 = 0.1;

/// A voxel and its 26 neighbours.
const NEIGHBOURHOOD: u8 = 27;

/// Regular grid of voxels; value [i, j, k] lies at origin + (i, j, k) · spacing, k runs fastest.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grid {
    /// Voxels along each axis.
    pub shape: [usize; 3],
    /// Distance of voxel centres along each axis, mm.
    pub spacing: [f64; 3],
    /// Centre of the first voxel, mm.
    pub origin: [f64; 3],
}

/// Scalar on a grid, positive inside, interpolated trilinearly; outside the grid it is negative.
#[derive(Debug, Clone)]
pub struct LevelImage {
    grid: Grid,
    values: Vec<f32>,
}

impl Grid {
    /// The grid, checked.
    ///
    /// # Errors
    /// An empty axis, spacing that is not positive, values that are not finite.
    pub fn new(shape: [usize; 3], spacing: [f64; 3], origin: [f64; 3]) -> Result<Self> {
        let kind = ErrorKind::Mesh;
        if shape.contains(&0) {
            return Err(MtmError::Empty { what: "image", kind });
        }
        for axis in 0..3 {
            if !(spacing[axis] > 0.0 && spacing[axis].is_finite()) {
                let allowed = "above 0 mm and finite";
                return Err(kind.out_of_range("spacing", axis, spacing[axis], allowed));
            }
            if !origin[axis].is_finite() {
                return Err(kind.not_finite("origin", axis, origin[axis]));
            }
        }
        Ok(Self { shape, spacing, origin })
    }

    /// Number of voxels.
    pub fn len(&self) -> usize {
        self.shape.iter().product()
    }

    /// Whether there are no voxels; a checked grid has some.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Centre of voxel `index` of the flat array, mm.
    pub fn centre(&self, index: usize) -> [f64; 3] {
        let [_, ny, nz] = self.shape;
        let voxel = [index / (ny * nz), index / nz % ny, index % nz];
        [0, 1, 2].map(|a| self.origin[a] + voxel[a] as f64 * self.spacing[a])
    }
}

impl LevelImage {
    /// The level image of `values` on `grid`.
    ///
    /// # Errors
    /// A number of values that differs from the number of voxels, NaN or infinity.
    pub fn new(grid: Grid, values: Vec<f32>) -> Result<Self> {
        let kind = ErrorKind::Mesh;
        kind.require_length("level image", values.len(), grid.len(), "one per voxel")?;
        if let Some(index) = values.par_iter().position_first(|v| !v.is_finite()) {
            let value = f64::from(values[index]);
            return Err(kind.not_finite("level image", index, value));
        }
        Ok(Self { grid, values })
    }

    /// The level image of labels: non-zero is tissue.
    ///
    /// Steps between voxels are smoothed by the binomial filter (1 2 1)/4 along each axis, which keeps flat
    /// faces half-way between voxels; every voxel centre stays on its side.
    ///
    /// # Errors
    /// A number of labels that differs from the number of voxels.
    pub fn from_labels(grid: Grid, inside: &[bool]) -> Result<Self> {
        ErrorKind::Mesh.require_length("labels", inside.len(), grid.len(), "one per voxel")?;
        let [nx, ny, nz] = grid.shape;
        let plane = ny * nz;
        // Along j and k plane by plane, then along i from three neighbouring planes each.
        let mut smooth = vec![0.0_f32; grid.len()];
        smooth.par_chunks_mut(plane).zip(inside.par_chunks(plane)).for_each(|(out, labels)| {
            let mut rows = vec![0.0_f32; plane];
            for (row, labels) in rows.chunks_mut(nz).zip(labels.chunks(nz)) {
                let at = |k: usize| if labels[k] { 1.0 } else { OUTSIDE };
                for k in 0..nz {
                    row[k] = smoothed(k, nz, at);
                }
            }
            for j in 0..ny {
                for k in 0..nz {
                    out[j * nz + k] = smoothed(j, ny, |j| rows[j * nz + k]);
                }
            }
        });
        let mut values = vec![0.0_f32; grid.len()];
        values.par_chunks_mut(plane).enumerate().for_each(|(i, out)| {
            for (p, value) in out.iter_mut().enumerate() {
                let level = smoothed(i, nx, |i| smooth[i * plane + p]);
                *value = if inside[i * plane + p] {
                    level.max(LABEL_FLOOR)
                } else {
                    level.min(-LABEL_FLOOR)
                };
            }
        });
        Ok(Self { grid, values })
    }

    /// The grid.
    pub fn grid(&self) -> &Grid {
        &self.grid
    }

    /// Value of each voxel, k fastest.
    pub fn values(&self) -> &[f32] {
        &self.values
    }

    /// Value of each voxel, k fastest, moved out of the level.
    pub fn into_values(self) -> Vec<f32> {
        self.values
    }

    /// The trilinear value at a point (mm).
    ///
    /// Tissue ends where its image ends: a voxel beyond the border is as far outside as the border voxel is
    /// inside, so that the surface runs half a voxel beyond the last centre, on the face of the voxel.
    pub fn value(&self, point: [f64; 3]) -> f64 {
        let mut low = [0_isize; 3];
        let mut part = [0.0_f64; 3];
        let shape = self.grid.shape.map(|n| n as isize);
        for axis in 0..3 {
            let place = (point[axis] - self.grid.origin[axis]) / self.grid.spacing[axis];
            if place < -1.0 || place >= shape[axis] as f64 {
                return f64::from(OUTSIDE);
            }
            // Rounded down; `floor` is a call on processors without SSE 4.1, which are built for.
            let towards_zero = place as isize;
            low[axis] = towards_zero - isize::from(place < towards_zero as f64);
            part[axis] = place - low[axis] as f64;
        }
        let [nx, ny, nz] = shape;
        let is_inner = (0..3).all(|axis| low[axis] >= 0 && low[axis] + 1 < shape[axis]);
        let at = |i: isize, j: isize, k: isize| {
            if is_inner {
                return f64::from(self.values[((i * ny + j) * nz + k) as usize]);
            }
            let [p, q, r] = [i.clamp(0, nx - 1), j.clamp(0, ny - 1), k.clamp(0, nz - 1)];
            let value = f64::from(self.values[((p * ny + q) * nz + r) as usize]);
            if [p, q, r] == [i, j, k] { value } else { -value.abs() }
        };
        let [i, j, k] = low;
        let along_k =
            |i: isize, j: isize| at(i, j, k) * (1.0 - part[2]) + at(i, j, k + 1) * part[2];
        let along_j = |i: isize| along_k(i, j) * (1.0 - part[1]) + along_k(i, j + 1) * part[1];
        along_j(i) * (1.0 - part[0]) + along_j(i + 1) * part[0]
    }

    /// Gradient of the level at a point by central differences over a tenth of a voxel, 1/mm.
    pub fn gradient(&self, point: [f64; 3]) -> [f64; 3] {
        [0, 1, 2].map(|axis| {
            let step = 0.1 * self.grid.spacing[axis];
            let mut ends = [point; 2];
            ends[0][axis] -= step;
            ends[1][axis] += step;
            (self.value(ends[1]) - self.value(ends[0])) / (2.0 * step)
        })
    }

    /// Volume inside, mm³: voxels count by the share given by their value, linear across the surface.
    ///
    /// A voxel whose neighbours all have its sign counts fully; the others are evaluated with eight
    /// sub-samples.
    pub fn volume(&self) -> f64 {
        let [nx, ny, nz] = self.grid.shape;
        let voxel = self.grid.spacing.iter().product::<f64>();
        let eighths: u64 = (0..nx * ny)
            .into_par_iter()
            .map_init(
                || vec![0_u8; nz],
                |inside, row| {
                    self.count_inside(row / ny, row % ny, inside);
                    let eighths = |k: usize| match self.neighbours_inside(row, k, inside) {
                        Some(0) => 0,
                        Some(NEIGHBOURHOOD) => 8,
                        _ => self.eighths_inside(row * nz + k),
                    };
                    (0..nz).map(eighths).sum::<u64>()
                },
            )
            .sum();
        eighths as f64 / 8.0 * voxel
    }

    /// Writes how many of the nine voxels in and next to each of row (i, j) lie inside.
    fn count_inside(&self, i: usize, j: usize, inside: &mut [u8]) {
        let [nx, ny, nz] = self.grid.shape;
        inside.fill(0);
        for i in i.saturating_sub(1)..nx.min(i + 2) {
            for j in j.saturating_sub(1)..ny.min(j + 2) {
                let row = &self.values[(i * ny + j) * nz..][..nz];
                inside.iter_mut().zip(row).for_each(|(n, &value)| *n += u8::from(value > 0.0));
            }
        }
    }

    /// How many of a voxel and its 26 neighbours lie inside; none at the border of the image.
    fn neighbours_inside(&self, row: usize, k: usize, inside: &[u8]) -> Option<u8> {
        let [nx, ny, nz] = self.grid.shape;
        let (i, j) = (row / ny, row % ny);
        let at_border = i == 0 || j == 0 || k == 0 || i + 1 == nx || j + 1 == ny || k + 1 == nz;
        (!at_border).then(|| inside[k - 1] + inside[k] + inside[k + 1])
    }

    /// How many of a voxel's eight sub-samples lie inside.
    fn eighths_inside(&self, index: usize) -> u64 {
        let centre = self.grid.centre(index);
        (0..8_u64)
            .filter(|corner| {
                let point = [0, 1, 2].map(|a| {
                    let side = if corner >> a & 1 == 1 { 0.25 } else { -0.25 };
                    centre[a] + side * self.grid.spacing[a]
                });
                self.value(point) > 0.0
            })
            .count() as u64
    }
}

/// Place `i` of a line of `n` values under the filter (1 2 1)/4; beyond its ends is outside.
#[inline(always)]
fn smoothed(i: usize, n: usize, at: impl Fn(usize) -> f32) -> f32 {
    let low = if i > 0 { at(i - 1) } else { OUTSIDE };
    let high = if i + 1 < n { at(i + 1) } else { OUTSIDE };
    0.25 * (low + high) + 0.5 * at(i)
}
