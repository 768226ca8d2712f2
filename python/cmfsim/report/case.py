"""The report of one case: plan, pictures, errors, model and files, from its results alone."""

from collections.abc import Mapping, Sequence
from typing import Any

from cmfsim.clinical_plan import plan_lines
from cmfsim.report.document import NOTHING, Document, Figure, Note, Section, Table, number
from cmfsim.report.labels import MESH, MUSCLES, labelled

__all__ = ["case_document", "statistics_table"]

Values = Mapping[str, Any]

MODEL_NAMES: Mapping[str, str] = {
    "H": "homogeneous",
    "M": "muscles",
    "H+S": "homogeneous, sliding",
    "M+S": "muscles, sliding",
}
# Pictures in the order of a report, with what they show. The names are those of the files.
PICTURES: Mapping[str, str] = {
    "prediction": "The face before the operation and as predicted after it, and how far it moves.",
    "plan": "The plan: bone segments where they are moved to, and before as outlines.",
    "muscles": "The muscles, carried from the template to the skull by its landmarks.",
    "anatomy": "Skin and bone segments.",
    "node_kinds": "Kinds of node (Kim et al. 2010, Figure 4): fixed pink, joined orange, sliding "
    "blue, free white.",
}

NO_PICTURES = (
    "Without pictures: none could be drawn where this was made. PyVista and OpenGL draw them "
    "(pip install 'cmfsim[view]'; Debian: libgl1, libegl1)."
)


def case_document(
    predictions: Sequence[Values],
    *,
    evaluation: Values | None = None,
    pictures: Mapping[str, bytes] | None = None,
    figures: Sequence[Figure] = (),
) -> Document:
    """The report of a case.

    Parameters
    ----------
    predictions : sequence of mapping
        What `prediction.json` holds, one per model; the first one's counts are shown.
    evaluation : mapping, optional
        What `evaluation.json` holds.
    pictures : mapping of str to bytes, optional
        PNG files by name, those of `PICTURES` first.
    figures : sequence of Figure
        Plots of the evaluation.

    Returns
    -------
    Document
    """
    first = predictions[0]
    pictures = pictures or {}
    models = ", ".join(entry["model"] for entry in predictions)
    sections = [
        *_note_section(first),
        _prediction_section(predictions, pictures),
        _plan_section(first, pictures),
        *_evaluation_sections(evaluation, figures),
        *_muscle_section(predictions, pictures),
        _model_section(predictions, pictures),
        _time_section(predictions),
        _finding_section(predictions),
        _input_section(first),
    ]
    versions = ", ".join(f"{name} {version}" for name, version in first["versions"].items())
    return Document(
        title=f"{first['case']}: predicted face",
        subtitle=f"Model {models}. Lengths in mm; L is the patient's left, P posterior, S up.",
        facts=_facts(first, evaluation),
        sections=sections,
        footer=f"Made by {versions}. Mass-tensor model after Kim, Jürgens, Weber, Nolte and Reyes "
        "(2010).",
    )


def _facts(prediction: Values, evaluation: Values | None) -> dict[str, str]:
    skin = prediction["skin"]
    facts = {
        "skin moves at most": f"{skin['largest']:.1f} mm",
        "tets": number(prediction["solution"]["n_tets"]),
        "from files to face": f"{sum(prediction['timings'].values()):.0f} s",
    }
    if evaluation is not None:
        face = evaluation["models"][prediction["model"]]["regions"]["whole"]
        facts["mean error of the face"] = f"{face['mean_mm']:.2f} mm"
        facts["within 2 mm"] = f"{100 * face['within']['2 mm']:.0f} %"
    return facts


def _note_section(prediction: Values) -> list[Section]:
    """What the case's own note says of it."""
    note = prediction.get("note")
    return [Section("About this case", (Note(note, "warning"),))] if note else []


def _prediction_section(predictions: Sequence[Values], pictures: Mapping[str, bytes]) -> Section:
    rows = tuple(
        (
            f"{entry['model']} ({MODEL_NAMES[entry['model']]})",
            number(entry["skin"]["mean"]),
            number(entry["skin"]["p95"]),
            number(entry["skin"]["largest"]),
        )
        for entry in predictions
    )
    table = Table(("model", "mean", "95 %", "largest"), rows, "How far the skin moves, mm.")
    drawn: Sequence[Figure | Note] = [
        Figure(figure.image, f"{figure.caption} Model {predictions[-1]['model']}.")
        for figure in _picture("prediction", pictures)
    ]
    return Section("Prediction", (*(drawn or (Note(NO_PICTURES, "warning"),)), table))


