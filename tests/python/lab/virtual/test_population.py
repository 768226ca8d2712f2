"""Drawn patients: who they are, and how a population of them is made, resumed and recorded."""

import hashlib
import json
import os
import subprocess
import sys
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

import cmfsim
from cmfsim.cli import main
from cmfsim.errors import CaseInputError, SolverError
from cmfsim.lab.virtual import population_folder
from cmfsim.lab.virtual.population import (
    ALONG_OVER_ACROSS,
    CHIN_FORWARDS,
    FAT_POISSON,
    LACKING,
    MUSCLE_OFFSET,
    MUSCLE_YOUNG,
    NEVER_LACKING,
    OPERATIONS,
    SKIN_THICKNESS,
    SKIN_YOUNG,
    TrueTissue,
)
from cmfsim.values.calibration import PLAN

SIZE = 400
# What a test can afford: coarse tets, and a CT that no prediction will read.
COARSE = {"edge_length": 12.0, "spacing": 8.0}


@pytest.fixture(scope="module")
def people():
    """Four hundred drawn patients."""
    return [cmfsim.drawn_patient(5, index) for index in range(1, SIZE + 1)]


def test_a_patient_depends_on_seed_and_index_alone(people):
    """Drawn backwards they are the same; another seed or index gives another person."""
    again = [cmfsim.drawn_patient(5, index) for index in range(SIZE, 0, -1)][::-1]
    assert again == people
    assert len({repr(patient) for patient in people}) == SIZE
    assert cmfsim.drawn_patient(6, 1) != people[0]
    assert people[6].name == "D007"


def test_operations_have_their_shares(people):
    """Within four standard deviations of the binomial; plans move what is cut, and nothing else."""
    found = Counter(patient.osteotomies for patient in people)
    for osteotomies, share in OPERATIONS:
        spread = 4.0 * np.sqrt(SIZE * share * (1.0 - share))
        assert abs(found[osteotomies] - SIZE * share) < spread
    moved = {"le_fort_1": "maxilla", "bsso": "mandible_body", "genioplasty": "chin"}
    for patient in people:
        assert set(patient.plan) == {moved[name] for name in patient.osteotomies}
        assert set(patient.departures) == set(patient.plan)


def test_operations_depart_from_plans_as_published(people):
    """Standard deviations of the errors against the published ones, cut at twice these."""
    errors = np.array([next(iter(p.departures.values())).translation for p in people])
    expected = np.array([source.sd for source in PLAN[:3]])
    # A normal distribution that is clipped at two standard deviations has 0.96 of its own.
    assert errors.std(axis=0) == pytest.approx(0.96 * expected, rel=0.12)
    assert (np.abs(errors).max(axis=0) <= 2.0 * expected + 0.01).all()
    angles = np.array([next(iter(p.departures.values())).angle for p in people])
    turns = np.sqrt(sum(source.sd**2 for source in PLAN[3:]))
    assert np.sqrt((angles**2).mean()) == pytest.approx(0.96 * turns, rel=0.12)
    changes = np.array([patient.thickness_change for patient in people])
    assert changes.std() == pytest.approx(0.96 * 0.05, rel=0.12)


def test_jaws_in_occlusion_are_off_together(people):
    """One error for both jaws, so that a splint would still fit; a chin comes forward."""
    for patient in people:
        jaws = {n: d for n, d in patient.departures.items() if n != "chin"}
        assert len({repr(departure) for departure in jaws.values()}) == 1
        if "chin" in patient.plan:
            chin, body = (patient.plan[name].translation[1] for name in ("chin", "mandible_body"))
            low, high = CHIN_FORWARDS[0] - CHIN_FORWARDS[2], CHIN_FORWARDS[0] + CHIN_FORWARDS[2]
            assert low - 0.01 <= body - chin <= high + 0.01


