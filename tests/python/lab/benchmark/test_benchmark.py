"""The benchmark on a made population: scores in closed form, entries, and what is refused."""

import csv
import io
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, cg

import cmfsim
from cmfsim.cli import main
from cmfsim.errors import CaseInputError
from cmfsim.io.results.populations import part_of
from cmfsim.lab.benchmark.entries import (
    SKIN_RATIOS,
    EntryFolder,
    PartialLeastSquares,
    learned_entries,
    predict_by_ratios,
)
from cmfsim.lab.benchmark.patients import BenchmarkPatient, patients_of
from cmfsim.lab.virtual.patient_folder import case_text
from cmfsim.lab.virtual.population import Relocation, VirtualPatient

PAGE = Path(__file__).parents[4] / "docs" / "benchmark.md"
COUNT = 18
FAILED = 6


def motion_of(index: int) -> tuple[float, float, float]:
    """A plan for each patient, no two the same."""
    return (0.3 * index - 2.0, 6.0 * math.sin(index), 0.1 * index)


@pytest.fixture(scope="module")
def head():
    """A head with a coarse skin, its landmarks and its normals."""
    made = cmfsim.make_head()
    return made, made.surface("skin", 8.0)


@pytest.fixture
def folder(tmp_path, head):
    """Eighteen patients of one head, whose skin below the mouth goes half-way with the jaw."""
    made, skin = head
    vertices = np.asarray(skin.vertices, dtype=np.float32).astype(float)
    entries = {}
    for index in range(1, COUNT + 1):
        name = f"D{index:03d}"
        place = tmp_path / name
        (place / "truth").mkdir(parents=True)
        state, reason = ("failed", "stalls") if index == FAILED else ("made", "")
        entries[name] = cmfsim.PopulationEntry(state, part_of(index), "M", reason)
        if state == "failed":
            continue
        plan = {"mandible_body": Relocation(motion_of(index))}
        person = VirtualPatient(index, "M", made.parameters, 1.0, 1.0, ("bsso",), plan)
        (place / "case.toml").write_text(case_text(person, made.skull_landmarks, 8.0))
        (place / "ct.nrrd").write_bytes(b"never read")
        cmfsim.write_landmarks(place / "skull.mrk.json", made.skull_landmarks)
        cmfsim.write_landmarks(place / "skin.mrk.json", made.skin_landmarks)
        cmfsim.write_surface(place / "skin.ply", skin)
        after = vertices + true_motion(made, vertices, index)
        cmfsim.write_surface(
            place / "truth" / "skin_exact.ply", cmfsim.SurfaceData(after, skin.triangles)
        )
    cmfsim.Population(entries, {"seed": 0}).write(tmp_path)
    return tmp_path


def true_motion(made, vertices, index):
    """Linear in the plan, smooth over the skin."""
    share = 0.5 / (1.0 + np.exp((vertices[:, 2] - made.skin_landmarks["cheilion_L"][2]) / 8.0))
    return share[:, None] * np.array(motion_of(index))


def enter(folder, method, change, parts=("test",), **more):
    """Enters the truth with a change."""
    for patient in patients_of(folder, cmfsim.Population.load(folder), parts):
        moves = change(patient)
        extra = {name: make(patient) for name, make in more.items()}
        cmfsim.write_skin_prediction(
            folder / "predictions" / method / f"{patient.name}.npz",
            cmfsim.SkinPrediction(patient.skin, moves, **extra),
        )


def rows(text):
    """The CSV by method and region."""
    return {(row["method"], row["region"]): row for row in csv.DictReader(io.StringIO(text))}


