"""`cmfsim solve` and `cmfsim info`: scenes; `cmfsim demo`: the case in the package."""

import argparse
import dataclasses
import logging
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim.cli import DONE, FAILED
from cmfsim.cli.terminal import Notices, StageProgress, escaped, open_page, print_json, print_text
from cmfsim.errors import CaseInputError
from cmfsim.io import read_plan, read_scene, result_suffixes, write_result
from cmfsim.lab.virtual.demo import DemoCase, write_demo_case
from cmfsim.pipeline.evaluating import evaluate
from cmfsim.pipeline.outputs.results import REPORT_STAGE, WrittenResults, write_results
from cmfsim.pipeline.predicting import prepare
from cmfsim.solving.simulation import solve_scene
from cmfsim.values.finding import Finding
from cmfsim.values.progress import expected_stages
from cmfsim.values.scene import Scene


def solve(options: argparse.Namespace) -> int:
    """Solves a scene and writes its result."""
    _check_output(options.output, options.scene)
    scene = _with_overrides(_read(options.scene), options)
    started = time.perf_counter()
    result = solve_scene(scene)
    seconds = time.perf_counter() - started
    write_result(options.output, result)
    logging.getLogger("cmfsim").info("wrote %s", options.output)
    summary = dict(result.summary)
    Notices(quiet=options.quiet).found(Finding.from_values(entry) for entry in summary["findings"])
    size = np.linalg.norm(result.displacements, axis=1)
    if options.json:
        extra = {"output": str(options.output), "seconds": seconds, "largest": float(size.max())}
        print_json({**summary, **extra})
        return DONE
    print_text(f"solved        {summary['n_tets']} tets, {summary['n_unknowns']} unknowns")
    print_text(f"method        {summary['method']}, {summary['iterations']} iterations")
    print_text(
        f"residual      {summary['residual']:.2e} "
        f"(error {summary['error_estimate']:.2e} mm, estimated)"
    )
    if len(result.contact_nodes):
        gap = summary["contact_gap"]
        gap = "unknown" if gap is None else f"{gap:.2e}"
        print_text(
            f"contact       {len(result.contact_nodes)} nodes, largest gap {gap} mm, "
            f"{summary['contact_iterations']} iterations"
        )
    print_text(f"displacement  {size.max():.3f} mm at most, {size.mean():.3f} mm on average")
    print_text(f"time          {seconds:.3f} s")
    return DONE


def _check_output(output: Path, scene: Path) -> None:
    """Detects invalid options and outputs before the scene is solved."""
    if output.suffix not in result_suffixes():
        known = ", ".join(result_suffixes())
        raise CaseInputError(f"{output.name}: a result file ends in {known}, not {output.suffix!r}")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"{output.parent}: no such folder")
    if output.is_dir():
        raise CaseInputError(f"{output}: is a folder")
    if output.exists() and scene.exists() and output.samefile(scene):
        raise CaseInputError(f"{output}: the result would replace the scene; name another file")


def _with_overrides(scene: Scene, options: argparse.Namespace) -> Scene:
    words = {name: getattr(options, name) for name in ("method", "contact", "tolerance")}
    given = {name: value for name, value in words.items() if value is not None}
    changes: dict[str, Any] = {}
    if given:
        changes["options"] = dataclasses.replace(scene.options, **given)
    if options.plan is not None:
        changes["plan"] = read_plan(options.plan, scene)
    return dataclasses.replace(scene, **changes) if changes else scene


def _read(path: Path) -> Scene:
    logging.getLogger("cmfsim").info("reading %s", path)
    return read_scene(path)


def info(options: argparse.Namespace) -> int:
    """Lists the contents of a scene."""
    scene = _read(options.scene)
    nodes = scene.nodes
    if options.json:
        counts = {
            name: {"joined": int(np.size(s.joined)), "sliding": int(np.size(s.sliding))}
            for name, s in scene.segments.items()
        }
        answer = {
            "sha256": scene.sha256(), "n_nodes": scene.n_nodes, "n_tets": scene.n_tets,
            "n_fixed": int(np.size(scene.fixed)),
            "lowest": nodes.min(axis=0).tolist() if len(nodes) else None,
            "highest": nodes.max(axis=0).tolist() if len(nodes) else None,
            "tissue": scene.header()["tissue"], "segments": counts,
            "solver": scene.options.header(),
        }  # fmt: skip
        print_json(answer)
        return DONE
    print_text("\n".join(map(escaped, repr(scene).split("\n"))))
    if len(nodes):
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        extent = " × ".join(f"{length:.1f}" for length in high - low)
        print_text(f"  extent    {extent} mm")
    print_text(f"  sha256    {scene.sha256()}")
    return DONE


# Without muscles or sliding, with muscles, with both.
DEMO_MODELS = ("H", "M", "M+S")


def demo(options: argparse.Namespace) -> int:
    """Predicts the face of the embedded case, writes its report and opens it."""
    begun = time.perf_counter()
    notices = Notices(quiet=options.quiet)
    each = (f"{work} {model}" for work in ("solving", "writing") for model in DEMO_MODELS)
    expected = expected_stages(*each, "writing the comparison", REPORT_STAGE)
    with StageProgress(sys.stderr, quiet=options.quiet, expected=expected) as progress:
        progress.stage("making a head")
        made = write_demo_case(options.folder, edge_length=options.edge_length)
        prepare(made.case, report=True, evaluation=True)
        written = _work(made, progress, notices)
    notices.found(written.findings)
    name = written.report
    if name is None:
        return FAILED
    # As the folder was given.
    folder, home = Path(options.folder), made.case.file.parent
    case_file = folder / made.case.file.name
    page = folder / (made.case.output / name).relative_to(home)
    seconds = time.perf_counter() - begun
    if options.json:
        answer = {"case": str(case_file), "report": str(page), "seconds": seconds}
        print_json({**answer, "findings": notices.as_dicts()})
        return DONE
    print_text(f"case    {escaped(str(case_file))}")
    for finding in notices.findings:
        if finding.code == "landmarks-proposed":
            print_text(f"note    {escaped(finding.what)}")
    print_text(f"report  {escaped(str(page))}")
    print_text(f"time    {seconds:.0f} s")
    notices.summarise(str(page))
    open_page(page, wanted=not options.no_open)
    return DONE


def _work(made: DemoCase, progress: StageProgress, notices: Notices) -> WrittenResults:
    """Predicts by each model, compares with the truth, and writes everything."""
    found = evaluate(
        made.case,
        DEMO_MODELS,
        progress=progress.stage,
        check=False,
        anatomy=made.anatomy,
        on_findings=notices.found,
    )
    return write_results(
        made.case.output,
        found.predictions,
        DEMO_MODELS,
        stage=progress.stage,
        evaluation=lambda: found,
        # The report shows the pictures of the last model alone.
        pictures=lambda model: model == DEMO_MODELS[-1],
    )
