//! `PlanOperator` for Python.

use mtm_core::PlanOperator;
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArrayMethods};
use pyo3::prelude::*;

use crate::arrays;
use crate::plans;
use crate::running::attempted;

/// Exact map from rigid plans to displacements of chosen nodes; call it with a plan.
#[pyclass(frozen, module = "cmfsim", name = "PlanOperator")]
pub struct PyPlanOperator {
    pub(super) core: PlanOperator,
}

#[pymethods]
impl PyPlanOperator {
    /// Displacements of `nodes` under a rigid plan, (k, 3) float64, mm.
    fn __call__<'py>(
        &self,
        py: Python<'py>,
        plan: &Bound<'py, PyAny>,
    ) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let plan = plans::plan(plan)?;
        Ok(arrays::rows(py, attempted(py, || self.core.apply(&plan))?))
    }

    /// The nodes whose displacements it returns, (k,) uint32.
    #[getter]
    fn nodes<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.core.nodes().to_vec().into_pyarray(py)
    }

    /// Names of the segments, in the order of the columns.
    #[getter]
    fn segments(&self) -> Vec<String> {
        self.core.segments().to_vec()
    }

    /// Point of each segment about which its columns are defined, (segments, 3) float64, mm.
    #[getter]
    fn centres<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray2<f64>> {
        arrays::rows(py, self.core.centres().to_vec())
    }

    /// The columns, (3k, 12 * segments) float64: R - I row by row, then the displacement of the centre.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArray2<f64>>> {
        let shape = [3 * self.core.nodes().len(), 12 * self.core.segments().len()];
        self.core.matrix().to_vec().into_pyarray(py).reshape(shape)
    }

    fn __repr__(&self) -> String {
        format!(
            "PlanOperator({} nodes, segments {:?})",
            self.core.nodes().len(),
            self.core.segments()
        )
    }
}
