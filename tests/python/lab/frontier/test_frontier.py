"""Error against run time: its parts against what is known exactly, and a coarse twin end to end."""

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import cmfsim
from cmfsim.cli import main
from cmfsim.errors import CaseInputError
from cmfsim.lab.frontier import frontier_run as bench
from cmfsim.lab.frontier.choice import EARLY, FACTORS, reference_choice, sweep_choices
from cmfsim.lab.frontier.files import frontier_page
from cmfsim.lab.frontier.frontier_run import frontier as bench_frontier
from cmfsim.lab.frontier.rows import (
    SKIN,
    WHOLE,
    FrontierRow,
    Spread,
    skin_errors,
    unbeaten,
    with_front,
)
from cmfsim.lab.frontier.timing import machine, run_job
from cmfsim.values.skin_motion import carried_points
from head_case import HeadCase

EDGES, KINEMATICS = [40.0, 30.0], ["linear", "corotational"]
WORDS = ["--model", "H", "--elements", "p1", "--kinematics", *KINEMATICS, "--edges", "40", "30"]
costs = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=14)


@settings(max_examples=200)
@given(costs)
def test_the_front_is_what_brute_force_finds(pairs):
    """Small whole numbers, so that there are ties in one cost and in both."""
    brute = [not any(x <= a and y <= b and (x, y) != (a, b) for x, y in pairs) for a, b in pairs]
    first, second = [float(a) for a, _ in pairs], [float(b) for _, b in pairs]
    assert unbeaten(first, second) == brute


def test_errors_are_those_of_a_known_difference():
    """|(3, 4, 0) s| = 5 s: by hand over all points and over a part of them."""
    size = np.arange(1.0, 5.0)
    exact = np.random.default_rng(0).normal(size=(4, 3))
    moved = exact + size[:, None] * [3.0, 4.0, 0.0]
    regions = {
        WHOLE: np.ones(4, dtype=bool),
        "chin": np.array([True, False, False, True]),
        "nose": np.zeros(4, dtype=bool),
    }
    found = skin_errors(moved, exact, regions)
    assert set(found) == {WHOLE, "chin"}
    assert found[WHOLE].mean == pytest.approx(12.5, rel=1e-12)
    assert found[WHOLE].max == pytest.approx(20.0, rel=1e-12)
    assert found["chin"].mean == pytest.approx(12.5, rel=1e-12)
    with pytest.raises(CaseInputError, match="4 points, the reference 3"):
        skin_errors(moved, exact[:3], regions)


