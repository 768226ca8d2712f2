"""Scans that nobody here has, from the command line to the face, without hand work.

Two heads of other shapes, scanned as `benches/scenes/unseen_scans.py` says. `cmfsim init` and
`predict` run on each as a user runs them. Landmarks are compared with the known ones, and faces
with those of the same anatomy in a perfect scan with its known landmarks, where these move by more
than 0.5 mm.

    python -m benches.accuracy.unseen_scans --work FOLDER [--only TEXT]
        [--markdown docs/landmarks.md]
"""

import argparse
import json
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

import cmfsim
from benches.scenes.marked import publish
from benches.scenes.real_data import data_folder
from benches.scenes.unseen_scans import TILTS, Scanned, made, unseen
from benches.scenes.warped_heads import KnownHead
from cmfsim.io.landmarks import write_landmarks

NAME = "benches/accuracy/unseen_scans.py"
# Points of the face that move by more than this are compared, and matched up to this distance, mm.
MOVES, NEAR, CLOSE = 0.5, 4.0, 4.0
FORWARDS = "forwards=4"
# How far a click is off, mm, and how many a refusal may ask for.
CLICK, CLICKS = 1.5, 3
SECONDS = 3600
QUIET = {"landmarks-proposed", "jaws-parted-by-shape", "jaws-separated-again"}


def written(
    folder: Path, head: Scanned | KnownHead, *, with_sites: bool, tilt: float = 0.0
) -> None:
    """The scan of a head in a folder, with the landmarks that a perfect person places.

    tilt: Of the slices, degrees; they are then written as DICOM.
    """
    folder.mkdir(parents=True)
    if isinstance(head, KnownHead):
        for name, surface in {**head.bones, "skin": head.skin}.items():
            cmfsim.write_surface(folder / f"{name}.stl", surface)
    elif tilt:
        _tilted(folder / "dicom", head.image, np.radians(tilt))
    else:
        import SimpleITK  # noqa: PLC0415

        image = SimpleITK.GetImageFromArray(np.ascontiguousarray(np.asarray(head.image.values).T))
        image.SetSpacing(np.asarray(head.image.spacing, dtype=float).tolist())
        image.SetOrigin(np.asarray(head.image.lowest, dtype=float).tolist())
        SimpleITK.WriteImage(image, str(folder / "ct.nii.gz"))
    for kind, points in zip(("skull", "skin"), head.truth, strict=True):
        if with_sites:
            write_landmarks(folder / f"{kind}_landmarks.mrk.json", points)


def _tilted(folder: Path, image: cmfsim.ImageData, tilt: float) -> None:
    """Slices that a tilted gantry takes, 1.5 mm apart along the couch, as DICOM files."""
    import SimpleITK  # noqa: PLC0415
    from scipy import ndimage  # noqa: PLC0415

    folder.mkdir()
    step, low = np.asarray(image.spacing), np.asarray(image.lowest)
    size = step * (np.array(image.values.shape) - 1)
    x, v = np.arange(0.0, size[0], 1.0), np.arange(0.0, size[1] / np.cos(tilt), 1.0)
    along = np.array([0.0, np.cos(tilt), np.sin(tilt)])
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k, height in enumerate(np.arange(-size[1] * np.tan(tilt), size[2], 1.5)):
        first = np.array([0.0, 0.0, height])
        places = first + x[None, :, None] * [1.0, 0.0, 0.0] + v[:, None, None] * along
        values = ndimage.map_coordinates(
            np.asarray(image.values, np.float32), np.moveaxis(places / step, -1, 0), order=1,
            cval=-1000.0,
        )  # fmt: skip
        one = SimpleITK.GetImageFromArray(np.round(values).astype(np.int16))
        tags = {
            "0008|0060": "CT", "0020|000d": "1.2.826.0.1.1", "0020|000e": "1.2.826.0.1.2",
            "0020|0013": str(k), "0008|0018": f"1.2.826.0.1.3.{k}", "0018|0050": "1.5",
            "0020|0032": "\\".join(f"{c:.6f}" for c in low + first),
            "0020|0037": "\\".join(f"{c:.8f}" for c in (1.0, 0.0, 0.0, *along)),
            "0018|1120": f"{np.degrees(tilt):.3f}",
        }  # fmt: skip
        for tag, value in tags.items():
            one.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"{k:04d}.dcm"))
        writer.Execute(one)


