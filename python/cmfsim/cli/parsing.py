"""The options of the command line."""

import argparse
from pathlib import Path
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS, __version__
from cmfsim.cli.band_options import add_band_options
from cmfsim.cli.patients import (
    case_commands,
    demo_command,
    init_command,
    landmarks_command,
    plan_command,
    scene_commands,
    template_commands,
    view_command,
)
from cmfsim.cli.research import bench_command, phantom_command, study_commands
from cmfsim.cli.research.population_commands import add_population_commands
from cmfsim.io import result_suffixes
from cmfsim.lab.frontier import EDGES, FACTORS
from cmfsim.muscles.template import WHERE
from cmfsim.planning.replanning import CORRECTIONS, TRIALS
from cmfsim.values.case_parts import PROCEDURES
from cmfsim.values.prediction import MODELS
from cmfsim.values.solver_options import CONTACTS

MOST_PORT = 65535
# How `predict` and `evaluate` take models.
MODEL_CHOICES: dict[str, Any] = {
    "metavar": "MODEL",
    "choices": (*MODELS, "all"),
    "action": "append",
}


def make_parser() -> argparse.ArgumentParser:
    """The parser of every command; `options.run` is the function that does it."""
    parser = argparse.ArgumentParser(
        prog="cmfsim",
        description="Predict soft tissue after cranio-maxillofacial surgery with the "
        "mass-tensor model.",
        epilog="Exit codes: 0 done, 1 failed, 2 bad input. For research, not a medical device.",
    )
    parser.add_argument("--version", action="version", version=f"cmfsim {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument(
        "--json", action="store_true", help="print the result, or the error, as a JSON object"
    )
    common.add_argument(
        "-q", "--quiet", action="store_true", help="print only warnings and errors, no progress"
    )
    _add_case_commands(commands, common)
    _add_scene_commands(commands, common)
    _add_template_commands(commands, common)
    _add_bench_commands(commands, common)
    add_population_commands(commands, common)
    return parser


def _add_case_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    named = argparse.ArgumentParser(add_help=False, parents=[common])
    named.add_argument(
        "case", metavar="CASE", type=Path, help="case.toml, or the folder that contains it"
    )

    _add_demo(commands, common)
    _add_init(commands, common)
    _add_view(commands, common)

    doctor = commands.add_parser(
        "doctor",
        parents=[named],
        help="check a case, and report how to fix its problems",
        epilog="Exit codes: 0 no errors found, 2 errors found or the case file cannot be read.",
    )
    doctor.set_defaults(run=case_commands.doctor)

    _add_landmarks(commands, named)

    changed = argparse.ArgumentParser(add_help=False, parents=[named])
    changed.add_argument(
        "-o", "--output", metavar="OUT", type=Path, help="output folder (default: that of the case)"
    )
    changed.add_argument(
        "--edge-length", metavar="H", type=float, help="tet edges, mm (default: those of the case)"
    )
    changed.add_argument("--no-doctor", action="store_true", help="skip the checks of the case")

    build = commands.add_parser(
        "build", parents=[changed], help="build the scene of a case from its images"
    )
    build.set_defaults(run=case_commands.build)

    _add_study_commands(commands, common, changed)

    _add_phantom(commands, common)


def _add_demo(commands: Any, common: argparse.ArgumentParser) -> None:
    demo = commands.add_parser(
        "demo", parents=[common], help="predict the face of a built-in case, and open the report"
    )
    demo.add_argument(
        "folder",
        metavar="FOLDER",
        type=Path,
        nargs="?",
        default=demo_command.DEMO_FOLDER,
        help=f"new, empty or from an earlier demo (default {demo_command.DEMO_FOLDER})",
    )
    demo.add_argument(
        "--edge-length", metavar="H", type=float, default=6.0, help="tet edges, mm (default 6)"
    )
    demo.add_argument("--no-open", action="store_true", help="do not open the report")
    demo.set_defaults(run=demo_command.demo, models=demo_command.DEMO_MODELS)


