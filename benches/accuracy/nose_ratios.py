"""How the nose follows the maxilla: nose_ratios.py [CASE …] [--model H+S] [--markdown PAGE].

A Le Fort I osteotomy advances the maxilla, without and with the septum that stays on the skull. The
table has the motion of the skin as a share of the advancement, next to published ratios. A case
needs skull and skin landmarks; its own plan and osteotomies are replaced. Without a case: the atlas
head, the CT phantom (in the folder named by CMFSIM_DATA, else ../shared/data) and the demo's head.
"""

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import cmfsim
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder
from cmfsim.lab.virtual.demo import write_demo_case
from cmfsim.pipeline.building.stages import BuildOptions
from cmfsim.pipeline.predicting import build_patient

ROOT = Path(__file__).parents[2]
NAME = "benches/accuracy/nose_ratios.py"
SITES = ("pronasale", "subnasale", "labiale_superius", "alare_L", "alare_R")
HEAD = (
    "| head | septum | tip forwards | tip up | subnasale forwards | upper lip forwards "
    "| alar width, mm per mm | nasolabial angle, ° per mm |\n"
    "|---|---|---:|---:|---:|---:|---:|---:|"
)
# Jung et al. 2018 (tip and upper lip forwards) and Hellak et al. 2015 (width at the alae 3.17 mm,
# nasolabial angle −6.65° for 5.58 mm).
PUBLISHED = "| published | | 0.17 | | | 0.21 | 0.57 | −1.2 |"
CASE = """format = "cmfsim-case"
version = 1
name = "{name}"
{source}
[landmarks]
skull = "{folder}/skull_landmarks.mrk.json"
skin = "{folder}/skin_landmarks.mrk.json"

[mesh]
edge_length = {edge}

[[osteotomies]]
procedure = "le_fort_1"

[plan.maxilla]
translation = [0, {y}, 0]
"""
SOURCES = {
    "atlas_head": '[surfaces]\nskin = "{0}/skin.ply"\n'
    '[surfaces.bones]\ncranium = "{0}/cranium.ply"\nmandible = "{0}/mandible.ply"\n',
    "ct_phantom": '[image]\nfile = "{0}/ct.nii.gz"\n',
}
Floats = NDArray[np.float64]


def ratios(prediction: cmfsim.Prediction, advance: float) -> list[float]:
    """The last six numbers of a row of the table."""
    marks = prediction.patient.landmarks["skin"]
    before = dict(zip(SITES, np.array([marks[n] for n in SITES]), strict=True))
    moved = prediction.carried(np.array(list(before.values())))
    after = {n: before[n] + way for n, way in zip(SITES, moved, strict=True)}
    tip, base, lip = (after[n] - before[n] for n in SITES[:3])
    wider = _width(after) - _width(before)
    return [
        -tip[1] / advance,
        tip[2] / advance,
        -base[1] / advance,
        -lip[1] / advance,
        wider / advance,
        (_angle(after) - _angle(before)) / advance,
    ]


def _width(places: Mapping[str, Floats]) -> float:
    return float(np.linalg.norm(places["alare_L"] - places["alare_R"]))


def _angle(places: Mapping[str, Floats]) -> float:
    """The nasolabial angle, between tip and upper lip as seen from subnasale, degrees."""
    one, other = (places[n] - places["subnasale"] for n in ("pronasale", "labiale_superius"))
    return float(np.degrees(np.arccos(one @ other / np.linalg.norm(one) / np.linalg.norm(other))))


def rows(case: cmfsim.Case, model: str, advance: float) -> Iterator[str]:
    """The rows of a case: without and with the septum."""
    for septum in (False, True):
        own = replace(case, node_kinds={**case.node_kinds, "septum": septum})
        patient = build_patient(own, (model,), BuildOptions(check=False))
        prediction = cmfsim.predict_patient(patient, model)
        values = ratios(prediction, advance)
        cells = [*(f"{v:.2f}" for v in values[:5]), f"{values[5]:.1f}"]
        yield f"| {case.name} | {'yes' if septum else 'no'} | " + " | ".join(cells) + " |"


def cases(folder: Path, edge: float, advance: float) -> Iterator[cmfsim.Case]:
    """The two real heads and the demo's."""
    data = data_folder()
    for name, source in SOURCES.items():
        head = (data / name).as_posix()
        path = folder / f"{name}.toml"
        text = CASE.format(
            name=name, source=source.format(head), folder=head, edge=edge, y=-advance
        )
        path.write_text(text, encoding="utf-8")
        yield cmfsim.Case.load(path)
    yield advanced(write_demo_case(folder / "demo", edge_length=edge).case, advance)


def advanced(case: cmfsim.Case, advance: float) -> cmfsim.Case:
    """A case whose only operation is a Le Fort I advancement."""
    assert case.file is not None  # noqa: S101 (cases of this bench are files)
    text = case.file.read_text(encoding="utf-8")
    first = min(at for word in ("[[osteotomies]]", "[plan") if (at := text.find(word)) >= 0)
    tables = [t for t in text[first:].split("\n[") if not t.startswith(("[osteo", "plan", "[["))]
    path = case.file.with_name("advanced.toml")
    operation = (
        '[[osteotomies]]\nprocedure = "le_fort_1"\n\n[plan.maxilla]\n'
        f"translation = [0, {-advance:g}, 0]\n\n"
    )
    path.write_text(text[:first] + operation + "".join(f"[{t}\n" for t in tables), "utf-8")
    return cmfsim.Case.load(path)


def main(words: Sequence[str] | None = None) -> None:
    """Prints the table, or writes it into a page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("cases", type=Path, nargs="*", help="case.toml, or its folder")
    parser.add_argument("--model", default="H+S")
    parser.add_argument("--advance", type=float, default=4.0, help="mm")
    parser.add_argument("--edge", type=float, default=6.0, help="mm, of heads without a case")
    parser.add_argument("--markdown", type=Path, help="page whose table is rewritten")
    options = parser.parse_args(words)
    with tempfile.TemporaryDirectory() as folder:
        found = [advanced(cmfsim.Case.load(path), options.advance) for path in options.cases]
        heads = found or cases(Path(folder), options.edge, options.advance)
        lines = [row for case in heads for row in rows(case, options.model, options.advance)]
    text = "\n".join([HEAD, *lines, PUBLISHED])
    text += (
        f"\n\nModel {options.model}, {options.advance:g} mm, edge {options.edge:g} mm, cmfsim "
        f"{cmfsim.__version__}.\n"
    )
    publish(options.markdown, NAME, text)


if __name__ == "__main__":
    main()
