"""Where the voxels of image files lie: axes, spaces and units of their headers, against ITK's."""

import sys

import numpy as np
import pytest
from header_files import SHAPE, SHEARED, VALUES, codes, refused, write_meta, write_nifti, write_nrrd

import cmfsim
from cmfsim.io.images.image_files import read_image, read_image_file
from cmfsim.io.images.nifti import read_nifti
from cmfsim.io.images.nrrd import read_meta, read_nrrd

sitk = pytest.importorskip("SimpleITK", reason="needs SimpleITK (pip install '.[imaging]')")


def _place(affine, index):
    return affine[:, :3] @ np.array(index) + affine[:, 3]


def _values_at(image, affine, scale=1.0, to_lps=(1.0, 1.0, 1.0)):
    """The largest departure of an image from 3i + 5j + 7k at the places of a map."""
    indices = [(1, 1, 2), (2, 3, 2), (1, 2, 4), (2, 2, 3)]
    places = [scale * np.array(to_lps) * _place(np.array(affine), i) for i in indices]
    expected = [3.0 * i + 5.0 * j + 7.0 * k for i, j, k in indices]
    return float(np.abs(image.sample(places) - expected).max())


@pytest.fixture
def linear(monkeypatch):
    i, j, k = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")
    values = (3 * i + 5 * j + 7 * k).astype("<i2")
    monkeypatch.setattr("header_files.VALUES", values)
    return values


@pytest.mark.usefixtures("linear")
@pytest.mark.parametrize("qform", [0, 1])
def test_a_sheared_sform_is_resampled_by_its_own_map(tmp_path, qform):
    # dcm2niix writes the tilt of a gantry there; a qform keeps no shear, and readers prefer it.
    path = write_nifti(tmp_path / "a.nii.gz", qform=qform, quaternion=(0.0, 0.0, 0.0))
    if qform:
        # What a qform keeps of it: the nearest perpendicular axes.
        u, _, v = np.linalg.svd(np.array(SHEARED)[:, :3] / [1.0, 1.0, np.hypot(0.6, 2.0)])
        turn = u @ v
        angle = np.arctan2(turn[2, 1], turn[1, 1])
        path = write_nifti(
            tmp_path / "a.nii.gz", qform=1, quaternion=(np.sin(angle / 2.0), 0.0, 0.0)
        )
    found = read_image_file(path)
    (finding,) = found.findings
    assert finding.code == "image-oblique"
    assert "16.7°" in finding.what
    assert _values_at(found.image, SHEARED, to_lps=(-1, -1, 1)) < 0.51


def test_a_sheared_nrrd_is_resampled_by_its_own_map(tmp_path, linear):
    path = write_nrrd(
        tmp_path / "a.nrrd",
        values=linear,
        **{"space directions": "(1,0,0) (0,1,0) (0,0.6,2)", "space origin": "(5,6,7)"},
    )
    found = read_image_file(path)
    assert [f.code for f in found.findings] == ["image-oblique"]
    assert _values_at(found.image, SHEARED) < 0.51


def test_two_maps_of_one_nifti_that_disagree_are_refused(tmp_path):
    straight = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 2, 7]]
    assert not codes(write_nifti(tmp_path / "a.nii", qform=1, rows=straight))
    mirrored = [[-1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 2, 7]]
    refused(write_nifti(tmp_path / "b.nii", qform=1, rows=mirrored), "disagree by 6 mm", "qform")
    shifted = [[1, 0, 0, 50], [0, 1, 0, 6], [0, 0, 2, 7]]
    refused(write_nifti(tmp_path / "c.nii", qform=1, rows=shifted), "disagree by 45 mm")


def test_a_template_space_is_not_taken_for_the_patient(tmp_path):
    large = [[1.2, 0, 0, 5], [0, 1.2, 0, 6], [0, 0, 2.4, 7]]
    found = read_image_file(write_nifti(tmp_path / "a.nii", qform=1, sform=4, rows=large))
    np.testing.assert_allclose(found.image.spacing, [1.0, 1.0, 2.0])
    assert [f.code for f in found.findings] == ["image-template-space"]