def test_own_tissue_is_drawn_from_the_published_ranges(people):
    """Log-uniform moduli, offsets of 5 mm in all, and a tenth without a muscle of expression."""
    tissues = [patient.tissue for patient in people]
    along, across = np.array([t.muscle_young for t in tissues]).T
    for values, (low, high) in (
        (along, MUSCLE_YOUNG),
        (along / across, ALONG_OVER_ACROSS),
        (np.array([t.skin_young for t in tissues]), SKIN_YOUNG),
    ):
        share = (np.log(values) - np.log(low)) / np.log(high / low)
        assert -0.01 < share.min() < 0.05
        assert 0.95 < share.max() < 1.01
        # Of a uniform distribution: mean 1/2 within four standard errors.
        assert abs(share.mean() - 0.5) < 4.0 / np.sqrt(12.0 * SIZE)
    offsets = np.array([offset for t in tissues for offset in t.offsets.values()])
    size = np.sqrt((offsets**2).sum(axis=1).mean())
    assert size == pytest.approx(0.96 * np.sqrt(3.0) * MUSCLE_OFFSET[1], rel=0.03)
    sides = ("masseter_L", "masseter_R")
    assert any(t.offsets[sides[0]] != t.offsets[sides[1]] for t in tissues)
    lacking = np.mean(["risorius_L" in t.absent for t in tissues])
    assert abs(lacking - LACKING) < 4.0 * np.sqrt(LACKING * (1.0 - LACKING) / SIZE)
    for tissue in tissues:
        assert not set(tissue.absent) & set(tissue.offsets)
        assert not any(name.rpartition("_")[0] in NEVER_LACKING for name in tissue.absent)
        assert {name.replace("_L", "_R") for name in tissue.absent} >= {
            name for name in tissue.absent if name.endswith("_R")
        }
        assert FAT_POISSON[0] <= tissue.fat_poisson <= FAT_POISSON[1]
        assert SKIN_THICKNESS[0] <= tissue.skin_thickness <= SKIN_THICKNESS[1]


def test_the_phantoms_tissue_belongs_to_the_same_people(people):
    """Shape, operation, plan and errors do not depend on how the tissue is made."""
    for index, patient in enumerate(people[:20], 1):
        same = cmfsim.drawn_patient(5, index, truth="phantom")
        assert same.tissue == TrueTissue()
        assert patient == replace(same, muscle_stiffness=1.0, tissue=patient.tissue)
    # As it was drawn before other tissue could be.
    first = cmfsim.drawn_patient(1, 1, truth="phantom")
    assert (first.muscle_thickness, first.muscle_stiffness) == (1.127, 0.811)
    with pytest.raises(CaseInputError, match="truth is 'model': use one of own, phantom"):
        cmfsim.drawn_patient(5, 1, truth="model")


@pytest.mark.parametrize(("seed", "index"), [(-1, 1), (0, 0), (0.5, 1), (0, 1.5)])
def test_what_is_no_patient_is_refused(seed, index):
    """Seeds from 0, indices from 1, whole."""
    with pytest.raises(CaseInputError, match="a whole number from"):
        cmfsim.drawn_patient(seed, index)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """One patient, made by a worker process, and what was reported."""
    folder = tmp_path_factory.mktemp("population")
    told = []
    cmfsim.virtual_population(folder, 1, seed=1, progress=told.append, **COARSE)
    return folder, told


