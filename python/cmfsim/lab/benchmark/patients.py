"""What a method of the benchmark reads and writes: patients, and displacements of their skin."""

import hashlib
import json
import math
import os
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, __version__
from cmfsim.errors import CaseInputError
from cmfsim.evaluation.regions import skin_regions
from cmfsim.io import Case, read_landmarks, read_surface
from cmfsim.io.files.reading_writing import check_readable, named, replacing
from cmfsim.io.results.populations import MADE, Population
from cmfsim.values.calibration import ADDED, PLAN, Source
from cmfsim.values.checks import Floats, as_rows, keep

# Vertices of a prediction may differ by this from those of the patient's skin, mm: they are written
# in single precision.
SAME_PLACE = 0.01
# No operation on the jaws moves skin further, mm: a larger displacement has another unit, or is the
# position of the moved vertex.
LARGEST_MOVE = 60.0
MEMBERS = {"vertices", "displacement", "half_width", "sd", "settings", "made_from"}
LIPS = "lips"
SKIN, CASE = "skin.ply", "case.toml"
READ = (CASE, "ct.nrrd", "skull.mrk.json", "skin.mrk.json", SKIN)
TRUE_SKIN = "truth/skin_exact.ply"
TRUTH_RECORD = "truth/truth.json"
# Of the logarithms, as docs/virtual_patients.md has what is drawn, and the axes of the execution.
THICKNESS_SD, STIFFNESS_SD = 0.12, 0.5
AXES = ("to the left", "backwards", "upwards")


@dataclass(frozen=True, eq=False)
class SkinPrediction:
    """The motion of a patient's skin as a method predicts it.

    Attributes
    ----------
    vertices : (v, 3) float64, mm
        Of `PATIENT/skin.ply`, in its order.
    displacement : (v, 3) float64, mm
    half_width : (v,) float64, mm, or None
        Of a band along the normal that, according to the method, covers 90 % of patients in each
        region of the face. NaN where there is none.
    sd : (v,) float64, mm, or None
        Instead of `half_width`, the expected standard deviation along the normal, above 0: the part
        `calibration` then determines how many of them cover 90 % of patients.
    settings : str
        The settings on which the standard deviation depends besides the patient, as JSON:
        predictions with different settings do not calibrate one another.
    made_from : str
        A digest of the inputs of the package's own entries, for reuse; empty for other methods.
    """

    vertices: Floats
    displacement: Floats
    half_width: Floats | None = None
    sd: Floats | None = None
    settings: str = ""
    made_from: str = ""

    def __post_init__(self) -> None:
        places = as_rows("vertices", self.vertices, 3)
        moves = as_rows("displacement", self.displacement, 3)
        if len(places) != len(moves):
            raise CaseInputError(f"{len(moves)} displacements for {len(places)} vertices")
        length = np.linalg.norm(moves, axis=1)
        most = int(length.argmax()) if len(length) else 0
        if len(length) and length[most] > LARGEST_MOVE:
            raise CaseInputError(
                f"displacement[{most}] is {length[most]:.0f} mm long: up to {LARGEST_MOVE:g} mm is "
                "allowed. Use mm, and write displacements, not positions"
            )
        keep(self, vertices=places, displacement=moves)
        if self.half_width is not None and self.sd is not None:
            raise CaseInputError("has both half_width and sd: give only one")
        if self.half_width is not None:
            keep(self, half_width=_lengths("half_width", self.half_width, len(places)))
        if self.sd is not None:
            deviations = _lengths("sd", self.sd, len(places))
            bad = np.flatnonzero(~(np.isfinite(deviations) & (deviations > 0.0)))
            if len(bad):
                raise CaseInputError(
                    f"sd[{bad[0]}] is {deviations[bad[0]]:g} mm: above 0 is needed, at each vertex"
                )
            keep(self, sd=deviations)

    def check_vertices(self, skin: ArrayLike) -> None:
        """Refuses a prediction of another skin, or of the same one in another order.

        Raises
        ------
        CaseError
            (also `ValueError`) A vertex lies elsewhere; the message names the first one.
        """
        places = as_rows("skin", skin, 3)
        if len(places) != len(self.vertices):
            raise CaseInputError(
                f"{len(self.vertices)} vertices, but the patient's skin.ply has {len(places)}: "
                "check whether the population was made again with another seed or resolution"
            )
        away = np.linalg.norm(self.vertices - places, axis=1)
        bad = np.flatnonzero(away > SAME_PLACE)
        if len(bad):
            raise CaseInputError(
                f"vertices[{bad[0]}] lies {away[bad[0]]:.2f} mm from that of the patient's "
                f"skin.ply ({SAME_PLACE:g} mm is allowed): give the vertices of that file, before "
                "the operation, in its order"
            )


