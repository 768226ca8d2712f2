//! Whether points can determine a registration: their coordinates, and how they are spread in space.

use nalgebra::Matrix3;

use crate::error::{self, ErrorKind, MtmError, Result};
use crate::vector::Vec3;

/// Thickness of points over their longest extent below which they count as lying in a plane or line.
///
/// At this limit, 0.015 mm in a head, no operator places points accurately enough to determine the direction.
pub const FLAT_THICKNESS: f64 = 1e-4;

/// Rejects NaN, infinity and coordinates that are too large, stating the row.
pub(crate) fn check_coordinates(what: &str, points: &[[f64; 3]]) -> Result<()> {
    error::check_coordinates(what, points, ErrorKind::Registration)
}

/// Rejects fewer than `needed` points.
pub(crate) fn check_count(
    what: &'static str,
    found: usize,
    needed: usize,
    shape: &'static str,
) -> Result<()> {
    if found >= needed {
        Ok(())
    } else {
        Err(MtmError::TooFewPoints { what, found, needed, shape })
    }
}

/// Extents of points along their principal axes, ascending, mm: thickness, width, length.
pub(crate) fn extents(points: &[Vec3]) -> [f64; 3] {
    let mean = points.iter().sum::<Vec3>() / points.len().max(1) as f64;
    let scatter =
        points.iter().map(|p| p - mean).fold(Matrix3::zeros(), |sum, p| sum + p * p.transpose());
    let axes = scatter.symmetric_eigen().eigenvectors;
    let mut extents = [0, 1, 2].map(|k| {
        let along = points.iter().map(|p| (p - mean).dot(&axes.column(k)));
        let (low, high) = along
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (low.min(x), high.max(x)));
        (high - low).max(0.0)
    });
    extents.sort_by(f64::total_cmp);
    extents
}

/// Rejects points that are all collinear.
pub(crate) fn check_not_in_line(what: &'static str, points: &[Vec3]) -> Result<()> {
    let [_, width, size] = extents(points);
    check_thickness(what, "line", width, size)
}

/// Rejects points that are all collinear or coplanar.
pub(crate) fn check_not_in_plane(what: &'static str, points: &[Vec3]) -> Result<()> {
    let [thickness, width, size] = extents(points);
    check_thickness(what, "line", width, size)?;
    check_thickness(what, "plane", thickness, size)
}

fn check_thickness(
    what: &'static str,
    shape: &'static str,
    thickness: f64,
    size: f64,
) -> Result<()> {
    if thickness > FLAT_THICKNESS * size {
        return Ok(());
    }
    Err(MtmError::FlatPoints { what, shape, thickness, size, limit: FLAT_THICKNESS })
}
