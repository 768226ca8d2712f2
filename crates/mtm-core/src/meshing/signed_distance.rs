//! Signed distance of a surface on a grid, in a band around it.

use rayon::prelude::*;

use crate::error::{ErrorKind, Result};
use crate::geometry::surface::Surface;
use crate::geometry::winding::WindingTree;
use crate::meshing::stuffing::level::{Grid, LevelImage};
use crate::vector::{norm, sub};

/// Winding number that separates inside from outside.
const INSIDE: f64 = 0.5;

/// Signed distance to `surface` on `grid`, positive inside, clipped at ±`band` (mm).
///
/// A point is inside if the generalised winding number exceeds one half (Barill et al. 2018): overlapping parts
/// count once, and small holes do no harm. Along a row of voxels the distance shows how many of the next ones
/// can be skipped (Hart 1996, sphere tracing). Parallel; the result does not depend on the number of threads.
///
/// # Errors
/// A band that is not positive.
pub fn signed_distance(surface: &Surface, grid: Grid, band: f64) -> Result<LevelImage> {
    let allowed = "above 0 mm and finite";
    ErrorKind::Mesh.require(band > 0.0 && band.is_finite(), "band", band, allowed)?;
    let winding = WindingTree::new(surface);
    let sign = |x: [f64; 3]| if winding.winding_number_one(x) > INSIDE { 1.0 } else { -1.0 };
    let distance = |x: [f64; 3]| norm(sub(surface.closest_one(x).point, x));
    let nz = grid.shape[2];
    let step = grid.spacing[2];
    let mut values = vec![0.0_f32; grid.len()];
    values.par_chunks_mut(nz).enumerate().for_each(|(row, out)| {
        let mut k = 0;
        let mut previous: Option<(f64, f64)> = None;
        while k < nz {
            let x = grid.centre(row * nz + k);
            let d = distance(x);
            // If the surface is further away than one step, the next voxel lies on the same side.
            let side = match previous {
                Some((side, d)) if d > step => side,
                _ => sign(x),
            };
            // The distance decreases by at most one step per voxel: all voxels up to here are beyond the band
            // too.
            let beyond = ((d - band) / step).floor().max(0.0) as usize;
            let end = (k + 1 + beyond).min(nz);
            out[k..end].fill((side * d.min(band)) as f32);
            previous = (beyond == 0).then_some((side, d));
            k = end;
        }
    });
    LevelImage::new(grid, values)
}
