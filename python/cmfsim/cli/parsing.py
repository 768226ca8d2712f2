"""The words of the command line."""

import argparse
from pathlib import Path
from typing import Any

from cmfsim import __version__
from cmfsim.cli import (
    case_commands,
    phantom_command,
    scene_commands,
    virtual_patients_command,
)
from cmfsim.insilico import PATIENTS
from cmfsim.io import result_suffixes
from cmfsim.scene import CONTACTS, METHODS

__all__ = ["make_parser"]


def make_parser() -> argparse.ArgumentParser:
    """The parser of every command; `options.run` is the function that does it."""
    parser = argparse.ArgumentParser(
        prog="cmfsim",
        description="Soft tissue after cranio-maxillofacial surgery, by the mass-tensor model.",
        epilog="Exit codes: 0 done, 1 failed, 2 bad input. Research software, no medical device.",
    )
    parser.add_argument("--version", action="version", version=f"cmfsim {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print a JSON object")
    common.add_argument("-q", "--quiet", action="store_true", help="no progress lines")
    _add_case_commands(commands, common)
    _add_scene_commands(commands, common)
    return parser


def _add_case_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    named = argparse.ArgumentParser(add_help=False, parents=[common])
    named.add_argument("case", metavar="CASE", type=Path, help="case.toml")

    doctor = commands.add_parser(
        "doctor",
        parents=[named],
        help="say what will go wrong with a case, and how to mend it",
        epilog="Exit codes: 0 no errors found, 2 errors found or the case file cannot be read.",
    )
    doctor.set_defaults(run=case_commands.doctor)

    build = commands.add_parser("build", parents=[named], help="build a case: image to scene")
    build.add_argument(
        "-o", "--output", metavar="OUT", type=Path, help="folder instead of the case's own"
    )
    build.add_argument(
        "--edge-length", metavar="H", type=float, help="mm, instead of the case's own"
    )
    build.add_argument("--no-doctor", action="store_true", help="build without checks before")
    build.set_defaults(run=case_commands.build)

    phantom = commands.add_parser(
        "phantom", parents=[common], help="write the case of a head made by code"
    )
    phantom.add_argument("folder", metavar="FOLDER", type=Path, help="made if it is not there")
    phantom.add_argument(
        "--person", metavar="N", type=int, help="another person; the same N is the same person"
    )
    phantom.add_argument(
        "--spacing", metavar="MM", type=float, default=1.0, help="of the CT (default 1)"
    )
    phantom.set_defaults(run=phantom_command.phantom)

    virtual = commands.add_parser(
        "virtual-patients",
        parents=[common],
        help="write virtual patients with the face after their operation (in silico)",
        epilog="Patients who are there already, made with the same settings, are kept.",
    )
    virtual.add_argument("folder", metavar="FOLDER", type=Path, help="made if it is not there")
    virtual.add_argument(
        "--patients",
        metavar="N",
        type=int,
        nargs="+",
        default=sorted(PATIENTS),
        help="which of them (default all)",
    )
    virtual.add_argument(
        "--seed", metavar="N", type=int, default=0, help="of all noise (default 0)"
    )
    virtual.add_argument(
        "--edge-length", metavar="H", type=float, default=3.0, help="mm, true mesh (default 3)"
    )
    virtual.add_argument(
        "--spacing", metavar="MM", type=float, default=1.0, help="of the CT (default 1)"
    )
    virtual.set_defaults(run=virtual_patients_command.virtual_patients)


def _add_scene_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    common = argparse.ArgumentParser(add_help=False, parents=[common])
    common.add_argument("scene", metavar="SCENE", type=Path, help="scene.npz or scene.toml")

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
    solve.set_defaults(run=scene_commands.solve)

    info = commands.add_parser("info", parents=[common], help="say what a scene holds")
    info.set_defaults(run=scene_commands.info)
