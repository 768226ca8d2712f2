"""The report of one case: plan, pictures, errors, model and files, from its results alone."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from cmfsim.errors import CaseInputError
from cmfsim.report.band import band_section, not_operated_blocks, statistics_table, thickness_blocks
from cmfsim.report.clinical import clinical_sections
from cmfsim.report.document import Alert, Document, Figure, Note, Section, View
from cmfsim.report.page import MEASURES, MESH, MUSCLES, labelled, plan_name, whose
from cmfsim.values.clinical_motion import plan_lines
from cmfsim.values.finding import Finding, counted, grouped
from cmfsim.values.language import translated
from cmfsim.values.table import NOTHING, Table, number

Values = Mapping[str, Any]

MODEL_NAMES: Mapping[str, str] = {
    "H": "homogeneous",
    "M": "muscles",
    "H+S": "homogeneous, sliding",
    "M+S": "muscles, sliding",
}
# The landmark of the soft chin.
CHIN = "pogonion (skin)"
# Pictures in the order of a report, with what they show. The names are those of the files.
PICTURES: Mapping[str, str] = {
    "prediction": "The face before the operation, the predicted face, and how far the skin moves.",
    "lateral": "Profile tracing in the midsagittal plane over a synthetic lateral view: before "
    "(blue), and as planned (red). The view is computed from the surfaces of skin and bones, as "
    "thin shells, in parallel projection without enlargement; it is no radiograph. Planes are "
    "drawn where their sites are known.",
    "band": "Half the width of the band around the predicted skin, mm; grey where no calibration "
    "case has data.",
    "plan": "The plan: bone segments in their planned positions, with outlines of their "
    "original positions.",
    "contacts": "Contacts of the planned tooth rows: signed distance of the crowns, mm; negative "
    "is overlap.",
    "muscles": "The muscles of the template, fitted to the skull by landmarks.",
}

VIEW = (
    "The face before and after, with the bones below it: drag to turn, Shift-drag to move, click "
    "and use the wheel to zoom. Surfaces are simplified for the screen."
)
NO_PICTURES = (
    "This report has no pictures because the machine that wrote it could not draw them. "
    "Pictures need PyVista and OpenGL (pip install '.[view]' in cmfsim's folder; Debian: libgl1, "
    "libegl1)."
)


def case_document(
    predictions: Sequence[Values],
    *,
    shown: str | None = None,
    evaluation: Values | None = None,
    pictures: Mapping[str, bytes] | None = None,
    figures: Sequence[Figure] = (),
    view: tuple[str, str] | None = None,
    left_out: str = "",
) -> Document:
    """The report of a case.

    predictions, evaluation: What `prediction.json` (one per model, all of one plan) and
        `metrics.json` hold.
    shown: The model whose pictures are given, and whose figures stand at the top; else the last.
    pictures: PNG files of the model that is shown, by name, those of `PICTURES` first.
    figures, view: Plots of the evaluation; markup and script policy of a view of the shown model.
    left_out: What does not belong to these predictions and is missing for that.
    Raises `CaseError`: Predictions, or predictions and evaluation, that do not belong together.
    """
    entry = _shown(predictions, shown)
    _check_together(predictions, evaluation)
    pictures = pictures or {}
    models = ", ".join(entry["model"] for entry in predictions)
    files = tuple(entry["inputs"].items())
    appendix = [
        Section("Motions", tuple(motion_blocks(entry))),
        *_muscle_section(entry, predictions, pictures),
        _model_section(predictions, entry),
        _time_section(predictions),
        Section("Inputs", (Table(("file", "SHA-256"), files, "Input files.", numeric=False),)),
    ]
    appended, note = translated("Appendix:"), entry.get("note")
    sections = [
        *([Section("About this case", (Note(note, "warning"),))] if note else []),
        _plan_section(entry, pictures),
        _prediction_section(predictions, entry, pictures, view),
        *clinical_sections(entry, _picture("contacts", pictures)),
        *([band_section(entry["band"], _picture("band", pictures))] if "band" in entry else []),
        *_evaluation_sections(evaluation, figures),
        _finding_section(findings_of(predictions, evaluation)),
        *(replace(s, title=f"{appended} {translated(s.title).lower()}") for s in appendix),
    ]
    versions = ", ".join(f"{name} {version}" for name, version in entry["versions"].items())
    several = "Models" if len(predictions) > 1 else "Model"
    return Document(
        title=f"{entry['case']}: predicted face",
        subtitle=f"{whose(entry)}{translated(several)} {models}. {plan_name(entry)}"
        + translated("Lengths in mm; L is the patient's left, P posterior, S up."),
        facts=_facts(entry, evaluation),
        sections=sections,
        footer=f"Made by {versions}. Mass-tensor model after Kim, Jürgens, Weber, Nolte and Reyes "
        "(2010).",
        alerts=_alerts(findings_of(predictions, evaluation), left_out),
        facts_title=f"Model {_named(entry['model'])}",
    )


def _shown(predictions: Sequence[Values], shown: str | None) -> Values:
    """The prediction whose pictures and figures are shown."""
    if not predictions:
        raise CaseInputError("there is no prediction to report")
    by_model = {entry["model"]: entry for entry in predictions}
    if shown is None:
        return predictions[-1]
    if shown not in by_model:
        raise CaseInputError(f"model {shown!r} is not among those predicted: {', '.join(by_model)}")
    return by_model[shown]


def _check_together(predictions: Sequence[Values], evaluation: Values | None) -> None:
    """Refuses results of different plans, inputs or versions in one report."""
    keys = {entry.get("case_key") for entry in predictions}
    if len(keys) > 1:
        models = ", ".join(entry["model"] for entry in predictions)
        raise CaseInputError(
            f"the predictions of {models} belong to different plans, inputs or versions: "
            "predict all of them again"
        )
    if evaluation is not None and evaluation.get("case_key") not in keys:
        raise CaseInputError(
            "the comparison belongs to another plan, other inputs or another version than the "
            "prediction: run cmfsim evaluate again"
        )


def _named(model: str) -> str:
    return f"{model} ({MODEL_NAMES[model]})"


def _facts(prediction: Values, evaluation: Values | None) -> dict[str, str]:
    """The plan at teeth and chin, and figures of the shown model; errors if it was evaluated."""
    skin, model = prediction["skin"], prediction["model"]
    facts = {}
    for name, motion in prediction["plan"].items():
        shift, _, place = motion["clinical"]["text"].partition(";")[0].partition(" at the ")
        if shift != "stays" and place:
            facts[f"{name} {translated(f'at the {place}')}"] = shift
    chin = [s for s in prediction.get("clinical", {"sites": ()})["sites"] if s["name"] == CHIN]
    for site in chin:
        way = "forwards" if site["forwards_mm"] >= 0.0 else "backwards"
        facts[f"{model}: soft chin"] = f"{abs(site['forwards_mm']):.1f} mm {way}"
    facts[f"{model}: skin moves at most"] = f"{skin['largest']:.1f} mm"
    if "band" in prediction:
        region = prediction["band"]["regions"]
        face = region.get("face") or next(iter(region.values()))
        state = prediction["band"]["state"]
        facts[f"{model}: band of the face, {state}"] = f"± {face['half_width_mean_mm']:.1f} mm"
    if evaluation is not None and model in evaluation["models"]:
        face = evaluation["models"][model]["regions"]["whole"]
        facts[f"{model}: mean error of the face"] = f"{face['mean_mm']:.2f} mm"
        facts[f"{model}: within 2 mm"] = f"{100 * face['within']['2 mm']:.0f} %"
    return facts


def findings_of(predictions: Sequence[Values], evaluation: Values | None) -> list[Finding]:
    """What the stages noticed, the solution of any model and the comparison; each once."""
    entries = [finding for prediction in predictions for finding in prediction["findings"]]
    entries += [] if evaluation is None else evaluation.get("findings", [])
    return [*dict.fromkeys(Finding.from_values(entry) for entry in entries)]


def _alerts(findings: Sequence[Finding], left_out: str) -> list[Alert]:
    """Errors and warnings by kind, and how many notes there are."""
    alerts = [Alert("warning", left_out)] if left_out else []
    for group in grouped(findings):
        if group.severity == "note":
            continue
        several = len(group.findings) > 1
        details = [_sentence(f, with_what=several) for f in group.findings]
        alerts.append(Alert(group.severity, group.text(translated), tuple(d for d in details if d)))
    notes = [finding for finding in findings if finding.severity == "note"]
    if notes:
        lines = tuple(group.text(translated) for group in grouped(notes))
        alerts.append(
            Alert("note", f"{counted(notes)}, listed in full below under Findings", lines)
        )
    return alerts


def _prediction_section(
    predictions: Sequence[Values],
    shown: Values,
    pictures: Mapping[str, bytes],
    view: tuple[str, str] | None,
) -> Section:
    rows = tuple(
        (
            _named(entry["model"]),
            number(entry["skin"]["mean"]),
            number(entry["skin"].get("face_mean")),
            number(entry["skin"]["p95"]),
            number(entry["skin"]["largest"]),
        )
        for entry in predictions
    )
    columns = ("model", "mean", "mean in the face", "95 %", "largest")
    caption = "How far the skin moves, mm: all that is simulated, and the face alone."
    table = Table(columns, rows, caption)
    model = translated(f"Model {shown['model']}.")
    turned = [View(*view, f"{translated(VIEW)} {model}")] if view else []
    drawn: Sequence[Figure | Note] = [
        Figure(figure.image, f"{translated(figure.caption)} {model}")
        for name in ("prediction", "lateral")
        for figure in _picture(name, pictures)
    ]
    return Section("Prediction", (*turned, *(drawn or (Note(NO_PICTURES, "warning"),)), table))


def motion_blocks(prediction: Values) -> list[Note | Table]:
    """The motion of each segment, and how well it was measured where it was."""
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
            bent.append(f"{name} ({number(motion['bending'])} mm RMS)")
    table = Table(
        ("segment", "L", "P", "S", "turn, °", "axis (L, P, S)"),
        tuple(rows),
        "Motion of each bone segment: translation of its centre, mm, and rotation about the "
        "centre.",
    )
    notes = []
    if bent:
        notes.append(
            Note(
                "Moved vertex by vertex (the table has the nearest rigid motion and its "
                f"residual): {', '.join(bent)}."
            )
        )
    return [table, *notes, *_achieved(prediction.get("achieved"))]


def _plan_section(prediction: Values, pictures: Mapping[str, bytes]) -> Section:
    words = [
        Note(line) for line in plan_lines({n: m["clinical"] for n, m in prediction["plan"].items()})
    ]
    return Section("Plan", (*words, *_picture("plan", pictures)))


def _achieved(achieved: Values | None) -> list[Table]:
    """The table of how well each segment was registered to the post-operative bone."""
    if achieved is None:
        return []
    rows = tuple(
        (
            name,
            *(number(found[f"{key}_mm"]) for key in ("rms", "worst", "median", "p95")),
            f"{found['share']:.0%}",
            _size(found.get("shape")),
        )
        for name, found in achieved["segments"].items()
    )
    caption = (
        "The plan was measured on the post-operative bones: remaining distance between each "
        "segment and the bone, mm, and the share of its vertices that are on the bone. RMS and "
        "maximum refer to these vertices, median and 95th percentile to all. Size: "
        "post-operative relative to pre-operative size, with its 95 % interval, which is not part "
        "of the motion; and of the 6 directions of the motion, those that the shape leaves open. "
        "Empty: the motion follows from paired vertices alone."
    )
    heads = ("segment", "RMS", "largest", "median", "P95", "share", "size")
    return [Table(heads, rows, caption)]


def _size(shape: Values | None) -> str:
    """The size of a segment after the operation, with its interval; directions left open."""
    if shape is None:
        return ""
    low, high = shape["scale_interval"]
    left = f", {len(shape['open'])} of 6 open" if shape.get("open") else ""
    return f"{shape['scale']:.3f} ({low:.3f} to {high:.3f}){left}"


def _evaluation_sections(evaluation: Values | None, figures: Sequence[Figure]) -> list[Section]:
    if evaluation is None:
        return []
    blocks: list[Note | Table | Figure] = [
        *not_operated_blocks(evaluation),
        _mean_table(evaluation),
        *thickness_blocks(evaluation),
        *figures,
    ]
    for model, entry in evaluation["models"].items():
        blocks.append(
            statistics_table(
                entry["regions"],
                f"Model {model}: distance of the prediction from the post-operative face, mm.",
            )
        )
    if "no_change" in evaluation:
        blocks.append(
            statistics_table(
                evaluation["no_change"]["regions"],
                "For comparison, the same with the pre-operative face as the prediction, mm.",
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
    caption = "Mean distance from the post-operative face, mm, by region and model."
    method = next(iter(entries.values())).get("comparison", {}).get("method")
    if method in MEASURES:
        caption += f" Measured {MEASURES[method]}."
    return Table(("region", *entries), rows, caption)


def _muscle_section(
    shown: Values, predictions: Sequence[Values], pictures: Mapping[str, bytes]
) -> list[Section]:
    # Muscles are placed once for all models that have them.
    entry = next((e for e in (shown, *predictions) if e["model"].startswith("M")), None)
    if entry is None or "muscles" not in entry:
        return []
    used = entry["muscles"]
    figures = Table.of_pairs(labelled(used, MUSCLES), "How the muscles were placed and sampled.")
    blocks: list[Note | Table | Figure] = [*_picture("muscles", pictures), figures]
    blocks += _moduli(used)
    volumes = used.get("volumes")
    if isinstance(volumes, Mapping) and volumes:
        rows = tuple((name, number(v / 1000.0)) for name, v in volumes.items() if v > 0.0)
        blocks.append(Table(("muscle", "cm³"), rows, "Volume of each muscle within the tissue."))
    return [Section("Muscles", tuple(blocks))]


def _moduli(used: Values) -> list[Note | Table | Figure]:
    """The moduli of fat and muscle, with the muscles that have their own."""
    moduli = used.get("moduli")
    if not isinstance(moduli, Mapping):
        return []  # of an earlier version
    fat = moduli["fat"]
    rows = [("fat", fat["young"], fat["young"], fat["poisson"])]
    rows += [
        (name, m["young_along"], m["young_across"], m["poisson"])
        for name, m in {"muscle": moduli["muscle"], **moduli["muscles"]}.items()
    ]
    return [
        Table(
            ("tissue", "along fibres, MPa", "across, MPa", "Poisson's ratio"),
            tuple((name, *(f"{value:g}" for value in values)) for name, *values in rows),
            "Moduli of fat and muscle before mixing within a tet.",
        )
    ]


def _model_section(predictions: Sequence[Values], shown: Values) -> Section:
    rows = []
    for entry in predictions:
        solved = entry["solution"]
        rows.append(
            (
                entry["model"],
                solved["method"],
                number(solved["n_unknowns"]),
                number(solved["residual"]),
                number(solved["error_estimate"]),
                number(solved["contact_iterations"]),
                number(solved["contact_gap"]),
            )
        )
    columns = (
        "model",
        "method",
        "unknowns",
        "residual",
        "error, mm (estimated)",
        "contact iterations",
        "largest gap, mm",
    )
    solved_table = Table(columns, tuple(rows), "How the equations were solved.")
    segments = tuple(
        (name, number(held["joined"]), number(held["sliding"]))
        for name, held in shown["segments"].items()
    )
    caption = "Nodes on each segment; models without sliding join the nodes that could slide."
    kinds = Table(("segment", "joined", "sliding"), segments, caption)
    mesh = Table.of_pairs(labelled(shown["mesh"], MESH), "The mesh, the same for all models.")
    left_out = [
        Note(f"Model {entry['model']} did not need: " + "; ".join(left))
        for entry in predictions
        if (left := entry.get("left_out"))
    ]
    return Section("Model", (solved_table, kinds, mesh, *left_out))


def _time_section(predictions: Sequence[Values]) -> Section:
    stages = list(dict.fromkeys(s for entry in predictions for s in entry["timings"]))
    rows = [
        (stage, *(number(entry["timings"].get(stage)) for entry in predictions)) for stage in stages
    ]
    rows.append(("sum", *(number(float(sum(entry["timings"].values()))) for entry in predictions)))
    columns = ("stage", *(entry["model"] for entry in predictions))
    note = Note("A case is built once for all its models; each total includes the build time.")
    table = Table(columns, tuple(rows), "Wall time of each stage, s.")
    return Section("Time", (table, *([note] if len(predictions) > 1 else [])))


def _finding_section(findings: Sequence[Finding]) -> Section:
    """Every finding in full, those of one code together, errors first."""
    kinds = {"error": "error", "warning": "warning"}
    blocks = []
    for group in grouped(findings):
        places = [f"{_placed(f).rstrip('. ')}." for f in group.findings]
        reasons = dict.fromkeys(_sentence(f, with_what=False) for f in group.findings)
        lines = [*places, *filter(None, reasons)]
        head = f"{group.severity} [{group.code}]"
        blocks.append(Note("\n".join([head, *lines]), kinds.get(group.severity, "plain")))
    return Section("Findings", tuple(blocks or [Note("No findings.")]))


def _sentence(finding: Finding, *, with_what: bool = True) -> str:
    """What a finding states, where, why it matters and what to do, as far as it does."""
    what = _placed(finding) if with_what else ""
    fix = f"{translated('Fix:')} {translated(finding.fix)}" if finding.fix else ""
    parts = [text.rstrip(". ") for text in (what, translated(finding.why), fix) if text]
    return "".join(f"{text}. " for text in parts).strip()


def _placed(finding: Finding) -> str:
    what = translated(finding.what)
    return f"{what} ({finding.where})" if finding.where else what


def _picture(name: str, pictures: Mapping[str, bytes]) -> list[Figure]:
    return [Figure(pictures[name], PICTURES[name])] if name in pictures else []
