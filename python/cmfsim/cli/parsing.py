"""The parser of the command line, made from the table of commands and options, `commands.json`."""

import argparse
import json
from collections.abc import Callable, Mapping
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS, __version__
from cmfsim.io import result_suffixes
from cmfsim.io.results.populations import PARTS, TEST
from cmfsim.lab.benchmark.entry_names import ENTRIES, ON_REQUEST
from cmfsim.lab.frontier.choice import EDGES, FACTORS
from cmfsim.lab.virtual.population import TRUTHS
from cmfsim.muscles.template.bodyparts3d import WHERE
from cmfsim.planning.replanning.corrected import CORRECTIONS
from cmfsim.planning.replanning.expected_error import TRIALS
from cmfsim.values.case_parts import PROCEDURES
from cmfsim.values.language import translated
from cmfsim.values.prediction import MODELS
from cmfsim.values.solver_options import CONTACTS
from cmfsim.values.solver_options import MODELS as SOLVED_MODELS

MOST_PORT = 65535
DESCRIPTION = "Predict soft tissue after cranio-maxillofacial surgery with the mass-tensor model."
EXIT_CODES = "Exit codes: 0 done, 1 failed, 2 bad input. For research, not a medical device."
# What the table names instead of repeating it: as $NAME for a value, as {NAME} within a text.
NAMED: Mapping[str, Any] = {
    "ALL_ENTRIES": (*ENTRIES, *ON_REQUEST), "CONTACTS": CONTACTS, "CORRECTIONS": CORRECTIONS,
    "EDGES": EDGES, "ELEMENTS": ELEMENTS, "ENTRIES": list(ENTRIES), "FACTORS": list(FACTORS),
    "KINEMATICS": KINEMATICS, "METHODS": METHODS, "MODELS": MODELS,
    "MODELS_OR_ALL": (*MODELS, "all"), "ON_REQUEST": ON_REQUEST, "PARTS": PARTS,
    "PROCEDURES": tuple(PROCEDURES), "SOLVED_MODELS": SOLVED_MODELS, "SUFFIXES": result_suffixes(),
    "TEST": TEST, "TRIALS": TRIALS, "TRUTHS": TRUTHS, "WHERE": WHERE,
}  # fmt: skip
TEXTS = {n: " ".join(v) if isinstance(v, tuple | list) else v for n, v in NAMED.items()
         if n != "EDGES"}  # fmt: skip
Parser = argparse.ArgumentParser


def make_parser() -> Parser:
    """The parser of every command; `function_of(options.run)` is what does it."""
    parser = Parser(
        prog="cmfsim", description=translated(DESCRIPTION), epilog=translated(EXIT_CODES)
    )
    parser.add_argument("--version", action="version", version=f"cmfsim {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    text = files("cmfsim.cli").joinpath("commands.json").read_text(encoding="utf-8")
    table = json.loads(text)
    for name, command in table["commands"].items():
        _add_command(commands, name, command, table["shared"])
    return parser


def function_of(run: str) -> Callable[[argparse.Namespace], int]:
    """The function of a command: only its module is loaded, and what that needs."""
    module, _, name = run.partition(".")
    function: Callable[[argparse.Namespace], int]
    function = getattr(import_module(f"cmfsim.cli.{module}"), name)
    return function


def _add_command(
    commands: Any, name: str, command: Mapping[str, Any], shared: Mapping[str, Any]
) -> None:
    """Adds a command with its options, or with the actions below it."""
    if "actions" in command:
        parser = commands.add_parser(name, help=command["help"])
        actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
        for word, action in command["actions"].items():
            _add_command(actions, word, action, shared)
        return
    words, epilog = translated(command["help"]), _text(command.get("epilog", ""))
    parser = commands.add_parser(name, help=words, epilog=epilog)
    parser.set_defaults(run=command["run"])
    for entry in command["options"]:
        for option in shared[entry] if isinstance(entry, str) else [entry]:
            _add_option(parser, **option)


def _add_option(parser: Parser, spec: str, help: str, type: str = "", **more: Any) -> None:  # noqa: A002 (keys of the table)
    """Adds an option, or an argument whose name has no dash.

    spec: Its names, and, in capitals, what stands for its value in the help.
    type: "switch", or a name in `KINDS`; a text where there is none.
    """
    names = spec.split()
    if names[-1].isupper() and not names[-1].startswith("-"):
        more["metavar"] = names.pop()
    for key, value in more.items():
        if isinstance(value, str) and value.startswith("$"):
            more[key] = NAMED[value[1:]]
    if isinstance(more.get("metavar"), list):
        more["metavar"] = tuple(more["metavar"])
    if type == "switch":
        more["action"] = "store_true"
    elif type:
        more["type"] = KINDS[type]
    parser.add_argument(*names, help=_text(help), **more)


def _text(words: str) -> str:
    return translated(words.format_map(TEXTS))


def _port(text: str) -> int:
    """A port that a user may listen on; 0 for a free one."""
    if not text.isdecimal() or not (text == "0" or 1024 <= int(text) <= MOST_PORT):
        message = f"{text!r} is no port: use 1024 to {MOST_PORT}, or leave it out for a free one"
        raise argparse.ArgumentTypeError(message)
    return int(text)


KINDS: Mapping[str, Callable[[str], Any]] = {
    "path": Path, "number": float, "whole": int, "port": _port
}  # fmt: skip
