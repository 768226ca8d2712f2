"""A patient of the benchmark: what a method may read, and the truth that it is scored by."""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from cmfsim._core import Surface, __version__
from cmfsim.errors import CaseInputError
from cmfsim.evaluation import skin_regions
from cmfsim.io import Case, read_landmarks, read_surface
from cmfsim.io.results.populations import MADE, Population
from cmfsim.values.checks import Floats
from cmfsim.values.uncertainty import ADDED, PLAN, Source

LIPS = "lips"
SKIN, CASE = "skin.ply", "case.toml"
READ = (CASE, "ct.nrrd", "skull.mrk.json", "skin.mrk.json", SKIN)
TRUE_SKIN = "truth/skin_exact.ply"
TRUTH_RECORD = "truth/truth.json"
# Of the logarithms, as docs/virtual_patients.md has what is drawn, and the axes of the execution.
THICKNESS_SD, STIFFNESS_SD = 0.12, 0.5
AXES = ("to the left", "backwards", "upwards")


def _sd_of(sources: Iterable[Source], name: str) -> float:
    return next(source.sd for source in sources if source.name == name)


@dataclass(frozen=True)
class BenchmarkPatient:
    """One patient of a population."""

    name: str
    folder: Path

    @cached_property
    def surface(self) -> Surface:
        """The skin before the operation."""
        found = read_surface(self.folder / SKIN)
        return Surface(found.vertices, found.triangles)

    @property
    def skin(self) -> Floats:
        """Its vertices, (v, 3) mm."""
        return self.surface.vertices

    @cached_property
    def normals(self) -> Floats:
        """The unit normals of the skin before the operation, (v, 3)."""
        return self.surface.vertex_normals

    @cached_property
    def case(self) -> Case:
        """The case file, with the plan."""
        return Case.load(self.folder / CASE)

    @cached_property
    def landmarks(self) -> Mapping[str, Floats]:
        """Of the skin before the operation, as they were placed."""
        return read_landmarks(self.folder / "skin.mrk.json")

    @cached_property
    def skull_landmarks(self) -> Mapping[str, Floats]:
        """Of the skull before the operation, as they were placed."""
        return read_landmarks(self.folder / "skull.mrk.json")

    @cached_property
    def regions(self) -> dict[str, NDArray[np.bool_]]:
        """The vertices in each region of the face, and in both lips together."""
        found = skin_regions(self.skin, self.landmarks)
        return {**found, LIPS: found["upper lip"] | found["lower lip"]}

    @cached_property
    def truth(self) -> Floats:
        """How each vertex truly moves, (v, 3) mm: in the test part, for no method to read."""
        after = read_surface(self.folder / TRUE_SKIN).vertices
        if after.shape != self.skin.shape:
            raise CaseInputError(
                f"{self.name}: {SKIN} has {len(self.skin)} vertices and {TRUE_SKIN} has "
                f"{len(after)}: make the patient again"
            )
        return after - self.skin

    @cached_property
    def departure(self) -> float | None:
        """How far the truth departs from what a prediction can know; None where it is not recorded.

        The root mean square of what was drawn for the thickness and the stiffness of muscles, the
        change of thickness, and the execution of the plan, each over its standard deviation.
        """
        path = self.folder / TRUTH_RECORD
        if not path.exists():
            return None
        drawn = json.loads(path.read_text(encoding="utf-8")).get("patient", {})
        if "departures" not in drawn:
            return None
        off = [
            math.log(drawn["muscle_thickness"]) / THICKNESS_SD,
            math.log(drawn["muscle_stiffness"]) / STIFFNESS_SD,
            drawn["thickness_change"] / _sd_of(ADDED, "thickness change"),
        ]
        for moved in drawn["departures"].values():
            shifts = zip(AXES, moved["translation"], strict=True)
            off += [shift / _sd_of(PLAN, axis) for axis, shift in shifts]
        return math.sqrt(sum(value**2 for value in off) / len(off))

    def planned_motion(self, *segments: str) -> Floats:
        """The planned motion (4, 4) mm of the first of some segments that the plan moves."""
        for name in segments:
            motion = self.case.plan.get(name)
            if motion is not None:
                if motion.matrix is None:
                    raise CaseInputError(f"{self.name}: the plan of {name} is no rigid motion")
                return motion.matrix
        return np.eye(4)

    def digest(self, *, truth: bool = False) -> str:
        """SHA-256 of this version and the files that a method may read; with the truth, or not."""
        found = hashlib.sha256(__version__.encode())
        for name in (*READ, TRUE_SKIN) if truth else READ:
            found.update(name.encode() + b"\0")
            found.update((self.folder / name).read_bytes())
        return found.hexdigest()


def patients_of(
    folder: Path, population: Population, parts: Iterable[str]
) -> list[BenchmarkPatient]:
    """The patients of some parts who have a truth.

    Raises `CaseError`: One of them has no folder, or none is there.
    """
    names = population.named(MADE, *parts)
    for name in names:
        for file in (*READ, TRUE_SKIN):
            if not (folder / name / file).exists():
                raise CaseInputError(
                    f"{folder / name / file} is missing: make the population again with "
                    "cmfsim virtual-patients --count"
                )
    return [BenchmarkPatient(name, folder / name) for name in names]


def far_from_models(patients: Sequence[BenchmarkPatient]) -> tuple[str, ...]:
    """The half of the patients whose truth differs most from what predictions can know.

    None of them where it is not stated how much the truth of each differs.
    """
    known = [(p.departure, p.name) for p in patients if p.departure is not None]
    if len(known) < len(patients):
        return ()
    return tuple(sorted(name for _, name in sorted(known)[(len(known) + 1) // 2 :]))
