//! `cmfsim._core`: the binding of mtm-core. It converts arguments, detaches and maps errors; it makes no
//! decisions.

mod arrays;
mod boundary;
mod equivalent;
mod errors;
mod fibres;
mod geometry;
mod materials;
mod plans;
mod registration;
mod running;
mod statics;
mod stuffing;

#[global_allocator]
static MEMORY: mtm_core::HugePages = mtm_core::HugePages;

/// The compiled core of cmfsim.
#[pyo3::pymodule]
mod _core {
    use mtm_core::{Element, FibreLaw, Kinematics, Method, Preset};
    use pyo3::prelude::*;
    use pyo3::types::PyTuple;

    #[pymodule_export]
    use crate::boundary::PyBoundary;
    #[pymodule_export]
    use crate::equivalent::{PyMuscleShares, sample};
    #[pymodule_export]
    use crate::fibres::PyMuscleFibres;
    #[pymodule_export]
    use crate::geometry::{
        PyMeshQuality, PySurface, PySurfaceMotion, PyTetMesh, decimated, rigid_matrix, smoothed,
        tube_levels,
    };
    #[pymodule_export]
    use crate::materials::{PyMassTensors, PyTissue};
    #[pymodule_export]
    use crate::registration::{PyFolds, PyIcpFit, PyRigidFit, PyThinPlateSpline, icp, rigid_fit};
    #[pymodule_export]
    use crate::statics::{PyPlanOperator, PySolution, PyStaticSolver};

    #[pymodule_export]
    use crate::stuffing::{
        distance_image, label_image, part_mesh, signed_distance_image, stuff_image,
    };

    #[pymodule_init]
    fn init(module: &Bound<'_, PyModule>) -> PyResult<()> {
        crate::errors::register(module)?;
        module.add("__version__", env!("CARGO_PKG_VERSION"))?;
        module.add("METHODS", PyTuple::new(module.py(), Method::ALL.map(Method::name))?)?;
        module.add("ELEMENTS", PyTuple::new(module.py(), Element::ALL.map(Element::name))?)?;
        let kinematics: Vec<&str> = Kinematics::all().map(Kinematics::name).collect();
        module.add("KINEMATICS", PyTuple::new(module.py(), kinematics)?)?;
        module.add("PRESETS", PyTuple::new(module.py(), Preset::ALL.map(|preset| preset.0))?)?;
        module.add("LAWS", PyTuple::new(module.py(), FibreLaw::ALL.map(|law| law.0))?)?;
        module.add("MOST_BOXES", mtm_core::MOST_BOXES)
    }
}