def _plan_section(prediction: Values, pictures: Mapping[str, bytes]) -> Section:
    rows, bent = [], []
    for name, motion in prediction["plan"].items():
        if "translation" in motion:
            cells = [*motion["translation"], motion["angle"]]
            turn = motion["axis"] if motion["angle"] else None
            axis = NOTHING if turn is None else ", ".join(number(value) for value in turn)
            rows.append((name, *(number(value) for value in cells), axis))
        else:
            rows.append((name, "surface", "", "", "", f"mean {number(motion['mean'])} mm"))
        if "bending" in motion:
            bent.append(f"{name} ({number(motion['bending'])} mm rms)")
    table = Table(
        ("segment", "L", "P", "S", "turn, °", "axis (L, P, S)"),
        tuple(rows),
        "Motion of each bone segment: that of its centre, mm, and the turn about it.",
    )
    notes = []
    if bent:
        notes.append(
            Note(
                "Moved vertex by vertex, with the nearest rigid motion in the table and what it "
                f"leaves: {', '.join(bent)}."
            )
        )
    words = [
        Note(line)
        for line in plan_lines(
            # Results of cmfsim 0.1 have no words.
            {n: m["clinical"] for n, m in prediction["plan"].items() if "clinical" in m}
        )
    ]
    return Section(
        "Plan",
        (
            *words,
            *_picture("plan", pictures),
            table,
            *notes,
            *_achieved(prediction.get("achieved")),
        ),
    )


def _achieved(achieved: Values | None) -> list[Note | Table | Figure]:
    """How well each segment was laid on the bone after the operation."""
    if achieved is None:
        return []
    rows = tuple(
        (name, number(found["rms_mm"]), number(found["worst_mm"]), f"{found['share']:.0%}")
        for name, found in achieved["segments"].items()
    )
    caption = (
        "The plan was read off the bones after the operation: what is left between each segment "
        "and that bone, mm, and the share of its vertices that lie on it."
    )
    return [Table(("segment", "RMS", "largest", "share"), rows, caption)]


def _evaluation_sections(evaluation: Values | None, figures: Sequence[Figure]) -> list[Section]:
    if evaluation is None:
        return []
    blocks: list[Note | Table | Figure] = [_mean_table(evaluation), *figures]
    for model, entry in evaluation["models"].items():
        blocks.append(
            statistics_table(
                entry["regions"],
                f"Model {model}: distance of the prediction from the face after the operation, mm.",
            )
        )
    if "no_change" in evaluation:
        blocks.append(
            statistics_table(
                evaluation["no_change"]["regions"],
                "For comparison, the face before the operation taken as the prediction, mm.",
            )
        )
    blocks += [Note(text) for text in evaluation.get("notes", ())]
    return [Section("Error", tuple(blocks))]


def _mean_table(evaluation: Values) -> Table:
    """Mean errors of every model by region."""
    entries = dict(evaluation["models"])
    if "no_change" in evaluation:
        entries["no change"] = evaluation["no_change"]
    regions = list(dict.fromkeys(r for entry in entries.values() for r in entry["regions"]))
    rows = tuple(
        (
            region,
            *(
                number(entry["regions"].get(region, {}).get("mean_mm"))
                for entry in entries.values()
            ),
        )
        for region in regions
    )
    caption = "Mean distance from the face after the operation, mm, by region and model."
    return Table(("region", *entries), rows, caption)


def statistics_table(regions: Mapping[str, Values], caption: str) -> Table:
    """Statistics of signed distances by region.

    Parameters
    ----------
    regions : mapping of str to mapping
        `DistanceStatistics.as_dict()` by region.
    caption : str
    """
    columns = ("region", "mean", "SD", "median", "RMS", "90 %", "95 %", "max", "signed", "< 2 mm")
    keys = ("mean_mm", "std_mm", "median_mm", "rms_mm", "p90_mm", "p95_mm", "max_mm")
    rows = tuple(
        (
            name,
            *(number(values[key]) for key in keys),
            f"{values['signed_mean_mm']:+.2f}",
            f"{100 * values['within']['2 mm']:.0f} %",
        )
        for name, values in regions.items()
    )
    return Table(columns, rows, caption)


