//! The only entry for numpy arrays: shape, order, finiteness and range are checked here and nowhere else.
//!
//! Any real dtype, order and stride is accepted: arrays that are not C-ordered float64 are first copied by
//! numpy, so that Fortran-ordered arrays and strided views keep the values that the user sees.

use std::ops::RangeInclusive;

use mtm_core::ErrorKind;
use numpy::{
    IntoPyArray, PyArray1, PyArray2, PyArray3, PyArrayMethods, PyReadonlyArrayDyn,
    PyUntypedArrayMethods,
};
use pyo3::exceptions::PyOverflowError;
use pyo3::prelude::*;
use pyo3::types::{PyBool, PyDict};

use crate::errors;

/// Name of an argument, and the error family of its faults.
#[derive(Clone, Copy)]
pub struct Named<'a>(pub &'a str, pub ErrorKind);

impl Named<'_> {
    fn fail(self, problem: String) -> PyErr {
        errors::input(self.1, format!("{} {problem}", self.0))
    }
}

/// `value` as a numpy array; rejects masked entries, whose values are unknown.
fn unmasked<'py>(value: &Bound<'py, PyAny>, name: Named<'_>) -> PyResult<Bound<'py, PyAny>> {
    let numpy = value.py().import("numpy")?;
    if value.hasattr("mask")?
        && numpy.getattr("ma")?.call_method1("is_masked", (value,))?.extract()?
    {
        let problem = "has masked entries, whose values are unknown: fill or remove them";
        return Err(name.fail(problem.into()));
    }
    numpy
        .call_method1("asarray", (value,))
        .map_err(|e| name.fail(format!("cannot be read as an array: {e}")))
}

/// `value` as a numpy array in C order with the given dtype; rejects values of another kind.
fn converted<'py>(
    value: &Bound<'py, PyAny>,
    name: Named<'_>,
    kinds: &str,
    dtype: &str,
    wanted: &str,
) -> PyResult<Bound<'py, PyAny>> {
    let numpy = value.py().import("numpy")?;
    let array = unmasked(value, name)?;
    let kind: String = array.getattr("dtype")?.getattr("kind")?.extract()?;
    let empty = array.getattr("size")?.extract::<usize>()? == 0;
    if !(kinds.contains(&kind) || empty && kind == "f") {
        let found: String = array.getattr("dtype")?.str()?.extract()?;
        let hint = match kind.as_str() {
            "b" => "; turn a mask into indices with numpy.flatnonzero",
            "O" => "; rows of different length?",
            _ => "",
        };
        return Err(name.fail(format!("has dtype {found} where {wanted} are needed{hint}")));
    }
    let options = PyDict::new(value.py());
    options.set_item("dtype", dtype)?;
    let array = numpy.call_method("ascontiguousarray", (array,), Some(&options))?;
    // A view into packed records is contiguous but may be misaligned: a copy is not.
    if array.getattr("flags")?.getattr("aligned")?.extract()? {
        return Ok(array);
    }
    array.call_method0("copy")
}

fn shape_text(shape: &[usize]) -> String {
    let parts: Vec<String> = shape.iter().map(ToString::to_string).collect();
    format!("({}{})", parts.join(", "), if shape.len() == 1 { "," } else { "" })
}

