"""Transform files against ITK itself, which writes and reads the same ones."""

import base64
import math
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cmfsim
from benches.scenes import meshes

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


@pytest.mark.parametrize("ending", [".tfm", ".h5", ".txt"])
@pytest.mark.parametrize(
    "kind", ["Euler", "Euler, z y x", "versor", "versor alone", "affine", "translation"]
)
def test_a_transform_that_itk_wrote_moves_points_as_itk_moves_them(kind, ending, tmp_path):
    transform = itk_transforms()[kind]
    path = tmp_path / f"motion{ending}"
    itk().WriteTransform(transform, str(path))
    points = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    matrix = cmfsim.read_transform(path, direction="to-parent")
    np.testing.assert_allclose(apply(matrix, points), moved(transform, points), rtol=0, atol=1e-9)
    back = cmfsim.read_transform(path, direction="from-parent")
    inverse = transform.GetInverse()
    np.testing.assert_allclose(apply(back, points), moved(inverse, points), rtol=0, atol=1e-9)


@pytest.mark.parametrize("ending", [".tfm", ".h5"])
def test_a_composite_of_one_rigid_transform_is_that_transform(ending, tmp_path):
    """SimpleITK's registration returns its result as such a composite."""
    sitk = itk()
    euler = itk_transforms()["Euler"]
    path = tmp_path / f"motion{ending}"
    sitk.WriteTransform(sitk.CompositeTransform([euler]), str(path))
    points = np.random.default_rng(0).uniform(-100, 100, (20, 3))
    matrix = cmfsim.read_transform(path, direction="to-parent")
    np.testing.assert_allclose(apply(matrix, points), moved(euler, points), rtol=0, atol=1e-9)


@pytest.mark.parametrize("ending", [".tfm", ".h5"])
def test_several_and_nonlinear_transforms_are_refused_by_name(ending, tmp_path):
    sitk = itk()
    several = sitk.CompositeTransform([sitk.Euler3DTransform(), sitk.AffineTransform(3)])
    for transform, complaint in (
        (several, "holds 2 transforms .CompositeTransform, Euler3DTransform, AffineTransform"),
        (sitk.BSplineTransform(3), "BSplineTransform.* is not a rigid"),
        (sitk.Similarity3DTransform(), "Similarity3DTransform.* is not a rigid"),
        (sitk.Euler2DTransform(), "Euler2DTransform.* is not a rigid|2-D space, not of 3-D"),
    ):
        path = tmp_path / f"motion{ending}"
        sitk.WriteTransform(transform, str(path))
        with pytest.raises(cmfsim.CaseError, match=complaint):
            cmfsim.read_transform(path, direction="to-parent")


# An Euler3DTransform with a second one, of another translation, in group 1 of the file: h5py copied
# the group within a file that SimpleITK 2.5 wrote. SimpleITK reads the first and prints a warning.
TWO_TRANSFORMS = (
    "c-"
    "rgqaB<`1lHy|G;9!7(|4_i73E>++#rv&y9rgEc31U+CA<UeOj4POgkTt>p7ZU>`0|T2V1CZkK4Dk+2Eh^5;&pQk?"
    "4=Mq40aW5XBSb<#fPvu|D}-"
    "&ufDki=iYdUI8vKr78rVsS=uTo_WE5dwU}6LUs9G4!EW*Gj3FHVcKrlp{gMk(3T4p8=pih_?8K9vd0JCTV!;k}I?"
    "ehAx2pa*3p&vHW9dF3eB5V|fLD<wS5uZtmurU}0VbeUp<)6Q^hc}xD$d8=<!O)URoCP9pvLvMuQbfv#K*9`0<1Zq"
    "4K*li|D6m0GMhM?<0j#96Am7Q_C!|k<oh%44lg&TaFEKauHxtw%Nsu64NKs;5aaw*+u6t2_X+bcwnEe)5cbA;<UI"
    "Jt$FWk(K%7WC*FpnvN<Rsv7ZkZLSDFKN^Kqr*|Loz@DQP`hnhp@F6kkXp?p@s}vq)mrmkTz#8{$&l0XgQD{h2de0"
    "2;Lk?h{|Hs^eIqHpr{t$Km?e(v%e1`Qb;f&sRIF1Jrg}pVuYq21{o*~ti(+fax#;O5{oJo${?A-"
    "O2JUi&`8e^90_RV_+;jlRsd;ezG2{p(q?*w7J4Qox@pO}Wu}&<aP`tq+O;$%waC~7?z#As{L-"
    "YH)Oh1~V@LucQ9TR@@H32pQ7{Td!6+C7qhJ(_f>AIEM!_f;1tSK?AdLqwp^XnPL;LA4J`1#;4da8<5*nO=_4i>kX"
    "mCbQ!5%u^?!aKe&0z8$Xc2gDh6^${6QBT5s{nK45FDK8e6afup|F9CU9gc5HU-"
    "c?F&M&O(`EcxU^M5Af>AIEM!|3ZAMBwF2MERC0F#+D69jhJL+F$C#$a$6s$Kx9P6SFzIAEWDY9w|3$wm=cwc?+DS"
    "`1T$a|(q^38EsI)ng%cxA{;q54Au88W2!Dr%F!!AYctSEvgL~s4c3L-"
    "7`)Qu!fw*$psD6#!2}fj;ztlF$zY(C>RB!fCzv*zQ9IA`vN~uazLj6o$7X1"
)


