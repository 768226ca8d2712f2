"""The report of a study of variants: each setting's error, and its change by patient."""

from collections.abc import Mapping, Sequence
from typing import Any

from cmfsim.evaluation.models import NO_CHANGE, WHOLE
from cmfsim.evaluation.regions import REGIONS
from cmfsim.evaluation.statistics import LEAST_PAIRS
from cmfsim.report.document import Document, Note, Section
from cmfsim.report.study import case_alerts
from cmfsim.values.table import NOTHING, Table, plain_line

Values = Mapping[str, Any]
# Variant, model, region and patient of an error.
Key = tuple[str, str, str, str]

# Patients whose errors have a column each; more do not fit on a line.
MOST_COLUMNS = 8
# Regions that are part of no other, in the columns of the table of regions.
COLUMNS = (WHOLE, *(region for region in REGIONS if region != "face"))
METHOD = (
    "Paired by patient: n counts patients, not vertices, which are not independent. Change: mean "
    "of variant minus mean as given over the patients for whom both succeeded; negative is better. "
    "Interval: 95 %, Student's t. p: Wilcoxon's signed-rank test, exact, two-sided, given from "
    f"{LEAST_PAIRS} patients on, because with fewer it cannot fall below 0.05. With many variants, "
    "some p below 0.05 are chance."
)


def _tables(values: Values) -> tuple[list[Table], list[Table]]:
    """A table for each model with all regions, and one for each model and region by patient."""
    rows: dict[Key, Values] = {
        (r["variant"], r["model"], r["region"], r["patient"]): r for r in values["rows"]
    }
    regions = [region for region in COLUMNS if any(key[2] == region for key in rows)]
    models = values["models"]
    return (
        [_regions_table(values, rows, model, regions) for model in models],
        [_patients_table(values, rows, m, region) for m in models for region in regions],
    )


def _patients_table(values: Values, rows: Mapping[Key, Values], model: str, region: str) -> Table:
    """Each patient's mean error by variant, with the change over all of them."""
    patients = values["patients"] if len(values["patients"]) <= MOST_COLUMNS else []
    changes = {
        entry["variant"]: entry
        for entry in values["changes"]
        if (entry["model"], entry["region"]) == (model, region)
    }
    lines = []
    for name, of, variant in _lines(values, model):
        found = {
            patient: rows[variant, of, region, patient]["mean_mm"]
            for patient in values["patients"]
            if (variant, of, region, patient) in rows
        }
        cells = [f"{found[p]:.2f}" if p in found else _absent(values, variant, p) for p in patients]
        mean = f"{sum(found.values()) / len(found):.2f}" if found else NOTHING
        compared = changes.get(variant) if of == model else None
        if compared is not None:
            mean = f"{compared['second_mm']:.2f}"
        lines.append((name, *cells, mean, *_change_cells(compared)))
    return Table(
        ("variant", *patients, "mean", "change", "95 % interval", "n", "better", "p"),
        tuple(lines),
        f"Model {model}, {region}: mean error of each patient, mm",
    )


def _regions_table(
    values: Values, rows: Mapping[Key, Values], model: str, regions: Sequence[str]
) -> Table:
    """The mean error over patients by variant and region, with its change."""
    changes = {
        (entry["variant"], entry["region"]): entry
        for entry in values["changes"]
        if entry["model"] == model
    }
    lines = []
    for name, of, variant in _lines(values, model):
        n = sum((variant, of, WHOLE, patient) in rows for patient in values["patients"])
        if of == model and (variant, WHOLE) in changes:
            n = changes[variant, WHOLE]["n"]
        cells = [str(n)]
        for region in regions:
            change = changes.get((variant, region)) if of == model else None
            found = [
                rows[variant, of, region, patient]["mean_mm"]
                for patient in values["patients"]
                if (variant, of, region, patient) in rows
            ]
            if change is not None:
                cells.append(f"{change['second_mm']:.2f} ({change['change_mm']:+.2f})")
            else:
                cells.append(f"{sum(found) / len(found):.2f}" if found else NOTHING)
        lines.append((name, *cells))
    caption = f"Model {model}: mean error over patients, mm, and in brackets its change"
    return Table(("variant", "n", *regions), tuple(lines), caption)


