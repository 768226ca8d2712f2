"""The commands and the options of the command line."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS, __version__
from cmfsim.cli import (
    case_commands,
    lab_commands,
    landmarks_command,
    plan_command,
    scene_commands,
    study_commands,
    template_commands,
)
from cmfsim.io import result_suffixes
from cmfsim.io.results.populations import PARTS, TEST
from cmfsim.lab.benchmark.entries import ENTRIES, ON_REQUEST
from cmfsim.lab.frontier import EDGES, FACTORS
from cmfsim.lab.virtual.population import TRUTHS
from cmfsim.muscles.template import WHERE
from cmfsim.planning.replanning import CORRECTIONS, TRIALS
from cmfsim.values.anatomy import JAWS
from cmfsim.values.case_parts import PROCEDURES
from cmfsim.values.language import translated
from cmfsim.values.prediction import MODELS
from cmfsim.values.solver_options import CONTACTS
from cmfsim.values.solver_options import MODELS as SOLVED_MODELS

MOST_PORT = 65535
DESCRIPTION = "Predict soft tissue after cranio-maxillofacial surgery with the mass-tensor model."
EXIT_CODES = "Exit codes: 0 done, 1 failed, 2 bad input. For research, not a medical device."
Parser = argparse.ArgumentParser


def option(command: Parser, spec: str, words: str, **more: Any) -> None:
    """Adds an option, or an argument whose name has no dash.

    spec: Its names, and, in capitals, what stands for its value in the help.
    words: Its help.
    """
    names = spec.split()
    if names[-1].isupper() and not names[-1].startswith("-"):
        more["metavar"] = names.pop()
    command.add_argument(*names, help=translated(words), **more)


switch = partial(option, action="store_true")
file = partial(option, type=Path)
number = partial(option, type=float)
whole = partial(option, type=int)
# How `predict`, `evaluate` and `study` take models.
models = partial(option, choices=(*MODELS, "all"), action="append")


def make_parser() -> Parser:
    """The parser of every command; `options.run` is the function that does it."""
    parser = Parser(
        prog="cmfsim", description=translated(DESCRIPTION), epilog=translated(EXIT_CODES)
    )
    parser.add_argument("--version", action="version", version=f"cmfsim {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    common = Parser(add_help=False)
    switch(common, "--json", "print the result, or the error, as a JSON object")
    switch(common, "-q --quiet", "print only warnings and errors, no progress")
    _add_case_commands(commands, common)
    _add_scene_commands(commands, common)
    _add_template_commands(commands, common)
    _add_frontier(commands, common)
    _add_virtual_patients(commands, common)
    _add_benchmark(commands, common)
    return parser


def _command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    words: str,
    parent: Parser,
    *,
    epilog: str | None = None,
) -> Parser:
    """A command with the options of its parent; `words` are its help."""
    more = {"help": translated(words), "epilog": translated(epilog or "")}
    made: Parser = commands.add_parser(name, parents=[parent], **more)
    made.set_defaults(run=run)
    return made


def _add_case_commands(commands: Any, common: Parser) -> None:
    named = Parser(add_help=False, parents=[common])
    file(named, "case CASE", "case.toml, or the folder that contains it")

    _add_first_commands(commands, common)
    words = "check a case, and report how to fix its problems"
    epilog = "Exit codes: 0 no errors found, 2 errors found or the case file cannot be read."
    _command(commands, "doctor", case_commands.doctor, words, named, epilog=epilog)
    _add_landmarks(commands, named)

    changed = Parser(add_help=False, parents=[named])
    file(changed, "-o --output OUT", "output folder (default: that of the case)")
    number(changed, "--edge-length H", "tet edges, mm (default: those of the case)")
    switch(changed, "--no-doctor", "skip the checks of the case")

    words = "build the scene of a case from its images"
    _command(commands, "build", case_commands.build, words, changed)
    _add_predict(commands, changed)
    _add_plan(commands, changed)
    _add_evaluate(commands, changed)
    _add_sensitivity(commands, changed)
    _add_study(commands, common)
    _add_report(commands, common)
    _add_splint(commands, named)
    _add_bite(commands, named)

    words = "write the case of a synthetic head"
    phantom = _command(commands, "phantom", lab_commands.phantom, words, common)
    file(phantom, "folder FOLDER", "output folder")
    whole(phantom, "--person N", "number of the person; each N gives a different head")
    number(phantom, "--spacing MM", "CT voxel size (default 1)", default=1.0)


def _add_first_commands(commands: Any, common: Parser) -> None:
    """`demo`, `init`, `desk` and `view`: what a newcomer needs."""
    words = "predict the face of a built-in case, and open the report"
    demo = _command(commands, "demo", scene_commands.demo, words, common)
    folder = scene_commands.DEMO_FOLDER
    words = f"new, empty or from an earlier demo (default {folder})"
    file(demo, "folder FOLDER", words, nargs="?", default=folder)
    number(demo, "--edge-length H", "tet edges, mm (default 6)", default=6.0)
    switch(demo, "--no-open", "do not open the report")
    demo.set_defaults(models=scene_commands.DEMO_MODELS)

    words = "write a commented case.toml for the files in a folder, or for a 3D Slicer scene"
    epilog = "Anything unclear is written as a line with a question mark, which doctor rejects."
    init = _command(commands, "init", case_commands.init, words, common, epilog=epilog)
    file(init, "folder FOLDER", "folder, or 3D Slicer scene (.mrml, .mrb)")
    switch(init, "--force", "replace an existing case.toml")
    words = "cut by this procedure; again for another"
    option(init, "--cut", words, action="append", default=[], choices=tuple(PROCEDURES))
    words = (
        "move a segment, such as: --move maxilla forwards=4 up=1 pitch=2. Words: forwards, "
        "backwards, up, down, left, right in mm; pitch (front up), yaw (front to the left), roll "
        "(left side up) in degrees, about the teeth or the chin. Again for another segment"
    )
    metavar = ("SEGMENT", "WORD=NUMBER")
    option(init, "--move", words, action="append", default=[], nargs="+", metavar=metavar)

    words = "from a folder with a scan to a saved plan and its report, in the browser"
    epilog = "Everything is saved in the case.toml there. Only this machine can open the page."
    desk = _command(commands, "desk", plan_command.desk, words, common, epilog=epilog)
    file(desk, "folder FOLDER", "folder with a CT or surfaces, or with a case")
    _add_page_options(desk)

    words = "display a prediction, model, scene, result or surface"
    view = _command(commands, "view", case_commands.view, words, common)
    words = "folder written by predict, build or demo; case.toml, scene, result or surface"
    file(view, "path FOLDER_OR_FILE", words)
    words = "which of several predictions (default: the last of H, M, H+S, M+S)"
    option(view, "--model", words, choices=MODELS)
    file(view, "--screenshot PNG", "write a picture instead of opening a window")


def _add_page_options(command: Parser) -> None:
    """Where a page is served, and whether it is opened."""
    words = "port from 1024 to 65535 (default: a free one)"
    option(command, "--port N", words, type=_port, default=0)
    switch(command, "--no-open", "do not open the page")


def _port(text: str) -> int:
    """A port that a user may listen on; 0 for a free one."""
    if not text.isdecimal() or not (text == "0" or 1024 <= int(text) <= MOST_PORT):
        message = f"{text!r} is no port: use 1024 to {MOST_PORT}, or leave it out for a free one"
        raise argparse.ArgumentTypeError(message)
    return int(text)


def _add_band_options(command: Parser) -> None:
    words = "add an uncertainty band of the face to the report, the files and the terminal output"
    switch(command, "--band", words)
    words = (
        "calibration of the band, from cases whose outcome is known; without one, the band "
        "is marked as uncalibrated"
    )
    file(command, "--calibration FILE", words)
    number(command, "--coverage SHARE", "coverage of the band (default 0.9, that is 90 %%)")
    option(command, "--group NAME", "use only the calibration cases of this group")


def _add_study(commands: Any, common: Parser) -> None:
    words = "predict and evaluate every case of a cohort with every model"
    epilog = (
        "Tables and figures of Kim et al. (2010) are written below the cohort's folder: "
        "study.csv, table3.md, figure9.png, figure10.png, and report.html (docs/kim2010.md). With "
        "--variants, the cohort runs as given and once for each named change of settings in FILE, "
        "which has tables such as [variants.soft] with lines such as muscles.young_along = 0.06 "
        "(docs/evaluation.md). Errors of each patient, region and variant, and their changes, are "
        "written to variants.csv, variants.md, variants.json and report.html."
    )
    study = _command(commands, "study", study_commands.study, words, common, epilog=epilog)
    file(study, "cohort COHORT", "cohort.toml, or a folder of cases")
    whole(study, "--workers N", "number of cases processed at a time")
    option(study, "--scheduler ADDRESS", "Dask cluster with access to the same files")
    switch(study, "--fresh", "repeat finished cases")
    words = "H, M, H+S, M+S or all; may be repeated (default: those of the cohort)"
    models(study, "--model MODEL", words)
    file(study, "-o --output OUT", "output folder (default: that of the cohort)")
    words = "compare named changes of any keys of a case file with the cases as given"
    file(study, "--variants FILE", words)


def _add_report(commands: Any, common: Parser) -> None:
    words = "regenerate the report of a results folder"
    report = _command(commands, "report", study_commands.report, words, common)
    file(report, "folder FOLDER", "folder written by predict, or that of its case")
    switch(report, "--pdf", "also write report.pdf, one page for the chart")
    words = (
        "also write report.dcm, that page as DICOM in the study of the CT, whose folder is given"
    )
    file(report, "--dicom CT", words)
    words = "also write the face on its way from before to after: .gif, or .mp4 by ffmpeg"
    file(report, "--animation FILE", words)


def _add_predict(commands: Any, changed: Parser) -> None:
    words = "predict the post-operative face"
    predict = _command(commands, "predict", study_commands.predict, words, changed)
    words = (
        "H (homogeneous), M (muscles), H+S or M+S (with sliding), or all; may be repeated "
        "(default M+S)"
    )
    models(predict, "--model MODEL", words)
    file(predict, "--plan PLAN", "plan.toml to use instead of the case's plan")
    _add_band_options(predict)
    _add_output_options(predict)


def _add_plan(commands: Any, changed: Parser) -> None:
    words = "write a page on which you move the bones and the face follows"
    epilog = "The page is a single file that needs neither a server nor a network."
    plan = _command(commands, "plan", plan_command.plan, words, changed, epilog=epilog)
    option(plan, "--model", "model (default M+S)", choices=MODELS, default="M+S")
    words = f"exact solutions for measuring the error of the page (default {TRIALS})"
    whole(plan, "--trials N", words, default=TRIALS)
    words = (
        "exact solutions for correcting the face at plans other than the case's, if tissue "
        f"slides; 0 for none (default {CORRECTIONS})"
    )
    whole(plan, "--corrections N", words, default=CORRECTIONS)
    words = "find the plan whose face is closest to a surface, or to named skin landmarks"
    file(plan, "--towards FILE", words)
    words = "with --towards: keep the mandible in its planned position relative to the maxilla"
    switch(plan, "--keep-bite", words)
    words = "solve plans exactly while the page is open, on this machine only, until Ctrl-C"
    switch(plan, "--serve", words)
    _add_band_options(plan)
    _add_page_options(plan)


def _add_evaluate(commands: Any, changed: Parser) -> None:
    words = "predict the face, and compare it with the post-operative face"
    evaluate = _command(commands, "evaluate", study_commands.evaluate, words, changed)
    models(evaluate, "--model MODEL", "as in predict (default all)")
    words = (
        "fit one change of thickness (swelling, weight) where nothing was operated on, and "
        "also report the errors with this change"
    )
    switch(evaluate, "--fit-thickness", words)
    _add_output_options(evaluate)


def _add_output_options(command: Parser) -> None:
    """Which files `predict` and `evaluate` write."""
    switch(command, "--no-report", "do not write report.html")
    switch(command, "--slicer", "also write prediction.mrb for 3D Slicer")


def _add_sensitivity(commands: Any, changed: Parser) -> None:
    words = "measure the effect of landmark errors on the face"
    sensitivity = _command(commands, "sensitivity", study_commands.sensitivity, words, changed)
    option(sensitivity, "--model", "model (default M+S)", choices=("M", "M+S"), default="M+S")
    whole(sensitivity, "--trials N", "(default 3)", default=3)
    words = "standard deviation of a landmark along each axis (default 2)"
    number(sensitivity, "--std MM", words, default=2.0)
    whole(sensitivity, "--seed", "random seed (default 0)", default=0)
    words = "landmarks placed again by hand, one file per trial, instead of random ones"
    file(sensitivity, "--landmarks FILE", words, action="append")


def _add_splint(commands: Any, named: Parser) -> None:
    words = "write a surgical splint between the planned tooth rows, as STL"
    epilog = (
        "The teeth must be in the bones of the case. A splint for a closed bite needs room: "
        "the error states by how many degrees the lower jaw has to be opened."
    )
    splint = _command(commands, "splint", plan_command.splint_case, words, named, epilog=epilog)
    words = (
        "the splint after one jaw: maxilla (default) or mandible first; without it, the final "
        "splint with both jaws as planned"
    )
    first = ("maxilla", "mandible")
    option(splint, "--intermediate FIRST", words, nargs="?", const=first[0], choices=first)
    number(splint, "--thickness MM", "least thickness of walls (default 2)")
    words = "open the lower jaw about its joint heads (default 0)"
    number(splint, "--open DEGREES", words, default=0.0)
    option(splint, "--label TEXT", "raised letters on the front", default="")
    names = "splint-final.stl or splint-intermediate.stl"
    _add_plan_and_file(splint, names)


def _add_bite(commands: Any, named: Parser) -> None:
    words = "write the plan in which the lower jaw follows the upper one into the final bite"
    epilog = (
        "Both scans of the teeth are exported in occlusion, in one frame: any. They are "
        "registered to the tooth rows of the case, which must have the teeth."
    )
    bite = _command(commands, "bite", plan_command.bite_case, words, named, epilog=epilog)
    for jaw in JAWS:
        file(bite, f"--{jaw} SCAN", f"{jaw} teeth (default: of [bite])")
    _add_plan_and_file(bite, "bite.toml")


def _add_plan_and_file(command: Parser, names: str) -> None:
    """The plan that `splint` and `bite` take, and the file that they write."""
    file(command, "--plan PLAN", "plan.toml to use instead of the case's plan")
    words = f"file to write (default: {names} among the results of the case)"
    file(command, "-o --out FILE", words)
    switch(command, "--no-doctor", "skip the checks of the case")
    command.set_defaults(edge_length=None, output=None)


def _add_scene_commands(commands: Any, common: Parser) -> None:
    common = Parser(add_help=False, parents=[common])
    file(common, "scene SCENE", "scene.npz or scene.toml")

    solve = _command(commands, "solve", scene_commands.solve, "solve a scene", common)
    words = f"result file; its suffix sets the format: {' '.join(result_suffixes())}"
    file(solve, "-o --output OUT", words, required=True)
    option(solve, "--method", "solver (default: that of the scene)", choices=METHODS)
    option(solve, "--contact", "contact (default: that of the scene)", choices=CONTACTS)
    number(solve, "--tolerance", "relative error of the iterative methods")
    file(solve, "--plan PLAN", "plan.toml or plan.json, instead of the scene's plan")

    _command(commands, "info", scene_commands.info, "list the contents of a scene", common)


def _add_landmarks(commands: Any, named: Parser) -> None:
    words = "find the landmarks of skull and skin, and draw them for checking"
    landmarks = _command(commands, "landmarks", landmarks_command.landmarks, words, named)
    file(landmarks, "-o --output OUT", "output folder (default: that of the case)")
    words = (
        "a head whose landmarks are known (cranium, mandible, skull_landmarks.mrk.json); "
        "may be repeated"
    )
    file(landmarks, "--template FOLDER", words, action="append")
    words = "labels of the files: gonion_L (default), or LGo as in cephalometry and ALI_CBCT"
    option(landmarks, "--names", words, choices=("cmfsim", "ali"), default="cmfsim")
    words = "also write landmarks.html, a page in which the landmarks are checked and placed"
    switch(landmarks, "--page", words)
    switch(landmarks, "--no-open", "do not open the page in the browser")


def _add_template_commands(commands: Any, common: Parser) -> None:
    template = commands.add_parser("template", help="muscle templates: list, check, import, morph")
    actions = template.add_subparsers(dest="action", metavar="ACTION", required=True)
    named = Parser(add_help=False, parents=[common])
    option(named, "template TEMPLATE", "folder, archive or name of a built-in template")

    words = "list the built-in templates"
    _command(actions, "list", template_commands.list_templates, words, common)

    words = "report what is wrong with a template, and how to fix it"
    epilog = "Exit codes: 0 no errors found, 2 errors found or there is no such template."
    _command(actions, "check", template_commands.check, words, named, epilog=epilog)

    words = "make a template from the files of an atlas"
    epilog = f"BodyParts3D: download the OBJ files from {WHERE}."
    imports = _command(
        actions, "import", template_commands.import_atlas, words, common, epilog=epilog
    )
    option(imports, "atlas", "which atlas", choices=["bodyparts3d"])
    file(imports, "folder FOLDER", "folder of the atlas files")
    words = "skull landmarks on the bones of the atlas (.mrk.json)"
    file(imports, "--landmarks FILE", words, required=True)
    file(imports, "-o --output OUT", "folder, or .npz file", required=True)
    switch(imports, "--any-files", "accept files with unknown hashes")

    words = "transfer the muscles of a template to a patient by landmarks"
    morph = _command(actions, "morph", template_commands.morph, words, named)
    file(morph, "landmarks LANDMARKS", "skull landmarks of the patient, .mrk.json or .fcsv")
    file(morph, "-o --output OUT", "folder, or .npz file", required=True)
    number(morph, "--smoothing MM", "0 (default): exact landmarks", default=0.0)

    words = "draw a template's muscles"
    show = _command(actions, "show", template_commands.show, words, named)
    file(show, "-o --output PNG", "picture to write", required=True)
    option(show, "--only NAME", "only these muscles; without _L or _R, both sides", nargs="+")
    switch(show, "--fibres", "draw fibre boxes and directions instead of names")


def _add_frontier(commands: Any, common: Parser) -> None:
    bench = commands.add_parser("bench", help="benchmarks: error against run time")
    actions = bench.add_subparsers(dest="action", metavar="ACTION", required=True)
    words = "measure the run time and the accuracy of each setting of a prediction"
    epilog = "Finished runs are kept in the output folder, so an interrupted sweep is resumed."
    frontier = _command(actions, "frontier", lab_commands.frontier, words, common, epilog=epilog)
    file(frontier, "case CASE", "case.toml (default: a synthetic head)", nargs="?")
    folder = lab_commands.FRONTIER_FOLDER
    file(frontier, "-o --output OUT", f"output folder (default {folder})", default=folder)
    words = "edge length of the base run, mm (default: that of the case)"
    number(frontier, "--edge-length H", words)
    option(frontier, "--model", "model of the base run (default M+S)", choices=MODELS)
    number(frontier, "--edges H", "edge lengths of the grid, mm", nargs="+", default=EDGES)
    for name, known in (("elements", ELEMENTS), ("kinematics", KINEMATICS)):
        words = f"{name} of the grid (default all)"
        option(frontier, f"--{name}", words, choices=known, nargs="+", default=known)
    words = f"settings to vary one at a time, none if empty (default {' '.join(FACTORS)})"
    factors = list(FACTORS)
    option(frontier, "--factors FACTOR", words, choices=FACTORS, nargs="*", default=factors)
    words = "edge length of the reference, mm (default: the smallest of the sweep)"
    number(frontier, "--reference-edge H", words)
    words = "kinematics of the reference (default hyperelastic)"
    option(frontier, "--reference-kinematics", words, choices=KINEMATICS, default="hyperelastic")
    whole(frontier, "--repeats N", "timing rounds (default 3)", default=3)
    whole(frontier, "--threads N", "number of threads (default: all cores)")
    number(frontier, "--time-limit S", "time limit per job, s (default 600)", default=600.0)
    switch(frontier, "--fresh", "repeat finished runs")


def _add_virtual_patients(commands: Any, common: Parser) -> None:
    words = "write virtual patients with their post-operative faces (in silico)"
    epilog = "Existing patients with the same settings are kept."
    run = lab_commands.virtual_patients
    parser = _command(commands, "virtual-patients", run, words, common, epilog=epilog)
    file(parser, "folder FOLDER", "output folder")
    words = "patients, 1 to 6 (default 1 to 4; the lips of 5 and 6 touch, which takes longer)"
    whole(parser, "--patients N", words, nargs="+")
    words = "draw N patients at random (shape, tissue, operation, plan) instead of --patients"
    whole(parser, "--count N", words)
    words = "number of drawn patients made at a time, one process each (default 1)"
    whole(parser, "--workers N", words, default=1)
    whole(parser, "--seed N", "random seed (default 0)", default=0)
    words = (
        "true tissue of drawn patients: their own (default), or the phantom's, whose muscles "
        "and moduli the models assume"
    )
    option(parser, "--truth", words, choices=TRUTHS)
    words = "edge length of the true mesh, mm (default 6)"
    number(parser, "--edge-length H", words, default=6.0)
    number(parser, "--spacing MM", "CT voxel size (default 2)", default=2.0)
    option(parser, "--scheduler ADDRESS", "Dask cluster with access to the same files")


def _add_benchmark(commands: Any, common: Parser) -> None:
    words = "score predictions for a population of virtual patients, by method and region"
    epilog = (
        "To enter a method, add predictions/METHOD/PATIENT.npz (docs/benchmark.md). "
        "Results are written to FOLDER/benchmark; except for the run times, they have "
        "the same bytes each time."
    )
    parser = _command(commands, "benchmark", lab_commands.benchmark, words, common, epilog=epilog)
    file(parser, "folder FOLDER", "folder written by virtual-patients --count")
    words = (
        f"entries of this package to run first, none if empty (default {' '.join(ENTRIES)}; "
        f"{' '.join(ON_REQUEST)} takes longer)"
    )
    known = (*ENTRIES, *ON_REQUEST)
    option(parser, "--entries ENTRY", words, nargs="*", choices=known, default=list(ENTRIES))
    words = (
        "models whose band of 90 %% is calibrated on the part calibration and tested on "
        "the scored patients"
    )
    option(parser, "--band MODEL", words, nargs="+", choices=SOLVED_MODELS, default=[])
    words = "parts on which bands are calibrated (default calibration, unless it is scored)"
    option(parser, "--band-parts PART", words, nargs="*", choices=PARTS)
    option(parser, "--part", "patients to score (default test)", choices=PARTS, default=TEST)
    words = "number of patients predicted at a time, one process each (default 1)"
    whole(parser, "--workers N", words, default=1)
    option(parser, "--scheduler ADDRESS", "Dask cluster with access to the same files")
