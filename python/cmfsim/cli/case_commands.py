"""`cmfsim init`, `doctor`, `build` and `view`: patient cases."""

import argparse
import contextlib
import dataclasses
import logging
import sys
import textwrap
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim._core import TetMesh
from cmfsim.cli import BAD_INPUT, DONE
from cmfsim.cli.terminal import (
    FindingsError,
    Notices,
    StageProgress,
    argument,
    columns,
    escaped,
    print_findings,
    print_json,
    print_text,
)
from cmfsim.doctor import Examination, examine
from cmfsim.drafting import CASE_FILE, init_case, read_moves
from cmfsim.errors import CaseInputError
from cmfsim.io import Case, read_parts, read_result, read_scene, read_surface
from cmfsim.io.results.populations import read_calibration
from cmfsim.io.results.predictions import predictions_of
from cmfsim.io.results.result_files import is_model_file
from cmfsim.pictures import KIND_COLOURS, SKIN_COLOUR, ViewPart, view_parts
from cmfsim.pictures.window import OVER_BONES, prediction_parts
from cmfsim.pipeline.predicting import case_for_models, prepare
from cmfsim.values.anatomy import segment_colours
from cmfsim.values.case_parts import EDGE_LENGTHS
from cmfsim.values.clinical_motion import plan_lines
from cmfsim.values.finding import SEVERITIES, Finding
from cmfsim.values.mesh_report import MeshReport
from cmfsim.values.skin_band import BandOptions
from cmfsim.values.surface_data import SurfaceData
from cmfsim.values.table import Table

# Columns of the text in a pipe, and at most on a terminal.
WIDTH = 100
# Columns before the values, as in the lines of `MeshReport.as_text`.
INDENT = 14
# Distances of a contact surface from the bone beneath.
AWAY = ("mean", "p95", "max")
_log = logging.getLogger(__name__)


def build_text(summary: Mapping[str, Any], *, width: int = WIDTH) -> str:
    """The summary of a `PatientModel` that was written: nodes, mesh, time per stage, files."""
    timings, margin = summary["timings"], " " * INDENT
    times = [f"time          {sum(timings.values()):.1f} s"]
    times += [f"  {seconds:8.2f} s  {escaped(name)}" for name, seconds in timings.items()]
    files = textwrap.wrap(
        ", ".join(escaped(name) for name in summary["files"]),
        max(width, 40),
        initial_indent=margin,
        subsequent_indent=margin,
        break_long_words=False,
        break_on_hyphens=False,
    )
    parts = [
        [f"case          {escaped(summary['case'])}", *_nodes(summary)],
        MeshReport(**summary["mesh"]).as_text().splitlines(),
        times,
        [f"written       {escaped(summary['output'])}", *files],
    ]
    return "\n\n".join("\n".join(part) for part in parts)


def _nodes(summary: Mapping[str, Any]) -> list[str]:
    """Nodes on each segment, and how far contact surfaces are from the bone beneath."""
    kinds = ", ".join(f"{count} {kind}" for kind, count in summary["nodes"].items())
    held = tuple((n, str(s["joined"]), str(s["sliding"])) for n, s in summary["segments"].items())
    tables = [Table(("segment", "joined", "sliding"), held, f"nodes         {kinds}")]
    if summary.get("contact"):
        rows = tuple(
            (name, *(f"{found[f'departure_{key}']:.2f}" for key in AWAY), found["surface"])
            for name, found in summary["contact"].items()
        )
        caption = "contact       departure from bone, mm"
        tables.append(Table(("segment", *AWAY, "surface"), rows, caption))
    return [escaped(line) for table in tables for line in table.text.split("\n")]


def init(options: argparse.Namespace) -> int:
    """Writes the case file, and reports the role assumed for each file."""
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        draft = init_case(
            options.folder,
            force=options.force,
            cuts=options.cut,
            moves=read_moves(options.move),
            progress=progress.stage,
        )
    folder = options.folder if options.folder.is_dir() else options.folder.parent
    case = folder / CASE_FILE
    if options.json:
        print_json({"case": str(case), **draft.as_dict()})
        return DONE
    for entry in draft.taken:
        is_open = entry.question or not entry.taken_for
        details = ", ".join(part for part in (entry.unit, entry.frame) if part)
        head = f"{entry.label}: {entry.taken_for or '?'}{f' ({details})' if details else ''}"
        print_text(f"{'? ' if is_open else '  '}{escaped(head)}")
        print_text(f"      {escaped(entry.why)}")
    print_text(f"case  {escaped(str(case))}")
    for question in draft.questions:
        print_text(f"decide  {escaped(question)}")
    print_text(f"next  cmfsim doctor {argument(case)}")
    return DONE