def test_errors_are_the_offsets_that_were_put_in(folder):
    """1.5 mm and 2.5 mm off the truth everywhere: mean, P95, share and normal part."""
    enter(folder, "near", lambda p: p.truth + [1.5, 0.0, 0.0])
    enter(folder, "far", lambda p: p.truth + 2.5 * p.normals)
    found = rows(cmfsim.run_benchmark(folder, entries=[]).table.csv())
    for region in ("face", "lips", "chin"):
        near, far = found["near", region], found["far", region]
        for figure in ("mean_mm", "p95_mm"):
            assert float(near[figure]) == pytest.approx(1.5, abs=1e-4)
            assert float(far[figure]) == pytest.approx(2.5, abs=1e-4)
        assert (float(near["share_within_2mm"]), float(far["share_within_2mm"])) == (1.0, 0.0)
        assert float(far["normal_mm"]) == pytest.approx(2.5, abs=1e-4)
        assert float(near["normal_mm"]) < 1.5
        # Five of the six in the test part have a truth.
        assert (near["patients"], near["of"]) == ("5", "5")


def test_regions_differ_and_lips_are_both(folder):
    """An error in the lower lip alone is seen there, in lips and face, and nowhere else."""

    def lower(patient):
        moves = patient.truth.copy()
        moves[patient.regions["lower lip"]] += [0.0, 3.0, 0.0]
        return moves

    enter(folder, "lower", lower)
    table = cmfsim.run_benchmark(folder, entries=[]).table
    found = {name: float(row["mean_mm"]) for (_, name), row in rows(table.csv()).items()}
    regions = BenchmarkPatient("D003", folder / "D003").regions
    share = regions["lower lip"].sum() / regions["lips"].sum()
    assert found["lower lip"] == pytest.approx(3.0, abs=1e-4)
    assert found["lips"] == pytest.approx(3.0 * share, abs=1e-4)
    assert found["upper lip"] == pytest.approx(0.0, abs=1e-4)
    assert found["nose"] == pytest.approx(0.0, abs=1e-4)


def test_a_band_covers_a_region_only_where_all_of_it_is_covered(folder):
    """1 mm off along the normal: a band of 1.1 mm covers, unless a vertex has less, or none."""

    def holed(patient, value):
        widths = np.full(len(patient.skin), 1.1)
        widths[np.flatnonzero(patient.regions["chin"])[0]] = value
        return widths

    for name, value in (("held", 1.1), ("thin", 0.9), ("none", np.nan)):
        enter(
            folder,
            name,
            lambda p: p.truth + p.normals,
            half_width=lambda p, value=value: holed(p, value),
        )
    found = rows(cmfsim.run_benchmark(folder, entries=[]).table.csv())
    assert float(found["held", "chin"]["share_covered"]) == 1.0
    assert float(found["held", "chin"]["half_width_mm"]) == pytest.approx(1.1, abs=1e-5)
    for name in ("thin", "none"):
        assert float(found[name, "chin"]["share_covered"]) == 0.0
        assert float(found[name, "nose"]["share_covered"]) == 1.0


def test_standard_deviations_are_calibrated_on_another_part(folder):
    """Ten patients whose errors along the normal are known show how many deviations hold them."""
    entries = dict(cmfsim.Population.load(folder).patients)
    calibrating = [name for name, entry in entries.items() if entry.part != "test"]
    for name in calibrating:
        part = "calibration" if name in calibrating[:10] else "train"
        entries[name] = cmfsim.PopulationEntry("made", part, "M")
    entries[f"D{FAILED:03d}"] = cmfsim.PopulationEntry("failed", "test", "M", "stalls")
    cmfsim.Population(entries).write(folder)
    errors = {name: 0.5 + 0.1 * k for k, name in enumerate(calibrating)}
    enter(
        folder,
        "stated",
        lambda p: p.truth + errors.get(p.name, 1.35) * p.normals,
        parts=("test", "calibration"),
        sd=lambda p: np.full(len(p.skin), 0.5),
    )
    found = cmfsim.run_benchmark(folder, entries=[]).table
    # Ten cases: 90 % is the tenth smallest, the largest: (0.5 + 0.9) / 0.5 deviations.
    row = rows(found.csv())["stated", "chin"]
    assert float(row["standard_deviations"]) == pytest.approx(2.8, abs=1e-4)
    assert float(row["half_width_mm"]) == pytest.approx(1.4, abs=1e-4)
    assert (row["calibration_patients"], float(row["share_covered"])) == ("10", 1.0)
    assert "5 of 5" in found.markdown()
    # One case less in the calibration: its largest error is now below those of the test.
    (folder / "predictions" / "stated" / f"{calibrating[9]}.npz").unlink()
    found = cmfsim.run_benchmark(folder, entries=[]).table
    assert float(rows(found.csv())["stated", "chin"]["share_covered"]) == 0.0
    assert f"calibrated without {calibrating[9]}" in found.markdown()
    (folder / "predictions" / "stated" / f"{calibrating[8]}.npz").unlink()
    text = cmfsim.run_benchmark(folder, entries=[]).table.markdown()
    assert "8 calibration patients are too few for a band: 9 are needed" in text


