"""What is doubtful is printed before the figures, again at the end, and at the top of reports."""

import dataclasses
import json

import pytest

import cmfsim
import cmfsim.pipeline.predicting
from cmfsim.cli import main
from cmfsim.cli.terminal import Notices
from cmfsim.report.case import case_document
from cmfsim.report.page import render_page
from cmfsim.values.finding import Finding, counted, grouped
from head_case import HeadCase
from shared_values import without_drawings

pytest.importorskip("meshio")
pytest.importorskip("jinja2")


def cut_off(name, share):
    what = f"{share}% of {name} lies outside the mesh"
    return Finding("muscle-does-not-fit", what, severity="warning", where=name)


MUSCLES = [cut_off(f"muscle_{i}", share) for i, share in enumerate((3.1, 12.0, 9.9, 11.0))]


def test_findings_of_one_kind_are_one_line_with_count_and_worst():
    findings = [*MUSCLES, cut_off("platysma", 40.2), Finding("x", "a note", severity="note")]
    groups = grouped([*findings, *findings])
    assert [len(group.findings) for group in groups] == [5, 1]
    assert groups[0].line == "5 muscles partly outside the tissue (largest: platysma 40.2 %)"
    assert groups[1].line == "a note"
    assert counted([*findings, *findings]) == "5 warnings, 1 note"


def test_errors_come_first_and_unknown_kinds_are_counted_too():
    findings = [
        Finding("a", "n", severity="note"),
        Finding("b", "thing lies 2.5 mm off", severity="warning", where="here"),
        Finding("b", "thing lies 12.5 mm off", severity="warning", where="there"),
        Finding("c", "e", severity="error"),
    ]
    lines = [group.line for group in grouped(findings)]
    assert lines == ["e", "thing lies 12.5 mm off (there); and 1 more of this kind [b]", "n"]


def test_different_facts_of_one_code_are_each_stated():
    """The chin and the forehead have one code; "1 more of this kind" would leave one out."""
    parts = ["chin cut off by 4 mm", "forehead cut off by 9 mm", "chin cut off by 5 mm"]
    (group,) = grouped([Finding("ct-cut-off", part, severity="warning") for part in parts])
    assert group.line == (
        "forehead cut off by 9 mm; chin cut off by 5 mm; and 1 more of this kind [ct-cut-off]"
    )


def test_warnings_are_printed_once_as_they_come_and_once_at_the_end(capsys):
    notices = Notices(quiet=True)
    notices.found(MUSCLES)
    notices.found([*MUSCLES, Finding("x", "a note", severity="note")])
    first = capsys.readouterr()
    assert first.out == ""
    assert first.err.count("warning") == 1
    assert "a note" not in first.err
    notices.found([Finding("y", "evil \x1b[2Jname", severity="warning", fix="rename it")])
    notices.summarise("out/report.html")
    err = capsys.readouterr().err
    assert err.count("4 muscles partly outside the tissue") == 1
    assert err.count("evil \\x1b[2Jname") == 2
    assert "5 warnings, 1 note; in full: out/report.html" in err
    assert "fix: rename it" in err


def test_nothing_doubtful_prints_nothing(capsys):
    Notices().summarise("out")
    quiet = Notices(quiet=True)
    quiet.found([Finding("x", "a note", severity="note")])
    quiet.summarise("out")
    assert capsys.readouterr() == ("", "")


@pytest.fixture
def noticed(tmp_path, monkeypatch):
    """A case with a warning of the doctor, one of building and one of solving."""
    without_drawings(monkeypatch)
    build, solve = (cmfsim.pipeline.predicting.model_of, cmfsim.pipeline.predicting.solved_patient)
    solved = Finding("of-solving", "solving is doubtful", severity="warning")

    def model_of(case, options):
        found = build(case, options)
        options.observer.found(MUSCLES)
        findings = [*found.summary["findings"], *map(dataclasses.asdict, MUSCLES)]
        summary = {**found.summary, "findings": findings}
        return dataclasses.replace(found, findings=(*found.findings, *MUSCLES), summary=summary)

    def solved_patient(patient, model, tensors):
        whole = solve(patient, model, tensors=tensors)
        found = whole.prediction
        result = {**found.result.summary, "findings": [dataclasses.asdict(solved)]}
        findings = [*found.summary["findings"], dataclasses.asdict(solved)]
        found = dataclasses.replace(
            found,
            result=dataclasses.replace(found.result, summary=result),
            summary={**found.summary, "findings": findings},
        )
        return dataclasses.replace(whole, prediction=found)

    monkeypatch.setattr("cmfsim.pipeline.predicting.model_of", model_of)
    monkeypatch.setattr("cmfsim.pipeline.predicting.solved_patient", solved_patient)
    given = {"where": "case.toml:3", "why": "why", "fix": "fix it"}
    doctor = Finding("of-doctor", "the case is doubtful", severity="warning", **given)
    found = cmfsim.doctor.Examination((doctor,), {})
    monkeypatch.setattr("cmfsim.cli.case_commands.examine", lambda *_, **__: found)
    head = HeadCase(rounds=2)
    head.toml = head.toml.replace("edge_length = 4.0", "edge_length = 16.0")
    return head.write(tmp_path)