def test_an_hdf5_file_with_a_second_transform_is_refused(tmp_path):
    itk()
    path = tmp_path / "two.h5"
    path.write_bytes(zlib.decompress(base64.b85decode(TWO_TRANSFORMS)))
    with pytest.raises(cmfsim.CaseError, match="holds 2 transforms, of which ITK reads 1"):
        cmfsim.read_transform(path, direction="to-parent")


def test_a_damaged_hdf5_file_is_an_error(tmp_path):
    sitk = itk()
    good, path = tmp_path / "good.h5", tmp_path / "bad.h5"
    sitk.WriteTransform(sitk.BSplineTransform(3), str(good))
    whole = good.read_bytes()
    unknown = whole.replace(b"BSplineTransform_double", b"XSplineTransform_double")
    for content, complaint in (
        (b"#Insight Transform File V1.0\n", "is not an HDF5 file"),
        (whole[:2000], "ITK cannot read it: it is damaged"),
        (unknown, "XSplineTransform_double_3_3, which ITK does not have"),
    ):
        path.write_bytes(content)
        with pytest.raises(cmfsim.CaseError, match=complaint) as found:
            cmfsim.read_transform(path, direction="to-parent")
        assert str(found.value).startswith("bad.h5: ")


def test_a_transform_that_3d_slicer_saved_is_from_parent(tmp_path):
    """https://discourse.slicer.org/t/displayed-transform-vs-tfm-content/270

    3D Slicer showed "transform to parent" (RAS, two decimals) and saved the .tfm quoted there. Its
    matrix deviates from a rotation by 0.004 and is made rigid here; the translation follows to 2 mm
    in 710.
    """
    shown = np.array([[-0.12, -0.96, 0.26], [0.99, -0.1, 0.1], [-0.07, 0.27, 0.96]])
    saved = np.array(
        [
            [-0.12281062601468536, 0.9902729990354874, 0.06989222618721933],
            [-0.9559259621663395, -0.0968506562880039, -0.26898522478338405],
            [-0.2598992353790456, -0.09944665326067206, 0.9609182640368552],
        ]
    )
    u, _, v = np.linalg.svd(saved)
    numbers = [*(u @ v).ravel(), -64.32660836989362, -696.1487386450094, -130.6846842169375]
    path = tmp_path / "slicer.tfm"
    path.write_text(
        HEAD
        + "Transform: AffineTransform_double_3_3\n"
        + f"Parameters: {' '.join(repr(float(n)) for n in numbers)}\nFixedParameters: 0 0 0\n",
        encoding="utf-8",
    )
    flip = np.diag([-1.0, -1.0, 1.0, 1.0])
    in_ras = flip @ cmfsim.read_transform(path, direction="from-parent") @ flip
    np.testing.assert_allclose(in_ras[:3, :3], shown, atol=0.01)
    np.testing.assert_allclose(in_ras[:3, 3], [710, 19, -58], atol=2.0)
    other = flip @ cmfsim.read_transform(path, direction="to-parent") @ flip
    assert np.abs(other[:3, 3] - [710, 19, -58]).max() > 600