def test_standard_deviations_of_other_settings_are_not_mixed(folder):
    """The second calibration patient was predicted under another setting."""
    enter(folder, "mixed", lambda p: p.truth, sd=lambda p: np.ones(len(p.skin)))
    settings = iter(["{}", '{"contact": "none"}'] + ["{}"] * 9)
    enter(
        folder,
        "mixed",
        lambda p: p.truth,
        parts=("calibration",),
        sd=lambda p: np.ones(len(p.skin)),
        settings=lambda _: next(settings),
    )
    with pytest.raises(CaseInputError, match=r'D005\.npz: its settings, \{"contact": "none"\}'):
        cmfsim.run_benchmark(folder, entries=[])


def test_nothing_is_left_out(folder):
    """A patient without a prediction, one without a truth, and regions worse than no change."""
    enter(folder, "worse", lambda p: p.truth + [9.0, 0.0, 0.0])
    (folder / "predictions" / "worse" / "D009.npz").unlink()
    found = cmfsim.run_benchmark(folder, entries=["no-change"])
    text = found.table.markdown()
    assert "**worse** has no prediction of D009" in text
    assert f"Not scored, because they have no truth: D{FAILED:03d}" in text
    summary = next(line for line in text.splitlines() if line.startswith("| worse |"))
    assert "4 of 5" in summary
    assert "upper lip" in summary.split("|")[-2]
    record = json.loads((folder / "benchmark" / "test.json").read_text())
    assert record["methods"]["worse"]["missing"] == ["D009"]
    assert record["patients_without_truth"] == [f"D{FAILED:03d}"]


def test_the_same_command_twice_gives_the_same_bytes(folder):
    """All files but the run times; the second time no entry is predicted again."""
    entries = ["no-change", "ratios", "pls"]
    files = cmfsim.run_benchmark(folder, entries=entries).files
    first = {path.name: path.read_bytes() for path in files}
    kept = {p: p.stat().st_mtime_ns for p in (folder / "predictions").rglob("*.npz")}
    assert len(kept) == 15
    again = cmfsim.run_benchmark(folder, entries=entries).files
    assert {p.name: p.read_bytes() for p in again} == first
    assert {p: p.stat().st_mtime_ns for p in kept} == kept
    for path in (folder / "predictions").rglob("*.npz"):
        path.unlink()
    fresh = cmfsim.run_benchmark(folder, entries=entries, workers=2).files
    for path in fresh:
        assert path.name == "test_times.csv" or path.read_bytes() == first[path.name]


def test_an_entry_is_predicted_again_where_its_patient_changed(folder):
    """Another plan: the entry of the old one would be scored without a word."""
    cmfsim.run_benchmark(folder, entries=["ratios"])
    file = folder / "predictions" / "ratios" / "D003.npz"
    before = cmfsim.read_skin_prediction(file).displacement
    case = folder / "D003" / "case.toml"
    case.write_text(re.sub(r"translation = .*", "translation = [0.0, -8.0, 0.0]", case.read_text()))
    cmfsim.run_benchmark(folder, entries=["ratios"])
    after = cmfsim.read_skin_prediction(file).displacement
    assert np.abs(after - before).max() > 3.0


