"""The options of the command line."""

import argparse
from typing import Any

from cmfsim._core import ELEMENTS, KINEMATICS, METHODS, __version__
from cmfsim.cli.options import add_band_options, file, number, switch, whole
from cmfsim.cli.patients import (
    case_commands,
    landmarks_command,
    plan_command,
    scene_commands,
    template_commands,
)
from cmfsim.cli.patients.plan_command import add_bite, add_splint
from cmfsim.cli.research import lab_commands, study_commands
from cmfsim.cli.research.lab_commands import add_population_commands
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
    switch(common, "--json", "print the result, or the error, as a JSON object")
    switch(common, "-q --quiet", "print only warnings and errors, no progress")
    _add_case_commands(commands, common)
    _add_scene_commands(commands, common)
    _add_template_commands(commands, common)
    _add_bench_commands(commands, common)
    add_population_commands(commands, common)
    return parser


def _add_case_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    named = argparse.ArgumentParser(add_help=False, parents=[common])
    file(named, "case", "CASE", "case.toml, or the folder that contains it")

    _add_demo(commands, common)
    _add_init(commands, common)
    _add_desk(commands, common)
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
    file(changed, "-o --output", "OUT", "output folder (default: that of the case)")
    number(changed, "--edge-length", "H", "tet edges, mm (default: those of the case)")
    switch(changed, "--no-doctor", "skip the checks of the case")

    build = commands.add_parser(
        "build", parents=[changed], help="build the scene of a case from its images"
    )
    build.set_defaults(run=case_commands.build)

    _add_study_commands(commands, common, changed)
    add_splint(commands, named)
    add_bite(commands, named)

    _add_phantom(commands, common)


def _add_demo(commands: Any, common: argparse.ArgumentParser) -> None:
    demo = commands.add_parser(
        "demo", parents=[common], help="predict the face of a built-in case, and open the report"
    )
    file(
        demo,
        "folder",
        "FOLDER",
        f"new, empty or from an earlier demo (default {scene_commands.DEMO_FOLDER})",
        nargs="?",
        default=scene_commands.DEMO_FOLDER,
    )
    number(demo, "--edge-length", "H", "tet edges, mm (default 6)", default=6.0)
    switch(demo, "--no-open", "do not open the report")
    demo.set_defaults(run=scene_commands.demo, models=scene_commands.DEMO_MODELS)


def _add_init(commands: Any, common: argparse.ArgumentParser) -> None:
    init = commands.add_parser(
        "init",
        parents=[common],
        help="write a commented case.toml for the files in a folder, or for a 3D Slicer scene",
        epilog="Anything unclear is written as a line with a question mark, which doctor rejects.",
    )
    file(init, "folder", "FOLDER", "folder, or 3D Slicer scene (.mrml, .mrb)")
    switch(init, "--force", "replace an existing case.toml")
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
    init.set_defaults(run=case_commands.init)


def _add_desk(commands: Any, common: argparse.ArgumentParser) -> None:
    desk = commands.add_parser(
        "desk",
        parents=[common],
        help="from a folder with a scan to a saved plan and its report, in the browser",
        epilog="Everything is saved in the case.toml there. Only this machine can open the page.",
    )
    file(desk, "folder", "FOLDER", "folder with a CT or surfaces, or with a case")
    _add_page_options(desk)
    desk.set_defaults(run=plan_command.desk)


def _add_page_options(command: argparse.ArgumentParser) -> None:
    """Where a page is served, and whether it is opened."""
    command.add_argument(
        "--port",
        metavar="N",
        type=_port,
        default=0,
        help="port from 1024 to 65535 (default: a free one)",
    )
    switch(command, "--no-open", "do not open the page")


def _add_view(commands: Any, common: argparse.ArgumentParser) -> None:
    view = commands.add_parser(
        "view", parents=[common], help="display a prediction, model, scene, result or surface"
    )
    file(
        view,
        "path",
        "FOLDER_OR_FILE",
        "folder written by predict, build or demo; case.toml, scene, result or surface",
    )
    view.add_argument(
        "--model",
        choices=MODELS,
        help="which of several predictions (default: the last of H, M, H+S, M+S)",
    )
    file(view, "--screenshot", "PNG", "write a picture instead of opening a window")
    view.set_defaults(run=case_commands.view)


