"""The predicted face of a CT as other clinics would send it, against that of the unmodified one.

Le Fort I moves the maxilla 4 mm forwards, without any landmarks, on the CT and on each variant.
Where the face of the unmodified CT moves by more than 0.5 mm, displacements are compared: mean and
95 % of the differences. A variant off by more than 0.3 mm on average (0.5 with open mouth) has to
be reported by a finding about what was changed, or refused by an error; otherwise its verdict is
"SILENT".

    python -m benches.accuracy.face_variants --markdown docs/landmarks.md [--only NAME ...]
        [--cache FOLDER]

Needs the real CT (the folder named by CMFSIM_DATA, else ../shared/data). Each row takes a minute or
two; with a cache, rows that were computed before by the same version are read back.
"""

import argparse
import hashlib
import json
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import cmfsim
from benches.accuracy import scan_variants
from benches.scenes import clinic_scans as clinic
from benches.scenes import ct_variants as variants
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder
from cmfsim import ImageData
from cmfsim.bones.cuts.procedures import UPPER_CANINE_REACH

ROOT = Path(__file__).parents[2]
NAME = "benches/accuracy/face_variants.py"
FORWARDS = np.array([0.0, -4.0, 0.0])
# Points of the face that move by more than this are compared, and matched up to this distance, mm.
MOVES, NEAR = 0.5, 4.0
TOLERANCE, OPEN_TOLERANCE = 0.3, 0.5
# Findings about landmarks found on any head.
USUAL = {"landmark-doubtful", "landmarks-proposed", "jaws-parted-by-shape", "jaws-separated-again"}
# Findings that say what is wrong with a scan: another finding does not report a variant.
JAWS = frozenset({"jaw-doubtful", "jaws-not-parted"})
CUT = frozenset({"ct-cut-off"})
ON_SKIN = frozenset({"skin-attachment", "skin-implausible", "skin-weak"})

CASE = """format = "cmfsim-case"
version = 1
name = "head"

[image]
file = "ct.nii.gz"

[mesh]
edge_length = {edge}

[[osteotomies]]
procedure = "le_fort_1"
{cut}

[plan.maxilla]
translation = [{motion}]

[muscles]
"""

LIPS = "\n[lips]\ncontact = true\n"


@dataclass(frozen=True)
class Variant:
    """A CT made harder.

    Attributes
    ----------
    make : callable
        The image of the clean one.
    to_variant : callable
        The (4, 4) motion and scale from the clean head to that of the variant, of the clean image.
    places : callable
        Where points of the clean face are in the variant before that motion, (n, 3).
    tolerance : float, mm
    causes : frozenset of str
        Codes of findings about what was changed.
    are_lips_apart : bool
        Whether it is compared with the clean face whose lips are separated: closed lips are one
        sheet of tissue in a CT.
    cut : mapping of str to float, mm
        Distances of the cut, where they are not those of the clean head.
    """

    make: Callable[[ImageData], ImageData]
    to_variant: Callable[[ImageData], np.ndarray] = field(default=lambda _: np.eye(4))
    places: Callable[[np.ndarray], np.ndarray] = field(default=lambda points: points)
    tolerance: float = TOLERANCE
    causes: frozenset[str] = frozenset()
    are_lips_apart: bool = False
    cut: Mapping[str, float] = field(default_factory=dict)


def _landmarks(kind: str = "skull") -> dict[str, np.ndarray]:
    path = data_folder() / "ct_phantom" / f"{kind}_landmarks.mrk.json"
    return dict(cmfsim.read_landmarks(path))


def _turned(*angles: float) -> Variant:
    x, y, z = angles
    return Variant(
        lambda image: variants.turned(image, (x, y, z))[0],
        lambda image: variants.turned(image, (x, y, z))[1],
        causes=JAWS,
    )


def _open(degrees: float) -> Variant:
    return Variant(
        lambda image: variants.with_mouth_open(image, _landmarks(), degrees),
        places=lambda points: variants.opened(points, _landmarks(), degrees),
        tolerance=OPEN_TOLERANCE,
        causes=JAWS,
        are_lips_apart=True,
    )


def _below(image: ImageData, name: str, by: float) -> ImageData:
    return variants.cropped(image, 2, low=float(_landmarks()[name][2]) + by)


def _pads(image: ImageData) -> ImageData:
    for name in ("inferior_malar_L", "inferior_malar_R"):
        place = _landmarks()[name] + [0.0, 15.0, -10.0]
        image = variants.with_pad(image, tuple(place), 50.0, 12.0, -60.0)
    return image


def _fine(image: ImageData) -> ImageData:
    face = variants.cropped(image, 1, high=float(_landmarks()["supraglenoid_L"][1]) + 40.0)
    return variants.resampled(face, (0.3, 0.3, 0.3))


def _smaller_cut(factor: float) -> dict[str, float]:
    """Distances that make the cut of the clean head smaller.

    By default it runs above roots of the usual length, whatever the size of the head.
    """
    height, posterior, width = 5.0, 12.0, 12.0
    above = factor * (UPPER_CANINE_REACH + height)
    return {
        "height": above - UPPER_CANINE_REACH,
        "posterior": factor * posterior,
        "width": factor * width,
    }