/// C-ordered float64 values of `value` with their shape.
fn floats(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<(Vec<usize>, Vec<f64>)> {
    let shape: Option<Vec<usize>> =
        value.getattr("shape").ok().and_then(|s| s.extract::<Vec<usize>>().ok());
    let array = converted(value, name, "fiu", "float64", "real numbers")?;
    let array: PyReadonlyArrayDyn<'_, f64> = array.extract()?;
    // ascontiguousarray turns a scalar into an array with one entry; the shape of the scalar is ().
    let shape = match shape {
        Some(shape) if shape.is_empty() => shape,
        _ if value.is_instance_of::<pyo3::types::PyFloat>()
            || value.is_instance_of::<pyo3::types::PyInt>() =>
        {
            Vec::new()
        }
        _ => array.shape().to_vec(),
    };
    let values =
        array.as_slice().map_err(|e| name.fail(format!("is not contiguous: {e}")))?.to_vec();
    if let Some(at) = values.iter().position(|v| !v.is_finite()) {
        let mut rest = at;
        let mut index = vec![0; shape.len()];
        for (i, &n) in shape.iter().enumerate().rev() {
            index[i] = rest % n.max(1);
            rest /= n.max(1);
        }
        return Err(name.fail(format!("{index:?} is {}: every value must be finite", values[at])));
    }
    Ok((shape, values))
}

/// Rows of three finite values; `rows` gives their number if it is known.
pub fn points(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<[f64; 3]>> {
    let (shape, values) = floats(value, name)?;
    match shape[..] {
        [_, 3] => Ok(values.as_chunks::<3>().0.to_vec()),
        [3] => Err(name.fail("has shape (3,) where (k, 3) is needed; write [[x, y, z]]".into())),
        _ => Err(name.fail(format!("has shape {} where (k, 3) is needed", shape_text(&shape)))),
    }
}

/// One value, or one per row.
pub fn values(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<f64>> {
    let (shape, values) = floats(value, name)?;
    match shape[..] {
        [] | [_] => Ok(values),
        [k, 1] => Err(name.fail(format!("has shape ({k}, 1) where ({k},) is needed"))),
        _ => {
            Err(name
                .fail(format!("has shape {} where a number or (m,) is needed", shape_text(&shape))))
        }
    }
}

/// An image with three axes, k fastest.
pub enum Image {
    /// Whether each voxel is tissue.
    Labels([usize; 3], Vec<bool>),
    /// Level of each voxel.
    Level([usize; 3], Vec<f32>),
}

/// An image: labels if its values are bool or integers, a level if they are real.
pub fn image(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Image> {
    let (array, shape, kind) = three_axes(value, name)?;
    if "biu".contains(&kind) {
        return Ok(Image::Labels(shape, non_zero(&array, name)?));
    }
    let array = converted(&array, name, "f", "float32", "labels or real numbers")?;
    let array: PyReadonlyArrayDyn<'_, f32> = array.extract()?;
    let values = array.as_slice().map_err(|e| name.fail(format!("is not contiguous: {e}")))?;
    Ok(Image::Level(shape, values.to_vec()))
}

/// Whether each voxel of an image of bool or integers is nonzero.
pub fn labels(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<([usize; 3], Vec<bool>)> {
    let (array, shape, kind) = three_axes(value, name)?;
    if !"biu".contains(&kind) {
        return Err(name.fail("has real numbers where bool or whole numbers are needed".into()));
    }
    Ok((shape, non_zero(&array, name)?))
}

/// Small integers of the voxels of an image.
pub fn counts(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<u8>> {
    let (array, _, kind) = three_axes(value, name)?;
    if !"biu".contains(&kind) {
        return Err(name.fail("has real numbers where whole numbers are needed".into()));
    }
    let numpy = array.py().import("numpy")?;
    let bounded = numpy.call_method1("clip", (array, 0, u8::MAX))?;
    let array = converted(&bounded.call_method1("astype", ("uint8",))?, name, "u", "uint8", "")?;
    let array: PyReadonlyArrayDyn<'_, u8> = array.extract()?;
    let values = array.as_slice().map_err(|e| name.fail(format!("is not contiguous: {e}")))?;
    Ok(values.to_vec())
}

fn three_axes<'py>(
    value: &Bound<'py, PyAny>,
    name: Named<'_>,
) -> PyResult<(Bound<'py, PyAny>, [usize; 3], String)> {
    let array = unmasked(value, name)?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    let shape = shape.try_into().map_err(|found: Vec<usize>| {
        name.fail(format!("has shape {} where (nx, ny, nz) is needed", shape_text(&found)))
    })?;
    let kind = array.getattr("dtype")?.getattr("kind")?.extract()?;
    Ok((array, shape, kind))
}

fn non_zero(array: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<bool>> {
    let inside = converted(array, name, "biu", "bool", "")?;
    let inside: PyReadonlyArrayDyn<'_, bool> = inside.extract()?;
    let values = inside.as_slice().map_err(|e| name.fail(format!("is not contiguous: {e}")))?;
    Ok(values.to_vec())
}

/// An image with three axes for Python, k fastest.
pub fn volume(
    py: Python<'_>,
    shape: [usize; 3],
    values: Vec<f32>,
) -> PyResult<Bound<'_, PyArray3<f32>>> {
    values.into_pyarray(py).reshape(shape)
}

/// A 4×4 matrix, or nothing if the shape is different.
pub fn matrix4(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Option<[[f64; 4]; 4]>> {
    let array = converted(value, name, "fiu", "float64", "real numbers")?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    if shape != [4, 4] {
        return Ok(None);
    }
    let array: PyReadonlyArrayDyn<'_, f64> = array.extract()?;
    let mut out = [[0.0; 4]; 4];
    let flat = array.as_slice().map_err(|e| name.fail(format!("is not contiguous: {e}")))?;
    for (i, v) in flat.iter().enumerate() {
        out[i / 4][i % 4] = *v;
    }
    Ok(Some(out))
}

/// A 4×4 matrix.
pub fn square4(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<[[f64; 4]; 4]> {
    matrix4(value, name)?.ok_or_else(|| {
        let shape: Vec<usize> = value
            .py()
            .import("numpy")
            .and_then(|numpy| numpy.call_method1("shape", (value,))?.extract())
            .unwrap_or_default();
        name.fail(format!("has shape {} where (4, 4) is needed", shape_text(&shape)))
    })
}

/// Stiffness matrices, (6, 6) or (m, 6, 6).
pub fn stiffness(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<[[f64; 6]; 6]>> {
    let (shape, values) = floats(value, name)?;
    if !matches!(shape[..], [6, 6] | [_, 6, 6]) {
        let found = shape_text(&shape);
        return Err(name.fail(format!("has shape {found} where (6, 6) or (m, 6, 6) is needed")));
    }
    Ok(values
        .chunks_exact(36)
        .map(|c| std::array::from_fn(|i| std::array::from_fn(|j| c[6 * i + j])))
        .collect())
}

/// Indices that fit an unsigned 32-bit integer, of the given row width (0: a flat list).
fn indices(value: &Bound<'_, PyAny>, name: Named<'_>, width: usize) -> PyResult<Vec<u32>> {
    let array = converted(value, name, "iu", "int64", "integers")?;
    let shape: Vec<usize> = array.getattr("shape")?.extract()?;
    let fits = match (width, &shape[..]) {
        (0, [_]) => true,
        (w, [_, k]) => w == *k,
        (_, [0]) => true,
        _ => false,
    };
    if !fits {
        let wanted = if width == 0 { "(k,)".into() } else { format!("(k, {width})") };
        return Err(name.fail(format!("has shape {} where {wanted} is needed", shape_text(&shape))));
    }
    let array: PyReadonlyArrayDyn<'_, i64> = array.extract()?;
    let flat = array.as_slice().map_err(|e| name.fail(format!("is not contiguous: {e}")))?;
    flat.iter()
        .enumerate()
        .map(|(at, &v)| {
            u32::try_from(v).map_err(|_| {
                name.fail(format!(
                    "[{}] is {v}: indices run from 0 to {}",
                    at / width.max(1),
                    u32::MAX
                ))
            })
        })
        .collect()
}

/// Number of characters of a rejected value that an error repeats.
const SHOWN: usize = 40;

/// An integer in the `allowed` range; bool and real numbers are rejected.
pub fn whole<T: TryFrom<i64>>(
    value: &Bound<'_, PyAny>,
    name: Named<'_>,
    allowed: RangeInclusive<i64>,
) -> PyResult<T> {
    let range = match allowed.clone().into_inner() {
        (least, i64::MAX) => format!("{least} or more, below 2^63"),
        (least, most) => format!("{least} to {most}"),
    };
    // Python refuses to convert a number with thousands of digits to text.
    let text = value.repr().map_or_else(|_| "very large".into(), |text| text.to_string());
    let shown: String = text.chars().take(SHOWN).collect();
    let dots = if text.chars().nth(SHOWN).is_some() { "..." } else { "" };
    let out_of_range = || name.fail(format!("is {shown}{dots}: allowed is {range}"));
    let is_bool = value.is_instance_of::<PyBool>();
    match value.extract::<i64>() {
        Ok(number) if !is_bool && allowed.contains(&number) => {
            T::try_from(number).map_err(|_| out_of_range())
        }
        Ok(_) if !is_bool => Err(out_of_range()),
        Err(error) if error.is_instance_of::<PyOverflowError>(value.py()) => Err(out_of_range()),
        _ => Err(name.fail(format!("is {shown}{dots}: a whole number is needed, {range}"))),
    }
}

/// Node indices.
pub fn nodes(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<u32>> {
    indices(value, name, 0)
}

/// Tets.
pub fn tets(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<[u32; 4]>> {
    Ok(indices(value, name, 4)?.as_chunks::<4>().0.to_vec())
}

/// Triangles.
pub fn triangles(value: &Bound<'_, PyAny>, name: Named<'_>) -> PyResult<Vec<[u32; 3]>> {
    Ok(indices(value, name, 3)?.as_chunks::<3>().0.to_vec())
}

/// (k, 3) float64.
pub fn rows<'py>(py: Python<'py>, rows: Vec<[f64; 3]>) -> Bound<'py, PyArray2<f64>> {
    table(py, rows)
}

/// (k, N) array of rows.
pub fn table<T: numpy::Element, const N: usize>(
    py: Python<'_>,
    rows: Vec<[T; N]>,
) -> Bound<'_, PyArray2<T>> {
    let k = rows.len();
    let flat: Bound<'_, PyArray1<T>> = rows.into_flattened().into_pyarray(py);
    flat.reshape([k, N]).expect("k rows of N fill k×N")
}

/// (k, 3, 3) float64.
pub fn blocks(py: Python<'_>, blocks: Vec<[f64; 9]>) -> Bound<'_, PyArray3<f64>> {
    let k = blocks.len();
    blocks.into_flattened().into_pyarray(py).reshape([k, 3, 3]).expect("k blocks of 9 fill k×3×3")
}

/// (4, 4) float64, read-only.
pub fn motion<'py>(py: Python<'py>, matrix: &[[f64; 4]; 4]) -> PyResult<Bound<'py, PyArray2<f64>>> {
    frozen(table(py, matrix.to_vec()))
}

/// (m, 6, 6) float64.
pub fn voigt(py: Python<'_>, rows: Vec<[[f64; 6]; 6]>) -> Bound<'_, PyArray3<f64>> {
    let m = rows.len();
    let flat = rows.into_flattened().into_flattened();
    flat.into_pyarray(py).reshape([m, 6, 6]).expect("m matrices of 36 fill m×6×6")
}

/// `array` as a read-only array: a view of data of a frozen class.
pub fn frozen<'py, T: numpy::Element, D: numpy::ndarray::Dimension>(
    array: Bound<'py, numpy::PyArray<T, D>>,
) -> PyResult<Bound<'py, numpy::PyArray<T, D>>> {
    array.call_method1("setflags", (false,))?;
    Ok(array)
}