def _add_init(commands: Any, common: argparse.ArgumentParser) -> None:
    init = commands.add_parser(
        "init",
        parents=[common],
        help="write a commented case.toml for the files in a folder, or for a 3D Slicer scene",
        epilog="Anything unclear is written as a line with a question mark, which doctor rejects.",
    )
    init.add_argument(
        "folder", metavar="FOLDER", type=Path, help="folder, or 3D Slicer scene (.mrml, .mrb)"
    )
    init.add_argument("--force", action="store_true", help="replace an existing case.toml")
    init.add_argument(
        "--cut",
        action="append",
        default=[],
        choices=tuple(PROCEDURES),
        help="cut by this procedure; again for another",
    )
    init.add_argument(
        "--move",
        action="append",
        default=[],
        nargs="+",
        metavar=("SEGMENT", "WORD=NUMBER"),
        help="move a segment, such as: --move maxilla forwards=4 up=1 pitch=2. Words: forwards, "
        "backwards, up, down, left, right in mm; pitch (front up), yaw (front to the left), roll "
        "(left side up) in degrees, about the teeth or the chin. Again for another segment",
    )
    init.set_defaults(run=init_command.init)


def _add_view(commands: Any, common: argparse.ArgumentParser) -> None:
    view = commands.add_parser(
        "view", parents=[common], help="display a prediction, model, scene, result or surface"
    )
    view.add_argument(
        "path",
        metavar="FOLDER_OR_FILE",
        type=Path,
        help="folder written by predict, build or demo; case.toml, scene, result or surface",
    )
    view.add_argument(
        "--model",
        choices=MODELS,
        help="which of several predictions (default: the last of H, M, H+S, M+S)",
    )
    view.add_argument(
        "--screenshot", metavar="PNG", type=Path, help="write a picture instead of opening a window"
    )
    view.set_defaults(run=view_command.view)


def _add_phantom(commands: Any, common: argparse.ArgumentParser) -> None:
    phantom = commands.add_parser(
        "phantom", parents=[common], help="write the case of a synthetic head"
    )
    phantom.add_argument("folder", metavar="FOLDER", type=Path, help="output folder")
    phantom.add_argument(
        "--person",
        metavar="N",
        type=int,
        help="number of the person; each N gives a different head",
    )
    phantom.add_argument(
        "--spacing", metavar="MM", type=float, default=1.0, help="CT voxel size (default 1)"
    )
    phantom.set_defaults(run=phantom_command.phantom)


def _add_study_commands(commands: Any, common: Any, changed: argparse.ArgumentParser) -> None:
    _add_predict(commands, changed)
    _add_plan(commands, changed)
    _add_evaluate(commands, changed)
    _add_sensitivity(commands, changed)
    study = commands.add_parser(
        "study",
        parents=[common],
        help="predict and evaluate every case of a cohort with every model",
        epilog="Tables and figures of Kim et al. (2010) are written below the cohort's folder: "
        "study.csv, table3.md, figure9.png, figure10.png, and report.html (docs/kim2010.md). With "
        "--variants, the cohort runs as given and once for each named change of settings in FILE, "
        "which has tables such as [variants.soft] with lines such as muscles.young_along = 0.06 "
        "(docs/evaluation.md). Errors of each patient, region and variant, and their changes, are "
        "written to variants.csv, variants.md, variants.json and report.html.",
    )
    study.add_argument(
        "cohort", metavar="COHORT", type=Path, help="cohort.toml, or a folder of cases"
    )
    study.add_argument(
        "--workers", metavar="N", type=int, help="number of cases processed at a time"
    )
    study.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask cluster with access to the same files"
    )
    study.add_argument("--fresh", action="store_true", help="repeat finished cases")
    study.add_argument(
        "--model",
        **MODEL_CHOICES,
        help="H, M, H+S, M+S or all; may be repeated (default: those of the cohort)",
    )
    study.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=Path,
        help="output folder (default: that of the cohort)",
    )
    study.add_argument(
        "--variants",
        metavar="FILE",
        type=Path,
        help="compare named changes of any keys of a case file with the cases as given",
    )
    study.set_defaults(run=study_commands.study)

    report = commands.add_parser(
        "report", parents=[common], help="regenerate the report of a results folder"
    )
    report.add_argument("folder", metavar="FOLDER", type=Path, help="folder written by predict")
    report.add_argument(
        "--pdf", action="store_true", help="also write report.pdf, one page for the chart"
    )
    report.set_defaults(run=study_commands.report)


