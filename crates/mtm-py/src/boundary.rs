//! `Boundary` for Python: the kinds of the nodes, and the surfaces that they slide on or may touch.

use std::sync::Arc;

use mtm_core::{Against, Boundary, Conflicts, ErrorKind, Gap, Segment, TouchingPair};
use numpy::{IntoPyArray, PyArray1};
use pyo3::prelude::*;
use pyo3::types::{PyDict, PyString};

use crate::arrays::{self, Named};
use crate::errors::{self, Failure};
use crate::geometry::PySurface;
use crate::plans::entries;

const BOUNDARY: ErrorKind = ErrorKind::Boundary;

/// Kinds of the nodes: fixed, joined to a bone segment, sliding on one; all others are free.
///
/// Parameters
/// ----------
/// fixed : (k,) array_like of int, optional
///     Nodes that do not move.
/// joined : dict of str to (k,) array_like of int, optional
///     Nodes that move with each segment.
/// sliding : dict of str to (k,) array_like of int, optional
///     Nodes that slide on the contact surface of each segment.
/// contact : dict of str to Surface, optional
///     Contact surface of each segment with sliding nodes, at rest, normals out of the bone.
/// gap : dict of str to float, (k,) array_like or "rest", optional
///     Distance that sliding nodes keep from the surface, mm, negative behind it. "rest", the default, keeps the
///     offset that each has at rest, moved with its segment, so that no motion moves nothing; with 0, nodes that do
///     not lie on the surface are pulled onto it.
/// touching : sequence of (nodes, triangles), optional
///     Nodes that may touch a part of the tissue's own boundary, and separate again: (k,) int, and (m, 3) int, the
///     nodes of boundary triangles with outward normals. They may not enter the tissue behind these; no friction.
/// obstacles : sequence of (nodes, segment, Surface), optional
///     Nodes that may touch bone without being sliding nodes of it: they may not go behind the surface, which is
///     given at rest with normals out of the bone and moves with the named segment; None for fixed bone.
/// liftable : (nodes, segment), optional
///     Nodes that some plans hold and others free: joined to the named segment while they are held, or fixed if it is
///     None. Those that `joined` or `fixed` has are held; `StaticSolver.holding` holds others with the same factor.
/// conflicts : {"error", "resolve"}
///     A node of two kinds is an error, or fixed takes precedence over joined and joined over sliding.
///
/// Raises
/// ------
/// BoundaryError
///     A node of two kinds, a negative index, sliding nodes without a contact surface, an empty segment. By
///     `StaticSolver`: nodes that keep their offset further from the surface than a quarter of the mesh's diagonal.
#[pyclass(frozen, module = "cmfsim", name = "Boundary")]
pub struct PyBoundary {
    pub core: Arc<Boundary>,
}