def command(folder: Path, *words: str) -> tuple[int, str, float]:
    """Exit code, last lines and processor seconds of a command."""
    # The writer of DICOM sets this process's own locale back to ASCII.
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(  # noqa: S603
        [sys.executable, "-m", "cmfsim", *words], cwd=folder, capture_output=True,
        encoding="utf-8", timeout=SECONDS, check=False,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return done.returncode, (done.stdout + done.stderr).strip(), spent


def ran(folder: Path, edge: float) -> dict[str, Any]:
    """What `init` and `predict` make of a folder."""
    code, text, _ = command(
        folder, "init", ".", "--force", "--cut", "le_fort_1", "--move", "maxilla", FORWARDS
    )
    if code:
        return {"exit": code, "stage": "init", "text": text, "codes": [], "seconds": 0.0}
    shutil.rmtree(folder / "out", ignore_errors=True)
    code, text, spent = command(
        folder, "predict", ".", f"--edge-length={edge:g}", "--no-report", "--json"
    )
    (folder / "predict.txt").write_text(text, encoding="utf-8")
    found: dict[str, Any] = {"exit": code, "stage": "predict", "text": text, "seconds": spent}
    return found | {"codes": codes_of(folder) if code == 0 else []}


def codes_of(folder: Path) -> list[str]:
    """The codes of the findings of a prediction that are more than notes."""
    found = json.loads((folder / "out" / "prediction.json").read_text(encoding="utf-8"))
    codes = {f["code"] for f in found["findings"] if f["severity"] != "note"}
    return sorted(codes - QUIET)


def clicked(folder: Path, row: dict[str, Any], edge: float) -> dict[str, Any]:
    """A refused scan again with the sites placed that its message names, if it names a few."""
    truth = read_truth(folder)["skull"]
    names = [n for n in truth if re.search(rf"\b{n}\b", row["text"])]
    if not 0 < len(names) <= CLICKS:
        return row
    rng = np.random.default_rng(0)
    off = {n: rng.normal(size=3) for n in names}
    placed = {n: truth[n] + CLICK * v / np.linalg.norm(v) for n, v in off.items()}
    write_landmarks(folder / "scan" / "skull_landmarks.mrk.json", placed)
    return ran(folder / "scan", edge) | {"refusal": row["text"], "placed": names}


def sites_of(folder: Path, row: Mapping[str, Any]) -> dict[str, Any]:
    """The landmarks of a prediction, or where it was refused, what `cmfsim landmarks` finds."""
    if row["exit"] == 0:
        text = (folder / "out" / "prediction.json").read_text(encoding="utf-8")
        return dict(json.loads(text)["landmarks"])
    code, text, _ = command(folder, "landmarks", ".", "--json", "-q")
    return json.loads(text) if code == 0 else {"skull": {}, "skin": {}, "missing_skull": {}}


def errors_of(sites: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, Any]:
    """True and stated errors by site, mm."""
    return {
        f"{name}{' (skin)' if kind == 'skin' else ''}": (
            float(np.linalg.norm(np.array(site["point"]) - truth[kind][name])),
            float(site["error"]),
            bool(site["doubt"]),
        )
        for kind in ("skull", "skin")
        for name, site in sites[kind].items()
        if name in truth[kind]
    }


def face(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points of the predicted face before the operation, and their displacements."""
    import pyvista  # noqa: PLC0415

    mesh = pyvista.read(folder / "out" / "face.vtp")
    return np.array(mesh.points, float), np.array(mesh["displacement"], float)


def apart(scan: Path, clean: Path) -> dict[str, float]:
    """How far faces differ where the clean one moves: mean, 95 %, and the share that is shown."""
    (points, moved), (places, right) = face(scan), face(clean)
    moves = np.linalg.norm(right, axis=1) > MOVES
    away, nearest = cKDTree(points).query(places[moves])
    near = np.asarray(away < NEAR)
    off = np.linalg.norm(moved[nearest] - right[moves], axis=1)[near]
    if not len(off):
        return {"mean": np.inf, "p95": np.inf, "shown": 0.0}
    mean, p95 = float(off.mean()), float(np.percentile(off, 95.0))
    return {"mean": mean, "p95": p95, "shown": float(near.mean())}


def read_truth(folder: Path) -> dict[str, Mapping[str, np.ndarray]]:
    """The known landmarks of a scan."""
    return {
        kind: cmfsim.read_landmarks(folder / "clean" / f"{kind}_landmarks.mrk.json")
        for kind in ("skull", "skin")
    }


def measured(folder: Path, edge: float) -> dict[str, Any]:
    """All figures of one scan; those of the clean one are kept."""
    row = ran(folder / "scan", edge)
    if row["exit"]:
        row = clicked(folder, row, edge)
    row["sites"] = sites_of(folder / "scan", row)
    row["errors"] = errors_of(row["sites"], read_truth(folder))
    if row["exit"] == 0:
        if not (folder / "clean" / "out" / "face.vtp").is_file():
            row["clean"] = ran(folder / "clean", edge)["text"][-300:]
        if (folder / "clean" / "out" / "face.vtp").is_file():
            row["face"] = apart(folder / "scan", folder / "clean")
    (folder / "row.json").write_text(json.dumps(row), encoding="utf-8")
    return row


def line(name: str, row: Mapping[str, Any]) -> str:
    """A row of the table."""
    errors = row["errors"]
    values = np.array([e for e, _, _ in errors.values()] or [np.nan])
    worst = sorted(errors.items(), key=lambda item: -item[1][0])[:2]
    said = ", ".join(f"{n} {e:.1f}" for n, (e, _, _) in worst)
    low = ", ".join(f"{n} {e:.1f} ({s:.1f})" for n, (e, s, _) in errors.items() if e > 2.0 * s)
    off = row.get("face")
    shown = f"{off['mean']:.2f} / {off['p95']:.2f}" if off else "–"
    outcome = "face" if row["exit"] == 0 else f"refused: {row['text'][-160:]}"
    if "placed" in row:
        outcome = f"refused until {', '.join(row['placed'])} were placed; {outcome}"
    codes = ", ".join(f"`{code}`" for code in row["codes"])
    return (
        f"| {name} | {outcome} | {row['exit']} | {len(errors)} | {values.mean():.2f} / "
        f"{np.quantile(values, 0.9):.1f} | {100 * (values <= CLOSE).mean():.0f} % | {said or '–'} "
        f"| {low or '–'} | {shown} | {codes or '–'} |"
    )


HEAD = """| scan | outcome | exit | sites | mean / 90 %, mm | within 4 mm | worst | more than twice as stated \
| face off, mean / 95 %, mm | findings |
|---|---|---|---|---|---|---|---|---|---|"""  # noqa: E501


def main() -> None:
    """Makes the scans that are not there yet, measures, and prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="folder for scans and results")
    parser.add_argument("--only", nargs="+", default=[], help="parts of names")
    parser.add_argument("--edge", type=float, default=6.0, help="of the tets, mm")
    parser.add_argument("--kept", action="store_true", help="take rows that were measured before")
    parser.add_argument("--markdown", type=Path)
    options = parser.parse_args()
    data = data_folder()
    lines = [HEAD]
    for kind, head, seed in unseen(data):
        name = f"{kind}, {head}, seed {seed}"
        if options.only and not any(part in name for part in options.only):
            continue
        folder = options.work / f"{kind.split(',')[0].replace(' ', '_')}_{seed}"
        if not (folder / "clean").is_dir():
            clean, scan = made(data, kind, head, seed)
            written(folder / "scan", scan, with_sites=False, tilt=TILTS.get(kind, 0.0))
            written(folder / "clean", clean, with_sites=True)
        kept = folder / "row.json"
        is_kept = options.kept and kept.is_file()
        row = json.loads(kept.read_text("utf-8")) if is_kept else measured(folder, options.edge)
        lines.append(line(name, row))
        print(lines[-1], file=sys.stderr, flush=True)
    publish(options.markdown, NAME, "\n".join(lines))


if __name__ == "__main__":
    main()
