"""The rows of a frontier: choices, their error on points of the skin, their cost; and the front."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface
from cmfsim.errors import CaseInputError
from cmfsim.evaluation.regions import skin_regions
from cmfsim.evaluation.statistics import DistanceStatistics, distance_statistics
from cmfsim.io.files.archives import member_of, read_archive, write_archive
from cmfsim.lab.frontier.choice import Choice
from cmfsim.surfaces.depth import distances
from cmfsim.values.checks import Floats, Plain, as_rows, in_files
from cmfsim.values.landmark_sites import SKIN_LANDMARKS
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.table import csv_of

Regions = dict[str, NDArray[np.bool_]]

POINTS_FORMAT = "cmfsim-bench-points"
# The region that figures speak of: by landmarks on the skin, without them all points.
WHOLE = "face"
# All points: the skin of the simulated tissue, the face and what lies round it.
SKIN = "skin"
# Points at most: beyond, figures do not change any more.
MOST_POINTS = 20_000
# Points up to this far from the mesh's skin are on the tissue, mm.
ON_TISSUE = 2.0


def skin_points(patient: PatientModel) -> tuple[Floats, Regions]:
    """Points of the skin of a patient's simulated tissue, and which lie in each region of the face.

    They are vertices of the detailed face, so that they are the same however the tissue is meshed.
    Without all of the skin's landmarks the face is all of them, in one part.
    """
    face = patient.face
    if face is None:
        raise CaseInputError(
            f"{patient.name}: predictions are compared on the detailed face, which is read from "
            "the image with scikit-image: pip install '.[imaging]' in cmfsim's folder"
        )
    vertices = face.vertices
    landmarks = patient.landmarks.get("skin", {})
    skin = Surface(patient.skin.vertices, patient.skin.triangles)
    on_tissue = distances(vertices, skin) <= ON_TISSUE
    regions = {WHOLE: on_tissue}
    if set(SKIN_LANDMARKS) <= set(landmarks):
        regions = skin_regions(vertices, landmarks)
    regions = {**regions, SKIN: on_tissue | regions[WHOLE]}
    if not regions[WHOLE].any():
        raise CaseInputError(
            f"{patient.name}: no point of the skin is on the face: check that the skin landmarks "
            "are in the frame of the image"
        )
    chosen = np.flatnonzero(regions[SKIN])
    chosen = chosen[:: -(-len(chosen) // MOST_POINTS)]
    return vertices[chosen], {name: inside[chosen] for name, inside in regions.items()}


def skin_errors(
    moved: ArrayLike, reference: ArrayLike, regions: Mapping[str, NDArray[np.bool_]]
) -> dict[str, DistanceStatistics]:
    """Figures of |u - u_ref| at the same points, mm, over each region that has points.

    moved, reference: (k, 3), mm. Displacements by a prediction and by the reference.
    """
    ours, theirs = as_rows("moved", moved, 3), as_rows("reference", reference, 3)
    if len(ours) != len(theirs):
        raise CaseInputError(f"moved has {len(ours)} points, the reference {len(theirs)}")
    apart = np.linalg.norm(ours - theirs, axis=1)
    return {
        name: distance_statistics(apart[inside]) for name, inside in regions.items() if inside.any()
    }


def write_points(path: Path, points: Floats, regions: Mapping[str, NDArray[np.bool_]]) -> None:
    """Replaces a file of points and regions in one step."""
    arrays = {f"region.{name}": inside for name, inside in regions.items()}
    write_archive(path, POINTS_FORMAT, "points_of", {}, {"points": points, **arrays})


def read_points(path: Path) -> tuple[Floats, Regions]:
    """The points and regions that `write_points` wrote."""
    _, arrays = read_archive(path, POINTS_FORMAT, "points_of")
    regions = {n.removeprefix("region."): a for n, a in arrays.items() if n.startswith("region.")}
    return member_of(arrays, "points"), regions


# Errors are told apart in steps of this, mm: two methods that solve the same system differ by less.
ERROR_STEP = 1e-3


@dataclass(frozen=True)
class Spread:
    """Repeated measurements of one quantity."""

    median: float
    low: float
    high: float
    count: int

    @staticmethod
    def of(values: Sequence[float]) -> "Spread":
        """The spread of at least one value."""
        return Spread(float(np.median(values)), min(values), max(values), len(values))


@dataclass(frozen=True, eq=False)
class FrontierRow(Plain):
    """The cost and the error of one choice.

    Attributes
    ----------
    choice : Choice
    is_base, is_reference : bool
        Whether it is the case's own choice, or the choice with which the others are compared.
    on_front : bool
        Whether no other row is as accurate (to 0.001 mm in the mean) in less time. The reference,
        whose error is 0 by definition, is not a candidate.
    failure : str
        Why there is no prediction; empty if there is one.
    error : mapping of str to DistanceStatistics
        |u - u_ref|, mm, over the face, its regions and the whole skin; empty where it failed.
    build_wall, build_cpu : float or None, s
        From the files to the scene, of one run.
    solve_wall, solve_cpu : Spread or None, s
        From the scene to the displacements.
    ratio : Spread or None
        `solve_wall` over that of the base in the same round.
    build_peak, solve_peak : float or None, MB
        Largest resident memory of the process, interpreter and scene included.
    n_tets, n_unknowns : int or None
    details : mapping
        Residual, iterations and contact of the solution, seconds of each stage.
    """

    choice: Choice
    is_base: bool = False
    is_reference: bool = False
    on_front: bool = False
    failure: str = ""
    error: Mapping[str, DistanceStatistics] = field(default_factory=dict)
    build_wall: float | None = field(default=None, metadata=in_files("build_wall_s"))
    build_cpu: float | None = field(default=None, metadata=in_files("build_cpu_s"))
    solve_wall: Spread | None = field(default=None, metadata=in_files("solve_wall_s"))
    solve_cpu: Spread | None = field(default=None, metadata=in_files("solve_cpu_s"))
    ratio: Spread | None = field(default=None, metadata=in_files("solve_ratio"))
    build_peak: float | None = field(default=None, metadata=in_files("build_peak_mb"))
    solve_peak: float | None = field(default=None, metadata=in_files("solve_peak_mb"))
    n_tets: int | None = None
    n_unknowns: int | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    @property
    def total_wall(self) -> float | None:
        """Seconds from the files to the face; None where it failed."""
        if self.build_wall is None or self.solve_wall is None:
            return None
        return self.build_wall + self.solve_wall.median

    @property
    def mean(self) -> float | None:
        """The mean error over the face, mm; None where it failed."""
        return self.error[WHOLE].mean if WHOLE in self.error else None

    def as_dict(self) -> dict[str, Any]:
        """Plain values with their unit in the name, as JSON holds them."""
        return {**super().as_dict(), "total_wall_s": self.total_wall}


@dataclass(frozen=True)
class Frontier(Plain):
    """Error against run time of many ways to predict one face.

    Attributes
    ----------
    case : str
        The name of the case.
    n_points : int
        On the skin, at which predictions are compared.
    moved : float, mm
        Mean movement of these points in the reference.
    machine : mapping
        Processor, threads, versions, commit.
    rows : tuple of FrontierRow
        The base first, the reference last.
    """

    case: str
    n_points: int
    moved: float = field(metadata=in_files("reference_movement_mm"))
    machine: Mapping[str, Any]
    rows: tuple[FrontierRow, ...]

    @property
    def base(self) -> FrontierRow:
        """The case's own choice."""
        return next(row for row in self.rows if row.is_base)

    @property
    def reference(self) -> FrontierRow:
        """The row with which all others are compared."""
        return next(row for row in self.rows if row.is_reference)

    @property
    def front(self) -> tuple[FrontierRow, ...]:
        """The rows that no other row beats, fastest first."""
        rows = [row for row in self.rows if row.on_front]
        return tuple(sorted(rows, key=lambda row: row.total_wall or 0.0))

    def csv(self) -> str:
        """One line for each row; an error column for each region's mean, mm."""
        named = dict.fromkeys(name for row in self.rows for name in row.error if name != WHOLE)
        return csv_of([_csv_row(row, list(named)) for row in self.rows])