def _add_predict(commands: Any, changed: argparse.ArgumentParser) -> None:
    predict = commands.add_parser(
        "predict", parents=[changed], help="predict the post-operative face"
    )
    predict.add_argument(
        "--model",
        **MODEL_CHOICES,
        help="H (homogeneous), M (muscles), H+S or M+S (with sliding), or all; may be repeated "
        "(default M+S)",
    )
    predict.add_argument(
        "--plan", metavar="PLAN", type=Path, help="plan.toml to use instead of the case's plan"
    )
    add_band_options(predict)
    _add_output_options(predict)
    predict.set_defaults(run=study_commands.predict)


def _add_plan(commands: Any, changed: argparse.ArgumentParser) -> None:
    plan = commands.add_parser(
        "plan",
        parents=[changed],
        help="write a page on which you move the bones and the face follows",
        epilog="The page is a single file that needs neither a server nor a network.",
    )
    plan.add_argument("--model", choices=MODELS, default="M+S", help="model (default M+S)")
    plan.add_argument(
        "--trials",
        metavar="N",
        type=int,
        default=TRIALS,
        help=f"exact solutions for measuring the error of the page (default {TRIALS})",
    )
    plan.add_argument(
        "--corrections",
        metavar="N",
        type=int,
        default=CORRECTIONS,
        help="exact solutions for correcting the face at plans other than the case's, if tissue "
        f"slides; 0 for none (default {CORRECTIONS})",
    )
    plan.add_argument(
        "--towards",
        metavar="FILE",
        type=Path,
        help="find the plan whose face is closest to a surface, or to named skin landmarks",
    )
    plan.add_argument(
        "--keep-bite",
        action="store_true",
        help="with --towards: keep the mandible in its planned position relative to the maxilla",
    )
    plan.add_argument(
        "--serve",
        action="store_true",
        help="solve plans exactly while the page is open, on this machine only, until Ctrl-C",
    )
    add_band_options(plan)
    plan.add_argument(
        "--port",
        metavar="N",
        type=_port,
        default=0,
        help="port from 1024 to 65535 (default: a free one)",
    )
    plan.add_argument("--no-open", action="store_true", help="do not open the page")
    plan.set_defaults(run=plan_command.plan)


def _port(text: str) -> int:
    """A port that a user may listen on; 0 for a free one."""
    if not text.isdecimal() or not (text == "0" or 1024 <= int(text) <= MOST_PORT):
        message = f"{text!r} is no port: use 1024 to {MOST_PORT}, or leave it out for a free one"
        raise argparse.ArgumentTypeError(message)
    return int(text)


def _add_evaluate(commands: Any, changed: argparse.ArgumentParser) -> None:
    evaluate = commands.add_parser(
        "evaluate",
        parents=[changed],
        help="predict the face, and compare it with the post-operative face",
    )
    evaluate.add_argument("--model", **MODEL_CHOICES, help="as in predict (default all)")
    evaluate.add_argument(
        "--fit-thickness",
        action="store_true",
        help="fit one change of thickness (swelling, weight) where nothing was operated on, and "
        "also report the errors with this change",
    )
    _add_output_options(evaluate)
    evaluate.set_defaults(run=study_commands.evaluate)


def _add_output_options(command: argparse.ArgumentParser) -> None:
    """Which files `predict` and `evaluate` write."""
    command.add_argument("--no-report", action="store_true", help="do not write report.html")
    command.add_argument(
        "--slicer", action="store_true", help="also write prediction.mrb for 3D Slicer"
    )