def test_an_itk_file_needs_its_direction(tmp_path):
    sitk = itk()
    for name in ("a.tfm", "a.h5", "a.txt"):
        sitk.WriteTransform(sitk.TranslationTransform(3, (0, -5, 0)), str(tmp_path / name))
        with pytest.raises(cmfsim.CaseError, match=r'state direction = "from-parent" if .* Slicer'):
            cmfsim.read_transform(tmp_path / name)
        with pytest.raises(cmfsim.CaseError, match="direction is 'forwards'"):
            cmfsim.read_transform(tmp_path / name, direction="forwards")


@pytest.mark.parametrize("direction", ["to-parent", "from-parent"])
def test_itk_reads_a_written_transform_as_its_direction_says(direction, tmp_path):
    matrix = cmfsim.rigid_motion((1, -2, 3), 12, (1, 1, -2), (5, -100, 40))
    path = tmp_path / "motion.tfm"
    cmfsim.write_transform(path, matrix, direction=direction)
    points = np.random.default_rng(1).uniform(-100, 100, (20, 3))
    read = itk().ReadTransform(str(path))
    wanted = matrix if direction == "to-parent" else np.linalg.inv(matrix)
    np.testing.assert_allclose(moved(read, points), apply(wanted, points), rtol=0, atol=1e-9)


@settings(max_examples=30)
@given(translation=vectors, angle=st.floats(-180, 180), axis=axes, centre=vectors)
def test_what_is_written_is_read_back_bit_for_bit(
    tmp_path_factory, translation, angle, axis, centre
):
    matrix = cmfsim.rigid_motion(translation, angle, axis, centre)
    folder = tmp_path_factory.mktemp("motion")
    for name in ("motion.tfm", "motion.txt"):
        cmfsim.write_transform(folder / name, matrix, direction="to-parent")
        assert np.array_equal(cmfsim.read_transform(folder / name), matrix)
    cmfsim.write_transform(folder / "ras.txt", matrix, frame="RAS")
    assert np.array_equal(cmfsim.read_transform(folder / "ras.txt", frame="RAS"), matrix)


def test_what_a_written_file_states_of_itself_is_used_and_not_contradicted(tmp_path):
    matrix = cmfsim.rigid_motion((1, -2, 3), 12, (1, 1, -2), (5, -100, 40))
    for name, frame in (("a.tfm", "LPS"), ("a.txt", "LPS"), ("ras.txt", "RAS")):
        path = tmp_path / name
        cmfsim.write_transform(path, matrix, direction="from-parent", frame=frame)
        np.testing.assert_allclose(cmfsim.read_transform(path), matrix, atol=1e-12)
        with pytest.raises(
            cmfsim.CaseError, match=r"states direction from-parent .* not to-parent"
        ):
            cmfsim.read_transform(path, direction="to-parent")
    with pytest.raises(cmfsim.CaseError, match="states frame RAS in its comment, not LPS"):
        cmfsim.read_transform(tmp_path / "ras.txt", frame="LPS")


def test_a_matrix_in_ras_moves_left_where_lps_has_plus_x(tmp_path):
    """+x is right in RAS and left in LPS; +z is up in both."""
    path = tmp_path / "motion.mat"
    path.write_text("1, 0, 0, 2\n0, 1, 0, 3\n0, 0, 1, 4\n0, 0, 0, 1\n", encoding="utf-8")
    assert cmfsim.read_transform(path, frame="RAS")[:3, 3].tolist() == [-2.0, -3.0, 4.0]
    assert cmfsim.read_transform(path)[:3, 3].tolist() == [2.0, 3.0, 4.0]
    assert cmfsim.read_transform(path, direction="from-parent")[:3, 3].tolist() == [-2, -3, -4]


