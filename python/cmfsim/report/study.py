"""The report of a study: every case by every model, compared with the paper's patients."""

from collections.abc import Mapping, Sequence
from typing import Any

from cmfsim.evaluation.models import NO_CHANGE, ErrorTable
from cmfsim.report.document import Alert, Document, Figure, Note, Section
from cmfsim.report.page import MEASURES
from cmfsim.values.table import NOTHING, Table, number, plain_line

Values = Mapping[str, Any]

# Mean errors over the four patients of Kim et al. (2010), Table 3, mm, and those of model M+S by
# patient.
PAPER_AVERAGES: Mapping[str, float] = {"H": 2.75, "M": 2.45, "H+S": 2.09, "M+S": 1.87}
PAPER_MUSCLES_SLIDING = (1.21, 2.14, 1.58, 2.56)


def study_document(study: Values, *, figures: Sequence[Figure] = ()) -> Document:
    """The report of a study, as `StudyReport.as_dict()` has it."""
    models = tuple(study["models"])
    done = [case for case in study["cases"] if case["status"] != "failed"]
    failed = [case for case in study["cases"] if case["status"] == "failed"]
    sections = []
    if study["note"]:
        sections.append(Section("Patients", (Note(study["note"], "warning"),)))
    sections.append(Section("Error of each model", (*_error_blocks(done, models), *figures)))
    sections.append(Section("Regions", _region_blocks(done, models)))
    sections.append(Section("The paper's patients", (_paper_table(models), Note(PAPER_NOTE))))
    sections.append(Section("Cases", _case_blocks(study["cases"], failed)))
    facts = {
        "cases": f"{len(done)} of {len(study['cases'])}",
        "models": ", ".join(models),
        "time": f"{study['seconds']:.0f} s",
    }
    subtitle = "Errors are distances of the predicted skin from the post-operative skin, mm."
    title = f"{study['cohort']}: study"
    return Document(title, subtitle, facts, sections, alerts=_alerts(study["cases"]))


def table3_text(study: Values, table: ErrorTable) -> str:
    """Table 3 of Kim et al. (2010) for a study, in Markdown, with the means that the paper states.

    The study is `StudyReport.as_dict()`, the table its own.
    """
    models = tuple(study["models"])
    blocks = [f"# {plain_line(study['cohort'])}: errors by patient and model"]
    if study["note"]:
        blocks.append(f"**{plain_line(study['note'])}**")
    blocks.append(TABLE_3_CAPTION)
    blocks += _measures(study["cases"])
    blocks.append(table.markdown())
    blocks += _tests(table, models)
    absent = [case["name"] for case in study["cases"] if case["name"] not in table.patients]
    if absent:
        blocks.append(f"Failed, and not included in any figure of this table: {', '.join(absent)}.")
    paper = _paper_table(models)
    blocks += [f"## The paper's patients\n\n{paper.caption}", paper.markdown, PAPER_NOTE]
    return "\n\n".join(blocks) + "\n"


def study_text(study: Values) -> str:
    """The errors of a study (`StudyReport.as_dict()`) and its doubtful cases, as plain text."""
    done = [case for case in study["cases"] if case["status"] != "failed"]
    blocks = [study["note"]] if study["note"] else []
    parts = (*_error_blocks(done, tuple(study["models"])), *_case_blocks(study["cases"], ()))
    blocks += [part.text for part in parts]
    doubts = [alert for alert in _alerts(study["cases"]) if alert.kind == "warning"]
    blocks += ["\n  ".join((alert.line, *alert.details)) for alert in doubts]
    return "\n".join(blocks)


def _measures(cases: Sequence[Values]) -> list[str]:
    """How the distances of which cases were measured: those of two methods cannot be compared."""
    by_method: dict[str, list[str]] = {}
    for case in cases:
        entry = case["evaluation"].get("no_change", {})
        method = entry.get("comparison", {}).get("method")
        if method in MEASURES:
            by_method.setdefault(method, []).append(case["name"])
    if len(by_method) == 1:
        return [f"Measured {MEASURES[method]}." for method in by_method]
    found = [f"{', '.join(names)}: {MEASURES[method]}." for method, names in by_method.items()]
    return [
        f"**Distances were measured in two ways, so averages mix both.** {' '.join(found)}"
    ] * bool(found)


def _tests(table: ErrorTable, models: tuple[str, ...]) -> list[str]:
    """Whether the first model and the last differ over patients."""
    if len(models) < 2 or len(table.complete()) < LEAST_TESTED:
        return []
    test = table.wilcoxon(models[0], models[-1])
    return [
        f"Wilcoxon's signed-rank test of {models[0]} and {models[-1]}, patient by patient: "
        f"p = {test.p:.3g}. {test.caveat}".strip()
    ]


