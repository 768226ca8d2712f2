"""The plan of a case in a surgeon's words, from what can be read before any work."""

from collections.abc import Mapping

from cmfsim.bones.motion import sound_motion, torn_pieces
from cmfsim.doctor.evidence import Evidence
from cmfsim.errors import CmfsimError
from cmfsim.values.checks import Floats
from cmfsim.values.clinical_motion import ClinicalMotion, clinical_motion
from cmfsim.values.surface_data import MovedSurface

# A bone whose vertices deviate by less than this from a rigid motion, mm RMS, was not cut.
BENT = 0.5


def state_plan(
    evidence: Evidence, vertices: Mapping[str, Floats | None]
) -> dict[str, ClinicalMotion]:
    """The motion of each segment that the plan names and that can be read, by name.

    An achieved plan is empty here: it is read off the bones when the case is built.

    vertices: mapping of str to (k, 3), mm, or None, of the surface of each segment, where known.
    """
    found: dict[str, ClinicalMotion] = {}
    for name, given in evidence.case.plan.items():
        if name not in evidence.motions:
            moved = evidence.moved.get(name)
            if isinstance(moved, MovedSurface):
                found |= _of_surface(evidence, name, moved, given.source())
            continue
        read = evidence.transforms.get(name)
        found[name] = clinical_motion(
            name,
            evidence.motions[name],
            landmarks=evidence.skull_landmarks,
            vertices=vertices.get(name),
            centre=given.centre,
            source=given.source("" if read is None else read.text),
        )
    return found


def _of_surface(
    evidence: Evidence, name: str, moved: MovedSurface, source: str
) -> dict[str, ClinicalMotion]:
    """A bone's motion, or that of each piece of a bone that was cut, as `build` names them."""
    marks = evidence.skull_landmarks
    whole = clinical_motion(name, moved, landmarks=marks, source=source)
    if whole.residual is None or whole.residual < BENT:
        return {name: whole}
    try:
        pieces = torn_pieces(sound_motion(moved))
    except CmfsimError:
        # Reported where bones before and after are compared.
        return {name: whole}
    if len(pieces) == 1:
        return {name: whole}
    named = {name if n == 0 else f"{name}_{n + 1}": piece for n, piece in enumerate(pieces)}
    return {
        part: clinical_motion(part, piece, landmarks=marks, source=source)
        for part, piece in named.items()
    }