def test_predict_prints_warnings_before_its_figures_and_at_its_end(noticed, tmp_path, capsys):
    """`predict` and `evaluate` printed none."""
    words = ["predict", str(noticed), "--model", "H"]
    assert main([*words, "-q"]) == 0
    out, err = capsys.readouterr()
    first, _, end = err.partition(" in full: ")
    for part in (first, end):
        assert part.index("the case is doubtful") < part.index("4 muscles partly outside")
        assert part.index("4 muscles partly outside") < part.index("solving is doubtful")
    assert "doubtful" not in out
    top = (tmp_path / "out/report.html").read_text("utf-8").partition("<main>")[0]
    assert "4 muscles partly outside the tissue (largest: muscle_1 12.0 %)" in top
    assert "solving is doubtful" in top
    # Progress goes on between: each is printed when it is known.
    assert main(words) == 0
    lines = capsys.readouterr().err.splitlines()
    at = [
        next(i for i, line in enumerate(lines) if text in line)
        for text in (
            "the case is doubtful",
            "4 muscles",
            "solving H",
            "solving is doubtful",
            "writing H",
        )
    ]
    assert at == sorted(at)
    assert main([*words, "-q", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["findings"]
    assert {"of-doctor", "muscle-does-not-fit", "of-solving"} <= {entry["code"] for entry in found}


def test_warnings_stand_above_the_figures_of_a_report_and_fold_out(noticed):
    made = cmfsim.predict(noticed, model="H", check=False)
    page = render_page(case_document([made.summary]))
    assert page.index("4 muscles partly outside") < page.index('<dl class="facts">')
    assert page.count("<details") >= 1
    assert "9.9% of muscle_2 lies outside the mesh" in page


def test_a_study_states_what_is_doubtful_of_each_case_at_the_top():
    """Its cases are worked on by other processes, whose output goes to a log."""
    figures = {
        **dict.fromkeys(("mean_mm", "std_mm", "median_mm", "rms_mm"), 1.0),
        **dict.fromkeys(("p90_mm", "p95_mm", "max_mm", "signed_mean_mm"), 1.0),
        "within": {"2 mm": 1.0},
    }
    evaluation = {
        "models": {"H": {"regions": {"whole": figures}}},
        "warnings": ["warning: the case is <doubtful>"],
    }
    cases = [
        {"name": "one", "status": "done", "seconds": 1.0, "error": "", "evaluation": evaluation},
        {"name": "two", "status": "failed", "seconds": 1.0, "error": "killed", "evaluation": {}},
    ]
    study = {"cohort": "all", "note": "", "models": ["H"], "seconds": 2.0, "cases": cases}
    top = render_page(cmfsim.report.study.study_document(study)).partition("<main>")[0]
    assert "one: 1 warning" in top
    assert "the case is &lt;doubtful&gt;" in top
    assert top.index("two failed") < top.index("one: 1 warning")


def test_the_warnings_of_an_evaluation_are_those_of_all_that_led_to_it(noticed):
    text = noticed.read_text("utf-8")
    noticed.write_text(f'{text}\n[postoperative]\nskin = "skin.ply"\nverified = true\n', "utf-8")
    found = cmfsim.evaluate(noticed, "H", check=False).as_dict()["warnings"]
    assert "warning: solving is doubtful" in found
    assert "warning: 4 muscles partly outside the tissue (largest: muscle_1 12.0 %)" in found