def _alerts(cases: Sequence[Values]) -> list[Alert]:
    return case_alerts([(c["name"], c, c["evaluation"].get("warnings", ())) for c in cases])


def case_alerts(cases: Sequence[tuple[str, Values, Sequence[str]]]) -> list[Alert]:
    """What is doubtful about each named case, with its warnings; cases that failed first."""
    alerts = [
        Alert("error", f"{name} failed", tuple(case["error"].splitlines()))
        for name, case, _ in cases
        if case["status"] == "failed"
    ]
    for name, _, lines in cases:
        if lines:
            several = "s" if len(lines) > 1 else ""
            alerts.append(Alert("warning", f"{name}: {len(lines)} warning{several}", tuple(lines)))
    return alerts


TABLE_3_CAPTION = (
    "Distance of the predicted skin from the skin after the operation over the whole face, mm: "
    f"mean ± SD, 90th and 95th percentile. {NO_CHANGE!r} takes the face before the operation as "
    "the prediction. Averages give each patient the same weight."
)
# Patients from which on a test of two models is printed: of one there is nothing to test.
LEAST_TESTED = 2
PAPER_NOTE = (
    "Kim et al. (2010), Table 3. Patients, scans and landmarks differ: the two tables show whether "
    "the errors are of similar size, not which program is better."
)


def _error_blocks(done: Sequence[Values], models: tuple[str, ...]) -> tuple[Note | Table, ...]:
    rows = []
    for case in done:
        entries = case["evaluation"]["models"]
        cells = [_mean_sd(entries.get(model)) for model in models]
        rows.append((case["name"], *cells, _mean_sd(case["evaluation"].get("no_change"))))
    if done:
        means = [_average(done, lambda e, m=model: e["models"].get(m)) for model in models]
        still = _average(done, lambda e: e.get("no_change"))
        rows.append(("mean", *(number(mean) for mean in means), number(still)))
    table = Table(
        ("case", *models, "no change"),
        tuple(rows),
        "Mean ± SD over the whole face, mm (as the paper's Table 3); the last column takes the "
        "face before the operation as the prediction.",
    )
    return (table, *(Note(line.replace("**", "")) for line in _measures(done)))


def _region_blocks(done: Sequence[Values], models: tuple[str, ...]) -> tuple[Note | Table, ...]:
    """Where each model is better than no change, and where it makes things worse."""
    names = list(
        dict.fromkeys(
            region
            for case in done
            for entry in case["evaluation"]["models"].values()
            for region in entry["regions"]
        )
    )
    blocks: list[Note | Table] = []
    for model in models:
        rows = []
        for case in done:
            entry = case["evaluation"]["models"].get(model)
            still = case["evaluation"].get("no_change")
            if entry is None:
                continue
            rows.append((case["name"], *(_gain(entry, still, name) for name in names)))
        caption = f"Model {model}: mean error, and in brackets its change against no change, mm."
        blocks.append(Table(("case", *names), tuple(rows), caption))
    return tuple(blocks) or (Note("No case is finished."),)


def _gain(entry: Values, still: Values | None, region: str) -> str:
    if region not in entry["regions"]:
        return NOTHING
    mean = entry["regions"][region]["mean_mm"]
    if still is None or region not in still["regions"]:
        return number(mean)
    return f"{mean:.2f} ({mean - still['regions'][region]['mean_mm']:+.2f})"


def _paper_table(models: tuple[str, ...]) -> Table:
    rows = [
        ("mean of four patients", *(number(PAPER_AVERAGES[m]) for m in models)),
        *(
            (f"patient {i + 1}", *(number(value) if m == "M+S" else NOTHING for m in models))
            for i, value in enumerate(PAPER_MUSCLES_SLIDING)
        ),
    ]
    return Table(("", *models), tuple(rows), "Mean error in the paper, mm.")


def _case_blocks(cases: Sequence[Values], failed: Sequence[Values]) -> tuple[Note | Table, ...]:
    rows = tuple((case["name"], case["status"], f"{case['seconds']:.0f}") for case in cases)
    table = Table(("case", "outcome", "time, s"), rows, "How each case ended.")
    return (table, *(Note(f"{case['name']} failed: {case['error']}", "error") for case in failed))


def _mean_sd(entry: Values | None) -> str:
    if entry is None:
        return NOTHING
    face = entry["regions"]["whole"]
    return f"{face['mean_mm']:.2f} ± {face['std_mm']:.2f}"


def _average(done: Sequence[Values], pick: Any) -> float | None:
    found = [pick(case["evaluation"]) for case in done]
    means = [entry["regions"]["whole"]["mean_mm"] for entry in found if entry is not None]
    return sum(means) / len(means) if means else None