def _add_sensitivity(commands: Any, changed: argparse.ArgumentParser) -> None:
    sensitivity = commands.add_parser(
        "sensitivity", parents=[changed], help="measure the effect of landmark errors on the face"
    )
    sensitivity.add_argument(
        "--model", choices=("M", "M+S"), default="M+S", help="model (default M+S)"
    )
    sensitivity.add_argument("--trials", metavar="N", type=int, default=3, help="(default 3)")
    sensitivity.add_argument(
        "--std",
        metavar="MM",
        type=float,
        default=2.0,
        help="standard deviation of a landmark along each axis (default 2)",
    )
    sensitivity.add_argument("--seed", type=int, default=0, help="random seed (default 0)")
    sensitivity.add_argument(
        "--landmarks",
        metavar="FILE",
        type=Path,
        action="append",
        help="landmarks placed again by hand, one file per trial, instead of random ones",
    )
    sensitivity.set_defaults(run=study_commands.sensitivity)


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
        help=f"result file; its suffix sets the format: {' '.join(result_suffixes())}",
    )
    solve.add_argument("--method", choices=METHODS, help="solver (default: that of the scene)")
    solve.add_argument("--contact", choices=CONTACTS, help="contact (default: that of the scene)")
    solve.add_argument("--tolerance", type=float, help="relative error of the iterative methods")
    solve.add_argument(
        "--plan",
        metavar="PLAN",
        type=Path,
        help="plan.toml or plan.json, instead of the scene's plan",
    )
    solve.set_defaults(run=scene_commands.solve)

    info = commands.add_parser("info", parents=[common], help="list the contents of a scene")
    info.set_defaults(run=scene_commands.info)


def _add_landmarks(commands: Any, named: argparse.ArgumentParser) -> None:
    landmarks = commands.add_parser(
        "landmarks",
        parents=[named],
        help="find the landmarks of skull and skin, and draw them for checking",
    )
    landmarks.add_argument(
        "-o", "--output", metavar="OUT", type=Path, help="output folder (default: that of the case)"
    )
    landmarks.add_argument(
        "--template",
        metavar="FOLDER",
        type=Path,
        action="append",
        help="a head whose landmarks are known (cranium, mandible, skull_landmarks.mrk.json); "
        "may be repeated",
    )
    landmarks.add_argument(
        "--names",
        choices=("cmfsim", "ali"),
        default="cmfsim",
        help="labels of the files: gonion_L (default), or LGo as in cephalometry and ALI_CBCT",
    )
    landmarks.add_argument(
        "--page",
        action="store_true",
        help="also write landmarks.html, a page in which the landmarks are checked and placed",
    )
    landmarks.add_argument(
        "--no-open", action="store_true", help="do not open the page in the browser"
    )
    landmarks.set_defaults(run=landmarks_command.landmarks)


def _add_template_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    template = commands.add_parser("template", help="muscle templates: list, check, import, morph")
    actions = template.add_subparsers(dest="action", metavar="ACTION", required=True)
    named = argparse.ArgumentParser(add_help=False, parents=[common])
    named.add_argument(
        "template", metavar="TEMPLATE", help="folder, archive or name of a built-in template"
    )

    listing = actions.add_parser("list", parents=[common], help="list the built-in templates")
    listing.set_defaults(run=template_commands.list_templates)

    check = actions.add_parser(
        "check",
        parents=[named],
        help="report what is wrong with a template, and how to fix it",
        epilog="Exit codes: 0 no errors found, 2 errors found or there is no such template.",
    )
    check.set_defaults(run=template_commands.check)

    _add_template_import(actions, common)
    _add_template_morph(actions, named)
    _add_template_show(actions, named)


def _add_template_import(actions: Any, common: argparse.ArgumentParser) -> None:
    imports = actions.add_parser(
        "import",
        parents=[common],
        help="make a template from the files of an atlas",
        epilog=f"BodyParts3D: download the OBJ files from {WHERE}.",
    )
    imports.add_argument("atlas", choices=["bodyparts3d"], help="which atlas")
    imports.add_argument("folder", metavar="FOLDER", type=Path, help="folder of the atlas files")
    imports.add_argument(
        "--landmarks",
        metavar="FILE",
        type=Path,
        required=True,
        help="skull landmarks on the bones of the atlas (.mrk.json)",
    )
    imports.add_argument(
        "-o", "--output", metavar="OUT", type=Path, required=True, help="folder, or .npz file"
    )
    imports.add_argument(
        "--any-files", action="store_true", help="accept files with unknown hashes"
    )
    imports.set_defaults(run=template_commands.import_atlas)


