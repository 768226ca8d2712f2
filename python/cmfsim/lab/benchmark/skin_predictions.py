"""The entry of a method: a displacement for each vertex of a patient's skin, in a `.npz` file."""

import os
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cmfsim.errors import CaseInputError
from cmfsim.io.files.reading_writing import check_readable, named, replacing
from cmfsim.values.checks import Floats, as_rows

# Vertices of a prediction may differ by this from those of the patient's skin, mm: they are written
# in single precision.
SAME_PLACE = 0.01
# No operation on the jaws moves skin further, mm: a larger displacement has another unit, or is the
# position of the moved vertex.
LARGEST_MOVE = 60.0
MEMBERS = {"vertices", "displacement", "half_width", "sd", "settings", "made_from"}


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
        object.__setattr__(self, "vertices", places)
        object.__setattr__(self, "displacement", moves)
        if self.half_width is not None and self.sd is not None:
            raise CaseInputError("has both half_width and sd: give only one")
        if self.half_width is not None:
            widths = _lengths("half_width", self.half_width, len(places))
            object.__setattr__(self, "half_width", widths)
        if self.sd is not None:
            deviations = _lengths("sd", self.sd, len(places))
            bad = np.flatnonzero(~(np.isfinite(deviations) & (deviations > 0.0)))
            if len(bad):
                raise CaseInputError(
                    f"sd[{bad[0]}] is {deviations[bad[0]]:g} mm: above 0 is needed, at each vertex"
                )
            object.__setattr__(self, "sd", deviations)

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
