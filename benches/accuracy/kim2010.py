"""The study of Kim et al. (2010) on virtual patients: kim2010.py FOLDER [--markdown PAGE].

FOLDER gets the virtual patients P1 to P4 (`cmfsim virtual-patients FOLDER`; existing ones are kept)
and their study (`cmfsim study FOLDER/paper.toml`), with the constants and the muscles of the paper:
Table 1, placed by landmarks alone, with shares as sampled. The landmarks of P1 are then placed
again three times, as in section 3.3. With a page, the tables and figures of the docs are written as
well.
"""

import argparse
import os
import platform
from pathlib import Path

import cmfsim
from benches.scenes.marked import publish
from cmfsim.study.cohort import FIGURE_9_FILE, FIGURE_10_FILE, TABLE_3_FILE

NAME = "benches/accuracy/kim2010.py"
TRIALS = 3
# What a virtual patient's case states of its muscles, and what it states with those of the paper.
DEFAULT_MUSCLES = "\n[muscles]\n"
PAPER_MUSCLES = '\n[muscles]\npreset = "kim2010"\nblur = 0\n'
CASE_FILE, PAPER_FILE = "case.toml", "paper.toml"
# Pixels of a page's column.
WIDTH = 1000


def paper_cohort(folder: Path) -> Path:
    """A cohort of the patients of a folder with the paper's muscles: files next to their own."""
    for case in sorted(folder.glob(f"*/{CASE_FILE}")):
        text = case.read_text(encoding="utf-8")
        if text.count(DEFAULT_MUSCLES) != 1:
            raise SystemExit(f"{case}: needs one empty [muscles], as virtual-patients writes it")
        paper = text.replace(DEFAULT_MUSCLES, PAPER_MUSCLES)
        case.with_name(PAPER_FILE).write_text(paper, encoding="utf-8")
    cohort = (folder / "cohort.toml").read_text(encoding="utf-8")
    made = folder / PAPER_FILE
    made.write_text(cohort.replace(CASE_FILE, PAPER_FILE), encoding="utf-8")
    return made


def studied(folder: Path) -> cmfsim.StudyReport:
    """The study of the four virtual patients in a folder, and its files."""
    cmfsim.virtual_patients(folder, progress=lambda stage: print(stage, flush=True))
    report = cmfsim.run_study(cmfsim.Cohort.load(paper_cohort(folder)), workers=1)
    cmfsim.write_study_report(report)
    for outcome in report.failed:
        raise SystemExit(f"{outcome.name} failed: {outcome.error}")
    return report


def shares(table: cmfsim.ErrorTable) -> str:
    """Shares of the face within each limit, averaged over patients."""
    limits = (1.0, 2.0, 3.0)
    lines = [
        "| mean of the patients | median, mm | largest of all, mm | "
        + " | ".join(f"within {limit:g} mm" for limit in limits)
        + " |",
        "| --- |" + " ---: |" * (2 + len(limits)),
    ]
    for model in table.models:
        cells = [table.cells[patient, "whole", model] for patient in table.patients]
        count = len(cells)
        figures = [
            f"{sum(c.median for c in cells) / count:.2f}",
            f"{max(c.max for c in cells):.1f}",
            *(f"{100 * sum(c.within[x] for c in cells) / count:.0f} %" for x in limits),
        ]
        lines.append(f"| {model} | " + " | ".join(figures) + " |")
    return "\n".join(lines)


def trials(case: Path) -> str:
    """What landmarks that are placed again do to muscles and face (section 3.3)."""
    found = cmfsim.sensitivity(case, trials=TRIALS)
    lines = [
        f"| {case.parent.name}, M+S, trial | landmarks | muscles | masseter | face that moves |",
        "| --- |" + " ---: |" * 4,
    ]
    for number, trial in enumerate(found.trials, start=1):
        muscles = trial.muscle_deviation
        masseter = [d for name, d in muscles.items() if "masseter" in name]
        figures = (
            trial.landmark_deviation,
            sum(muscles.values()) / len(muscles),
            sum(masseter) / len(masseter),
            float(trial.skin_deviation[found.moved].mean()),
        )
        lines.append(f"| {number} | " + " | ".join(f"{f:.2f} mm" for f in figures) + " |")
    return "\n".join(lines)


def write_figures(study: Path, docs: Path) -> None:
    """Writes the study's figures for a page: a column wide, in few colours."""
    from PIL import Image  # noqa: PLC0415 (comes with matplotlib)

    for name in (FIGURE_9_FILE, FIGURE_10_FILE):
        picture = Image.open(study / name).convert("RGB")
        size = (WIDTH, round(picture.height * WIDTH / picture.width))
        small = picture.resize(size, Image.Resampling.LANCZOS)
        path = docs / "figures" / f"kim2010_{name}"
        # By the range of colours, so that the ends of the colour bar, which few pixels have, stay.
        few = small.quantize(method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
        few.save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1024:.0f} kB")


def main() -> None:
    """Runs the study and prints its tables, or writes them into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--markdown", type=Path, metavar="PAGE", help="page to write into")
    options = parser.parse_args()
    report = studied(options.folder)
    text = (report.cohort.output / TABLE_3_FILE).read_text(encoding="utf-8")
    # The page has its own title, and its sections are a level below.
    table = text.split("\n", 2)[2].strip().replace("\n## ", "\n### ")
    machine = f"{platform.machine()}, {os.cpu_count()} cores, cmfsim {cmfsim.__version__}."
    blocks = [table, shares(cmfsim.study_table(report)), trials(options.folder / "P1" / PAPER_FILE)]
    publish(options.markdown, NAME, "\n\n".join([*blocks, machine]))
    if options.markdown is not None:
        write_figures(report.cohort.output, options.markdown.parent)


if __name__ == "__main__":
    main()
