//! `StaticSolver`, `Solution` and `PlanOperator` for Python.

mod operator;
mod solution;
mod solver;

use mtm_core::Timings;
use pyo3::prelude::*;
use pyo3::types::PyDict;

pub use operator::PyPlanOperator;
pub use solution::PySolution;
pub use solver::PyStaticSolver;

/// Seconds by stage.
pub(super) fn timings<'py>(py: Python<'py>, laps: &Timings) -> PyResult<Bound<'py, PyDict>> {
    let out = PyDict::new(py);
    for (stage, seconds) in laps {
        out.set_item(stage, seconds)?;
    }
    Ok(out)
}