@pytest.mark.parametrize(("units", "scale"), [(1, 1000.0), (2, 1.0), (3, 0.001)])
@pytest.mark.parametrize("forms", [(1, 0), (0, 1), (1, 1)])
def test_units_of_a_nifti_are_applied_to_spacing_and_place(tmp_path, units, scale, forms):
    rows = np.array([[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 2, 7]]) / scale
    path = write_nifti(
        tmp_path / "a.nii",
        qform=forms[0],
        sform=forms[1],
        rows=rows,
        spacing=tuple(np.array([1.0, 1.0, 2.0]) / scale),
        offset=tuple(np.array([5.0, 6.0, 7.0]) / scale),
        units=units,
    )
    found = read_image_file(path)
    np.testing.assert_allclose(found.image.spacing, [1.0, 1.0, 2.0], rtol=1e-5)
    # R and A to L and P: the first voxel in LPS is the last along these axes.
    np.testing.assert_allclose(found.image.lowest, [-8.0, -10.0, 7.0], rtol=1e-5)
    assert not found.findings


def test_what_a_file_does_not_state_is_reported(tmp_path, caplog):
    straight = [[1, 0, 0, 5], [0, 1, 0, 6], [0, 0, 2, 7]]
    assert codes(write_nifti(tmp_path / "a.nii", units=0, rows=straight)) == ["image-unit-unstated"]
    assert codes(write_nifti(tmp_path / "b.nii", sform=0)) == ["frame-unstated"]
    read_image(tmp_path / "b.nii")
    assert "b.nii: its codes qform and sform are 0" in caplog.text
    bare = {"space": None, "space directions": None, "space origin": None, "spacings": "1 1 2"}
    found = read_image_file(write_nrrd(tmp_path / "c.nrrd", **bare))
    assert [f.code for f in found.findings] == ["frame-unstated"]
    np.testing.assert_allclose(found.image.spacing, [1.0, 1.0, 2.0])
    assert codes(write_nrrd(tmp_path / "d.nrrd", space="scanner-xyz")) == ["frame-unstated"]


@pytest.mark.parametrize(
    ("space", "signs"),
    [
        ("right-anterior-superior", (-1, -1, 1)),
        ("LAS", (1, -1, 1)),
        ("left-posterior-superior", (1, 1, 1)),
    ],
)
def test_each_space_of_a_nrrd_is_brought_to_lps(tmp_path, linear, space, signs):
    path = write_nrrd(tmp_path / "a.nrrd", space=space, values=linear)
    affine = [[1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 2, 3]]
    assert _values_at(read_image(path), affine, to_lps=signs) < 1e-6


def test_units_of_a_nrrd_and_a_meta_image_are_applied(tmp_path):
    path = write_nrrd(
        tmp_path / "a.nrrd",
        **{
            "space units": '"m" "m" "m"',
            "space directions": "(0.001,0,0) (0,0.001,0) (0,0,0.002)",
            "space origin": "(0.001,0.002,0.003)",
        },
    )
    np.testing.assert_allclose(read_image(path).spacing, [1.0, 1.0, 2.0])
    np.testing.assert_allclose(read_image(path).lowest, [1.0, 2.0, 3.0])
    path = write_meta(tmp_path / "a.mha", DistanceUnits="cm")
    np.testing.assert_allclose(read_image(path).spacing, [10.0, 10.0, 20.0])
    np.testing.assert_allclose(read_image(path).lowest, [10.0, 20.0, 30.0])


