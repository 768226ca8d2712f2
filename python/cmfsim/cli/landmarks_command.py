"""`cmfsim landmarks`: automatic landmarks of a case, with a picture to confirm them."""

import argparse
import json
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.cli.case_commands import print_findings
from cmfsim.cli.exit_codes import DONE
from cmfsim.cli.terminal import StageProgress, escaped
from cmfsim.errors import CmfsimError
from cmfsim.io import Case
from cmfsim.io.landmarks import write_landmarks
from cmfsim.pictures import picture_landmarks
from cmfsim.pipeline.building.inputs import read_anatomy, read_case_landmarks
from cmfsim.pipeline.preparation import prepare
from cmfsim.pipeline.proposing import BY_SHAPE, ProposedHead, proposed_head
from cmfsim.values.finding import Finding
from cmfsim.values.proposed_landmarks import ProposedLandmarks, ProposedSite

__all__ = ["landmarks"]

PICTURE = "landmarks.png"
FILES = {"skull": "skull_landmarks.mrk.json", "skin": "skin_landmarks.mrk.json"}


def landmarks(options: argparse.Namespace) -> int:
    """Proposes the landmarks of a case, writes them and a picture, and reports doubtful ones."""
    case = Case.load(options.case)
    if options.output is not None:
        case = replace(case, output=options.output)
    prepare(case, {*FILES.values(), PICTURE}.__contains__)
    begun = time.perf_counter()
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        anatomy, noticed = read_anatomy(case, {}, progress.stage)
        progress.stage("finding the landmarks")
        head = proposed_head(case, anatomy, progress.stage, options.template or ())
        found = head.landmarks
        if head.anatomy is not anatomy:
            noticed = tuple(finding for finding in noticed if finding.code != BY_SHAPE)
        progress.stage("writing the landmarks")
        written, unwritten = _write(case.output, head)
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
        print(json.dumps(report, allow_nan=False))
        return DONE
    _print(report, found)
    print_findings(findings, sys.stdout)
    return DONE


def _write(folder: Path, head: ProposedHead) -> tuple[list[str], tuple[Finding, ...]]:
    """The names of the files written, and the findings."""
    found = head.landmarks
    folder.mkdir(parents=True, exist_ok=True)
    names, findings = [], []
    for kind, sites in (("skull", found.skull), ("skin", found.skin)):
        if sites:
            texts = {name: _description(site) for name, site in sites.items()}
            points = {name: site.point for name, site in sites.items()}
            write_landmarks(folder / FILES[kind], points, descriptions=texts)
            names.append(FILES[kind])
    doubtful = {
        kind: [name for name, site in sites.items() if site.doubt]
        for kind, sites in (("skull", found.skull), ("skin", found.skin))
    }
    try:
        picture_landmarks(folder / PICTURE, head.bones, head.skin, found.points, doubtful=doubtful)
        names.append(PICTURE)
    except CmfsimError as error:
        findings.append(
            Finding(
                "landmarks-no-picture",
                f"the picture was not drawn: {error}",
                where=str(folder / PICTURE),
            )
        )
    return names, tuple(findings)


def _description(site: ProposedSite) -> str:
    doubt = f"; doubtful: {site.doubt}" if site.doubt else ""
    return f"proposed by cmfsim, not placed by a person; expected error {site.error:.1f} mm{doubt}"


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
    print(f"{len(found.skull)} skull and {len(found.skin)} skin landmarks of {report['case']}")
    for kind, apart in report["from_given"].items():
        values = np.array(list(apart.values()))
        if len(values):
            print(
                f"{kind}: {values.mean():.1f} mm on average from the landmarks of the case, "
                f"{values.max():.1f} mm at most ({max(apart, key=lambda name: apart[name])})"
            )
    for name in report["files"]:
        print(f"wrote {escaped(str(Path(report['output']) / name))}")