def _lengths(name: str, values: ArrayLike, count: int) -> Floats:
    """Lengths of 0 or more, or NaN."""
    found = np.asarray(values, dtype=np.float64)
    if found.shape != (count,):
        raise CaseInputError(f"{name} has shape {found.shape}: ({count},) is needed")
    bad = np.flatnonzero(found < 0.0)
    if len(bad):
        raise CaseInputError(f"{name}[{bad[0]}] is {found[bad[0]]:g} mm: 0 or more is needed")
    return found


def write_skin_prediction(path: str | os.PathLike[str], prediction: SkinPrediction) -> None:
    """Writes a prediction as `.npz`, in single precision: the same bytes for the same prediction.

    Raises
    ------
    OSError
        The file cannot be written.

    Examples
    --------
    >>> import cmfsim
    >>> skin = cmfsim.read_surface("insilico/D003/skin.ply")  # doctest: +SKIP
    >>> still = cmfsim.SkinPrediction(skin.vertices, 0.0 * skin.vertices)  # doctest: +SKIP
    >>> cmfsim.write_skin_prediction("insilico/predictions/still/D003.npz", still)  # doctest: +SKIP
    """
    place = Path(path)
    place.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        "vertices": prediction.vertices.astype(np.float32),
        "displacement": prediction.displacement.astype(np.float32),
    }
    for name, values in (("half_width", prediction.half_width), ("sd", prediction.sd)):
        if values is not None:
            arrays[name] = values.astype(np.float32)
    for name, text in (("settings", prediction.settings), ("made_from", prediction.made_from)):
        if text:
            arrays[name] = np.array(text)
    with replacing(place) as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_skin_prediction(path: str | os.PathLike[str]) -> SkinPrediction:
    """The prediction of a `.npz` file.

    Raises
    ------
    FileNotFoundError
    CaseError
        (also `ValueError`) Not such an archive; an array that is missing, unknown or misshapen; a
        displacement that is not a number, or too long: with file, index and value.

    Examples
    --------
    >>> import cmfsim
    >>> found = cmfsim.read_skin_prediction("insilico/predictions/pls/D003.npz")  # doctest: +SKIP
    >>> found.displacement.shape  # doctest: +SKIP
    (20214, 3)
    """
    place = Path(path)
    check_readable(place)
    with named(place):
        try:
            with np.load(place, allow_pickle=False) as archive:
                unknown = set(archive.files) - MEMBERS
                missing = {"vertices", "displacement"} - set(archive.files)
                if unknown or missing:
                    raise CaseInputError(
                        f"has {', '.join(sorted(archive.files))}: vertices and displacement are "
                        "needed, half_width or sd is optional"
                    )
                found = {name: archive[name] for name in archive.files}
        except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
            if isinstance(error, CaseInputError):
                raise
            raise CaseInputError(f"is not an .npz archive of arrays: {error}") from error
        settings, made_from = (str(found.pop(name, "")) for name in ("settings", "made_from"))
        return SkinPrediction(**found, settings=settings, made_from=made_from)


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

    def planned_moves(self, carriers: Mapping[str, Sequence[str]]) -> Floats:
        """How far the plan moves skull landmarks, (3 k,) mm: each with its first moved carrier."""
        moves = []
        for name, segments in carriers.items():
            place, matrix = self.skull_landmarks[name], self.planned_motion(*segments)
            moves.append(matrix[:3, :3] @ place + matrix[:3, 3] - place)
        return np.concatenate(moves)

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
    """The patients of some parts who have a truth; an error if a file of one of them is missing."""
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

    None where it is not stated how much the truth of each differs.
    """
    known = [(p.departure, p.name) for p in patients if p.departure is not None]
    if len(known) < len(patients):
        return ()
    return tuple(sorted(name for _, name in sorted(known)[(len(known) + 1) // 2 :]))
