"""A cohort with named changes of settings: what runs, what is compared, what is refused."""

import csv
import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import cmfsim
import phantom_case
from cmfsim.cli import main
from cmfsim.errors import CaseInputError
from cmfsim.report.variants import variants_text
from shared_values import drawn_levels, without_drawings, without_processes

pytest.importorskip("skimage")
pytest.importorskip("jinja2")
stats = pytest.importorskip("scipy.stats")

COHORT = """format = "cmfsim-cohort"
version = 1
name = "two heads"
models = ["H"]
[[cases]]
file = "P1/case.toml"
[[cases]]
file = "P2/case.toml"
[[cases]]
name = "gone"
file = "nowhere/case.toml"
"""
VARIANTS = """description = "what matters"
[variants.loose]
description = "compressible fat"
tissue = {young = 0.003, poisson = 0.1}
[variants.named-default]
node_kinds.contact_surface = "bone"
lips.contact = false
[variants.other-skin]
surfaces.skin = "other.ply"
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two coarse patients; the second's other skin is no surface. The third is not there."""
    folder = tmp_path_factory.mktemp("cohort")
    head = cmfsim.make_head()
    anatomy = drawn_levels(tmp_path_factory, 4.0)
    for name, share in (("P1", 1.0), ("P2", 0.5)):
        (folder / name).mkdir()
        path = phantom_case.surface_case(folder / name, head, anatomy)
        text = path.read_text(encoding="utf-8").replace("edge_length = 7.0", "edge_length = 14.0")
        after = '[postoperative]\nskin = "after.ply"\nverified = true'
        path.write_text(f"{text}\n{after}\n", encoding="utf-8")
        skin = cmfsim.read_surface(folder / name / "skin.ply")
        after = np.array(skin.vertices)
        after[:, 1] += share * np.exp(-(((after[:, 2] + 45.0) / 20.0) ** 2))
        cmfsim.write_surface(folder / name / "after.ply", cmfsim.SurfaceData(after, skin.triangles))
        cmfsim.write_surface(folder / name / "other.ply", skin)
    (folder / "P2" / "other.ply").write_text("no surface\n", encoding="utf-8")
    (folder / "cohort.toml").write_text(COHORT, encoding="utf-8")
    (folder / "variants.toml").write_text(VARIANTS, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def study(folder):
    """The values of the study, its exit code being 1 for cases that failed."""
    words = ["study", str(folder), "--variants", str(folder / "variants.toml"), "-q"]
    with pytest.MonkeyPatch.context() as patch:
        without_processes(patch)
        without_drawings(patch)
        assert main([*words, "--workers", "1"]) == 1
    text = (folder / "study-variants" / "variants.json").read_text(encoding="utf-8")
    return json.loads(text)


def statuses(study, variant):
    found = next(v for v in study["variants"] if v["name"] == variant)
    return [case["status"] for case in found["cases"]]


def rows_of(folder):
    text = (folder / "study-variants" / "variants.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def test_each_variant_has_its_own_results(folder, study):
    place = folder / "study-variants"
    keys = {}
    for name in ("as-given", "loose", "other-skin"):
        metrics = json.loads((place / name / "P1" / "metrics.json").read_text(encoding="utf-8"))
        keys[name] = metrics["case_key"]
    assert len(set(keys.values())) == 3
    # Where a variant names the default, nothing is repeated.
    assert not (place / "named-default").exists()
    same = {variant["name"]: variant["same"] for variant in study["variants"]}
    assert same["named-default"] == ["P1", "P2", "gone"]
    assert same["loose"] == ["gone"]


def test_a_patient_who_failed_is_reported_and_not_compared(folder, study):
    assert statuses(study, "as-given") == ["done", "done", "failed"]
    assert statuses(study, "loose") == ["done", "done", "failed"]
    assert statuses(study, "other-skin") == ["done", "failed", "failed"]
    n = {entry["variant"]: entry["n"] for entry in study["changes"] if entry["region"] == "whole"}
    assert n == {"loose": 2, "named-default": 2, "other-skin": 1}
    failed = next(v for v in study["variants"] if v["name"] == "other-skin")["cases"][1]
    assert "other.ply" in failed["error"]
    text = variants_text(study)
    assert "failed" in next(line for line in text.splitlines() if line.startswith("  other-skin"))
    page = (folder / "study-variants" / "report.html").read_text(encoding="utf-8")
    assert "other-skin, P2 failed" in page


def test_changes_are_those_of_the_metrics_of_both(folder, study):
    def mean(variant, patient, region):
        path = folder / "study-variants" / variant / patient / "metrics.json"
        metrics = json.loads(path.read_text(encoding="utf-8"))
        return metrics["models"]["H"]["regions"][region]["mean_mm"]

    rows = {(r["variant"], r["patient"], r["region"], r["model"]): r for r in rows_of(folder)}
    for patient in ("P1", "P2"):
        row = rows["loose", patient, "lower lip", "H"]
        first, second = (mean(v, patient, "lower lip") for v in ("as-given", "loose"))
        assert float(row["as_given_mm"]) == first
        assert float(row["mean_mm"]) == second
        assert float(row["change_mm"]) == second - first != 0.0
        assert float(rows["named-default", patient, "chin", "H"]["change_mm"]) == 0.0
    entry = next(
        e for e in study["changes"] if (e["variant"], e["region"]) == ("loose", "lower lip")
    )
    change = [float(rows["loose", p, "lower lip", "H"]["change_mm"]) for p in ("P1", "P2")]
    assert entry["change_mm"] == pytest.approx(np.mean(change), abs=1e-12)
    assert entry["n_better"] == sum(c < 0.0 for c in change)
    assert entry["test"] is None
    # The face as it was has the error of "no change", once.
    still = [key for key in rows if key[3] == "no change"]
    assert {key[0] for key in still} == {"as-given"}


def test_tables_name_patients_variants_and_regions(folder, study):
    text = variants_text(study)
    lines = text.splitlines()
    table = lines[lines.index("Model H, chin: mean error of each patient, mm") :]
    assert table[1].split()[:4] == ["variant", "P1", "P2", "gone"]
    assert [line.split()[0] for line in table[2:7]] == [
        "no",
        "as-given",
        "loose",
        "named-default",
        "other-skin",
    ]
    assert "  named-default (default)" in text
    assert "n counts patients, not vertices" in text
    markdown = (folder / "study-variants" / "variants.md").read_text(encoding="utf-8")
    assert "| loose | tissue.young = 0.003, tissue.poisson = 0.1 | compressible fat |" in markdown


def test_what_is_finished_is_kept_until_its_variant_changes(folder, study, monkeypatch, tmp_path):
    del study
    without_processes(monkeypatch)
    without_drawings(monkeypatch)
    text = (folder / "variants.toml").read_text(encoding="utf-8")
    other = tmp_path / "variants.toml"
    other.write_text(text.partition("[variants.named")[0].replace("0.1", "0.2"), encoding="utf-8")
    cohort = cmfsim.Cohort.load(folder)
    cohort = replace(cohort, cases={"P1": cohort.cases["P1"]})
    found = cmfsim.run_variants(cohort, cmfsim.Variants.load(other, cohort.models))
    assert [o.status for o in found.reports["as-given"].outcomes] == ["kept"]
    assert [o.status for o in found.reports["loose"].outcomes] == ["done"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tissue.poison = 0.3\n", "variants.toml:3: tissue.poison is unknown; did you mean"),
        (
            'node_kinds.contact_surfac = "bone"\n',
            "contact_surfac: there is no option 'contact_surfac'; did you mean 'contact_surface'?",
        ),
        ('node_kinds.contact_surface = "bones"\n', "variants.toml:3 node_kinds.contact_surface"),
        ('surfaces.skin = "nowhere.ply"\n', "nowhere.ply"),
    ],
)
def test_a_fault_in_any_variant_ends_the_study_before_it_begins(
    folder, tmp_path, capsys, text, message
):
    file = tmp_path / "variants.toml"
    file.write_text(f"\n[variants.wrong]\n{text}", encoding="utf-8")
    cohort = tmp_path / "cohort.toml"
    cohort.write_text(COHORT.replace('file = "P', f'file = "{folder}/P'), encoding="utf-8")
    assert main(["study", str(cohort), "--variants", str(file), "-q"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert not (tmp_path / "study-variants").exists()


def test_a_paired_change_has_the_interval_of_students_t_and_an_exact_test():
    """Student (1908); the exact distribution by counting all signs (Wilcoxon 1945)."""
    generator = np.random.default_rng(5)
    for n in (2, 5, 6, 9):
        first = 1.0 + generator.random(n)
        change = generator.normal(-0.1, 0.2, n)
        found = cmfsim.paired_change(first, first + change)
        moved = (first + change) - first
        assert found.change == pytest.approx(moved.mean(), abs=1e-12)
        assert found.interval == pytest.approx(
            stats.ttest_1samp(moved, 0.0).confidence_interval(0.95), abs=1e-12
        )
        if n < 6:
            assert found.test is None
            continue
        ranks = stats.rankdata(np.abs(moved))
        seen = abs((np.sign(moved) * ranks).sum())
        sums = [abs(np.dot(signs, ranks)) for signs in product((-1.0, 1.0), repeat=n)]
        assert found.test.p == pytest.approx(np.mean([s >= seen - 1e-9 for s in sums]))


def test_patients_without_a_change_do_not_count_for_the_test():
    first = np.linspace(1.0, 2.0, 7)
    second = first - np.array([0.0, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    found = cmfsim.paired_change(first, second)
    assert (found.n, found.n_better, found.test) == (7, 5, None)
    assert cmfsim.paired_change([1.0], [2.0]).interval is None


def test_models_and_output_of_a_cohort_change_for_one_run(tmp_path, monkeypatch, capsys):
    """What the command line states wins over the file, which keeps what it has."""
    (tmp_path / "cohort.toml").write_text(COHORT, encoding="utf-8")
    asked = []

    def run(cohort, **_):
        asked.append(cohort)
        raise CaseInputError("far enough")

    monkeypatch.setattr("cmfsim.cli.study_commands.run_study", run)
    words = ["study", str(tmp_path), "-q"]
    assert main([*words, "--model", "M+S", "--model", "M", "-o", str(tmp_path / "x")]) == 2
    assert main(words) == 2
    capsys.readouterr()
    assert asked[0].models == ("M", "M+S")
    assert asked[0].output == tmp_path / "x"
    assert asked[1].models == ("H",)
    assert asked[1].output == tmp_path / "study"
