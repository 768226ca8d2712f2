"""`cmfsim template`: muscle templates listed, checked, imported, morphed and shown."""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.cli import BAD_INPUT, DONE
from cmfsim.cli.terminal import StageProgress, escaped, print_findings, print_json, print_text
from cmfsim.errors import CaseInputError
from cmfsim.muscles.template.bodyparts3d import import_bodyparts3d
from cmfsim.muscles.template.checking import check_template, template_names
from cmfsim.muscles.template.muscle_template import MorphedMusculature, MuscleTemplate
from cmfsim.pictures import picture_muscles
from cmfsim.pictures.anatomy import without_side
from cmfsim.values.finding import SEVERITIES
from cmfsim.values.musculature import Musculature

# Landmarks that the table of a morph shows: those that disagree most with the others.
WORST_SHOWN = 5


def list_templates(options: argparse.Namespace) -> int:
    """Lists the templates that come with the package."""
    entries = []
    for name in template_names():
        template = MuscleTemplate.load(name)
        texts = {key: getattr(template, key) for key in ("licence", "attribution", "source")}
        muscles = [muscle.name for muscle in template.muscles]
        entries.append(
            {"name": name, "muscles": muscles, "landmarks": list(template.landmarks), **texts}
        )
    if options.json:
        print_json({"templates": entries})
        return DONE
    for entry in entries:
        counts = f"{len(entry['muscles'])} muscles, {len(entry['landmarks'])} landmarks"
        print_text(f"{entry['name']}: {counts}; {entry['source']}; {entry['licence']}")
    return DONE


def check(options: argparse.Namespace) -> int:
    """Reports problems of a template; the exit code is bad input if any is an error."""
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        progress.stage(f"checking {options.template}")
        findings = check_template(options.template)
    if options.json:
        counts = {f"{s}s": sum(f.severity == s for f in findings) for s in SEVERITIES}
        entries = [dataclasses.asdict(finding) for finding in findings]
        print_json({"template": options.template, **counts, "findings": entries})
    else:
        print_findings(findings, sys.stdout)
    return BAD_INPUT if any(f.severity == "error" for f in findings) else DONE


def import_atlas(options: argparse.Namespace) -> int:
    """Makes a template from the files of an atlas, and writes it with a list of repairs."""
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        template = import_bodyparts3d(
            options.folder,
            options.landmarks,
            verify=not options.any_files,
            progress=lambda name: progress.stage(f"reading {name}"),
        )
        progress.stage("writing")
        report = {
            "template": template.name,
            "licence": template.licence,
            "attribution": template.attribution,
            "muscles": len(template.muscles),
            "findings": [dataclasses.asdict(finding) for finding in template.findings],
        }
        template.save(options.output, report=_beside(options.output, report))
    if options.json:
        print_json({"folder": str(options.output), **report})
        return DONE
    print_findings(template.findings, sys.stdout)
    print_text(
        f"wrote {options.output}: {len(template.muscles)} muscles; {template.licence}, ", end=""
    )
    print_text(template.attribution)
    return DONE


def morph(options: argparse.Namespace) -> int:
    """Maps a template to a patient, and writes muscles, skull and landmark errors."""
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        progress.stage(f"morphing {options.template}")
        template = MuscleTemplate.load(options.template)
        muscles = template.morph(options.landmarks, smoothing=options.smoothing)
        progress.stage("writing")
        report = {
            **muscles.summary(),
            "findings": [dataclasses.asdict(finding) for finding in muscles.findings],
        }
        muscles.save(options.output, report=_beside(options.output, report))
    if options.json:
        print_json({"folder": str(options.output), **report})
        return DONE
    if muscles.findings:
        print_findings(muscles.findings, sys.stdout)
    _print_landmarks(muscles)
    print_text(f"wrote {options.output}: {len(muscles)} muscles")
    return DONE


def show(options: argparse.Namespace) -> int:
    """Draws the muscles of a template on its skull."""
    path = Path(options.output)
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        progress.stage(f"drawing {options.template}")
        template = MuscleTemplate.load(options.template)
        muscles = template.musculature
        if options.only:
            muscles = _chosen(template, options.only)
        picture_muscles(path, muscles, template.skull, fibres=options.fibres)
    if options.json:
        print_json({"picture": str(path), "muscles": [m.name for m in muscles]})
    else:
        print_text(f"wrote {path}: {len(muscles)} muscles")
    return DONE


def _beside(output: Path, report: dict[str, Any]) -> dict[str, Any] | None:
    """The report, if it has a place: next to the files of a folder, not in an archive."""
    return None if output.suffix == ".npz" else report


def _chosen(template: MuscleTemplate, names: Sequence[str]) -> Musculature:
    """The muscles with these names; a name without a side selects both."""
    known = {muscle.name for muscle in template.muscles}
    bare = set(map(without_side, known))
    for name in names:
        if name not in known | bare:
            raise CaseInputError(f"no muscle {name!r}; muscles are: {', '.join(sorted(bare))}")
    return Musculature(
        tuple(m for m in template.muscles if {m.name, without_side(m.name)} & set(names))
    )


def _print_landmarks(muscles: MorphedMusculature) -> None:
    """How well the landmarks agree: the worst ones, by the distance the others would put them."""
    residual = max(muscles.residuals.values())
    print_text(f"{len(muscles.landmarks)} landmarks, matched to {residual:.2g} mm")
    left_out = muscles.leave_one_out
    if left_out is None:
        return
    median = float(np.median(left_out.distances))
    print_text(f"predicted from the others, each is off by {median:.1f} mm (median); worst:")
    for line in left_out.table().splitlines()[: 1 + WORST_SHOWN]:
        print_text(f"  {escaped(line)}")