def test_an_entry_of_another_version_is_not_scored(folder):
    """Left there, and not asked for again: it would pass for this version's."""
    cmfsim.run_benchmark(folder, entries=["no-change", "ratios"])
    enter(folder, "ratios", lambda p: p.truth)
    with pytest.raises(CaseInputError, match="--entries ratios"):
        cmfsim.run_benchmark(folder, entries=["no-change"])


def test_a_model_that_fails_stays_in_the_table(folder):
    """These patients have no CT that can be read: H says so for each, and has no figures."""
    found = cmfsim.run_benchmark(folder, entries=["no-change", "H"])
    failed = next(r for r in found.table.results if r.method == "H")
    assert tuple(failed.failed) == found.table.patients
    assert "it failed on D003" in found.table.markdown()
    reason = json.loads((folder / "predictions" / "H" / "D003.failed.json").read_text())["reason"]
    assert f"\n- D003: {reason}\n" in found.table.markdown()
    assert found.table.as_dict()["methods"]["H"]["reasons"]["D003"] == reason
    assert "ct.nrrd" in reason


def test_what_is_refused_says_where_and_why(folder):
    """Another person's vertices, another order, places for moves, NaN, unknown arrays, no file."""
    patient = BenchmarkPatient("D003", folder / "D003")
    skin, still = patient.skin, np.zeros_like(patient.skin)
    for vertices, moves, words in (
        (skin[:-1], still[:-1], "whether the population was made again"),
        (skin[::-1], still, r"vertices\[0\] lies"),
        (skin + 0.1, still, "before the operation, in its order"),
    ):
        entered = cmfsim.SkinPrediction(vertices, moves)
        cmfsim.write_skin_prediction(folder / "predictions/x/D003.npz", entered)
        with pytest.raises(CaseInputError, match=words):
            cmfsim.run_benchmark(folder, entries=[])
        with pytest.raises(CaseInputError, match=r"x.D003\.npz"):
            cmfsim.run_benchmark(folder, entries=[])
    holed = still.copy()
    holed[7, 1] = np.nan
    with pytest.raises(CaseInputError, match=r"displacement\[7, 1\] is nan"):
        cmfsim.SkinPrediction(skin, holed)
    with pytest.raises(CaseInputError, match="write displacements, not positions"):
        cmfsim.SkinPrediction(skin, skin + 1.0)
    with pytest.raises(CaseInputError, match="half_width has shape"):
        cmfsim.SkinPrediction(skin, still, half_width=np.ones(3))
    ones = np.ones(len(skin))
    with pytest.raises(CaseInputError, match="half_width and sd: give only one"):
        cmfsim.SkinPrediction(skin, still, half_width=ones, sd=ones)
    with pytest.raises(CaseInputError, match=r"sd\[4\] is 0 mm: above 0"):
        cmfsim.SkinPrediction(skin, still, sd=np.where(np.arange(len(skin)) == 4, 0.0, 1.0))
    with pytest.raises(CaseInputError, match="calibrating the bands"):
        cmfsim.run_benchmark(folder, entries=[], part="train", band_parts=["train"])
    with pytest.raises(CaseInputError, match=r"band is 'M'"):
        cmfsim.run_benchmark(folder, entries=["H"], band=["M"])
    path = folder / "predictions/x/D003.npz"
    np.savez(path, vertices=skin, moved=still)
    with pytest.raises(CaseInputError, match="displacement are needed"):
        cmfsim.read_skin_prediction(path)
    path.write_bytes(b"PK no archive")
    with pytest.raises(CaseInputError, match="is no"):
        cmfsim.read_skin_prediction(path)


def test_a_population_that_is_not_complete_is_refused(folder):
    """Methods would be compared on whoever happens to be there."""
    population = cmfsim.Population.load(folder)
    entries = dict(population.patients)
    entries["D018"] = cmfsim.PopulationEntry("pending", "test", "M")
    cmfsim.Population(entries).write(folder)
    with pytest.raises(CaseInputError, match="D018: not yet made"):
        cmfsim.run_benchmark(folder, entries=[])


