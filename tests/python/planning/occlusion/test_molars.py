"""First molars found on crowns, against the teeth of which heads were made."""

import numpy as np
import pytest
import tooth_row_heads as heads

import cmfsim
import real_heads
from cmfsim.phantom import model, skull
from cmfsim.phantom.parameters import JawWarp
from cmfsim.planning.occlusion.molars import WIDTHS, first_molars

pytest.importorskip("skimage")

# Of the middle of a crown along the row, mm: the greatest error of 24 synthetic teeth is 0.7.
CLOSE = 0.8
# The upper 5 mm of a tooth are its crown.
CROWN = 5.0
FIRST_MOLAR = 5
# Parts of BodyParts3D by jaw and side: first molars.
PARTS = {
    ("upper", "L"): "FMA55699", ("upper", "R"): "FMA55698",
    ("lower", "L"): "FMA55704", ("lower", "R"): "FMA55705",
}  # fmt: skip


def middle_of(points, up):
    """The middle of the box about the crown of a tooth, by points in it."""
    high = points @ up
    crown = points[high > high.max() - CROWN]
    return 0.5 * (crown.min(axis=0) + crown.max(axis=0))


def ahead_of(row):
    """The direction forwards in the plane of the bite."""
    out, ahead = row.arch.out, row.arch.axes()[1]
    ahead = ahead - (ahead @ out) * out
    return ahead / np.linalg.norm(ahead)


def synthetic_middle(head, jaw, side):
    """The middle of the first molar that a synthetic head has."""
    tooth = skull.teeth_shape(upper=jaw == "upper").steps[FIRST_MOLAR].shape
    if jaw == "lower":
        tooth = model.JawWarped(tooth, JawWarp(head.parameters, soft=False))
    axes = [np.arange(low, high, 0.5) for low, high in ((12, 48), (-100, -30), (-80, -18))]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid[:, 0] *= 1.0 if side == "L" else -1.0
    x, y, z = head.warp.inverse(*grid.T)
    inside = grid[tooth.level(np.abs(x), y, z) > 0.0]
    return middle_of(inside, np.array([0.0, 0.0, -1.0 if jaw == "upper" else 1.0]))


@pytest.mark.parametrize("seed", [None, 2])
def test_molars_of_synthetic_heads_are_found_where_they_were_made(seed, monkeypatch):
    person = cmfsim.HeadParameters() if seed is None else cmfsim.HeadParameters.random(seed)
    head = cmfsim.make_head(person)
    monkeypatch.setattr(heads, "LOWEST", np.array([-50.0, -112.0, -72.0]))
    monkeypatch.setattr(heads, "HIGHEST", np.array([50.0, -24.0, -20.0]))
    for row in heads.rows_of(head):
        for side, place in first_molars(row).items():
            wanted = synthetic_middle(head, row.arch.jaw, side)
            assert abs(ahead_of(row) @ (place - wanted)) < CLOSE


def test_a_row_without_a_premolar_has_no_sixth_tooth(monkeypatch):
    for name in ("UPPER", "LOWER"):
        for values in ("WIDTHS", "DEPTHS", "EDGES"):
            of_teeth = list(getattr(skull, f"{name}_{values}"))
            del of_teeth[3]
            monkeypatch.setattr(skull, f"{name}_{values}", tuple(of_teeth))
    # Other parameters: shapes are kept by their parameters.
    row = heads.rows_of(cmfsim.make_head(cmfsim.HeadParameters(fat_thickness=0.01)))[0]
    assert set(first_molars(row).values()) == {"a tooth in front of it may be missing"}
    assert len(WIDTHS["upper"]) == len(WIDTHS["lower"]) == 7


def test_a_bar_without_teeth_has_no_molars():
    upper, _ = heads.closed_rows()
    smooth = cmfsim.ToothRow(upper.segment, horseshoe(upper.arch), upper.arch)
    assert all("gaps" in why or "ends" in why for why in first_molars(smooth).values())


def horseshoe(arch):
    """A smooth rim about an arch, as an edentulous ridge or a bite rim is."""
    pv = pytest.importorskip("pyvista")
    left, ahead, out = arch.axes()
    turns = np.linspace(-1.7, 1.7, 200)
    front = float((arch.tip - arch.middle) @ ahead) + 2.0
    line = (
        arch.middle
        + 12.0 * -out
        + np.array([26.0 * np.sin(t) * left + (front * np.cos(t)) * ahead for t in turns])
    )
    tube = pv.Spline(line, 300).tube(radius=4.0, n_sides=24).triangulate()
    return cmfsim.SurfaceData(np.asarray(tube.points, dtype=float), tube.regular_faces)


def test_molars_of_a_real_skull_are_its_separate_teeth():
    pv = pytest.importorskip("pyvista")
    anatomy = real_heads.anatomy("atlas_head", 1.0)
    segments = [
        cmfsim.BoneSegment(name, anatomy.bones[name], real_heads.read_ply("atlas_head", name))
        for name in ("cranium", "mandible")
    ]
    rows = cmfsim.tooth_rows(anatomy, segments, real_heads.landmarks("atlas_head"))
    for row in rows:
        for side, place in first_molars(row).items():
            path = (
                real_heads.data_folder() / f"bodyparts3d/v3_obj99/{PARTS[row.arch.jaw, side]}.obj"
            )
            tooth = pv.read(path).clean().connectivity("largest")
            wanted = middle_of(np.asarray(tooth.points, dtype=float), -row.arch.out)
            assert abs(ahead_of(row) @ (place - wanted)) < CLOSE
