"""The measures of the face and the movement of landmarks, as tables of a report."""

from collections.abc import Mapping, Sequence
from typing import Any

from cmfsim.report.document import Figure, Note, Section
from cmfsim.values.language import translated
from cmfsim.values.table import NOTHING, Table

Values = Mapping[str, Any]
# A site that moves by less, mm, stays: half of the last digit of the tables.
STAYS = 0.05
TITLES: Mapping[str, str] = {
    "occlusion": "Occlusion",
    "cephalometry": "Cephalometry (midsagittal projection)",
    "face": "Measures of the soft tissue",
}
WAYS = ("forwards", "up", "left")
NORMS = (
    "Norms are means ± standard deviations of small groups of adults or adolescents without "
    "deformity; they are not targets of surgery. Legan and Burstone's nasolabial angle has its own "
    "point on the columella. Without teeth or porion among the landmarks, occlusal and Frankfort "
    "planes are estimated. S, Po, Gn and the tips of roots are not found automatically: add them "
    "to the file of skull landmarks under these names."
)


def clinical_sections(prediction: Values, contacts: Sequence[Figure] = ()) -> list[Section]:
    """The sections on measures, with a picture of contacts, and on landmarks of `prediction.json`.

    There are none in that of older versions.
    """
    found = prediction.get("clinical")
    if found is None:
        return []
    columns = ("measure", "before", "planned", "change", "norm", "norm from")
    blocks: list[Note | Table | Figure] = []
    for kind, title in TITLES.items():
        if kind not in found:
            continue  # of an earlier version
        blocks.append(Table(columns, tuple(measure_rows(found, kind)), f"{title}."))
        blocks += [Note(f"Not available: {text}.") for text in [absent_text(found, kind)] if text]
        if kind == "occlusion":
            blocks += [*_contact_notes(found), *contacts]
    blocks.append(Note(NORMS))
    columns = ("landmark", "moves with", *WAYS, "distance")
    caption = "Movement of each landmark, mm; negative is backwards, down, to the right."
    table = Table(columns, tuple(site_rows(found)), caption)
    still = [site["name"] for site in found["sites"] if _size(site) < STAYS]
    notes = [Note(f"Stay: {', '.join(still)}.")] if still else []
    return [Section("Measures", tuple(blocks)), Section("Landmarks", (table, *notes))]


def _contact_notes(found: Values) -> list[Note]:
    """How the planned tooth rows touch, in words."""
    contacts = found.get("contacts")
    if contacts is None:
        return []  # of an earlier version
    if "absent" in contacts:
        return [Note(f"Contacts of the teeth are not available: {contacts['absent']}.")]
    overlap, count = contacts["greatest_overlap_mm"], contacts["n_contacts"]
    text = f"at least {_text(contacts['least_gap_mm'])} mm lie between them"
    if overlap > 0.0:
        text = f"they overlap by at most {_text(overlap)} mm"
    touch = f"touch at {count} place{'s' if count > 1 else ''}" if count else "do not touch"
    return [Note(f"As planned, the tooth rows {touch}; {text}.")]


def measure_rows(found: Values, kind: str) -> list[tuple[str, ...]]:
    """Label, value before and as planned, change, norm and its source of each known measure."""
    rows = []
    for entry in found.get(kind, ()):
        values = [entry["before"], entry["planned"]]
        if values != [None, None]:
            change = NOTHING if None in values else _text(values[1] - values[0], "+")
            cells = (NOTHING if value is None else _text(value) for value in values)
            norm = (entry["norm"] or NOTHING, entry["source"] or NOTHING)
            # A unit is not parted from its name.
            rows.append(
                (f"{entry['label']},\N{NO-BREAK SPACE}{entry['unit']}", *cells, change, *norm)
            )
    return rows


def absent_text(found: Values, kind: str) -> str:
    """The measures without a value, by the reason; empty if there are none."""
    reasons: dict[str, list[str]] = {}
    for entry in found.get(kind, ()):
        if entry["before"] is None and entry["planned"] is None:
            reasons.setdefault(entry["absent"], []).append(
                f"{translated(entry['label'])}, {entry['unit']}"
            )
    with_and = f" {translated('and')} "
    return "; ".join(
        f"{with_and.join(names)} ({translated(why)})" for why, names in reasons.items()
    )


def site_rows(found: Values) -> list[tuple[str, ...]]:
    """Name, segment, shifts and distance of each landmark that moves."""
    return [
        (
            site["name"],
            site["moves_with"],
            *(_text(site[f"{way}_mm"], "+") for way in WAYS),
            _text(_size(site)),
        )
        for site in found["sites"]
        if _size(site) >= STAYS
    ]


def _size(site: Values) -> float:
    return float(sum(site[f"{way}_mm"] ** 2 for way in WAYS) ** 0.5)


def _text(value: float, sign: str = "-") -> str:
    """A number of one digit; zero without a sign."""
    value = round(value, 1)
    return format(value, f"{sign}.1f").replace("-", "−") if value else "0.0"