#[pymethods]
impl PyBoundary {
    #[new]
    #[pyo3(signature = (
        fixed = None, joined = None, sliding = None, contact = None, *, gap = None, touching = None,
        obstacles = None, liftable = None, conflicts = "error"
    ))]
    #[expect(clippy::too_many_arguments, reason = "one for each keyword of the Python signature")]
    fn new(
        fixed: Option<&Bound<'_, PyAny>>,
        joined: Option<&Bound<'_, PyAny>>,
        sliding: Option<&Bound<'_, PyAny>>,
        contact: Option<&Bound<'_, PyAny>>,
        gap: Option<&Bound<'_, PyAny>>,
        touching: Option<&Bound<'_, PyAny>>,
        obstacles: Option<&Bound<'_, PyAny>>,
        liftable: Option<(Bound<'_, PyAny>, Option<String>)>,
        conflicts: &str,
    ) -> PyResult<Self> {
        let fixed = fixed.map_or(Ok(Vec::new()), |f| arrays::nodes(f, Named("fixed", BOUNDARY)))?;
        let mut segments: Vec<Segment> = Vec::new();
        for (name, ids) in entries(joined, "joined")? {
            let what = format!("joined[\"{name}\"]");
            let ids = arrays::nodes(&ids, Named(&what, BOUNDARY))?;
            segment(&mut segments, &name).joined = ids;
        }
        for (name, ids) in entries(sliding, "sliding")? {
            let what = format!("sliding[\"{name}\"]");
            let ids = arrays::nodes(&ids, Named(&what, BOUNDARY))?;
            segment(&mut segments, &name).sliding = ids;
        }
        for (name, surface) in entries(contact, "contact")? {
            let surface = surface.cast::<PySurface>().map_err(|_| {
                errors::input(BOUNDARY, format!("contact[\"{name}\"] must be a cmfsim.Surface"))
            })?;
            segment(&mut segments, &name).contact = Some(surface.get().core.clone());
        }
        for (name, value) in entries(gap, "gap")? {
            let gap = read_gap(&name, &value)?;
            let Some(segment) = segments.iter_mut().find(|s| s.name == name) else {
                let problem = format!("gap[\"{name}\"]: no such segment");
                return Err(errors::input(BOUNDARY, problem));
            };
            segment.gap = gap;
        }
        let conflicts = match conflicts {
            "error" => Conflicts::Refuse,
            "resolve" => Conflicts::Resolve,
            other => {
                let problem = format!("conflicts is \"{other}\": use \"error\" or \"resolve\"");
                return Err(errors::input(BOUNDARY, problem));
            }
        };
        let mut pairs = touching_pairs(touching)?;
        pairs.extend(obstacle_pairs(obstacles)?);
        let mut core = Boundary::new(fixed, segments, conflicts)
            .and_then(|boundary| boundary.with_touching(pairs))
            .map_err(Failure)?;
        if let Some((nodes, segment)) = liftable {
            let nodes = arrays::nodes(&nodes, Named("liftable", BOUNDARY))?;
            core = core.with_liftable(&nodes, segment.as_deref()).map_err(Failure)?;
        }
        Ok(Self { core: Arc::new(core) })
    }

    /// Nodes that do not move, (k,) uint32.
    #[getter]
    fn fixed<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.core.fixed().to_vec().into_pyarray(py)
    }

    /// Nodes that move with each segment, dict of (k,) uint32.
    #[getter]
    fn joined<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.by_segment(py, |s| (!s.joined.is_empty()).then(|| s.joined.clone().into_pyarray(py)))
    }

    /// Nodes that slide on each segment, dict of (k,) uint32.
    #[getter]
    fn sliding<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        self.by_segment(py, |s| (!s.sliding.is_empty()).then(|| s.sliding.clone().into_pyarray(py)))
    }

    /// Contact surface of each segment that has one, dict of Surface.
    #[getter]
    fn contact<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        for s in self.core.segments() {
            if let Some(surface) = &s.contact {
                out.set_item(&s.name, PySurface::wrap(surface.as_ref().clone()))?;
            }
        }
        Ok(out)
    }

    /// Prescribed gap of the sliding nodes of each segment, dict of (k,) float64, mm, or "rest".
    #[getter]
    fn gap<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        for s in self.core.segments().iter().filter(|s| !s.sliding.is_empty()) {
            match &s.gap {
                Gap::Uniform(value) => {
                    out.set_item(&s.name, vec![*value; s.sliding.len()].into_pyarray(py))?;
                }
                Gap::PerNode(values) => out.set_item(&s.name, values.clone().into_pyarray(py))?,
                _ => out.set_item(&s.name, "rest")?,
            }
        }
        Ok(out)
    }

    /// Names of the segments.
    #[getter]
    fn segments(&self) -> Vec<String> {
        self.core.segments().iter().map(|s| s.name.clone()).collect()
    }

    /// Nodes that some plans hold and others free, (k,) uint32, ascending.
    #[getter]
    fn liftable<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<u32>> {
        self.core.liftable().0.to_vec().into_pyarray(py)
    }

    /// Number of nodes that were given two kinds, one of which was dropped (with `conflicts="resolve"`).
    #[getter]
    fn conflicts(&self) -> usize {
        self.core.conflicts()
    }

    fn __repr__(&self) -> String {
        let parts: Vec<String> = self
            .core
            .segments()
            .iter()
            .map(|s| format!("{}: {} joined, {} sliding", s.name, s.joined.len(), s.sliding.len()))
            .collect();
        format!("Boundary({} fixed; {})", self.core.fixed().len(), parts.join("; "))
    }
}