HEAD = "#Insight Transform File V1.0\n#Transform 0\n"
ROWS = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.h5", "", r"a\.h5: is not an HDF5 file"),
        ("a.xfm", "", r"\.tfm, \.h5, \.txt or \.mat"),
        ("a.tfm", "", "line 1: an ITK transform begins"),
        ("a.tfm", HEAD, "no line 'Transform"),
        ("a.tfm", HEAD + "Transform: Euler3DTransform_double_3_3\n", "lacks its line 'Parameters"),
        ("a.tfm", HEAD + "Transform: Euler3DTransform_double_3_3\nParameters: 0 0 0\n", "line 4"),
        ("a.tfm", HEAD + "Transform: BSplineTransform_double_3_3\n", "line 3: .*use one of Euler"),
        ("a.tfm", HEAD + "Transform: Euler2DTransform_double_2_2\n", "line 3"),
        ("a.tfm", HEAD + "Transform: CompositeTransform_double_3_3\n", "holds 0 transforms"),
        (
            "a.tfm",
            HEAD + 2 * "Transform: VersorTransform_double_3_3\nParameters: 0 0 0\n",
            "line 5: the file holds 2 transforms",
        ),
        ("a.tfm", HEAD + "Parameters: 0 0 0\n", "line 3: Parameters comes before"),
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
        cmfsim.read_transform(tmp_path / name, direction="to-parent")
    assert isinstance(found.value, ValueError)
    assert str(found.value).startswith(name)


def test_binary_and_absent_files_and_wrong_frames_are_named(tmp_path):
    (tmp_path / "a.mat").write_bytes(b"\xff\xfe\x00binary")
    with pytest.raises(cmfsim.CaseError, match="is not text"):
        cmfsim.read_transform(tmp_path / "a.mat")
    with pytest.raises(FileNotFoundError, match=r"b\.tfm: no such file"):
        cmfsim.read_transform(tmp_path / "b.tfm")
    cmfsim.write_transform(tmp_path / "c.tfm", np.eye(4), direction="to-parent")
    with pytest.raises(cmfsim.CaseError, match="states frame LPS"):
        cmfsim.read_transform(tmp_path / "c.tfm", frame="RAS")
    text = (tmp_path / "c.tfm").read_text(encoding="utf-8").replace("# mm, LPS, to-parent\n", "")
    (tmp_path / "c.tfm").write_text(text, encoding="utf-8")
    with pytest.raises(cmfsim.CaseError, match="always LPS"):
        cmfsim.read_transform(tmp_path / "c.tfm", direction="to-parent", frame="RAS")
    with pytest.raises(cmfsim.CaseError, match="always LPS"):
        cmfsim.write_transform(tmp_path / "c.tfm", np.eye(4), direction="to-parent", frame="RAS")
    with pytest.raises(cmfsim.CaseError, match='give direction = "from-parent" for 3D Slicer'):
        cmfsim.write_transform(tmp_path / "c.tfm", np.eye(4))
    with pytest.raises(cmfsim.CaseError, match="frame is 'LAS'"):
        cmfsim.read_transform(tmp_path / "c.tfm", frame="LAS")


def test_a_refused_transform_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.tfm"
    cmfsim.write_transform(path, np.eye(4), direction="to-parent")
    old = path.read_bytes()
    with pytest.raises(cmfsim.BoundaryError):
        cmfsim.write_transform(path, np.diag([2.0, 1.0, 1.0, 1.0]), direction="to-parent")
    with pytest.raises(cmfsim.CaseError, match="written as"):
        cmfsim.write_transform(tmp_path / "a.h5", np.eye(4))
    assert path.read_bytes() == old
    assert math.isclose(cmfsim.read_transform(path)[0, 0], 1.0)


@pytest.mark.parametrize(
    ("name", "plan", "words"),
    [
        ("plan.json", {"maxilla": np.eye(4)}, r"plan\.json: a plan is written as \.toml"),
        ("plan.toml", {}, r"plan\.toml: the plan has no motion"),
        ("plan.toml", {"max illa": np.eye(4)}, "segment 'max illa' of the plan is not a valid"),
    ],
)
def test_a_plan_that_predict_would_refuse_is_not_written(name, plan, words, tmp_path):
    with pytest.raises(cmfsim.CaseError, match=words):
        cmfsim.write_plan(tmp_path / name, plan)
    assert not [*tmp_path.iterdir()]
