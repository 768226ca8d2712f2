"""A study's table and figures hold what scipy and VTK measure on the surfaces that it exports."""

import csv
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

import cmfsim
import phantom_case
from cmfsim.cli import main
from cmfsim.report.page import render_page
from cmfsim.report.study import study_document, table3_text
from shared_values import drawn_levels, without_drawings, without_processes

pytest.importorskip("skimage")
pytest.importorskip("jinja2")
pv = pytest.importorskip("pyvista")
interpolate = pytest.importorskip("scipy.interpolate")
image_of = pytest.importorskip("matplotlib.image").imread

MODELS = ("H", "M")
PAPER_AVERAGES = {"H": 2.75, "M": 2.45, "H+S": 2.09, "M+S": 1.87}


def _moved(points):
    """Where the operation takes the skin: the upper lip forwards, chin and lower lip back, mm."""
    points = np.asarray(points, dtype=np.float64)
    height = points[:, 2]
    forwards = 3.5 * np.exp(-(((height + 25.0) / 15.0) ** 2))
    back = 2.5 / (1.0 + np.exp((height + 52.0) / 4.0))
    return points + np.outer(back - forwards, [0.0, 1.0, 0.1])


def _patient(folder, head, anatomy, share):
    """A coarse case whose face after the operation is `share` of the way to `_moved`."""
    folder.mkdir()
    path = phantom_case.surface_case(folder, head, anatomy)
    text = path.read_text(encoding="utf-8").replace("edge_length = 7.0", "edge_length = 14.0")
    skin = cmfsim.read_surface(folder / "skin.ply")
    vertices = np.asarray(skin.vertices)
    after = vertices + share * (_moved(vertices) - vertices)
    cmfsim.write_surface(folder / "after.ply", cmfsim.SurfaceData(after, skin.triangles))
    places = {n: np.asarray(p) for n, p in head.skin_landmarks.items()}
    there = {n: p + share * (_moved([p])[0] - p) for n, p in places.items()}
    cmfsim.write_landmarks(folder / "after.mrk.json", there)
    path.write_text(
        f"{text}\n[muscles]\nsamples = 16\n"
        '\n[postoperative]\nskin = "after.ply"\nlandmarks = "after.mrk.json"\n',
        encoding="utf-8",
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two patients in a folder, and a cohort file that names a third who is not there.

    Work on a case draws nothing; the figures of the study are drawn.
    """
    folder = tmp_path_factory.mktemp("cohort")
    head = cmfsim.make_head()
    anatomy = drawn_levels(tmp_path_factory, 4.0)
    _patient(folder / "P1", head, anatomy, 1.0)
    _patient(folder / "P2", head, anatomy, 0.4)
    (folder / "cohort.toml").write_text(
        'format = "cmfsim-cohort"\nversion = 1\nname = "two *heads*"\nnote = "in silico"\n'
        'models = ["H", "M"]\n[[cases]]\nfile = "P1/case.toml"\n[[cases]]\nfile = "P2/case.toml"\n'
        '[[cases]]\nname = "gone"\nfile = "nowhere/case.toml"\n',
        encoding="utf-8",
    )
    with pytest.MonkeyPatch.context() as patch:
        without_processes(patch)
        without_drawings(patch)
        assert main(["study", str(folder), "-q", "--workers", "1"]) == 1
    return folder


@pytest.fixture(scope="module")
def rows(folder):
    text = (folder / "study" / "study.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def _skin(folder, patient, model):
    """A skin with its errors, as VTK reads it."""
    return pv.read(folder / "study" / patient / f"error-{model}.vtp")


def _carried(skin, shift, place):
    """Where a point near a skin goes: it keeps its place in the frame of its closest triangle."""
    corners = skin.get_cell(skin.find_closest_cell(place)).point_ids

    def frame(points):
        first, second = points[1] - points[0], points[2] - points[0]
        normal = np.cross(first, second)
        return np.column_stack([first, second, normal / np.linalg.norm(normal)])

    before = np.asarray(skin.points)[corners]
    after = before + shift[corners]
    return after[0] + frame(after) @ np.linalg.solve(frame(before), place - before[0])


def test_distances_are_those_of_scipy_and_vtk(folder):
    """A spline through landmarks leads to the partner; the error is from the unwarped vertex.

    Kim et al. (2010), section 3.2; the spline (Bookstein 1989, U = r) is scipy's, the closest point
    VTK's, and so is the place to which the prediction carries each landmark.
    """
    case = folder / "P1"
    after = pv.read(case / "after.ply")
    before = cmfsim.read_landmarks(case / "skin.mrk.json")
    there = cmfsim.read_landmarks(case / "after.mrk.json")
    names = sorted(before)
    for model in MODELS:
        skin = _skin(folder, "P1", model)
        prediction = pv.read(folder / "study" / "P1" / model / "prediction.vtp")
        shift = np.asarray(prediction.point_data["displacement"])
        np.testing.assert_allclose(skin.points, prediction.points + shift, atol=1e-9)
        carried = [_carried(prediction, shift, np.asarray(before[name])) for name in names]
        target = np.array([there[name] for name in names])
        warp = interpolate.RBFInterpolator(np.array(carried), target, kernel="linear", degree=1)
        chosen = np.asarray(skin.point_data["evaluated"]) == 1
        points = np.asarray(skin.points)[chosen]
        _, partners = after.find_closest_cell(warp(points), return_closest_point=True)
        expected = np.linalg.norm(points - partners, axis=1)
        signed = np.asarray(skin.point_data["signed_distance_mm"])
        # A landmark above an edge may follow either of two triangles.
        np.testing.assert_allclose(np.abs(signed[chosen]), expected, atol=3e-3)
        assert not signed[~chosen].any()
        inside = pv.PolyData(points).compute_implicit_distance(after)["implicit_distance"]
        clear = np.abs(inside) > 0.5
        assert (np.sign(signed[chosen][clear]) == np.sign(inside[clear])).mean() > 0.99


def test_the_table_holds_the_figures_of_the_exported_distances(folder, rows):
    assert {row["patient"] for row in rows} == {"P1", "P2"}
    assert {row["model"] for row in rows} == {*MODELS, "no change"}
    assert {"whole", "nose", "upper lip", "lower lip", "chin"} <= {row["region"] for row in rows}
    assert len(rows) == len({(r["patient"], r["region"], r["model"]) for r in rows})
    for row in (r for r in rows if r["region"] == "whole" and r["model"] in MODELS):
        skin = _skin(folder, row["patient"], row["model"])
        chosen = np.asarray(skin.point_data["evaluated"]) == 1
        sizes = np.abs(np.asarray(skin.point_data["signed_distance_mm"])[chosen])
        expected = {
            "count": chosen.sum(),
            "mean_mm": sizes.mean(),
            "std_mm": sizes.std(),
            "median_mm": np.median(sizes),
            "rms_mm": np.sqrt((sizes**2).mean()),
            "p90_mm": np.percentile(sizes, 90),
            "p95_mm": np.percentile(sizes, 95),
            "max_mm": sizes.max(),
            **{f"within_{limit:g}_mm": (sizes <= limit).mean() for limit in (1.0, 2.0, 3.0)},
        }
        found = {name: float(row[name]) for name in expected}
        assert found == pytest.approx(expected, abs=1e-12)
    # "no change" is as far off as the face moved.
    mean = {(r["patient"], r["model"]): float(r["mean_mm"]) for r in rows if r["region"] == "whole"}
    assert mean["P1", "no change"] > mean["P2", "no change"] > 0.3


def test_table_3_rounds_the_same_figures_and_averages_patients_alike(folder, rows):
    text = (folder / "study" / "table3.md").read_text(encoding="utf-8")
    ours, _, papers = text.partition("## The paper's patients")
    whole = {(r["patient"], r["model"]): r for r in rows if r["region"] == "whole"}
    lines = [[c.strip() for c in li.split("|")[1:-1]] for li in ours.splitlines() if li[:1] == "|"]
    head, _, first, second, average = lines[:5]
    assert head == ["whole, mm", *MODELS, "no change"]
    for line in (first, second):
        for model, cell in zip(head[1:], line[1:], strict=True):
            row = whole[line[0], model]
            figures = [float(row[k]) for k in ("mean_mm", "std_mm", "p90_mm", "p95_mm")]
            assert cell == "{:.2f} ± {:.2f}  P90 {:.2f}  P95 {:.2f}".format(*figures)
    for model, cell in zip(head[1:], average[1:], strict=True):
        mean = np.mean([float(whole[p, model]["mean_mm"]) for p in ("P1", "P2")])
        assert cell == f"{mean:.2f}"
    assert "**in silico**" in ours
    assert "Failed, and not included in any figure of this table: gone." in ours
    # A name is a name: its asterisks are no markup.
    assert "two \\*heads\\*" in ours
    for model in MODELS:
        assert f"{PAPER_AVERAGES[model]:.2f}" in papers
    assert "Patients, scans and landmarks differ" in papers


def test_distances_measured_in_two_ways_are_not_passed_off_as_one(folder):
    """A patient without landmarks has smaller distances, to closest points."""
    text = (folder / "study" / "table3.md").read_text(encoding="utf-8")
    assert "Measured from the corresponding point given by a spline" in text
    assert "two ways" not in text
    first, second, gone = cmfsim.run_study(cmfsim.Cohort.load(folder), workers=1).outcomes
    other = json.loads(json.dumps(second.evaluation))
    other["no_change"]["comparison"]["method"] = "closest"
    mixed = replace(second, evaluation=other)
    report = cmfsim.StudyReport(cmfsim.Cohort.load(folder), (first, mixed, gone), 1.0)
    told = table3_text(report.as_dict(), cmfsim.study_table(report))
    assert "**Distances were measured in two ways, so averages mix both.**" in told
    assert "P2: from the closest point" in told
    page = render_page(study_document(report.as_dict()))
    assert "measured in two ways" in page


def test_figures_show_every_patient_and_model(folder):
    """Both are drawn, differ where the errors do, and are in the report."""
    study = folder / "study"
    boxes, faces = image_of(study / "figure9.png"), image_of(study / "figure10.png")
    for model in MODELS:
        colour = cmfsim.pictures.MODEL_COLOURS[model]
        rgb = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        drawn = (np.abs(boxes[:, :, :3] - rgb).max(axis=2) < 0.01).any(axis=0)
        # A box a patient: two runs of columns besides the legend's, which is above them.
        assert np.count_nonzero(np.diff(drawn.astype(int)) == 1) >= 2
    height, width = faces.shape[0] // 2, faces.shape[1] // 2
    cells = [
        faces[r * height : r * height + 340, c * width : c * width + 380]
        for r, c in np.ndindex(2, 2)
    ]
    for cell in cells:
        blue = cell[:, :, 2] - cell[:, :, 0] > 0.1
        assert 0.02 < blue.mean() < 0.6
    # The errors of the two patients differ, and so do their faces.
    assert np.abs(cells[0] - cells[2]).mean() > 0.005
    page = (study / "report.html").read_text(encoding="utf-8")
    assert len(re.findall("data:image/(png|webp);base64,", page)) == 2
    assert "as the paper&#39;s Figure 10" in page or "as the paper's Figure 10" in page


def test_a_study_is_drawn_from_what_it_left_and_nothing_else(folder, tmp_path, monkeypatch):
    """Errors that were changed after the study are refused; a run again works on that case."""
    without_processes(monkeypatch)
    without_drawings(monkeypatch)
    copied = tmp_path / "copy"
    shutil.copytree(folder, copied)
    cohort = replace(cmfsim.Cohort.load(copied), cases={"P1": copied / "P1" / "case.toml"})
    report = cmfsim.run_study(cohort, workers=1)
    assert [outcome.status for outcome in report.outcomes] == ["kept"]
    changed = copied / "study" / "P1" / "error-M.vtp"
    changed.write_bytes((copied / "study" / "P1" / "error-H.vtp").read_bytes())
    with pytest.raises(cmfsim.CaseError, match=r"error-M\.vtp: is not the file written"):
        cmfsim.write_study_report(report)
    again = cmfsim.run_study(cohort, workers=1)
    assert [outcome.status for outcome in again.outcomes] == ["done"]
    names = cmfsim.write_study_report(again)
    assert names[0] == "study.csv"
    # Of the earlier cohort of three nothing is left.
    assert "P2" not in (copied / "study" / "study.csv").read_text(encoding="utf-8")


def test_models_are_averaged_over_the_same_patients(folder):
    """Where a model failed for a patient, the averages of all models leave that patient out."""
    cohort = cmfsim.Cohort.load(folder)
    report = cmfsim.run_study(cohort, workers=1)
    first, second, gone = report.outcomes
    models = {"H": second.evaluation["models"]["H"]}
    broken = replace(second, status="failed", evaluation={**second.evaluation, "models": models})
    table = cmfsim.study_table(replace(report, outcomes=(first, broken, gone)))
    assert table.complete() == ("P1",)
    alone = cmfsim.study_table(replace(report, outcomes=(first,)))
    for model in (*MODELS, "no change"):
        assert table.average(model) == alone.average(model)
    assert "average of 1 of 2" in table.text()
    assert ("P2", "whole", "H") in table.cells
    assert ("P2", "whole", "M") not in table.cells
    nobody = cmfsim.study_table(replace(report, outcomes=(broken,)))
    assert nobody.text().splitlines()[-1].split()[-1] == "–"
    with pytest.raises(cmfsim.CaseError, match="no patient has an error of each of H, M"):
        nobody.average("H")


def test_a_study_in_which_all_failed_has_no_table(folder, tmp_path):
    cohort = replace(
        cmfsim.Cohort.load(folder), cases={"gone": tmp_path / "no.toml"}, output=tmp_path / "study"
    )
    cohort = replace(cohort, file=tmp_path / "cohort.toml")
    report = cmfsim.run_study(cohort, workers=1)
    with pytest.raises(cmfsim.CaseError, match="no case was compared with its post-operative"):
        cmfsim.study_table(report)
    assert cmfsim.write_study_report(report) == ["study.json", "report.html"]


def test_a_folder_of_cases_is_a_cohort(folder, tmp_path):
    for name in ("P1", "P2"):
        shutil.copytree(folder / name, tmp_path / name)
    (tmp_path / "notes").mkdir()
    cohort = cmfsim.Cohort.load(tmp_path)
    assert cohort.cases == {name: tmp_path / name / "case.toml" for name in ("P1", "P2")}
    assert cohort.models == cmfsim.MODELS
    assert cohort.output == tmp_path / "study"
    (tmp_path / "P1").rename(tmp_path / "P 1")
    with pytest.raises(cmfsim.CaseError, match=r"P 1: is no name for a case"):
        cmfsim.Cohort.load(tmp_path)


@pytest.mark.parametrize("lost", ["mean_mm", "quartiles_mm", "within", "outliers"])
def test_figures_survive_json_and_missing_ones_are_named(lost):
    figures = cmfsim.distance_statistics([-2.0, 0.25, 1.0, 1.5, 0.1])
    values = json.loads(json.dumps(figures.as_dict()))
    assert cmfsim.DistanceStatistics.from_dict(values) == figures
    del values[lost]
    with pytest.raises(cmfsim.CaseError, match=re.escape(f"lack {lost!r}")):
        cmfsim.DistanceStatistics.from_dict(values)