def files_of(folder):
    """What each file holds, but for the times."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != "times.json"
    }


def test_the_truth_is_the_plan_with_its_departures(made):
    """Bones end where plan and departure bring them; the case file knows the plan alone."""
    folder, told = made
    assert [(o.name, o.status, o.done, o.count) for o in told] == [("D001", "made", 1, 1)]
    patient, place = cmfsim.drawn_patient(1, 1), folder / "D001"
    case = cmfsim.Case.load(place / "case.toml")
    head = cmfsim.make_head(patient.parameters)
    for name, error in patient.departures.items():
        centre = head.skull_landmarks[error.centre]
        off = cmfsim.rigid_motion(error.translation, error.angle, error.axis, centre)
        matrix = off @ case.plan[name].matrix
        start, end = (
            np.asarray(cmfsim.read_surface(place / f"truth/{bones}/{name}.ply").vertices)
            for bones in ("bones_before", "bones")
        )
        assert np.abs(start @ matrix[:3, :3].T + matrix[:3, 3] - end).max() < 1e-3
        assert np.linalg.norm(off - np.eye(4)) > 0.1
    assert "departures" not in (place / "case.toml").read_text(encoding="utf-8")


def test_the_operation_as_carried_out_is_a_case_of_its_own(made):
    """Its plan is the true motion of each segment; all else is that of the case."""
    folder, _ = made
    cohort = cmfsim.Cohort.load(folder / "executed.toml")
    assert list(cohort.cases) == ["D001"]
    done, case = (cmfsim.Case.load(p) for p in (cohort.cases["D001"], folder / "D001"))
    record = json.loads((folder / "D001/truth/truth.json").read_text(encoding="utf-8"))
    assert set(done.plan) == set(case.plan)
    for name, motion in done.plan.items():
        np.testing.assert_allclose(motion.matrix, record["motions"][name], atol=1e-12)
        assert np.abs(motion.matrix - case.plan[name].matrix).max() > 0.1
    assert done.image.file.resolve() == case.image.file.resolve()
    assert done.postoperative.skin.resolve() == case.postoperative.skin.resolve()
    assert done.mesh == case.mesh
    assert not [f for f in cmfsim.diagnose(done) if f.severity == "error"]


def test_the_skin_is_thicker_where_nothing_moved(made):
    """Forehead: outward along the normal by the drawn share of the tissue's depth."""
    place, share = made[0] / "D001", cmfsim.drawn_patient(1, 1).thickness_change
    assert abs(share) > 0.01
    before = cmfsim.read_surface(place / "skin.ply")
    after = cmfsim.read_surface(place / "truth/skin_exact.ply")
    points = np.asarray(before.vertices)
    skin = cmfsim.Surface(before.vertices, before.triangles)
    landmarks = cmfsim.read_landmarks(place / "skin.mrk.json")
    forehead = cmfsim.unmoved_regions(points, landmarks)["forehead"]
    outward = ((np.asarray(after.vertices) - points) * np.asarray(skin.vertex_normals)).sum(axis=1)
    bone = cmfsim.read_surface(place / "truth/bones_before/cranium.ply")
    closest, _, _ = cmfsim.Surface(bone.vertices, bone.triangles).closest(points[forehead])
    depth = np.minimum(np.linalg.norm(closest - points[forehead], axis=1), 12.0)
    off = np.abs(outward[forehead] - share * depth)
    # The person's stiffer skin carries a little of the operation's motion as far as here.
    assert np.median(off) < 0.01
    assert off.max() < 0.04


@pytest.mark.slow
def test_another_process_gives_the_same_bytes(made, tmp_path):
    """The core with three threads, against that of a worker, which has one."""
    folder, _ = made
    job = {"folder": str(tmp_path), "seed": 1, "index": 1, **COARSE}
    code = f"from cmfsim.lab.virtual.population_folder import make_patient; make_patient(**{job!r})"
    environment = {"RAYON_NUM_THREADS": "3", "PYTHONPATH": os.pathsep.join(sys.path)}
    words = [sys.executable, "-c", code]
    subprocess.run(words, env={**os.environ, **environment}, check=True)
    assert files_of(tmp_path / "D001") == files_of(folder / "D001")


def test_who_is_complete_is_kept(made):
    """The second run makes nothing, and reports so; the record stays the same."""
    folder, _ = made
    before, told = files_of(folder), []
    found = cmfsim.virtual_population(folder, 1, seed=1, progress=told.append, **COARSE)
    assert [outcome.status for outcome in told] == ["kept"]
    assert files_of(folder) == before
    assert found == cmfsim.Population.load(folder)


