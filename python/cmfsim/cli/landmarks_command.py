"""`cmfsim landmarks`: automatic landmarks of a case, with a picture to confirm them."""

import argparse
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.cli import DONE
from cmfsim.cli.terminal import (
    StageProgress,
    escaped,
    open_page,
    print_findings,
    print_json,
    print_text,
)
from cmfsim.errors import CmfsimError, LandmarkError
from cmfsim.io import Case
from cmfsim.io.landmarks import write_landmarks
from cmfsim.pictures import picture_landmarks
from cmfsim.pipeline.building.inputs import read_anatomy, read_case_landmarks, read_placed_sites
from cmfsim.pipeline.outputs.landmark_page import PAGE_FILE, head_content, write_landmark_page
from cmfsim.pipeline.predicting import prepare
from cmfsim.pipeline.proposing import (
    BY_SHAPE,
    ProposedHead,
    filled_landmarks,
    proposed_head,
    unproposed_head,
)
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import short_name
from cmfsim.values.proposed_landmarks import ProposedLandmarks

PICTURE = "landmarks.png"
FILES = {"skull": "skull_landmarks.mrk.json", "skin": "skin_landmarks.mrk.json"}


def landmarks(options: argparse.Namespace) -> int:
    """Proposes the landmarks of a case, writes them and a picture, and reports doubtful ones."""
    case = Case.load(options.case)
    if options.output is not None:
        case = replace(case, output=options.output)
    prepare(case, {*FILES.values(), PICTURE, PAGE_FILE}.__contains__)
    begun = time.perf_counter()
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        anatomy, noticed = read_anatomy(case, {}, progress.stage)
        progress.stage("finding the landmarks")
        head = _head(options, case, anatomy, progress)
        found = head.landmarks
        if head.anatomy is not anatomy:
            noticed = tuple(finding for finding in noticed if finding.code != BY_SHAPE)
        if case.landmarks.fills and (given := read_placed_sites(case)):
            found = filled_landmarks(head, given)
        progress.stage("writing the landmarks")
        written, unwritten = _write(case.output, replace(head, landmarks=found), options.names)
        if options.page:
            progress.stage("making the page")
            # With what a person has placed in the case's files.
            given = read_placed_sites(case)
            placed = {key: (at, state) for key, (at, state) in given.items() if state.by_person}
            content = head_content(case.name, head, placed)
            size = write_landmark_page(case.output / PAGE_FILE, content)
            written.append(PAGE_FILE)
    findings = (*noticed, *head.findings, *found.findings, *unwritten)
    report = {
        "case": case.name,
        "output": str(case.output),
        "files": written,
        "seconds": time.perf_counter() - begun,
        **_values(found),
        "from_given": _from_given(case, found),
        "findings": [asdict(finding) for finding in findings],
    }
    if options.json:
        print_json(report)
        return DONE
    _print(report, found)
    print_findings(findings, sys.stdout)
    if options.page:
        path = case.output / PAGE_FILE
        print_text(f"page   {escaped(str(path))} ({size / 1e6:.1f} MB): open it in a browser")
        open_page(path, wanted=not options.no_open)
    return DONE


def _head(
    options: argparse.Namespace, case: Case, anatomy: Anatomy, progress: StageProgress
) -> ProposedHead:
    """The head with the landmarks found on it; for a page also if none were found."""
    try:
        return proposed_head(case, anatomy, progress.stage, options.template or ())
    except LandmarkError as error:
        if not options.page:
            raise
        return unproposed_head(anatomy, str(error))


def _write(folder: Path, head: ProposedHead, labels: str) -> tuple[list[str], tuple[Finding, ...]]:
    """The names of the files written, and the findings."""
    found = head.landmarks
    folder.mkdir(parents=True, exist_ok=True)
    names, findings = [], []
    for kind, sites in (("skull", found.skull), ("skin", found.skin)):
        if sites:
            label = {n: n if labels == "cmfsim" else short_name(kind, n) for n in sites}
            texts = {label[name]: site.state.description for name, site in sites.items()}
            points = {label[name]: site.point for name, site in sites.items()}
            write_landmarks(folder / FILES[kind], points, descriptions=texts)
            names.append(FILES[kind])
    kinds = {"skull": found.skull, "skin": found.skin}
    doubtful = {kind: [n for n, site in own.items() if site.doubt] for kind, own in kinds.items()}
    if not found.skull and not found.skin:
        return names, ()
    try:
        picture_landmarks(folder / PICTURE, head.bones, head.skin, found.points, doubtful=doubtful)
        names.append(PICTURE)
    except CmfsimError as error:
        what, where = f"the picture was not drawn: {error}", str(folder / PICTURE)
        findings.append(Finding("landmarks-no-picture", what, where=where))
    return names, tuple(findings)


def _values(found: ProposedLandmarks) -> dict[str, Any]:
    """Points, errors, doubts and missing sites as plain values."""
    values: dict[str, Any] = {}
    for kind, sites, missing in (
        ("skull", found.skull, found.missing_skull),
        ("skin", found.skin, found.missing_skin),
    ):
        values[kind] = {
            name: {"point": site.point.tolist(), "error": site.error, "doubt": site.doubt}
            for name, site in sites.items()
        }
        values[f"missing_{kind}"] = dict(missing)
    return values


def _from_given(case: Case, found: ProposedLandmarks) -> dict[str, dict[str, float]]:
    """Distances of proposed landmarks from those given in the case, mm."""
    given, _ = read_case_landmarks(case)
    return {
        kind: {
            name: float(np.linalg.norm(point - given[kind][name]))
            for name, point in points.items()
            if name in given[kind]
        }
        for kind, points in found.points.items()
        if kind in given
    }


def _print(report: Mapping[str, Any], found: ProposedLandmarks) -> None:
    print_text(f"{len(found.skull)} skull and {len(found.skin)} skin landmarks of {report['case']}")
    for kind, apart in report["from_given"].items():
        values = np.array(list(apart.values()))
        if len(values):
            print_text(
                f"{kind}: {values.mean():.1f} mm on average from the landmarks of the case, "
                f"{values.max():.1f} mm at most ({max(apart, key=lambda name: apart[name])})"
            )
    for name in report["files"]:
        print_text(f"wrote {escaped(str(Path(report['output']) / name))}")
