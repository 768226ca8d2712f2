//! Plans and what else drives a body, read from Python dicts by segment.

use mtm_core::{Change, ErrorKind, Motion, Plan, RigidMotion};
use pyo3::prelude::*;
use pyo3::types::PyDict;

use crate::arrays::{self, Named};
use crate::errors::{self, Failure};
use crate::geometry::PySurfaceMotion;

const BOUNDARY: ErrorKind = ErrorKind::Boundary;

/// Items of an optional dict with text keys.
pub fn entries<'py>(
    value: Option<&Bound<'py, PyAny>>,
    what: &str,
) -> PyResult<Vec<(String, Bound<'py, PyAny>)>> {
    let Some(value) = value else { return Ok(Vec::new()) };
    let wrong = || errors::input(BOUNDARY, format!("{what} must be a dict of segment names"));
    let dict = value.cast::<PyDict>().map_err(|_| wrong())?;
    dict.iter().map(|(k, v)| Ok((k.extract::<String>().map_err(|_| wrong())?, v))).collect()
}

/// Motions by segment: (4, 4) rigid, (k, 3) displacements of joined nodes, or a SurfaceMotion.
pub fn plan(value: &Bound<'_, PyAny>) -> PyResult<Plan> {
    entries(Some(value), "plan")?
        .into_iter()
        .map(|(name, motion)| {
            if let Ok(surface) = motion.cast::<PySurfaceMotion>() {
                return Ok((name, Motion::Surface(surface.get().core.clone())));
            }
            let what = format!("plan[\"{name}\"]");
            let named = Named(&what, BOUNDARY);
            if let Some(matrix) = arrays::matrix4(&motion, named)? {
                let rigid = RigidMotion::new(&name, &matrix).map_err(Failure)?;
                return Ok((name, Motion::Rigid(rigid)));
            }
            let rows = arrays::points(&motion, named).map_err(|e| {
                let problem = format!(
                    "{what} must be a (4, 4) rigid matrix, (k, 3) displacements of its joined nodes, or a \
                     SurfaceMotion ({e})"
                );
                errors::input(BOUNDARY, problem)
            })?;
            Ok((name, Motion::Nodes(rows)))
        })
        .collect()
}

/// Changes of what drives a body: forces on nodes, or rates of motions by segment.
pub fn changes(value: &Bound<'_, PyAny>) -> PyResult<Vec<Change>> {
    let wrong = |i: usize| {
        errors::input(
            BOUNDARY,
            format!("changes[{i}] must be (n, 3) forces, N, or a dict of rates"),
        )
    };
    let change = |(i, entry): (usize, PyResult<Bound<'_, PyAny>>)| {
        let entry = entry?;
        if !entry.is_instance_of::<PyDict>() {
            let what = format!("changes[{i}]");
            return Ok(Change::Loads(arrays::points(&entry, Named(&what, BOUNDARY))?));
        }
        let rate = |(name, matrix): (String, Bound<'_, PyAny>)| {
            let what = format!("changes[{i}][\"{name}\"]");
            let found = arrays::matrix4(&matrix, Named(&what, BOUNDARY))?;
            let [x, y, z, last] = found.ok_or_else(|| wrong(i))?;
            if last != [0.0; 4] {
                let problem = format!("{what}: the last row of a rate is zero, not {last:?}");
                return Err(errors::input(BOUNDARY, problem));
            }
            Ok((name, [x, y, z]))
        };
        let rates = entries(Some(&entry), &format!("changes[{i}]"))?.into_iter().map(rate);
        Ok(Change::Rates(rates.collect::<PyResult<_>>()?))
    };
    let listed = value.try_iter().map_err(|_| {
        errors::input(BOUNDARY, "changes must be a sequence of forces and of dicts".to_owned())
    })?;
    listed.enumerate().map(change).collect()
}