@pytest.mark.parametrize("suffix", [".nrrd", ".nii", ".nii.gz", ".mha"])
@pytest.mark.parametrize("degrees", [0.0, 90.0, 7.0])
def test_our_reading_of_a_header_is_that_of_itk(tmp_path, suffix, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array(
        [[1, 0, 0], [0, c, -s], [0, s, c]]
    )
    image = sitk.GetImageFromArray(VALUES.T)
    image.SetSpacing([0.5, 0.75, 2.0])
    image.SetOrigin([-20.0, 7.0, 100.0])
    image.SetDirection(turn.ravel().tolist())
    path = tmp_path / f"a{suffix}"
    sitk.WriteImage(image, str(path))
    read = {".nrrd": read_nrrd, ".mha": read_meta}.get(suffix, read_nifti)
    values, affine, _ = read(path)
    np.testing.assert_array_equal(values, VALUES)
    expected = np.column_stack([turn * [0.5, 0.75, 2.0], [-20.0, 7.0, 100.0]])
    np.testing.assert_allclose(affine, expected, atol=1e-5)
    read_image(path)


@pytest.mark.parametrize("kind", ["int", "float", "uchar"])
@pytest.mark.parametrize("how", ["text", "hex", "raw, from its end", "behind two lines"])
@pytest.mark.parametrize(
    "lines",
    [
        (),
        ("spacings: 1 2 3",),
        ("spacings: 1 nan 3",),
        ("spacings: 1 2 3", "axis mins: 5 6 7"),
        ("spacings: 1 2 3", "axis mins: 5 6 7", "centerings: node node node"),
        ("space: scanner-xyz", "space directions: (1,0,0) (0,0,2) (0,3,0)"),
        ("space dimension: 3", "space directions: (1,0,0) (0,0,2) (0,3,0)", "space origin: (1,2,3)"),  # noqa: E501
    ],
)  # fmt: skip
def test_a_nrrd_without_a_frame_is_read_as_itk_reads_it(tmp_path, lines, how, kind):
    bare = {"space": None, "space directions": None, "space origin": None, "type": kind}
    values = VALUES.astype({"int": "<i4", "float": "<f4", "uchar": "u1"}[kind])
    more = {"text": {"encoding": "text"}, "hex": {"encoding": "hex"}}.get(how, {})
    more |= {"raw, from its end": {"byte skip": "-1"}, "behind two lines": {"line skip": "2"}}.get(
        how, {}
    )
    path = write_nrrd(tmp_path / "a.nrrd", *lines, data=False, **bare, **more)
    raw = values.T.tobytes()
    written = {
        "text": " ".join(str(v) for v in values.T.ravel()).encode(),
        "hex": raw.hex().encode(),
        "raw, from its end": b"before" + raw,
        "behind two lines": b"one\ntwo\n" + raw,
    }
    path.write_bytes(path.read_bytes() + written[how])
    known = sitk.ReadImage(str(path))
    found, affine, findings = read_nrrd(path)
    np.testing.assert_array_equal(found, sitk.GetArrayFromImage(known).T)
    direction = np.reshape(known.GetDirection(), (3, 3))
    expected = np.column_stack([direction * known.GetSpacing(), known.GetOrigin()])
    np.testing.assert_allclose(affine, expected)
    assert [f.code for f in findings] == ["frame-unstated"]


@pytest.mark.parametrize(
    ("fields", "dtype"),
    [
        ({"ElementType": "MET_LONG"}, "<i4"),
        ({"ElementType": "MET_ULONG_LONG"}, "<u8"),
        ({"ElementType": "MET_USHORT", "BinaryDataByteOrderMSB": "True"}, ">u2"),
        ({"ElementType": "MET_DOUBLE", "BinaryDataByteOrderMSB": "True"}, ">f8"),
        ({"HeaderSize": "-1"}, "<i2"),
        ({"BinaryData": "False"}, "text"),
    ],
)
def test_a_meta_image_of_any_type_is_read_as_itk_reads_it(tmp_path, fields, dtype):
    values = VALUES if dtype == "text" else VALUES.astype(dtype)
    path = write_meta(tmp_path / "a.mha", data=False, **fields)
    text = " ".join(map(str, values.T.ravel())).encode() + b"\n"
    path.write_bytes(path.read_bytes() + (text if dtype == "text" else values.T.tobytes()))
    found = read_meta(path)[0]
    np.testing.assert_array_equal(found, VALUES)
    np.testing.assert_array_equal(found, sitk.GetArrayFromImage(sitk.ReadImage(str(path))).T)


def test_images_along_the_patients_axes_need_no_extra_and_others_name_it(tmp_path, monkeypatch):
    straight, sheared = write_nrrd(tmp_path / "a.nrrd"), write_nifti(tmp_path / "b.nii")
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    np.testing.assert_array_equal(read_image(straight).values, VALUES)
    with pytest.raises(cmfsim.ImageError, match=r"oblique images are resampled.*\[imaging\]"):
        read_image(sheared)
