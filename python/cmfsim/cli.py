"""The command line: `cmfsim solve SCENE -o OUT` and `cmfsim info SCENE`.

Results and `--json` go to standard output, progress and errors to standard error.
Exit codes: 0 done, 1 failed, 2 bad input.
"""

import argparse
import dataclasses
import json
import logging
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmfsim import __version__
from cmfsim.errors import CaseInputError, CmfsimError
from cmfsim.io import read_plan, read_scene, result_suffixes, write_result
from cmfsim.scene import CONTACTS, METHODS, Scene
from cmfsim.simulation import solve_scene

__all__ = ["main"]

DONE, FAILED, BAD_INPUT = 0, 1, 2


def main(arguments: Sequence[str] | None = None) -> int:
    """The exit code of one command: 0 done, 1 failed, 2 bad input.

    Parameters
    ----------
    arguments : sequence of str, optional
        Words after the program's name; those of the process if left out.

    Returns
    -------
    int

    Examples
    --------
    >>> from cmfsim.cli import main
    >>> main(["solve", "no-such-scene.npz", "-o", "out.npz"])
    2
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help(sys.stderr)
        return BAD_INPUT
    handler = _ProgressHandler()
    logger = logging.getLogger("cmfsim")
    previous = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.WARNING if options.quiet else logging.INFO)
    try:
        return _run(options)
    finally:
        logger.removeHandler(handler)
        logger.setLevel(previous)


def _run(options: argparse.Namespace) -> int:
    try:
        if options.command == "solve":
            _solve(options)
        else:
            _info(options)
    except (FileNotFoundError, ValueError) as error:
        _say_error(error)
        return BAD_INPUT
    except (CmfsimError, OSError, MemoryError) as error:
        _say_error(error)
        return FAILED
    except KeyboardInterrupt:
        print("cmfsim: stopped; existing files are as they were", file=sys.stderr)
        return FAILED
    return DONE


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cmfsim",
        description="Soft tissue after cranio-maxillofacial surgery, by the mass-tensor model.",
        epilog="Exit codes: 0 done, 1 failed, 2 bad input. Research software, no medical device.",
    )
    parser.add_argument("--version", action="version", version=f"cmfsim {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("scene", metavar="SCENE", type=Path, help="scene.npz or scene.toml")
    common.add_argument("--json", action="store_true", help="print a JSON object")
    common.add_argument("-q", "--quiet", action="store_true", help="no progress lines")

    solve = commands.add_parser("solve", parents=[common], help="solve a scene")
    solve.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=Path,
        required=True,
        help=f"result file, by its ending {' '.join(result_suffixes())}",
    )
    solve.add_argument("--method", choices=METHODS, help="instead of the scene's own")
    solve.add_argument("--contact", choices=CONTACTS, help="instead of the scene's own")
    solve.add_argument("--tolerance", type=float, help="relative error bound, iterative methods")
    solve.add_argument(
        "--plan", metavar="PLAN", type=Path, help="plan.toml or plan.json instead of the scene's"
    )
    commands.add_parser("info", parents=[common], help="say what a scene holds")
    return parser


def _solve(options: argparse.Namespace) -> None:
    _check_output(options.output, options.scene)
    scene = _with_overrides(_read(options.scene), options)
    started = time.perf_counter()
    result = solve_scene(scene)
    seconds = time.perf_counter() - started
    write_result(options.output, result)
    logging.getLogger("cmfsim").info("wrote %s", options.output)
    summary = dict(result.summary)
    size = np.linalg.norm(result.displacements, axis=1)
    if options.json:
        extra = {"output": str(options.output), "seconds": seconds, "largest": float(size.max())}
        print(json.dumps({**summary, **extra}, allow_nan=False))
        return
    print(f"solved        {summary['n_tets']} tets, {summary['n_unknowns']} unknowns")
    print(f"method        {summary['method']}, {summary['iterations']} iterations")
    print(
        f"residual      {summary['residual']:.2e} (error at most {summary['error_bound']:.2e} mm)"
    )
    if len(result.contact_nodes):
        print(
            f"contact       {len(result.contact_nodes)} nodes, largest gap "
            f"{_number(summary['contact_gap'])} mm, {summary['contact_iterations']} iterations"
        )
    print(f"displacement  {size.max():.3f} mm at most, {size.mean():.3f} mm on average")
    print(f"time          {seconds:.3f} s")


def _check_output(output: Path, scene: Path) -> None:
    """Finds before the work what would spoil its result."""
    if output.suffix not in result_suffixes():
        known = ", ".join(result_suffixes())
        raise CaseInputError(f"{output.name}: results end in {known}, not {output.suffix!r}")
    if not output.parent.is_dir():
        raise FileNotFoundError(f"{output.parent}: no such folder")
    if output.is_dir():
        raise CaseInputError(f"{output}: is a folder")
    if output.exists() and scene.exists() and output.samefile(scene):
        raise CaseInputError(f"{output}: the result would replace the scene; name another file")


def _with_overrides(scene: Scene, options: argparse.Namespace) -> Scene:
    given = {
        name: getattr(options, name)
        for name in ("method", "contact", "tolerance")
        if getattr(options, name) is not None
    }
    changes: dict[str, Any] = {}
    if given:
        changes["options"] = dataclasses.replace(scene.options, **given)
    if options.plan is not None:
        changes["plan"] = read_plan(options.plan, scene)
    return dataclasses.replace(scene, **changes) if changes else scene


def _read(path: Path) -> Scene:
    logging.getLogger("cmfsim").info("reading %s", path)
    return read_scene(path)


def _info(options: argparse.Namespace) -> None:
    scene = _read(options.scene)
    nodes = np.asarray(scene.nodes)
    if options.json:
        counts = {
            name: {"joined": int(np.size(s.joined)), "sliding": int(np.size(s.sliding))}
            for name, s in scene.segments.items()
        }
        print(
            json.dumps(
                {
                    "sha256": scene.sha256(),
                    "n_nodes": scene.n_nodes,
                    "n_tets": scene.n_tets,
                    "n_fixed": int(np.size(scene.fixed)),
                    "lowest": nodes.min(axis=0).tolist() if len(nodes) else None,
                    "highest": nodes.max(axis=0).tolist() if len(nodes) else None,
                    "tissue": scene.header()["tissue"],
                    "segments": counts,
                    "solver": scene.options.as_dict(),
                },
                allow_nan=False,
            )
        )
        return
    print(f"mesh      {scene.n_nodes} nodes, {scene.n_tets} tets")
    if len(nodes):
        low, high = nodes.min(axis=0), nodes.max(axis=0)
        extent = " × ".join(f"{length:.1f}" for length in high - low)
        print(f"extent    {extent} mm")
    print(f"tissue    {', '.join(scene.header()['tissue'].values())}")
    print(f"fixed     {np.size(scene.fixed)} nodes")
    for name, segment in scene.segments.items():
        print(
            f"segment   {_escaped(name)}: {np.size(segment.joined)} joined, "
            f"{np.size(segment.sliding)} sliding"
        )
    print(f"solver    {scene.options.method}, {scene.options.contact} contact")
    print(f"sha256    {scene.sha256()}")


class _ProgressHandler(logging.Handler):
    """Log lines on the standard error of the moment."""

    def emit(self, record: logging.LogRecord) -> None:
        print(f"cmfsim: {_escaped(record.getMessage())}", file=sys.stderr, flush=True)


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.2e}"


def _say_error(error: BaseException) -> None:
    text = str(error) or type(error).__name__
    print(f"cmfsim: error: {_escaped(text)}", file=sys.stderr)


def _escaped(text: str) -> str:
    """A text that cannot steer the terminal: names in files come from strangers."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


if __name__ == "__main__":
    sys.exit(main())
