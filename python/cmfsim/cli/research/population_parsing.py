"""The options of `cmfsim virtual-patients` and `cmfsim benchmark`."""

import argparse
from pathlib import Path
from typing import Any

from cmfsim.cli.research import benchmark_command, virtual_patients_command
from cmfsim.io.results.populations import PARTS, TEST
from cmfsim.lab.benchmark.entries import ENTRIES, ON_REQUEST
from cmfsim.lab.virtual.population import TRUTHS
from cmfsim.values.model_names import MODELS


def add_population_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    """Adds both commands."""
    _add_virtual_patients(commands, common)
    _add_benchmark(commands, common)


def _add_virtual_patients(commands: Any, common: argparse.ArgumentParser) -> None:
    virtual = commands.add_parser(
        "virtual-patients",
        parents=[common],
        help="write virtual patients with their post-operative faces (in silico)",
        epilog="Existing patients with the same settings are kept.",
    )
    virtual.add_argument("folder", metavar="FOLDER", type=Path, help="output folder")
    virtual.add_argument(
        "--patients",
        metavar="N",
        type=int,
        nargs="+",
        help="patients, 1 to 6 (default 1 to 4; the lips of 5 and 6 touch, which takes longer)",
    )
    virtual.add_argument(
        "--count",
        metavar="N",
        type=int,
        help="draw N patients at random (shape, tissue, operation, plan) instead of --patients",
    )
    virtual.add_argument(
        "--workers",
        metavar="N",
        type=int,
        default=1,
        help="number of drawn patients made at a time, one process each (default 1)",
    )
    virtual.add_argument("--seed", metavar="N", type=int, default=0, help="random seed (default 0)")
    virtual.add_argument(
        "--truth",
        choices=TRUTHS,
        help="true tissue of drawn patients: their own (default), or the phantom's, whose muscles "
        "and moduli the models assume",
    )
    virtual.add_argument(
        "--edge-length",
        metavar="H",
        type=float,
        default=6.0,
        help="edge length of the true mesh, mm (default 6)",
    )
    virtual.add_argument(
        "--spacing", metavar="MM", type=float, default=2.0, help="CT voxel size (default 2)"
    )
    virtual.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask cluster with access to the same files"
    )
    virtual.set_defaults(run=virtual_patients_command.virtual_patients)


def _add_benchmark(commands: Any, common: argparse.ArgumentParser) -> None:
    benchmark = commands.add_parser(
        "benchmark",
        parents=[common],
        help="score predictions for a population of virtual patients, by method and region",
        epilog="To enter a method, add predictions/METHOD/PATIENT.npz (docs/benchmark.md). "
        "Results are written to FOLDER/benchmark; except for the run times, they have "
        "the same bytes each time.",
    )
    benchmark.add_argument(
        "folder", metavar="FOLDER", type=Path, help="folder written by virtual-patients --count"
    )
    benchmark.add_argument(
        "--entries",
        metavar="ENTRY",
        nargs="*",
        choices=(*ENTRIES, *ON_REQUEST),
        default=list(ENTRIES),
        help=f"entries of this package to run first, none if empty (default {' '.join(ENTRIES)}; "
        f"{' '.join(ON_REQUEST)} takes longer)",
    )
    benchmark.add_argument(
        "--band",
        metavar="MODEL",
        nargs="+",
        choices=MODELS,
        default=[],
        help="models whose band of 90 %% is calibrated on the part calibration and tested on "
        "the scored patients",
    )
    benchmark.add_argument(
        "--band-parts",
        metavar="PART",
        nargs="*",
        choices=PARTS,
        help="parts on which bands are calibrated (default calibration, unless it is scored)",
    )
    benchmark.add_argument(
        "--part", choices=PARTS, default=TEST, help="patients to score (default test)"
    )
    benchmark.add_argument(
        "--workers",
        metavar="N",
        type=int,
        default=1,
        help="number of patients predicted at a time, one process each (default 1)",
    )
    benchmark.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask cluster with access to the same files"
    )
    benchmark.set_defaults(run=benchmark_command.benchmark)
