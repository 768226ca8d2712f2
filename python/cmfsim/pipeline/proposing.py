"""Landmarks of a head that has none: found on its surfaces, by the synthetic head and templates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from cmfsim.errors import CaseInputError
from cmfsim.io import Case, read_landmark_file, read_surface
from cmfsim.phantom.average_head import average_head
from cmfsim.registration.proposed import ProposedLandmarks, TemplateHead, landmarks_from
from cmfsim.surfaces.levels import detailed_surface
from cmfsim.values.anatomy import Anatomy
from cmfsim.values.surface_data import SurfaceData

__all__ = ["head_surfaces", "propose_landmarks", "proposed_for_case", "read_template_head"]

# What a template head keeps its surfaces in.
SURFACE_SUFFIXES = (".ply", ".stl", ".obj", ".vtp")


def propose_landmarks(
    bones: Mapping[str, SurfaceData],
    skin: SurfaceData | None = None,
    *,
    templates: Sequence[TemplateHead] = (),
) -> ProposedLandmarks:
    """The landmarks of a head without hand work: each site where its own definition holds.

    The head's plane of symmetry and the fit of a synthetic cranium give its pose; each site is
    found in the views from front and side by its definition, on either side and independently of
    the jaw's posture; heads whose landmarks are known correct the definitions' bias as far as the
    head resembles them. It takes a few seconds.

    Parameters
    ----------
    bones : mapping of str to SurfaceData
        LPS mm, upright within about 30°. The lower jaw is what is called "mandible"; without one,
        sites of the jaws are missing.
    skin : SurfaceData, optional
        Without it, no landmark of the skin is found.
    templates : sequence of TemplateHead, optional
        Further heads whose landmarks are known, besides the synthetic one.

    Returns
    -------
    ProposedLandmarks
        Points, mm, with the expected error of each; sites that the surfaces do not show are missing
        and listed with the reason.

    Raises
    ------
    LandmarkError
        (also `ValueError`) The bones show no face, or lie otherwise than LPS says.
    CaseError
        scipy is missing.

    Notes
    -----
    Sites after Rhine & Campbell (1980) and Phillips & Smuts (1996); poses by iterative closest
    points with steps to tangent planes (Chen & Medioni 1992). Accuracy: docs/landmarks.md.

    Examples
    --------
    >>> import cmfsim
    >>> from cmfsim.phantom.average_head import average_head
    >>> head = average_head()
    >>> found = cmfsim.propose_landmarks(head.bones, head.skin)
    >>> len(found.skull), len(found.skin)
    (32, 14)
    """
    return landmarks_from(bones, skin, [average_head(), *templates])


def head_surfaces(anatomy: Anatomy) -> tuple[dict[str, SurfaceData], SurfaceData | None]:
    """The bones and the skin of a head as surfaces: as given, or those of its levels.

    Raises
    ------
    CaseError
        (also `ValueError`) scikit-image is missing.
    """
    found: dict[str, SurfaceData] = {}
    for name, level in {**anatomy.bones, "skin": anatomy.skin}.items():
        surface = anatomy.surfaces.get(name) or detailed_surface(name, level)
        if surface is None:
            raise CaseInputError(
                "landmarks are found on surfaces, which need scikit-image: install "
                "'cmfsim[imaging]', or place the landmarks by hand"
            )
        found[name] = surface
    skin = found.pop("skin")
    return found, skin


def proposed_for_case(case: Case, anatomy: Anatomy) -> ProposedLandmarks:
    """The landmarks of a case's head, with the template heads that the case names."""
    bones, skin = head_surfaces(anatomy)
    templates = [read_template_head(folder) for folder in case.landmarks.templates]
    return propose_landmarks(bones, skin, templates=templates)


def read_template_head(folder: Path) -> TemplateHead:
    """A head whose landmarks are known, from a folder of surfaces and landmarks.

    The folder holds `cranium.*`, `mandible.*` and, where known, `skin.*` (PLY, STL, OBJ, VTP; LPS
    mm), `skull_landmarks.mrk.json` and, where known, `skin_landmarks.mrk.json`.

    Raises
    ------
    FileNotFoundError
        The folder has no cranium or no skull landmarks.
    CmfsimError
        (also `ValueError`) A file cannot be read.
    """
    surfaces = {
        name: read_surface(path)
        for name in ("cranium", "mandible", "skin")
        if (path := _file_of(folder, name)) is not None
    }
    points = {
        kind: read_landmark_file(path).points
        for kind in ("skull", "skin")
        if (path := folder / f"{kind}_landmarks.mrk.json").is_file()
    }
    if "cranium" not in surfaces or "skull" not in points:
        raise FileNotFoundError(
            f"{folder}: a template head needs a surface called cranium (.ply, .stl, .obj, .vtp) "
            "and skull_landmarks.mrk.json"
        )
    skin = surfaces.pop("skin", None)
    return TemplateHead(folder.name, surfaces, points["skull"], skin, points.get("skin", {}))


def _file_of(folder: Path, name: str) -> Path | None:
    found = [folder / f"{name}{suffix}" for suffix in SURFACE_SUFFIXES]
    return next((path for path in found if path.is_file()), None)