def _lines(values: Values, model: str) -> list[tuple[str, str, str]]:
    """Label, model and variant of each row of a table: the first takes the face as it was."""
    found = [(NO_CHANGE, NO_CHANGE, values["variants"][0]["name"])]
    for variant in values["variants"]:
        if model in variant["models"]:
            same = len(variant["same"]) == len(values["patients"])
            found.append((variant["name"] + (" (default)" if same else ""), model, variant["name"]))
    return found


def _absent(values: Values, variant: str, patient: str) -> str:
    """Why a patient has no figure."""
    cases = next(v["cases"] for v in values["variants"] if v["name"] == variant)
    failed = any(case["name"] == patient and case["status"] == "failed" for case in cases)
    return "failed" if failed else NOTHING


def _change_cells(entry: Values | None) -> tuple[str, ...]:
    if entry is None:
        return (NOTHING,) * 5
    low_high = entry["interval_mm"]
    interval = NOTHING if low_high is None else f"{low_high[0]:+.2f} to {low_high[1]:+.2f}"
    p = NOTHING if entry["test"] is None else f"{entry['test']['p']:.3g}"
    return (f"{entry['change_mm']:+.2f}", interval, str(entry["n"]), str(entry["n_better"]), p)


def _named_cases(values: Values) -> list[tuple[str, Values, Sequence[str]]]:
    """Each case of each variant, with its warnings."""
    return [
        (f"{variant['name']}, {case['name']}", case, case["warnings"])
        for variant in values["variants"]
        for case in variant["cases"]
    ]


def variants_document(values: Values) -> Document:
    """The report of a study of variants, `VariantsReport.as_dict()`."""
    regions, patients = _tables(values)
    notes = [Note(note, "warning") for note in (values["note"], values["description"]) if note]
    sections = [
        Section("Variants", (*notes, _variants_table(values))),
        Section("Regions", (*regions, Note(METHOD))),
        Section("Patients", tuple(patients)),
    ]
    facts = {
        "patients": str(len(values["patients"])),
        "variants": str(len(values["variants"])),
        "models": ", ".join(values["models"]),
        "time": f"{values['seconds']:.0f} s",
    }
    subtitle = "Errors are distances of the predicted skin from the post-operative skin, mm."
    alerts = case_alerts(_named_cases(values))
    return Document(f"{values['cohort']}: variants", subtitle, facts, sections, alerts=alerts)


def _variants_table(values: Values) -> Table:
    rows = tuple((v["name"], v["words"], v["description"]) for v in values["variants"])
    return Table(("variant", "settings", "description"), rows, numeric=False)


def variants_text(values: Values) -> str:
    """The tables of a study of variants as plain text; the short ones come last."""
    blocks = [note for note in (values["note"], values["description"]) if note]
    regions, patients = _tables(values)
    blocks += [table.text for table in (*patients, *regions)]
    return "\n\n".join([*blocks, METHOD])


def variants_markdown(values: Values) -> str:
    """The tables of a study of variants in Markdown."""
    blocks = [f"# {plain_line(values['cohort'])}: variants"]
    blocks += [plain_line(note) for note in (values["note"], values["description"]) if note]
    blocks.append(_variants_table(values).markdown)
    regions, patients = _tables(values)
    for table in (*regions, *patients):
        blocks += [f"{plain_line(table.caption)}:", table.markdown]
    blocks.append(METHOD)
    blocks += [
        f"{plain_line(name)} failed: {plain_line(case['error'])}"
        for name, case, _ in _named_cases(values)
        if case["status"] == "failed"
    ]
    return "\n\n".join(blocks) + "\n"
