"""The final bite of scans made from a head, moved by known motions."""

import importlib
import json

import numpy as np
import pytest
import tooth_row_heads as heads

import cmfsim
import phantom_case
import shared_values
from cmfsim.cli import main
from cmfsim.pipeline.building.case_model import planned_head
from cmfsim.values.motion import carried

pytest.importorskip("skimage")

# The lower jaw goes forwards and turns; the scans are in a frame of their own.
BITE = cmfsim.rigid_motion((1.0, -2.5, 1.0), 3.0, (0.2, 1.0, 0.3), centre=(0.0, -60.0, -45.0))
FRAME = cmfsim.rigid_motion((120.0, 40.0, -33.0), 140.0, (1.0, 2.0, -0.5))


@pytest.fixture(scope="module")
def scans():
    """Scans of the same head in finer voxels: other vertices than those of the rows."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(heads, "SPACING", 0.6)
        upper, lower = heads.rows_of(cmfsim.make_head())
    return heads.scan_of(upper, FRAME), heads.scan_of(lower, FRAME @ BITE)


def coarse_case(folder, temporary):
    """The path of a case of the head; its voxels and tets are coarse, its surfaces are not."""
    levels = shared_values.drawn_levels(temporary, 2.0)
    path = phantom_case.surface_case(folder, cmfsim.make_head(), levels)
    text = path.read_text(encoding="utf-8").replace("edge_length = 7.0", "edge_length = 14.0")
    path.write_text(text, encoding="utf-8")
    return path


def moved(surface, motion):
    return cmfsim.SurfaceData(carried(motion, surface.vertices), surface.triangles)


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    """Fits of a seventh of the points of a row: the motion is right to 0.1 mm by them as well."""
    module = importlib.import_module("cmfsim.planning.occlusion.final_bite")
    monkeypatch.setattr(module, "MOST_POINTS", 400)


def test_the_lower_jaw_goes_where_the_scans_have_it(scans):
    rows = heads.closed_rows()
    bite = cmfsim.final_bite(*rows, *scans)
    crowns = rows[1].surface.vertices[rows[1].crowns]
    off = np.linalg.norm(carried(bite.motion, crowns) - carried(BITE, crowns), axis=1)
    assert off.max() < 0.1
    assert max(bite.upper_error, bite.lower_error) < 0.05
    shift = cmfsim.rigid_motion((0.0, -4.0, 1.0), 2.0)
    np.testing.assert_allclose(bite.following(shift), shift @ bite.motion, atol=1e-12)
    contacts = cmfsim.contact_map(rows[0], rows[1].moved(bite.motion))
    assert bite.overlap == contacts.greatest_overlap


def mirrored(surface, *, turned=True):
    triangles = surface.triangles[:, ::-1] if turned else surface.triangles
    return cmfsim.SurfaceData(surface.vertices * [-1.0, 1.0, 1.0], np.ascontiguousarray(triangles))


def test_a_mirrored_scan_is_refused_or_noticed_where_the_arch_is_symmetric(scans):
    upper, lower = scans
    rows = heads.closed_rows()
    # The teeth of this head are its own mirror image: nothing in the shapes tells them apart.
    assert cmfsim.final_bite(*rows, mirrored(upper), mirrored(lower)).mirrored == ("upper", "lower")
    with pytest.raises(cmfsim.CaseError, match=r"upper scan.*bite-scan-mirrored.*face inwards"):
        cmfsim.final_bite(*rows, mirrored(upper, turned=False), mirrored(lower, turned=False))
    # A row that leans to one side by 0.3 mm is not symmetric.
    surface = rows[0].surface
    shift = 0.3 * np.sin(0.3 * surface.vertices[:, [0]]) * [0.0, 1.0, 0.0]
    bent = cmfsim.SurfaceData(surface.vertices + shift, surface.triangles)
    lean = cmfsim.ToothRow(rows[0].segment, bent, rows[0].arch)
    own = heads.scan_of(lean, FRAME)
    assert cmfsim.final_bite(lean, rows[1], own, lower).mirrored == ("lower",)
    with pytest.raises(cmfsim.CaseError, match=r"bite-scan-mirrored.*mirror image fits better"):
        cmfsim.final_bite(lean, rows[1], mirrored(own), mirrored(lower))


def test_scans_of_another_shape_frame_or_unit_are_refused_by_name(scans):
    upper, lower = scans
    apart = FRAME @ cmfsim.rigid_motion((0, 0, -8)) @ np.linalg.inv(FRAME)
    narrow = cmfsim.SurfaceData(upper.vertices * [1.0, 0.8, 1.1], upper.triangles)
    metres = cmfsim.SurfaceData(upper.vertices / 1000, upper.triangles)
    for pair, code in (
        ((narrow, lower), "bite-scan-poor"),
        ((upper, moved(lower, apart)), "bite-not-closed"),
        ((metres, lower), "bite-scan-size"),
        ((upper, upper), "bite-not-closed.*one file given for both jaws"),
    ):
        with pytest.raises(cmfsim.CaseError, match=code):
            cmfsim.final_bite(*heads.closed_rows(), *pair)


def test_the_command_writes_a_plan_in_which_the_lower_jaw_follows(
    scans, tmp_path, tmp_path_factory, capsys, monkeypatch
):
    kept = []

    def head_of(*given, **more):
        """The head of the first run, for the second as well."""
        kept[:] = kept or [planned_head(*given, **more)]
        return kept[0]

    monkeypatch.setattr("cmfsim.pipeline.planning.planned_head", head_of)
    case = coarse_case(tmp_path, tmp_path_factory)
    words = ["bite", str(case), "--json", "-q", "--no-doctor"]
    for jaw, scan in zip(("upper", "lower"), scans, strict=True):
        cmfsim.write_surface(tmp_path / f"{jaw}_scan.stl", scan)
        words += [f"--{jaw}", str(tmp_path / f"{jaw}_scan.stl")]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    before, after = cmfsim.Case.load(case), cmfsim.Case.load(case).with_plan(found["file"])
    upper = before.plan["maxilla"].matrix
    np.testing.assert_allclose(after.plan["maxilla"].matrix, upper, atol=1e-9)
    wanted, lower = upper @ BITE, after.plan["mandible_body"].matrix
    crowns = heads.closed_rows()[1]
    places = crowns.surface.vertices[crowns.crowns]
    # The bones of this case are made of voxels of 2 mm.
    assert np.linalg.norm(carried(lower, places) - carried(wanted, places), axis=1).max() < 0.3
    assert found["upper_error_mm"] < 0.35
    assert found["fits_mirrored"] == ["upper", "lower"]
    # Exchanged files write no plan.
    exchanged = [{"--upper": "--lower", "--lower": "--upper"}.get(word, word) for word in words]
    out = str(tmp_path / "exchanged.toml")
    assert main([*exchanged, "-o", out]) == 2
    assert "bite-scan-poor" in json.loads(capsys.readouterr().out)["error"]["text"]
    assert not (tmp_path / "exchanged.toml").exists()


def test_a_case_states_how_far_its_plan_is_from_the_bite_of_its_scans(
    scans, tmp_path, tmp_path_factory, capsys
):
    case = coarse_case(tmp_path, tmp_path_factory)
    text = case.read_text(encoding="utf-8")
    for jaw, scan in zip(("upper", "lower"), scans, strict=True):
        cmfsim.write_surface(tmp_path / f"{jaw}_scan.stl", scan)
    named = '[bite]\nupper = "upper_scan.stl"\nlower = "lower_scan.stl"\n'
    case.write_text(f"{text}\n{named}", encoding="utf-8")
    # One scan beside the other of the case would be in another frame.
    words = ["bite", str(case), "--json", "-q", "--no-doctor"]
    assert main([*words, "--upper", str(tmp_path / "upper_scan.stl")]) == 2
    assert "scans of both jaws" in capsys.readouterr().out
    assert main(words) == 0
    file = json.loads(capsys.readouterr().out)["file"]
    given = cmfsim.Case.load(case)
    first = cmfsim.predict(given, model="H", check=False)
    target = first.patient.summary["target_bite"]
    places = np.array(target["places"])
    into = np.array(target["motion"])
    planned = first.scene.plan["maxilla"] @ into, first.scene.plan["mandible_body"]
    off = [np.linalg.norm(carried(m, places) - places, axis=1).max() for m in (into, BITE)]
    assert abs(off[0] - off[1]) < 0.3
    row = cmfsim.clinical_figures(first)["occlusion"][-1]
    assert row["label"] == "Lower teeth off the target bite"
    assert row["before"] == pytest.approx(off[0])
    apart = np.linalg.norm(carried(planned[0], places) - carried(planned[1], places), axis=1)
    assert row["planned"] == pytest.approx(apart.max())
    second = first.replan(
        {name: motion.matrix for name, motion in given.with_plan(file).plan.items()}
    )
    assert cmfsim.clinical_figures(second)["occlusion"][-1]["planned"] < 1e-6
    # A scan that is gone is found before anything is built.
    (tmp_path / "lower_scan.stl").unlink()
    found = [f for f in cmfsim.diagnose(case) if f.code == "input-unreadable"]
    assert ["bite.lower" in finding.where for finding in found] == [True]