def _add_phantom(commands: Any, common: argparse.ArgumentParser) -> None:
    phantom = commands.add_parser(
        "phantom", parents=[common], help="write the case of a synthetic head"
    )
    file(phantom, "folder", "FOLDER", "output folder")
    whole(phantom, "--person", "N", "number of the person; each N gives a different head")
    number(phantom, "--spacing", "MM", "CT voxel size (default 1)", default=1.0)
    phantom.set_defaults(run=lab_commands.phantom)


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
    file(study, "cohort", "COHORT", "cohort.toml, or a folder of cases")
    whole(study, "--workers", "N", "number of cases processed at a time")
    study.add_argument(
        "--scheduler", metavar="ADDRESS", help="Dask cluster with access to the same files"
    )
    switch(study, "--fresh", "repeat finished cases")
    study.add_argument(
        "--model",
        **MODEL_CHOICES,
        help="H, M, H+S, M+S or all; may be repeated (default: those of the cohort)",
    )
    file(study, "-o --output", "OUT", "output folder (default: that of the cohort)")
    file(
        study,
        "--variants",
        "FILE",
        "compare named changes of any keys of a case file with the cases as given",
    )
    study.set_defaults(run=study_commands.study)

    report = commands.add_parser(
        "report", parents=[common], help="regenerate the report of a results folder"
    )
    file(report, "folder", "FOLDER", "folder written by predict, or that of its case")
    switch(report, "--pdf", "also write report.pdf, one page for the chart")
    file(
        report,
        "--dicom",
        "CT",
        "also write report.dcm, that page as DICOM in the study of the CT, whose folder is given",
    )
    file(
        report,
        "--animation",
        "FILE",
        "also write the face on its way from before to after: .gif, or .mp4 by ffmpeg",
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
    file(predict, "--plan", "PLAN", "plan.toml to use instead of the case's plan")
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
    whole(
        plan,
        "--trials",
        "N",
        f"exact solutions for measuring the error of the page (default {TRIALS})",
        default=TRIALS,
    )
    whole(
        plan,
        "--corrections",
        "N",
        "exact solutions for correcting the face at plans other than the case's, if tissue "
        f"slides; 0 for none (default {CORRECTIONS})",
        default=CORRECTIONS,
    )
    file(
        plan,
        "--towards",
        "FILE",
        "find the plan whose face is closest to a surface, or to named skin landmarks",
    )
    switch(
        plan,
        "--keep-bite",
        "with --towards: keep the mandible in its planned position relative to the maxilla",
    )
    switch(
        plan,
        "--serve",
        "solve plans exactly while the page is open, on this machine only, until Ctrl-C",
    )
    add_band_options(plan)
    _add_page_options(plan)
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
    switch(
        evaluate,
        "--fit-thickness",
        "fit one change of thickness (swelling, weight) where nothing was operated on, and "
        "also report the errors with this change",
    )
    _add_output_options(evaluate)
    evaluate.set_defaults(run=study_commands.evaluate)


def _add_output_options(command: argparse.ArgumentParser) -> None:
    """Which files `predict` and `evaluate` write."""
    switch(command, "--no-report", "do not write report.html")
    switch(command, "--slicer", "also write prediction.mrb for 3D Slicer")


def _add_sensitivity(commands: Any, changed: argparse.ArgumentParser) -> None:
    sensitivity = commands.add_parser(
        "sensitivity", parents=[changed], help="measure the effect of landmark errors on the face"
    )
    sensitivity.add_argument(
        "--model", choices=("M", "M+S"), default="M+S", help="model (default M+S)"
    )
    whole(sensitivity, "--trials", "N", "(default 3)", default=3)
    number(
        sensitivity,
        "--std",
        "MM",
        "standard deviation of a landmark along each axis (default 2)",
        default=2.0,
    )
    sensitivity.add_argument("--seed", type=int, default=0, help="random seed (default 0)")
    file(
        sensitivity,
        "--landmarks",
        "FILE",
        "landmarks placed again by hand, one file per trial, instead of random ones",
        action="append",
    )
    sensitivity.set_defaults(run=study_commands.sensitivity)


def _add_scene_commands(commands: Any, common: argparse.ArgumentParser) -> None:
    common = argparse.ArgumentParser(add_help=False, parents=[common])
    file(common, "scene", "SCENE", "scene.npz or scene.toml")

    solve = commands.add_parser("solve", parents=[common], help="solve a scene")
    file(
        solve,
        "-o --output",
        "OUT",
        f"result file; its suffix sets the format: {' '.join(result_suffixes())}",
        required=True,
    )
    solve.add_argument("--method", choices=METHODS, help="solver (default: that of the scene)")
    solve.add_argument("--contact", choices=CONTACTS, help="contact (default: that of the scene)")
    solve.add_argument("--tolerance", type=float, help="relative error of the iterative methods")
    file(solve, "--plan", "PLAN", "plan.toml or plan.json, instead of the scene's plan")
    solve.set_defaults(run=scene_commands.solve)

    info = commands.add_parser("info", parents=[common], help="list the contents of a scene")
    info.set_defaults(run=scene_commands.info)


def _add_landmarks(commands: Any, named: argparse.ArgumentParser) -> None:
    landmarks = commands.add_parser(
        "landmarks",
        parents=[named],
        help="find the landmarks of skull and skin, and draw them for checking",
    )
    file(landmarks, "-o --output", "OUT", "output folder (default: that of the case)")
    file(
        landmarks,
        "--template",
        "FOLDER",
        "a head whose landmarks are known (cranium, mandible, skull_landmarks.mrk.json); "
        "may be repeated",
        action="append",
    )
    landmarks.add_argument(
        "--names",
        choices=("cmfsim", "ali"),
        default="cmfsim",
        help="labels of the files: gonion_L (default), or LGo as in cephalometry and ALI_CBCT",
    )
    switch(
        landmarks,
        "--page",
        "also write landmarks.html, a page in which the landmarks are checked and placed",
    )
    switch(landmarks, "--no-open", "do not open the page in the browser")
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
    file(imports, "folder", "FOLDER", "folder of the atlas files")
    file(
        imports,
        "--landmarks",
        "FILE",
        "skull landmarks on the bones of the atlas (.mrk.json)",
        required=True,
    )
    file(imports, "-o --output", "OUT", "folder, or .npz file", required=True)
    switch(imports, "--any-files", "accept files with unknown hashes")
    imports.set_defaults(run=template_commands.import_atlas)


def _add_template_morph(actions: Any, named: argparse.ArgumentParser) -> None:
    morph = actions.add_parser(
        "morph",
        parents=[named],
        help="transfer the muscles of a template to a patient by landmarks",
    )
    file(morph, "landmarks", "LANDMARKS", "skull landmarks of the patient, .mrk.json or .fcsv")
    file(morph, "-o --output", "OUT", "folder, or .npz file", required=True)
    number(morph, "--smoothing", "MM", "0 (default): exact landmarks", default=0.0)
    morph.set_defaults(run=template_commands.morph)


def _add_template_show(actions: Any, named: argparse.ArgumentParser) -> None:
    show = actions.add_parser("show", parents=[named], help="draw a template's muscles")
    file(show, "-o --output", "PNG", "picture to write", required=True)
    show.add_argument(
        "--only", metavar="NAME", nargs="+", help="only these muscles; without _L or _R, both sides"
    )
    switch(show, "--fibres", "draw fibre boxes and directions instead of names")
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
    file(frontier, "case", "CASE", "case.toml (default: a synthetic head)", nargs="?")
    file(
        frontier,
        "-o --output",
        "OUT",
        f"output folder (default {lab_commands.FRONTIER_FOLDER})",
        default=lab_commands.FRONTIER_FOLDER,
    )
    number(
        frontier,
        "--edge-length",
        "H",
        "edge length of the base run, mm (default: that of the case)",
    )
    frontier.add_argument("--model", choices=MODELS, help="model of the base run (default M+S)")
    number(frontier, "--edges", "H", "edge lengths of the grid, mm", nargs="+", default=EDGES)
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
    number(
        frontier,
        "--reference-edge",
        "H",
        "edge length of the reference, mm (default: the smallest of the sweep)",
    )
    frontier.add_argument(
        "--reference-kinematics",
        choices=KINEMATICS,
        default="hyperelastic",
        help="kinematics of the reference (default hyperelastic)",
    )
    whole(frontier, "--repeats", "N", "timing rounds (default 3)", default=3)
    whole(frontier, "--threads", "N", "number of threads (default: all cores)")
    number(frontier, "--time-limit", "S", "time limit per job, s (default 600)", default=600.0)
    switch(frontier, "--fresh", "repeat finished runs")
    frontier.set_defaults(run=lab_commands.frontier)