def _offset(image: ImageData) -> ImageData:
    values = np.clip(image.values, -1024, None).astype(np.int32) + 1024
    return image.with_values(values.astype(np.uint16))


VARIANTS: Mapping[str, Variant] = {
    **{f"mouth open by {degrees:g}°": _open(degrees) for degrees in (5.0, 10.0, 15.0, 25.0)},
    "nodding forwards by 25°": _turned(25.0, 0.0, 0.0),
    "nodding backwards by 25°": _turned(-25.0, 0.0, 0.0),
    "round field of view, 16 cm": Variant(
        scan_variants.VARIANTS["cone beam, 160 mm of the head"].make, causes=CUT
    ),
    "cut above the brow": Variant(
        lambda i: variants.cropped(i, 2, high=float(_landmarks()["glabella"][2]) + 6.0), causes=CUT
    ),
    "cut below the chin": Variant(lambda i: _below(i, "menton", -6.0), causes=CUT),
    "chin cut off": Variant(lambda i: _below(i, "menton", 25.0), causes=CUT),
    "one side": Variant(
        lambda i: variants.one_side(i, float(_landmarks()["nasion"][0])), causes=CUT
    ),
    "no teeth": Variant(lambda i: variants.without_teeth(i, _landmarks()), causes=JAWS),
    "brackets": Variant(
        scan_variants.VARIANTS["brackets and wire of steel"].make, causes=frozenset({"metal"})
    ),
    "head holder": Variant(
        lambda i: variants.with_holder(variants.with_pillow(variants.without_couch(i, -107.0))),
        causes=ON_SKIN,
    ),
    "beard": Variant(lambda i: variants.with_beard(i, _landmarks()), causes=ON_SKIN),
    "pads on the cheeks": Variant(_pads, causes=ON_SKIN),
    "soft rest at the chin": Variant(
        lambda i: clinic.with_soft_rest(i, _landmarks(), _landmarks("skin")), causes=ON_SKIN
    ),
    "oxygen mask": Variant(lambda i: clinic.with_mask(i, _landmarks("skin")), causes=ON_SKIN),
    "bandage": Variant(lambda i: clinic.with_bandage(i, _landmarks()), causes=ON_SKIN),
    "plates of titanium": Variant(
        lambda i: clinic.with_plates(i, _landmarks()), causes=frozenset({"metal"})
    ),
    "contrast agent": Variant(lambda i: clinic.with_contrast(i, _landmarks(), _landmarks("skin"))),
    "slices of 5 mm": Variant(clinic.in_thick_slices, causes=frozenset({"ct-spacing-coarse"})),
    "slices of 3 mm": Variant(
        lambda i: variants.resampled(i, (i.spacing[0], i.spacing[1], 3.0)),
        causes=frozenset({"ct-spacing-coarse"}),
    ),
    "voxels of 0.3 mm": Variant(_fine),
    "a child's size, 0.8": Variant(
        lambda i: variants.scaled(i, 0.8),
        lambda _: np.diag([0.8, 0.8, 0.8, 1.0]),
        cut=_smaller_cut(0.8),
    ),
    "1024 too high": Variant(_offset, causes=frozenset({"ct-not-hu"})),
}


def predicted(
    image: ImageData, motion: np.ndarray, edge: float, cut: Mapping[str, float], more: str = ""
) -> dict[str, Any]:
    """Points and displacements of the face, the codes of findings, or the error."""
    import SimpleITK  # noqa: PLC0415

    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        written = SimpleITK.GetImageFromArray(np.ascontiguousarray(np.asarray(image.values).T))
        written.SetSpacing(np.asarray(image.spacing, dtype=float).tolist())
        written.SetOrigin(np.asarray(image.lowest, dtype=float).tolist())
        SimpleITK.WriteImage(written, str(path / "ct.nii.gz"))
        distances = "\n".join(f"{name} = {value:.6f}" for name, value in cut.items())
        moved = ", ".join(f"{v:.6f}" for v in motion)
        text = CASE.format(edge=edge, motion=moved, cut=distances) + more
        (path / "case.toml").write_text(text, encoding="utf-8")
        try:
            found = cmfsim.predict(cmfsim.Case.load(path / "case.toml"), model="M+S")
        except cmfsim.CmfsimError as error:
            return {"error": str(error), "seconds": time.process_time() - begun}
        before, after = found.face_before, found.face
    codes = sorted({f.code for f in found.findings if f.severity != "note"})
    return {
        "points": before.vertices,
        "displacements": after.vertices - before.vertices,
        "codes": codes,
        "error": "",
        "seconds": time.process_time() - begun,
    }