def test_another_population_is_not_mixed_in(made):
    """Another seed or resolution in the same folder is an error that says what is there."""
    with pytest.raises(CaseInputError, match="'seed': 1"):
        cmfsim.virtual_population(made[0], 1, seed=2, **COARSE)
    with pytest.raises(CaseInputError, match="use another folder"):
        cmfsim.virtual_population(made[0], 1, seed=1, edge_length=7.0, spacing=4.0)
    with pytest.raises(CaseInputError, match="'truth': 'own'"):
        cmfsim.virtual_population(made[0], 1, seed=1, truth="phantom", **COARSE)


def test_a_failure_is_recorded_and_not_tried_again(tmp_path, monkeypatch):
    """The reason is kept with the settings; other settings, or a damaged record, are tried."""
    calls = []

    def stall(place, patient, **_):
        place.mkdir(parents=True, exist_ok=True)
        calls.append(patient.name)
        raise SolverError("Newton's method stalls")

    monkeypatch.setattr(population_folder, "write_virtual_patient", stall)
    job = {"folder": str(tmp_path), "seed": 1, "index": 4, **COARSE}
    for _ in range(2):
        assert population_folder.make_patient(**job) == ("failed", "Newton's method stalls")
    assert calls == ["D004"]
    population_folder.make_patient(**{**job, "edge_length": 8.0})
    assert calls == ["D004", "D004"]
    record = json.loads((tmp_path / "D004" / "failed.json").read_text(encoding="utf-8"))
    assert record["reason"] == "Newton's method stalls"
    (tmp_path / "D004" / "failed.json").write_text("{", encoding="utf-8")
    population_folder.make_patient(**{**job, "edge_length": 8.0})
    assert calls == ["D004"] * 3


def test_a_missing_package_is_no_failure_of_a_patient(tmp_path, monkeypatch):
    """It ends the command before a head is made, and leaves nothing that a later run believes."""
    monkeypatch.setitem(sys.modules, "pyamg", None)
    job = {"folder": str(tmp_path), "seed": 1, "index": 4, **COARSE}
    with pytest.raises(CaseInputError, match=r"pyamg, which cannot be imported.*\[study\]"):
        population_folder.make_patient(**job)
    assert list(tmp_path.rglob("*.*")) == []


def test_failures_are_in_the_record_and_counted(tmp_path, monkeypatch, capsys):
    """D002 fails: it stays in population.json with the reason, in its part, and is named."""

    def outcomes(jobs, *_):
        for job in reversed(jobs):
            yield job, "made", "stalls" if job.index == 2 else ""

    monkeypatch.setattr(population_folder, "_made", outcomes)
    assert main(["virtual-patients", str(tmp_path), "--count", "4", "--seed", "3"]) == 0
    assert "failed: D002 (population.json)" in capsys.readouterr().out
    found = cmfsim.Population.load(tmp_path)
    assert list(found.patients) == ["D001", "D002", "D003", "D004"]
    assert found.patients["D002"] == cmfsim.PopulationEntry(
        "failed", "calibration", found.patients["D002"].operation, "stalls"
    )
    assert found.named("made", "train") == ("D001", "D004")
    assert list(cmfsim.Cohort.load(tmp_path / "executed.toml").cases) == ["D001", "D003", "D004"]
    # A smaller count later takes nobody away.
    monkeypatch.setattr(population_folder, "_made", lambda jobs, *_: outcomes(jobs, 1))
    cmfsim.virtual_population(tmp_path, 1, seed=3)
    assert cmfsim.Population.load(tmp_path) == found


def test_options_that_contradict_are_refused(tmp_path, capsys):
    """Named and drawn at once; workers for named ones; lengths that cannot be."""
    for words in (
        ["--count", "2", "--patients", "1"],
        ["--workers", "2"],
        ["--patients", "1", "--truth", "phantom"],
        ["--count", "0"],
        ["--count", "1", "--edge-length", "0"],
        ["--count", "1", "--workers", "0"],
    ):
        assert main(["virtual-patients", str(tmp_path), *words]) == 2
        assert capsys.readouterr().err