def test_two_meshes_of_one_skin_carry_points_alike():
    """A linear field on a plane is exact on any mesh of it: no error where meshes alone differ."""

    def plane(count):
        side = np.linspace(0.0, 60.0, count)
        x, y = np.meshgrid(side, side, indexing="ij")
        at = np.arange(count * count).reshape(count, count)
        a, b, c, d = (v.ravel() for v in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
        vertices = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
        return cmfsim.SurfaceData(vertices, np.r_[np.c_[a, b, c], np.c_[a, c, d]])

    slope = np.array([[0.01, 0.02, 0.0], [-0.03, 0.0, 0.05], [0.0, 0.0, 0.0]])
    points = np.random.default_rng(1).uniform(5.0, 55.0, size=(50, 3)) * [1.0, 1.0, 0.0]
    by_mesh = [
        carried_points(skin, np.asarray(skin.vertices) @ slope, points)
        for skin in (plane(4), plane(11))
    ]
    for moved in by_mesh:
        np.testing.assert_allclose(moved, points @ slope, atol=1e-12)


def test_a_sweep_has_the_grid_and_each_factor_by_itself():
    base = cmfsim.Choice(edge_length=6.0)
    choices = sweep_choices(base, edges=[8.0, 6.0])
    assert choices[0] == base
    assert len(set(choices)) == len(choices)
    grid = {(c.edge_length, c.element, c.kinematics) for c in choices}
    assert len(grid) == 2 * 3 * 3
    changed = [set(c.changes(base)) for c in choices]
    alone = {next(iter(names)) for names in changed if len(names) == 1}
    assert alone >= set(FACTORS) - {"tolerance"}
    for choice, names in zip(choices, changed, strict=True):
        # The direct factor has no tolerance; Newton's method has one whatever solves its steps.
        large = choice.kinematics != "linear"
        assert "tolerance" not in names or large or choice.method == "pcg"
        assert names - {"kinematics", "tolerance"} or choice.tolerance in {base.tolerance, *EARLY}
    early = {(c.kinematics, c.tolerance) for c in choices if c.tolerance in EARLY}
    assert early == {(k, t) for k in ("corotational", "hyperelastic") for t in EARLY} | {
        ("linear", 1e-2)
    }
    few = sweep_choices(base, edges=[6.0], kinematics=["linear"], factors={"tolerance": (1e-4,)})
    assert {c.kinematics for c in few} == {"linear"}
    with pytest.raises(CaseInputError, match="'poisson' is unknown"):
        sweep_choices(base, factors={"poisson": (0.3,)})
    with pytest.raises(CaseInputError, match="p9"):
        sweep_choices(base, elements=["p9"])


def test_choices_share_what_is_built_alike():
    base = cmfsim.Choice()
    same = [replace(base, element="p2"), replace(base, model="M"), replace(base, method="pcg")]
    assert {c.build_key("case") for c in same} == {base.build_key("case")}
    others = [
        replace(base, edge_length=5.0),
        replace(base, samples=4),
        replace(base, mixing="stiffness"),
        replace(base, model="H"),
    ]
    assert len({c.build_key("case") for c in (base, *others)}) == 5
    # Without muscles there is nothing to sample.
    plain = replace(base, model="H")
    assert replace(plain, samples=4).build_key("case") == plain.build_key("case")
    assert base.key("case") != base.key("another case")
    with pytest.raises(CaseInputError, match="samples is 0"):
        replace(base, samples=0)


def test_the_reference_is_not_on_the_front_and_equals_in_error_are_told_apart_by_time():
    def row(seconds, error, **more):
        figures = {WHOLE: cmfsim.distance_statistics([error])}
        spread = Spread.of([seconds])
        return FrontierRow(
            cmfsim.Choice(), error=figures, build_wall=1.0, solve_wall=spread, **more
        )

    rows = [
        row(2.0, 0.2),
        row(1.0, 0.2 + 1e-9),  # the same answer by another method
        row(3.0, 0.1),
        row(9.0, 0.0, is_reference=True),
        FrontierRow(cmfsim.Choice(), failure="refused"),
        row(4.0, 0.15),
    ]
    assert [r.on_front for r in with_front(rows)] == [False, True, True, False, False, False]


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """The ellipsoid head, so coarse that a solve takes a tenth of a second."""
    head = HeadCase(rounds=2).without_mouth()
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 30.0\nrefine = false")
    return cmfsim.Case.load(head.write(tmp_path_factory.mktemp("head")))


@pytest.fixture(scope="module")
def swept(case, tmp_path_factory):
    """A sweep of it: its folder, choices, reference and frontier."""
    base = replace(cmfsim.case_choice(case), model="H")
    reference = reference_choice(base, 30.0, kinematics="corotational")
    choices = [
        *sweep_choices(base, edges=EDGES, elements=["p1"], kinematics=KINEMATICS, factors={}),
        # Node-wise relaxation is a linear method: refused when it is solved.
        replace(base, method="relaxation", kinematics="corotational"),
        # No tet is left: refused when it is built.
        replace(base, edge_length=1e4),
    ]
    folder = tmp_path_factory.mktemp("frontier")
    found = bench_frontier(case, folder, choices, reference=reference, repeats=2)
    return folder, choices, reference, found


def test_the_twin_has_a_row_for_every_choice(swept):
    _, choices, reference, found = swept
    assert [row.choice for row in found.rows] == [*choices, reference]
    assert found.base.choice == choices[0]
    assert found.reference.error[WHOLE].max == 0.0
    assert found.moved > 0.1
    for row in found.rows[:4]:
        assert not row.failure
        assert 0.0 < row.error[WHOLE].mean <= row.error[WHOLE].p95 <= row.error[WHOLE].max
        assert row.solve_wall.count == row.ratio.count == 2
        assert row.solve_wall.low <= row.solve_wall.median <= row.solve_wall.high
        assert row.build_wall > 0.0
        assert row.solve_peak is None or row.solve_peak > 1.0
    assert found.base.ratio == Spread(1.0, 1.0, 1.0, 2)
    assert found.front


def test_the_error_is_the_distance_of_independent_predictions(case, swept):
    """Built and solved here in one process by the ordinary way: the same figure."""
    _, choices, reference, found = swept
    moved = []
    for choice in (choices[0], reference):
        patient = cmfsim.build_model(choice.case(case), check=False)
        prediction = cmfsim.predict_patient(patient, choice.model)
        face = np.asarray(prediction.face_before.vertices)
        skin = cmfsim.Surface(prediction.skin_before.vertices, prediction.skin_before.triangles)
        near = np.linalg.norm(skin.closest(face)[0] - face, axis=1)
        moved.append((prediction.carried(face), near))
    # The twin lacks landmarks of the mouth: its face is what covers the tissue of the reference.
    on_tissue = moved[1][1] <= 2.0
    apart = np.linalg.norm(moved[0][0] - moved[1][0], axis=1)[on_tissue]
    assert found.n_points == on_tissue.sum()
    assert found.base.error[SKIN] == found.base.error[WHOLE]
    assert found.base.error[WHOLE].mean == pytest.approx(apart.mean(), rel=1e-9)
    assert found.base.error[WHOLE].max == pytest.approx(apart.max(), rel=1e-9)


def test_a_refused_choice_is_a_row_with_its_reason(swept):
    found = swept[3]
    solved, built = found.rows[4], found.rows[5]
    assert solved.failure.startswith("SolverError")
    assert "relaxation" in solved.failure
    assert built.failure.startswith("building: ")
    for row in (solved, built):
        assert row.total_wall is None
        assert not row.error
        assert not row.on_front
    assert solved.failure in frontier_page(found)


def test_a_finished_sweep_is_kept_and_a_wider_one_adds_to_it(case, swept, monkeypatch):
    folder, choices, reference, found = swept
    jobs = []

    def counted(job, **options):
        jobs.append(job)
        return run_job(job, **options)

    monkeypatch.setattr(bench, "run_job", counted)
    again = bench_frontier(case, folder, choices, reference=reference, repeats=2)
    assert not jobs
    assert again.as_dict() == found.as_dict()
    wider = [*choices, replace(choices[0], method="pcg")]
    more = bench_frontier(case, folder, wider, reference=reference, repeats=1)
    assert [job["task"] for job in jobs] == ["solve"]
    # The machine may have been faster then: no ratio to a base that was timed in another run.
    assert more.base.ratio.count == 1
    assert more.rows[-2].ratio is None
    # Another method solves the same system.
    error = more.rows[-2].error[WHOLE].mean
    assert error == pytest.approx(found.base.error[WHOLE].mean, rel=1e-4)


def test_what_cannot_be_meant_is_refused(case, tmp_path):
    with pytest.raises(CaseInputError, match="no choice"):
        bench_frontier(case, tmp_path, [])
    with pytest.raises(CaseInputError, match="repeats is 0"):
        bench_frontier(case, tmp_path, repeats=0)
    with pytest.raises(CaseInputError, match="time_limit"):
        bench_frontier(case, tmp_path, time_limit=-1.0)


def test_a_reference_that_takes_too_long_is_an_error(case, tmp_path):
    with pytest.raises(cmfsim.SolverError, match=r"reference .* time limit of 0\.1 s"):
        bench_frontier(
            case, tmp_path, [replace(cmfsim.case_choice(case), model="H")], time_limit=0.01
        )


def test_what_was_stopped_is_not_tried_on_smaller_tets(case, swept, monkeypatch, tmp_path):
    """The kept answers of a sweep, one of them replaced by a stop: the finer twin is not run."""
    folder, choices, reference, _ = swept
    shutil.copytree(folder, tmp_path / "copy")
    coarse = replace(choices[0], edge_length=40.0, kinematics="corotational")
    fine = replace(coarse, edge_length=30.0)
    keyed = {path.name.split("-")[0]: path for path in (tmp_path / "copy/runs").glob("*-0.json")}
    keyed[coarse.key(bench.content_key(case, None))].write_text(
        '{"error": "stopped after the time limit of 7 s"}'
    )
    monkeypatch.setattr(bench, "run_job", None)
    found = bench_frontier(
        case, tmp_path / "copy", [choices[0], coarse, fine], reference=reference, repeats=1
    )
    assert found.rows[1].failure == "stopped after the time limit of 7 s"
    assert found.rows[2].failure.startswith("not run: at 40 mm it was stopped")


def test_the_command_writes_table_page_picture_and_figures(case, swept, capsys):
    pytest.importorskip("matplotlib")
    folder = swept[0]
    words = [*WORDS, "--factors", "--repeats", "2", "--reference-kinematics", "corotational"]
    assert main(["bench", "frontier", str(case.file), "-o", str(folder), "-q", *words]) == 0
    printed = capsys.readouterr().out
    assert "off on average over the face" in printed
    assert "off on average over the skin" in printed
    written = json.loads((folder / "frontier.json").read_text(encoding="utf-8"))
    assert written["files"] == ["frontier.csv", "frontier.md", "frontier.png", "frontier.json"]
    assert all((folder / name).stat().st_size for name in written["files"])
    with (folder / "frontier.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [line["role"] for line in lines] == ["base", "", "", "", "reference"]
    first = written["rows"][0]["error"][WHOLE]
    assert float(lines[0]["mean_mm"]) == first["mean_mm"]


def test_the_machine_is_named_with_the_commit_of_its_source():
    source = Path(cmfsim.__file__).parents[2]
    if shutil.which("git") is None or not (source / ".git").exists():
        pytest.skip("the package is not imported from a checkout")
    assert re.fullmatch("[0-9a-f]{7,}", machine(None)["commit"])