def doctor(options: argparse.Namespace) -> int:
    """Reports the problems of a case; the exit code is bad input if any is an error."""
    case = Case.load(options.case)
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        progress.stage(f"checking {case.name}")
        found = examine(case)
    findings, plan = found.findings, _plan_values(found)
    if case.image is not None:
        # Of other commands, the work itself follows.
        findings = (*findings, Finding("not-segmented", where=case.where("image")))
    if options.json:
        counts = {f"{s}s": sum(f.severity == s for f in findings) for s in SEVERITIES}
        entries = [dataclasses.asdict(finding) for finding in findings]
        report = {"case": case.name, "file": str(case.file), **counts, "plan": plan}
        print_json({**report, "findings": entries})
    else:
        for line in plan_lines(plan):
            print_text(f"plan: {escaped(line)}")
        print_findings(findings, sys.stdout)
    return BAD_INPUT if _has_errors(findings) else DONE


def build(options: argparse.Namespace) -> int:
    """Builds a case, unless the doctor finds an error in it."""
    case = case_of(options)
    prepare(case, is_model_file)
    begun = time.perf_counter()
    notices, asked = checked(options, case)
    seconds = time.perf_counter() - begun
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        build_case = import_module("cmfsim.pipeline.outputs.model").build_case
        built = build_case(case, progress=progress.stage, **asked)
    summary = dict(built.summary)
    # Those of muscles are noticed after the last stage.
    notices.found(Finding.from_values(entry) for entry in summary["findings"])
    if not options.no_doctor:
        summary["timings"] = {"checking the case": seconds, **summary["timings"]}
    if options.json:
        print_json(summary)
        return DONE
    width = min(columns(), WIDTH) if sys.stdout.isatty() else WIDTH
    print_text(build_text(summary, width=width))
    notices.summarise(str(Path(summary["output"]) / "build.json"))
    return DONE


def case_of(options: argparse.Namespace) -> Case:
    """The case given to a command, with the changes given on the command line."""
    case = Case.load(options.case)
    if not Path(options.case).is_absolute():
        # Results are printed as the case was given.
        case = dataclasses.replace(case, output=case.output.relative_to(Path.cwd()))
    given = vars(options)
    if (edge_length := given.get("edge_length")) is not None:
        low, high = EDGE_LENGTHS
        if not low <= edge_length <= high:
            raise CaseInputError(
                f"--edge-length is {edge_length:g}: must be at least {low:g} and at most "
                f"{high:g} mm"
            )
        mesh = dataclasses.replace(case.mesh, edge_length=edge_length)
        case = dataclasses.replace(case, mesh=mesh)
    if given.get("plan") is not None:
        case = case.with_plan(options.plan)
    if (output := given.get("output")) is not None:
        # A link that the user names is followed, and the folder it leads to is printed.
        output = output.resolve() if output.is_symlink() else output
        case = dataclasses.replace(case, output=output)
    return case


def band_options(options: argparse.Namespace, case: Case) -> BandOptions | None:
    """The band that the command line or the case asks for; the command line comes first."""
    given = (options.calibration, options.coverage, options.group)
    if not (options.band or case.band.asked or any(value is not None for value in given)):
        return None
    file = case.band.calibration if options.calibration is None else options.calibration
    return BandOptions(
        coverage=case.band.coverage if options.coverage is None else options.coverage,
        calibration=None if file is None else read_calibration(file),
        group=case.band.group if options.group is None else options.group,
        source="" if file is None else file.name,
    )


def checked(
    options: argparse.Namespace, case: Case, models: Sequence[str] | None = None
) -> tuple[Notices, dict[str, Any]]:
    """The notices of a command, and how a case is built that the doctor has checked, if asked."""
    notices = Notices(quiet=options.quiet)
    asked: dict[str, Any] = {"check": False, "findings": (), "observer": notices}
    if options.no_doctor:
        return notices, asked
    with StageProgress(sys.stderr, quiet=options.quiet) as progress:
        progress.stage("checking the case")
        found = examine(case if models is None else case_for_models(case, models), models=models)
    if not options.quiet:
        # Before the work: a reversed plan is seen here, not in the face.
        for line in plan_lines(_plan_values(found)):
            print_text(f"cmfsim: plan: {escaped(line)}", file=sys.stderr, flush=True)
    if _has_errors(found.findings):
        raise FindingsError(found.findings)
    notices.found(found.findings)
    return notices, {**asked, "findings": found.findings}


def _plan_values(found: Examination) -> dict[str, Any]:
    return {name: motion.as_dict() for name, motion in found.plan.items()}


def _has_errors(findings: Sequence[Finding]) -> bool:
    return any(finding.severity == "error" for finding in findings)


SURFACES = (".stl", ".ply", ".obj", ".vtp")


