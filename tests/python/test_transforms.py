"""Transform files against ITK itself, which writes and reads the same ones."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cmfsim
import meshes

numbers = st.floats(-100.0, 100.0)
vectors = st.tuples(numbers, numbers, numbers)
axes = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3)


def itk():
    return pytest.importorskip("SimpleITK")


def moved(transform, points):
    return np.array([transform.TransformPoint(p) for p in points])


def apply(matrix, points):
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def itk_transforms():
    sitk = itk()
    angles, centre, shift = (0.1, -0.3, 0.7), (10.0, -20.0, 30.0), (1.5, -2.5, 3.5)
    euler = sitk.Euler3DTransform(centre, *angles, shift)
    zyx = sitk.Euler3DTransform(centre, *angles, shift)
    zyx.SetComputeZYX(True)  # noqa: FBT003 - takes no keyword
    versor = sitk.VersorRigid3DTransform()
    versor.SetCenter(centre)
    versor.SetRotation((1.0, 2.0, -0.5), 0.4)
    versor.SetTranslation(shift)
    turn = sitk.VersorTransform((1.0, 2.0, -0.5), 0.4)
    turn.SetCenter(centre)
    affine = sitk.AffineTransform(3)
    affine.SetMatrix(meshes.rotation((3.0, 1.0, 2.0), 25.0).ravel())
    affine.SetCenter(centre)
    affine.SetTranslation(shift)
    return {
        "Euler": euler,
        "Euler, z y x": zyx,
        "versor": versor,
        "versor alone": turn,
        "affine": affine,
        "translation": sitk.TranslationTransform(3, shift),
    }


@pytest.mark.parametrize(
    "kind", ["Euler", "Euler, z y x", "versor", "versor alone", "affine", "translation"]
)
def test_a_transform_that_itk_wrote_moves_points_as_itk_moves_them(kind, tmp_path):
    transform = itk_transforms()[kind]
    path = tmp_path / "motion.tfm"
    itk().WriteTransform(transform, str(path))
    points = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    matrix = cmfsim.read_transform(path)
    np.testing.assert_allclose(apply(matrix, points), moved(transform, points), rtol=0, atol=1e-9)
    back = cmfsim.read_transform(path, inverse=True)
    np.testing.assert_allclose(back @ matrix, np.eye(4), rtol=0, atol=1e-10)


@pytest.mark.parametrize("inverse", [False, True])
def test_itk_reads_a_written_transform_as_the_same_motion(inverse, tmp_path):
    matrix = cmfsim.rigid_motion((1, -2, 3), 12, (1, 1, -2), (5, -100, 40))
    path = tmp_path / "motion.tfm"
    cmfsim.write_transform(path, matrix, inverse=inverse)
    points = np.random.default_rng(1).uniform(-100, 100, (20, 3))
    read = itk().ReadTransform(str(path))
    wanted = np.linalg.inv(matrix) if inverse else matrix
    np.testing.assert_allclose(moved(read, points), apply(wanted, points), rtol=0, atol=1e-9)


@settings(max_examples=30)
@given(translation=vectors, angle=st.floats(-180, 180), axis=axes, centre=vectors)
def test_what_is_written_is_read_back_bit_for_bit(
    tmp_path_factory, translation, angle, axis, centre
):
    matrix = cmfsim.rigid_motion(translation, angle, axis, centre)
    folder = tmp_path_factory.mktemp("motion")
    for name in ("motion.tfm", "motion.txt"):
        cmfsim.write_transform(folder / name, matrix)
        assert np.array_equal(cmfsim.read_transform(folder / name), matrix)
    cmfsim.write_transform(folder / "ras.txt", matrix, frame="RAS")
    assert np.array_equal(cmfsim.read_transform(folder / "ras.txt", frame="RAS"), matrix)


def test_a_matrix_in_ras_moves_left_where_lps_has_plus_x(tmp_path):
    """+x is right in RAS and left in LPS; +z is up in both."""
    path = tmp_path / "motion.mat"
    path.write_text("1, 0, 0, 2\n0, 1, 0, 3\n0, 0, 1, 4\n0, 0, 0, 1\n", encoding="utf-8")
    assert cmfsim.read_transform(path, frame="RAS")[:3, 3].tolist() == [-2.0, -3.0, 4.0]
    assert cmfsim.read_transform(path)[:3, 3].tolist() == [2.0, 3.0, 4.0]


HEAD = "#Insight Transform File V1.0\n#Transform 0\n"
ROWS = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.h5", "", r"a\.h5: HDF5 .* save the transform as \.tfm"),
        ("a.xfm", "", r"\.tfm, \.txt or \.mat"),
        ("a.tfm", "", "line 1: an ITK transform begins"),
        ("a.tfm", HEAD, "no line 'Transform"),
        ("a.tfm", HEAD + "Transform: Euler3DTransform_double_3_3\n", "no line 'Parameters"),
        ("a.tfm", HEAD + "Transform: Euler3DTransform_double_3_3\nParameters: 0 0 0\n", "line 4"),
        ("a.tfm", HEAD + "Transform: BSplineTransform_double_3_3\n", "line 3: .*use one of Euler"),
        ("a.tfm", HEAD + "Transform: Euler2DTransform_double_2_2\n", "line 3"),
        ("a.tfm", HEAD + "Transform: CompositeTransform_double_3_3\n", "line 3"),
        (
            "a.tfm",
            HEAD + "Transform: VersorTransform_double_3_3\nTransform: X\n",
            "line 4: holds a second",
        ),
        (
            "a.tfm",
            HEAD + "Transform: VersorTransform_double_3_3\nParameters: 1 1 0\n",
            "line 4: the versor has length 1.41",
        ),
        (
            "a.tfm",
            HEAD + "Transform: VersorTransform_double_3_3\nParameters: 0 0 0\nFixedParameters: 1\n",
            "line 5: FixedParameters holds 1",
        ),
        (
            "a.tfm",
            HEAD + "Transform: AffineTransform_double_3_3\nParameters: 2 0 0 0 1 0 0 0 1 0 0 0\n",
            "not rigid",
        ),
        ("a.tfm", HEAD + "Transform\n", "line 3: 'Transform' is not"),
        ("a.tfm", HEAD + "Scale: 1\n", "line 3: unknown entry 'Scale'"),
        ("a.txt", ROWS.replace("0 0 1 0", "0 0 one 0"), "line 3: 'one' is not a number"),
        ("a.txt", ROWS.replace("0 0 1 0", "0 0 nan 0"), "line 3: 'nan' is not finite"),
        ("a.txt", ROWS.replace("0 0 1 0", "0 0 1"), "line 3: holds 3 numbers"),
        ("a.txt", ROWS + "0 0 0 1\n", "holds 5 rows"),
        ("a.txt", ROWS.replace("1 0 0 0", "-1 0 0 0"), "mirrors"),
        ("a.mat", "\0\0\1", "is not text"),
    ],
)
def test_what_is_no_transform_is_named_with_its_line(name, text, complaint, tmp_path):
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match=complaint) as found:
        cmfsim.read_transform(tmp_path / name)
    assert isinstance(found.value, ValueError)
    assert str(found.value).startswith(name)


def test_binary_and_absent_files_and_wrong_frames_are_named(tmp_path):
    (tmp_path / "a.mat").write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(cmfsim.CaseError, match="is not text"):
        cmfsim.read_transform(tmp_path / "a.mat")
    with pytest.raises(FileNotFoundError, match=r"b\.tfm: no such file"):
        cmfsim.read_transform(tmp_path / "b.tfm")
    cmfsim.write_transform(tmp_path / "c.tfm", np.eye(4))
    with pytest.raises(cmfsim.CaseError, match="LPS always"):
        cmfsim.read_transform(tmp_path / "c.tfm", frame="RAS")
    with pytest.raises(cmfsim.CaseError, match="LPS always"):
        cmfsim.write_transform(tmp_path / "c.tfm", np.eye(4), frame="RAS")
    with pytest.raises(cmfsim.CaseError, match="frame is 'LAS'"):
        cmfsim.read_transform(tmp_path / "c.tfm", frame="LAS")


def test_a_refused_transform_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.tfm"
    cmfsim.write_transform(path, np.eye(4))
    old = path.read_bytes()
    with pytest.raises(cmfsim.BoundaryError):
        cmfsim.write_transform(path, np.diag([2.0, 1.0, 1.0, 1.0]))
    with pytest.raises(cmfsim.CaseError, match="written as"):
        cmfsim.write_transform(tmp_path / "a.h5", np.eye(4))
    assert path.read_bytes() == old
    assert math.isclose(cmfsim.read_transform(path)[0, 0], 1.0)