def _muscle_section(predictions: Sequence[Values], pictures: Mapping[str, bytes]) -> list[Section]:
    used = next((e["muscles"] for e in predictions if e["model"].startswith("M")), None)
    if used is None:
        return []
    figures = Table.of_pairs(labelled(used, MUSCLES), "How the muscles were placed and sampled.")
    blocks: list[Note | Table | Figure] = [*_picture("muscles", pictures), figures]
    volumes = used.get("volumes")
    if isinstance(volumes, Mapping) and volumes:
        rows = tuple((name, number(v / 1000.0)) for name, v in volumes.items() if v > 0.0)
        blocks.append(Table(("muscle", "cm³"), rows, "Volume of each muscle within the tissue."))
    return [Section("Muscles", tuple(blocks))]


def _model_section(predictions: Sequence[Values], pictures: Mapping[str, bytes]) -> Section:
    rows = []
    for entry in predictions:
        solved = entry["solution"]
        rows.append(
            (
                entry["model"],
                solved["method"],
                number(solved["n_unknowns"]),
                number(solved["residual"]),
                number(solved["error_bound"]),
                number(solved["contact_iterations"]),
                number(solved["contact_gap"]),
            )
        )
    columns = ("model", "method", "unknowns", "residual", "error ≤ mm", "contact its.", "gap, mm")
    solved_table = Table(columns, tuple(rows), "How the equations were solved.")
    first = predictions[0]
    segments = tuple(
        (name, number(held["joined"]), number(held["sliding"]))
        for name, held in first["segments"].items()
    )
    kinds = Table(("segment", "joined", "sliding"), segments, "Nodes held by each segment.")
    mesh = Table.of_pairs(labelled(first["mesh"], MESH), "The mesh.")
    left_out = [
        Note(f"Left out, because the scene did not need it ({entry['model']}): " + "; ".join(left))
        for entry in predictions
        if (left := entry.get("left_out"))
    ]
    blocks = [*_picture("node_kinds", pictures), *_picture("anatomy", pictures)]
    return Section("Model", (*blocks, solved_table, kinds, mesh, *left_out))


def _time_section(predictions: Sequence[Values]) -> Section:
    stages = list(dict.fromkeys(s for entry in predictions for s in entry["timings"]))
    rows = [
        (stage, *(number(entry["timings"].get(stage)) for entry in predictions)) for stage in stages
    ]
    rows.append(("sum", *(number(float(sum(entry["timings"].values()))) for entry in predictions)))
    columns = ("stage", *(entry["model"] for entry in predictions))
    note = Note("A case is built once for all its models; the time of building is in each sum.")
    table = Table(columns, tuple(rows), "Wall time of each stage, s.")
    return Section("Time", (table, *([note] if len(predictions) > 1 else [])))


def _finding_section(predictions: Sequence[Values]) -> Section:
    """What the stages noticed, and the solution of any model; what all share once."""
    found: list[Values] = []
    for prediction in predictions:
        found += [finding for finding in prediction["findings"] if finding not in found]
    kinds = {"error": "error", "warning": "warning"}
    blocks = [
        Note(
            f"{f['severity']}: {f['what']} ({f['where']}). {_reason(f)}".rstrip(),
            kinds.get(f["severity"], "plain"),
        )
        for f in found
    ]
    return Section("Findings", tuple(blocks or [Note("Nothing was noticed.")]))


def _reason(finding: Values) -> str:
    """Why a finding matters and what mends it, as far as it says so."""
    said = "; ".join(text for text in (finding["why"], finding["mend"]) if text)
    return f"{said}." if said else ""


def _input_section(prediction: Values) -> Section:
    rows = tuple(prediction["inputs"].items())
    return Section("Inputs", (Table(("file", "SHA-256"), rows, "What was read.", numeric=False),))


def _picture(name: str, pictures: Mapping[str, bytes]) -> list[Figure]:
    return [Figure(pictures[name], PICTURES[name])] if name in pictures else []