def view(options: argparse.Namespace) -> int:
    """Shows the contents of a folder or file, or writes a picture of them."""
    path: Path = options.path
    parts = parts_of(path, options.model)
    view_parts(parts, title=f"{path.name} - cmfsim", screenshot=options.screenshot)
    if options.json:
        names = [part.name for part in parts]
        picture = None if options.screenshot is None else str(options.screenshot)
        print_json({"parts": names, "screenshot": picture})
    elif options.screenshot is not None:
        print_text(f"wrote {options.screenshot}")
    return DONE


def parts_of(path: Path, model: str | None = None) -> list[ViewPart]:
    """The surfaces to show of a folder or file."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder")
    if path.is_dir():
        return _of_folder(path, model)
    if path.name == "prediction.json":
        return prediction_parts(read_parts(path.parent))
    if path.suffix == ".toml" and "cmfsim-case" in path.read_text(encoding="utf-8"):
        output = Case.load(path).output
        if not output.is_dir():
            raise CaseInputError(f"{path}: has no results yet: run cmfsim predict {path} first")
        # A model that was built alone, which holds no prediction, is shown as it is.
        with contextlib.suppress(FileNotFoundError):
            output = import_module("cmfsim.pipeline.outputs.results").results_folder(path)
        return _of_folder(output, model)
    suffix = path.suffix.lower()
    if suffix in SURFACES:
        return [ViewPart(path.stem, read_surface(path), SKIN_COLOUR)]
    if suffix not in {".toml", ".npz"}:
        known = ", ".join((*SURFACES, ".toml", ".npz"))
        raise CaseInputError(f"{path.name}: view displays folders, and files ending in {known}")
    return _of_scene(path) if suffix == ".toml" else _of_archive(path)


def _of_folder(folder: Path, model: str | None) -> list[ViewPart]:
    """A prediction; else those of a folder by model; else a model of a patient; else a case."""
    with contextlib.suppress(FileNotFoundError):
        found = {entry["model"]: place for place, entry in predictions_of(folder).items()}
        if model is not None and model not in found:
            raise CaseInputError(f"{folder}: contains the models {', '.join(found)}, not {model}")
        # The case's own prediction before those in folders by model.
        own = next((name for name, place in found.items() if place == folder), None)
        return prediction_parts(read_parts(found[model or own or [*found][-1]]))
    if (folder / "build.json").exists():
        return _of_model(folder)
    if (folder / "case.toml").exists():
        return parts_of(folder / "case.toml", model)
    raise CaseInputError(
        f"{folder}: contains no prediction.json, build.json or case.toml, so there is nothing to "
        "display"
    )


def _of_model(folder: Path) -> list[ViewPart]:
    bones = {p.stem.removeprefix("segment-"): p for p in sorted(folder.glob("segment-*.ply"))}
    colours = segment_colours(list(bones))
    skin = ViewPart("skin", read_surface(folder / "skin.ply"), SKIN_COLOUR, OVER_BONES)
    return [skin, *(ViewPart(n, read_surface(p), colours[n]) for n, p in bones.items())]


def _of_archive(path: Path) -> list[ViewPart]:
    """A scene or a result: both are archives that state their own type."""
    with np.load(path, allow_pickle=False) as archive:
        names = set(archive.files)
    if "scene" in names:
        return _of_scene(path)
    if "result" not in names:
        raise CaseInputError(f"{path.name}: is neither a scene nor a result of cmfsim")
    result = read_result(path)
    nodes, triangles = result.nodes, result.skin_triangles
    moved = result.displacements
    size = np.linalg.norm(moved, axis=1)
    return [
        ViewPart("after", SurfaceData(nodes + moved, triangles), "#21918c", values=size),
        ViewPart("before", SurfaceData(nodes, triangles), SKIN_COLOUR, shown=False),
    ]


def _of_scene(path: Path) -> list[ViewPart]:
    scene = read_scene(path)
    boundary = TetMesh(scene.nodes, scene.tets).boundary_triangles()
    parts = [ViewPart("tissue", SurfaceData(scene.nodes, boundary), SKIN_COLOUR, OVER_BONES)]
    held = {"fixed": scene.fixed}
    for name, segment in scene.segments.items():
        held[f"{name} joined"] = segment.joined
        held[f"{name} sliding"] = segment.sliding
        if segment.contact is not None:
            parts.append(ViewPart(f"{name} contact", segment.contact, "#e6dcc3", shown=False))
    for name, nodes in held.items():
        touched = boundary[np.isin(boundary, nodes).any(axis=1)]
        if len(touched):
            kind = name.rsplit(" ", 1)[-1]
            parts.append(ViewPart(name, SurfaceData(scene.nodes, touched), KIND_COLOURS[kind]))
    return parts