def test_learning_never_sees_the_test(folder):
    """A patient in both is an error; the truth of the test part changes no prediction."""
    population = cmfsim.Population.load(folder)
    train, test = (patients_of(folder, population, [part]) for part in ("train", "test"))
    with pytest.raises(CaseInputError, match="D003: not predicted, because they are in"):
        learned_entries([*train, test[0]], test, folder / "predictions")
    learned_entries(train, test, folder / "predictions")
    files = sorted((folder / "predictions" / "pls").glob("*.npz"))
    first = [path.read_bytes() for path in files]
    for patient in test:
        shown = folder / patient.name / "truth/skin_exact.ply"
        shown.write_bytes((folder / "D001/truth/skin_exact.ply").read_bytes())
        assert EntryFolder(folder / "predictions").file("pls", patient.name).exists()
    for path in files:
        path.unlink()
    learned_entries(train, patients_of(folder, population, ["test"]), folder / "predictions")
    assert [path.read_bytes() for path in files] == first


def test_what_is_linear_in_the_plan_is_learned(folder):
    """Six patients show a face that follows the jaw half-way; six others are predicted by it."""
    found = rows(cmfsim.run_benchmark(folder, entries=["no-change", "pls"]).table.csv())
    assert float(found["no-change", "chin"]["mean_mm"]) > 1.5
    assert float(found["pls", "chin"]["mean_mm"]) < 0.1


def test_partial_least_squares_against_other_solvers():
    """All components: least squares by numpy. Some: as many steps of scipy's conjugate gradients.

    For one output, k components are k iterations on the normal equations (Wold et al. 1984).
    """
    generator = np.random.default_rng(3)
    x, y = generator.standard_normal((12, 5)), generator.standard_normal((12, 3))
    full = PartialLeastSquares.fit(x, y, 5)
    centred = x - x.mean(axis=0)
    expected = np.linalg.lstsq(centred, y - y.mean(axis=0), rcond=None)[0]
    assert np.abs(full.coefficients - expected).max() < 1e-10
    one = y[:, :1] - y[:, :1].mean()
    for count in (1, 2, 3):
        normal = LinearOperator((5, 5), matvec=lambda v: centred.T @ (centred @ v), dtype=float)
        krylov, _ = cg(normal, (centred.T @ one).ravel(), rtol=0.0, atol=0.0, maxiter=count)
        found = PartialLeastSquares.fit(x, y[:, :1], count).coefficients.ravel()
        assert np.abs(found - krylov).max() < 1e-10


def test_ratios_move_their_landmarks_by_their_share(folder):
    """At each landmark the share of the jaw's planned motion, at the eyes and the crown nothing."""
    patient = BenchmarkPatient("D003", folder / "D003")
    moves = predict_by_ratios(patient)
    jaw = np.array(motion_of(3))
    for ratio in SKIN_RATIOS:
        at = int(np.linalg.norm(patient.skin - patient.landmarks[ratio.skin], axis=1).argmin())
        share = 0.0 if "maxilla" in ratio.segments else ratio.forwards
        # The nearest vertex of this coarse skin is some mm from the landmark.
        assert np.abs(moves[at] - share * jaw).max() < 0.6
    eye = int(np.linalg.norm(patient.skin - patient.landmarks["exocanthion_L"], axis=1).argmin())
    assert np.linalg.norm(moves[eye]) < 0.5
    assert np.abs(moves[patient.skin[:, 2] > 90.0]).max() == 0.0


def test_the_page_shows_how_to_enter(folder, monkeypatch, capsys):
    """The example of docs/benchmark.md as it stands, and the command beside it."""
    example = re.search(r"```python\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    monkeypatch.chdir(folder)
    text = example[1].replace('Path("insilico")', 'Path(".")')
    exec(compile(text, str(PAGE), "exec"), {})  # noqa: S102 (our own page)
    assert "| chin-follows | 5 of 5 |" in capsys.readouterr().out
    assert main(["benchmark", ".", "--entries", "--json"]) == 0
    assert "chin-follows" in json.loads(capsys.readouterr().out)["methods"]
