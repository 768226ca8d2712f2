//! Rows of three that must be finite and within the range of what a head can have.

use crate::error::{ErrorKind, Result};

/// Rejects NaN and infinity in rows of three, stating the row.
pub(crate) fn check_finite_rows(what: &str, rows: &[[f64; 3]], kind: ErrorKind) -> Result<()> {
    for (index, row) in rows.iter().enumerate() {
        if let Some(&value) = row.iter().find(|v| !v.is_finite()) {
            return Err(kind.not_finite(what, index, value));
        }
    }
    Ok(())
}

/// Largest coordinate and displacement, mm (1 km): squares and sums of them stay far from overflow.
pub const LARGEST_COORDINATE: f64 = 1e6;
/// Largest force on a node, N.
const LARGEST_FORCE: f64 = 1e12;

/// Rejects NaN, infinity and coordinates or displacements beyond [`LARGEST_COORDINATE`], stating the row.
pub(crate) fn check_coordinates(what: &str, rows: &[[f64; 3]], kind: ErrorKind) -> Result<()> {
    check_rows_within(what, rows, LARGEST_COORDINATE, "-1e6 to 1e6 mm; check the units", kind)
}

/// Rejects NaN, infinity and displacements that no body can have, stating the row: those of a solution under
/// absurd loads may be beyond [`LARGEST_COORDINATE`].
pub(crate) fn check_displacements(what: &str, rows: &[[f64; 3]], kind: ErrorKind) -> Result<()> {
    check_rows_within(what, rows, 1e30, "-1e30 to 1e30 mm", kind)
}

/// Rejects NaN, infinity and forces beyond [`LARGEST_FORCE`], stating the row.
pub(crate) fn check_forces(what: &str, rows: &[[f64; 3]], kind: ErrorKind) -> Result<()> {
    check_rows_within(what, rows, LARGEST_FORCE, "-1e12 to 1e12 N; check the units", kind)
}

fn check_rows_within(
    what: &str,
    rows: &[[f64; 3]],
    largest: f64,
    allowed: &'static str,
    kind: ErrorKind,
) -> Result<()> {
    check_finite_rows(what, rows, kind)?;
    for (index, row) in rows.iter().enumerate() {
        if let Some(&value) = row.iter().find(|v| v.abs() > largest) {
            return Err(kind.out_of_range(what, index, value, allowed));
        }
    }
    Ok(())
}