def _add_template_morph(actions: Any, named: argparse.ArgumentParser) -> None:
    morph = actions.add_parser(
        "morph",
        parents=[named],
        help="transfer the muscles of a template to a patient by landmarks",
    )
    morph.add_argument(
        "landmarks",
        metavar="LANDMARKS",
        type=Path,
        help="skull landmarks of the patient, .mrk.json or .fcsv",
    )
    morph.add_argument(
        "-o", "--output", metavar="OUT", type=Path, required=True, help="folder, or .npz file"
    )
    morph.add_argument(
        "--smoothing", metavar="MM", type=float, default=0.0, help="0 (default): exact landmarks"
    )
    morph.set_defaults(run=template_commands.morph)


def _add_template_show(actions: Any, named: argparse.ArgumentParser) -> None:
    show = actions.add_parser("show", parents=[named], help="draw a template's muscles")
    show.add_argument(
        "-o", "--output", metavar="PNG", type=Path, required=True, help="picture to write"
    )
    show.add_argument(
        "--only", metavar="NAME", nargs="+", help="only these muscles; without _L or _R, both sides"
    )
    show.add_argument(
        "--fibres", action="store_true", help="draw fibre boxes and directions instead of names"
    )
    show.set_defaults(run=template_commands.show)


def _add_bench_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    bench = commands.add_parser("bench", help="benchmarks: error against run time")
    actions = bench.add_subparsers(dest="action", metavar="ACTION", required=True)

    frontier = actions.add_parser(
        "frontier",
        parents=[common],
        help="measure the run time and the accuracy of each setting of a prediction",
        epilog="Finished runs are kept in the output folder, so an interrupted sweep is resumed.",
    )
    frontier.add_argument(
        "case", metavar="CASE", type=Path, nargs="?", help="case.toml (default: a synthetic head)"
    )
    frontier.add_argument(
        "-o",
        "--output",
        metavar="OUT",
        type=Path,
        default=bench_command.FRONTIER_FOLDER,
        help=f"output folder (default {bench_command.FRONTIER_FOLDER})",
    )
    frontier.add_argument(
        "--edge-length",
        metavar="H",
        type=float,
        help="edge length of the base run, mm (default: that of the case)",
    )
    frontier.add_argument("--model", choices=MODELS, help="model of the base run (default M+S)")
    frontier.add_argument(
        "--edges",
        metavar="H",
        type=float,
        nargs="+",
        default=EDGES,
        help="edge lengths of the grid, mm",
    )
    for name, known in (("elements", ELEMENTS), ("kinematics", KINEMATICS)):
        frontier.add_argument(
            f"--{name}",
            choices=known,
            nargs="+",
            default=known,
            help=f"{name} of the grid (default all)",
        )
    frontier.add_argument(
        "--factors",
        choices=FACTORS,
        nargs="*",
        default=list(FACTORS),
        metavar="FACTOR",
        help=f"settings to vary one at a time, none if empty (default {' '.join(FACTORS)})",
    )
    frontier.add_argument(
        "--reference-edge",
        metavar="H",
        type=float,
        help="edge length of the reference, mm (default: the smallest of the sweep)",
    )
    frontier.add_argument(
        "--reference-kinematics",
        choices=KINEMATICS,
        default="hyperelastic",
        help="kinematics of the reference (default hyperelastic)",
    )
    frontier.add_argument(
        "--repeats", metavar="N", type=int, default=3, help="timing rounds (default 3)"
    )
    frontier.add_argument(
        "--threads", metavar="N", type=int, help="number of threads (default: all cores)"
    )
    frontier.add_argument(
        "--time-limit",
        metavar="S",
        type=float,
        default=600.0,
        help="time limit per job, s (default 600)",
    )
    frontier.add_argument("--fresh", action="store_true", help="repeat finished runs")
    frontier.set_defaults(run=bench_command.frontier)