def with_front(rows: Sequence[FrontierRow]) -> tuple[FrontierRow, ...]:
    """The rows with those marked that no other one beats in mean error and total time."""
    able = [i for i, row in enumerate(rows) if row.mean is not None and not row.is_reference]
    front = unbeaten([rows[i].total_wall or 0.0 for i in able], [rows[i].mean or 0.0 for i in able])
    marked = {i for i, on in zip(able, front, strict=True) if on}
    return tuple(replace(row, on_front=i in marked) for i, row in enumerate(rows))


def _csv_row(row: FrontierRow, regions: Sequence[str]) -> dict[str, Any]:
    """The choice, errors and cost of a row of the CSV file, by column."""
    whole = row.error.get(WHOLE)
    return {
        **asdict(row.choice),
        "role": "base" if row.is_base else "reference" if row.is_reference else "",
        "on_front": int(row.on_front),
        "mean_mm": whole and whole.mean,
        "p95_mm": whole and whole.p95,
        "max_mm": whole and whole.max,
        **{f"{n} mean_mm": row.error[n].mean if n in row.error else None for n in regions},
        "total_wall_s": row.total_wall,
        "build_wall_s": row.build_wall,
        "build_cpu_s": row.build_cpu,
        **_spread_columns("solve_wall", "_s", row.solve_wall),
        "solve_cpu_s": row.solve_cpu and row.solve_cpu.median,
        "repeats": row.solve_wall and row.solve_wall.count,
        **_spread_columns("ratio", "", row.ratio),
        "build_peak_mb": row.build_peak,
        "solve_peak_mb": row.solve_peak,
        "n_tets": row.n_tets,
        "n_unknowns": row.n_unknowns,
        "failure": row.failure,
    }


def _spread_columns(name: str, unit: str, spread: Spread | None) -> dict[str, float | None]:
    found = (None,) * 3 if spread is None else (spread.median, spread.low, spread.high)
    titles = (f"{name}{end}{unit}" for end in ("", "_low", "_high"))
    return dict(zip(titles, found, strict=True))


def unbeaten(seconds: Sequence[float], errors: Sequence[float]) -> list[bool]:
    """Which rows no other row beats: as low in both costs, and lower in one.

    Errors count as far as they are worth telling; rows that are equal do not beat each other.
    """
    x, y = np.asarray(seconds), np.round(np.array(errors) / ERROR_STEP)
    on_front = np.zeros(len(x), dtype=bool)
    best, best_at = np.inf, np.nan
    # By time, then by error: what comes before a row takes no longer.
    for row in np.lexsort((y, x)):
        if y[row] < best or (y[row] == best and x[row] == best_at):
            on_front[row] = True
            best, best_at = y[row], x[row]
    return [bool(on) for on in on_front]
