"""Errors at the lips, with and without contact of the lips: lip_contact.py FOLDER [--fill PAGE].

FOLDER holds virtual patients as `cmfsim virtual-patients` writes them. Each is predicted by every
model twice, with `contact = false` and `contact = true` in [lips] of its case file, and compared
with its face after the operation. A version without [lips] is run only without contact.
"""

import argparse
import os
import platform
import re
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

import cmfsim
from benches.scenes.marked import publish
from cmfsim.errors import CmfsimError
from cmfsim.evaluation.models import NO_CHANGE
from cmfsim.lab.virtual.population import PATIENTS

REGIONS = ("upper lip", "lower lip", "face")
HEAD = "| patient | lips in contact | region |"
MISSING = "–"
Errors = Mapping[str, Mapping[str, float]]


def has_lip_contact() -> bool:
    """Whether this version reads [lips]."""
    return "lips" in {item.name for item in fields(cmfsim.Case)}


def variant(case: Path, *, contact: bool) -> Path:
    """A copy of a case file beside it that states whether lips are in contact."""
    text = case.read_text(encoding="utf-8")
    if re.search(r"^\[lips\]", text, re.MULTILINE):
        raise SystemExit(f"{case}: has [lips] already; the bench writes that table itself")
    if has_lip_contact():
        text += f"\n[lips]\ncontact = {str(contact).lower()}\n"
    elif contact:
        raise SystemExit("this version knows no [lips]: contact of lips cannot be run")
    made = case.with_name(f"case_lips_{'on' if contact else 'off'}.toml")
    made.write_text(text, encoding="utf-8")
    return made


def errors_of(case: Path, models: Sequence[str]) -> Errors:
    """Mean distance in each region, mm, by model and "no change"; a failed model has none."""
    begin = time.perf_counter()
    found = cmfsim.evaluate(cmfsim.Case.load(case), models)
    for model, why in found.failed.items():
        print(f"{case.parent.name} {model}: {why}", file=sys.stderr, flush=True)
    print(f"{case}: {time.perf_counter() - begin:.0f} s", file=sys.stderr, flush=True)
    regions = found.comparison.regions
    return {
        name: {region: regions[region][name].mean for region in REGIONS}
        for name in found.comparison.errors
    }


def rows_of(patient: str, found: Mapping[bool, Errors], models: Sequence[str]) -> list[str]:
    """The rows of one patient; the least error of each region and row is bold."""
    rows = []
    for contact, errors in found.items():
        for region in REGIONS:
            of_region = {name: errors[name][region] for name in errors}
            least = min(of_region.values())
            cells = []
            for name in (*models, NO_CHANGE):
                value = of_region.get(name)
                text = MISSING if value is None else f"{value:.2f}"
                cells.append(f"**{text}**" if value == least else text)
            head = f"| {patient} | {'yes' if contact else 'no'} | {region} |"
            rows.append(f"{head} {' | '.join(cells)} |")
    return rows


def main(words: Sequence[str] | None = None) -> int:
    """Prints the table, or fills it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="virtual patients")
    everyone = [patient.name for patient in PATIENTS.values()]
    parser.add_argument("--patients", nargs="+", default=everyone, choices=everyone)
    parser.add_argument("--models", nargs="+", default=["H", "M", "H+S", "M+S"])
    parser.add_argument("--fill", type=Path, help="page whose table is rewritten")
    options = parser.parse_args(words)
    choices = (False, True) if has_lip_contact() else (False,)
    rows, failed = [], False
    for patient in options.patients:
        case = options.folder / patient / "case.toml"
        found = {}
        for contact in choices:
            try:
                found[contact] = errors_of(variant(case, contact=contact), options.models)
            except CmfsimError as error:
                print(f"{patient}, contact {contact}: {error}", file=sys.stderr, flush=True)
                failed = True
                rows.append(f"| {patient} | {'yes' if contact else 'no'} | failed: {error} |")
        rows += rows_of(patient, found, options.models)
    names = " | ".join((*options.models, NO_CHANGE))
    lines = [f"{HEAD} {names} |", "| --- | --- | --- |" + " ---: |" * (len(options.models) + 1)]
    note = "" if has_lip_contact() else " Contact of lips is not part of this version."
    text = "\n".join([*lines, *rows]) + (
        f"\n\nMean distance, mm; landmarks as placed. {platform.machine()}, "
        f"{os.cpu_count()} cores, cmfsim {cmfsim.__version__}.{note}\n"
    )
    publish(options.fill, "lip_contact", text)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