def compared(
    row: Mapping[str, Any], clean: Mapping[str, Any], to_variant: np.ndarray
) -> dict[str, float]:
    """Mean and 95 % of the differences where the clean face moves, and the part that is there."""
    back = np.linalg.inv(to_variant)
    points = row["points"] @ back[:3, :3].T + back[:3, 3]
    moved = row["displacements"] @ back[:3, :3].T
    moves = np.linalg.norm(clean["displacements"], axis=1) > MOVES
    away, nearest = cKDTree(points).query(clean["points"][moves])
    near = np.less(away, NEAR)
    apart = np.linalg.norm(moved[nearest] - clean["displacements"][moves], axis=1)[near]
    if not len(apart):
        return {"mean": np.inf, "p95": np.inf, "covered": 0.0}
    return {
        "mean": float(apart.mean()),
        "p95": float(np.percentile(apart, 95.0)),
        "covered": float(near.mean()),
    }


def verdict(name: str, row: Mapping[str, Any], usual: set[str]) -> str:
    """Within tolerance, reported, refused or silent."""
    if row["error"]:
        return f"refused: {row['error'][:160]}"
    codes = [code for code in row["codes"] if code not in usual | USUAL]
    told = ", ".join(f"`{code}`" for code in codes)
    if row["mean"] <= VARIANTS[name].tolerance:
        return f"within tolerance{f'; {told}' if told else ''}"
    if VARIANTS[name].causes.isdisjoint(codes):
        return f"**SILENT** about its cause; {told or 'no finding'}"
    return f"reported: {told}"


def _line(name: str, row: Mapping[str, Any], usual: set[str]) -> str:
    figures = "– | – | –"
    if not row["error"]:
        figures = f"{row['mean']:.2f} | {row['p95']:.2f} | {100 * row['covered']:.0f}"
    return f"| {name} | {figures} | {row['seconds']:.0f} | {verdict(name, row, usual)} |"


def _kept(cache: Path | None, name: str, edge: float, make: Callable[[], dict[str, Any]]) -> Any:
    """What `make` returns, read back where the same sources have computed it before."""
    if cache is None:
        return make()
    sources = sorted((ROOT / "python/cmfsim").rglob("*.py")) + [Path(__file__)]
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources))
    digest.update(f"{name} {edge}".encode())
    path = cache / f"GATES_face_{digest.hexdigest()[:16]}.npz"
    if path.exists():
        with np.load(path) as stored:
            plain = json.loads(str(stored["plain"]))
            return {**plain, **{k: stored[k] for k in stored.files if k != "plain"}}
    found = make()
    arrays = {k: v for k, v in found.items() if isinstance(v, np.ndarray)}
    plain = {k: v for k, v in found.items() if k not in arrays}
    np.savez_compressed(path, plain=json.dumps(plain), allow_pickle=False, **arrays)
    return found


def main() -> None:
    """Prints the table, or puts it into a page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--only", nargs="+", choices=[*VARIANTS])
    parser.add_argument("--edge", type=float, default=6.0, help="of the tets, mm")
    parser.add_argument("--cache", type=Path, help="folder for rows")
    options = parser.parse_args()
    image = cmfsim.read_image(data_folder() / "ct_phantom" / "ct.nii.gz")

    def clean_face(more: str) -> Any:
        return _kept(
            options.cache,
            f"clean {more}",
            options.edge,
            lambda: predicted(image, FORWARDS, options.edge, {}, more),
        )

    clean = {False: clean_face(""), True: clean_face(LIPS)}
    for found in clean.values():
        if found["error"]:
            raise SystemExit(f"the unmodified CT: {found['error']}")
    usual = set(clean[False]["codes"])
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],  # noqa: S607
        cwd=ROOT, check=True, capture_output=True, text=True,
    ).stdout.strip()  # fmt: skip
    made = (
        f"cmfsim {cmfsim.__version__} after commit {commit}, {platform.machine()}, edges of "
        f"{options.edge:g} mm; `python {NAME} --edge {options.edge:g}`. Differences of the face in "
        "mm, part of it that the variant shows in %, processor time in s."
    )
    lines = [
        made,
        "",
        "| variant | mean | 95 % | shown | time | verdict |",
        "|---|---|---|---|---|---|",
    ]
    for name in options.only or VARIANTS:
        variant = VARIANTS[name]
        to_variant = variant.to_variant(image)
        motion = to_variant[:3, :3] @ FORWARDS
        # A smaller head has smaller tets, or its mesh would be compared as well.
        edge = options.edge * float(np.cbrt(np.linalg.det(to_variant[:3, :3])))

        def make(
            variant: Any = variant, motion: np.ndarray = motion, edge: float = edge
        ) -> dict[str, Any]:
            return predicted(variant.make(image), motion, edge, variant.cut)

        row = _kept(options.cache, name, options.edge, make)
        if not row["error"]:
            to = clean[variant.are_lips_apart]
            row |= compared(row, {**to, "points": variant.places(to["points"])}, to_variant)
        lines.append(_line(name, row, usual))
        print(lines[-1], file=sys.stderr, flush=True)
    publish(options.markdown, NAME, "\n".join(lines))


if __name__ == "__main__":
    main()