impl PyBoundary {
    fn by_segment<'py>(
        &self,
        py: Python<'py>,
        get: impl Fn(&Segment) -> Option<Bound<'py, PyArray1<u32>>>,
    ) -> PyResult<Bound<'py, PyDict>> {
        let out = PyDict::new(py);
        for s in self.core.segments() {
            if let Some(ids) = get(s) {
                out.set_item(&s.name, ids)?;
            }
        }
        Ok(out)
    }
}

/// Pairs of nodes and triangles of the tissue.
fn touching_pairs(value: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<TouchingPair>> {
    let wrong =
        || errors::input(BOUNDARY, "touching must be a sequence of (nodes, triangles)".to_owned());
    let Some(value) = value else { return Ok(Vec::new()) };
    let entries = value.try_iter().map_err(|_| wrong())?;
    let pair = |(i, entry): (usize, PyResult<Bound<'_, PyAny>>)| {
        let (nodes, triangles): (Bound<'_, PyAny>, Bound<'_, PyAny>) =
            entry?.extract().map_err(|_| wrong())?;
        let what = [format!("touching[{i}] nodes"), format!("touching[{i}] triangles")];
        Ok(TouchingPair {
            nodes: arrays::nodes(&nodes, Named(&what[0], BOUNDARY))?,
            against: Against::Tissue(arrays::triangles(&triangles, Named(&what[1], BOUNDARY))?),
        })
    };
    entries.enumerate().map(pair).collect()
}

/// Pairs of nodes and surfaces of bone.
fn obstacle_pairs(value: Option<&Bound<'_, PyAny>>) -> PyResult<Vec<TouchingPair>> {
    let wrong = || {
        errors::input(
            BOUNDARY,
            "obstacles must be a sequence of (nodes, segment name or None, Surface)".to_owned(),
        )
    };
    let Some(value) = value else { return Ok(Vec::new()) };
    let entries = value.try_iter().map_err(|_| wrong())?;
    let pair = |(i, entry): (usize, PyResult<Bound<'_, PyAny>>)| {
        let (nodes, segment, surface): (Bound<'_, PyAny>, Option<String>, Bound<'_, PyAny>) =
            entry?.extract().map_err(|_| wrong())?;
        let surface = surface.cast::<PySurface>().map_err(|_| wrong())?.get().core.clone();
        let what = format!("obstacles[{i}] nodes");
        Ok(TouchingPair {
            nodes: arrays::nodes(&nodes, Named(&what, BOUNDARY))?,
            against: Against::Bone { surface, segment },
        })
    };
    entries.enumerate().map(pair).collect()
}

/// The segment called `name`, added if it is new.
fn segment<'a>(segments: &'a mut Vec<Segment>, name: &str) -> &'a mut Segment {
    let at = segments.iter().position(|s| s.name == name).unwrap_or_else(|| {
        segments.push(Segment {
            name: name.to_owned(),
            joined: Vec::new(),
            sliding: Vec::new(),
            contact: None,
            gap: Gap::Rest,
        });
        segments.len() - 1
    });
    &mut segments[at]
}

/// The gap of the segment `name`: mm for all of its nodes or for each, or "rest".
fn read_gap(name: &str, value: &Bound<'_, PyAny>) -> PyResult<Gap> {
    if let Ok(text) = value.cast::<PyString>() {
        return match text.to_str()? {
            "rest" => Ok(Gap::Rest),
            other => {
                let problem = format!("gap[\"{name}\"] is \"{other}\": give mm or \"rest\"");
                Err(errors::input(BOUNDARY, problem))
            }
        };
    }
    let what = format!("gap[\"{name}\"]");
    let values = arrays::values(value, Named(&what, BOUNDARY))?;
    Ok(if values.len() == 1 { Gap::Uniform(values[0]) } else { Gap::PerNode(values) })
}
