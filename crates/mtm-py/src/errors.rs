//! The exception family: one class per kind, with a twin that is also a `ValueError` if the input is at fault.

use mtm_core::{ErrorKind, MtmError};
use pyo3::exceptions::{PyException, PyKeyboardInterrupt, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use pyo3::types::{PyDict, PyTuple, PyType};

/// Public names with their docs; all are subclasses of the first.
const FAMILY: [(&str, &str); 10] = [
    ("CmfsimError", "Any error of cmfsim."),
    ("MeshError", "Nodes, tets or surfaces cannot be used."),
    ("MaterialError", "Tissue constants or stiffness cannot be used."),
    ("BoundaryError", "Node kinds, segments or plans do not fit."),
    ("ContactError", "A contact surface cannot serve, or contact does not converge."),
    ("SolverError", "Solver options are out of range, or a solve failed."),
    ("RegistrationError", "A registration failed."),
    ("LandmarkError", "Landmarks are missing, doubled or misplaced."),
    ("CaseError", "A case or scene file cannot be used."),
    ("ImageError", "An image cannot be used."),
];

/// Classes by name, each with its twin that is also a `ValueError`.
struct Family {
    public: Vec<Py<PyType>>,
    input: Vec<Py<PyType>>,
}

static CLASSES: PyOnceLock<Family> = PyOnceLock::new();

fn family(py: Python<'_>) -> PyResult<&Family> {
    CLASSES.get_or_try_init(py, || {
        let (mut public, mut input): (Vec<Py<PyType>>, Vec<Py<PyType>>) = (Vec::new(), Vec::new());
        for (name, doc) in FAMILY {
            let base = match public.first() {
                Some(class) => class.bind(py).clone().into_any(),
                None => py.get_type::<PyException>().into_any(),
            };
            let class = new_type(name, doc, PyTuple::new(py, [base])?)?;
            // The same name for both: users see and catch a single class.
            let value_error = py.get_type::<PyValueError>().into_any();
            let both = PyTuple::new(py, [class.clone().into_any(), value_error])?;
            input.push(new_type(name, doc, both)?.unbind());
            public.push(class.unbind());
        }
        Ok(Family { public, input })
    })
}

/// `type(name, bases, {"__doc__": doc, "__module__": "cmfsim"})`: several bases require a call to Python's
/// `type`.
fn new_type<'py>(
    name: &str,
    doc: &str,
    bases: Bound<'py, PyTuple>,
) -> PyResult<Bound<'py, PyType>> {
    let py = bases.py();
    let members = PyDict::new(py);
    members.set_item("__doc__", doc)?;
    members.set_item("__module__", "cmfsim")?;
    Ok(py.get_type::<PyType>().call1((name, bases, members))?.cast_into::<PyType>()?)
}

/// Adds the exceptions to the module.
pub fn register(module: &Bound<'_, PyModule>) -> PyResult<()> {
    let py = module.py();
    for ((name, _), class) in FAMILY.iter().zip(&family(py)?.public) {
        module.add(*name, class.bind(py))?;
    }
    Ok(())
}

fn raise(kind: ErrorKind, is_input: bool, message: String) -> PyErr {
    let at = match kind {
        ErrorKind::Mesh => 1,
        ErrorKind::Material => 2,
        ErrorKind::Boundary => 3,
        ErrorKind::Contact => 4,
        ErrorKind::Solver => 5,
        ErrorKind::Registration => 6,
        _ => 0,
    };
    Python::attach(|py| match family(py) {
        Ok(family) => {
            let classes = if is_input { &family.input } else { &family.public };
            PyErr::from_type(classes[at].bind(py).clone(), message)
        }
        Err(error) => error,
    })
}

/// An error of the family `kind` that is caused by the input.
pub fn input(kind: ErrorKind, message: String) -> PyErr {
    raise(kind, true, message)
}

/// An error of the library itself.
pub fn internal(message: String) -> PyErr {
    raise(ErrorKind::Solver, false, format!("internal error, please report it: {message}"))
}

/// A core error on its way to Python.
pub struct Failure(pub MtmError);

impl From<MtmError> for Failure {
    fn from(error: MtmError) -> Self {
        Self(error)
    }
}

impl From<Failure> for PyErr {
    fn from(Failure(error): Failure) -> Self {
        if error == MtmError::Interrupted {
            return PyKeyboardInterrupt::new_err("interrupted");
        }
        let raised = raise(error.kind(), error.is_input(), error.to_string());
        if let MtmError::IcpNotConverged { history, .. } = error {
            // The values reached are attached to the error, for callers that examine it.
            let noted = Python::attach(|py| raised.value(py).setattr("rms_history", history));
            return noted.err().unwrap_or(raised);
        }
        raised
    }
}
