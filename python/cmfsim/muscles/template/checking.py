"""Problems of a muscle template: files, surfaces, sides, landmarks, each with its fix."""

import itertools
import os
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from cmfsim._core import Surface
from cmfsim.io.cases.templates import survey_template
from cmfsim.io.files.reading_writing import is_there
from cmfsim.registration import side_vectors, wrong_sides
from cmfsim.surfaces.checks import check_surface
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.repair import clean_surface
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.landmark_sites import SKULL_LANDMARKS
from cmfsim.values.musculature import MuscleSurface, TemplateData

# Made by scripts/make_default_template.py.
BUILT_IN: Mapping[str, str] = MappingProxyType({"default": "default.npz"})


def template_names() -> tuple[str, ...]:
    """The names of the templates that come with the package.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.template_names()
    ('default',)
    """
    return tuple(BUILT_IN)


def template_path(folder_or_name: str | os.PathLike[str]) -> Path:
    """The folder or archive of a template; a built-in name comes first, `./default` means a folder.

    Raises `FileNotFoundError`: Neither a name nor a folder or archive.
    Raises `CaseError`: A name that no file can have.
    """
    if isinstance(folder_or_name, str) and folder_or_name in BUILT_IN:
        return Path(__file__).with_name(BUILT_IN[folder_or_name])
    path = Path(folder_or_name)
    if not is_there(path):
        known = ", ".join(BUILT_IN)
        raise FileNotFoundError(f"{path}: no such template; built in: {known}")
    return path


# Longest extents of a skull or its face, mm: from the facial skeleton alone to a head with neck.
SKULL_EXTENT = (90.0, 400.0)
# Distance of a landmark from the skull reference beyond which it lies on something else, mm: twice
# the placing error of an operator.
LANDMARK_DISTANCE = 5.0
# Least distance between a muscle and the skull beyond which one of them is in another place, mm:
# muscles round the mouth and of the neck reach within a centimetre of bone.
MUSCLE_DISTANCE = 20.0
# Distance of a fibre line outside its muscle beyond which it belongs to another, mm: lines start in
# bone, where the muscle's surface is cut off.
COURSE_DISTANCE = 8.0
# Landmarks with less spread across their best plane than this share of their greatest lie in it.
# A spline through them has no third direction.
PLANE_SHARE = 1e-3
# How many names a finding lists.
MOST_NAMES = 6


def check_template(template: TemplateData | str | os.PathLike[str]) -> tuple[Finding, ...]:
    """All problems of a template, each with its place, reason and fix.

    Parameters
    ----------
    template : MuscleTemplate, or path or name of one on disk
        A folder is surveyed as a whole: missing files, unknown keys, broken surfaces and landmarks
        are all found at once.

    Returns
    -------
    tuple of Finding
        Errors prevent its use; warnings make its muscles doubtful.

    Raises
    ------
    FileNotFoundError
        There is no such template.

    Examples
    --------
    >>> import cmfsim
    >>> [f.code for f in cmfsim.check_template("default") if f.severity == "error"]
    []
    """
    if isinstance(template, TemplateData):
        return check_contents(template)
    survey = survey_template(template_path(template))
    if survey.template is None:
        return survey.findings
    return check_contents(survey.template)


def check_contents(template: TemplateData) -> tuple[Finding, ...]:
    """Problems of the contents of a template, after the findings of its reading."""
    skull = _searchable(template.skull)
    kinds = {muscle.name: muscle.kind for muscle in template.muscles}
    middles = {m.name: m.surface.vertices.mean(axis=0)[0] for m in template.muscles}
    of_template = (
        *_check_terms(template),
        *_check_sites(template),
        *_check_landmark_places(template, skull),
        *_check_skull(template),
    )
    checks = (
        partial(_check_partner, kinds=kinds),
        partial(_check_muscle, skull=skull),
        partial(_check_side, middles=middles),
    )
    of_muscles = (findings_at(m.name, check(m)) for check in checks for m in template.muscles)
    return (
        *template.findings,
        *findings_at(template.name, of_template),
        *itertools.chain(*of_muscles),
    )


def _searchable(surface: object) -> Surface | None:
    """A surface to measure distances from; None if no triangle of it has an area."""
    cleaned = clean_surface(surface)  # type: ignore[arg-type]
    if not len(cleaned.triangles):
        return None
    return Surface(cleaned.vertices, cleaned.triangles)


def _listed(names: list[str]) -> str:
    return ", ".join(names[:MOST_NAMES]) + (", …" if len(names) > MOST_NAMES else "")


def _check_terms(template: TemplateData) -> Iterator[Finding]:
    if not template.attribution:
        yield Finding("template-source", "attribution is not stated")
    if not template.source:
        yield Finding("template-source", "source is not stated")


def _check_sites(template: TemplateData) -> Iterator[Finding]:
    """Names of landmarks against the usual ones, their definitions, and whether they span space."""
    names = list(template.landmarks)
    missing = [name for name in SKULL_LANDMARKS if name not in template.landmarks]
    extra = [name for name in names if name not in SKULL_LANDMARKS]
    if missing:
        yield Finding(
            "template-landmarks-missing",
            f"{len(missing)} of the {len(SKULL_LANDMARKS)} usual landmarks are missing: "
            f"{_listed(missing)}",
            fix="place them on the skull reference",
        )
    undefined = [name for name in extra if name not in template.definitions]
    if extra:
        yield Finding(
            "landmark-extra",
            f"{len(extra)} landmarks have names defined by this template: {_listed(extra)}"
            + (f"; without a definition: {_listed(undefined)}" if undefined else ""),
            severity="warning" if undefined else "note",
            why="they can be used only for patients with landmarks of the same names",
            fix="describe their positions under [landmarks.definitions], or use the usual names",
        )
    points = np.array(list(template.landmarks.values()))
    away = np.linalg.norm(points[:, None] - points[None], axis=2)
    close = np.triu(away <= 1e-6 * max(float(away.max()), 1e-300), k=1)
    for one, other in np.argwhere(close):
        yield Finding(
            "template-landmarks",
            f"{names[one]} and {names[other]} lie in the same place",
            why="no map can send one point to two places",
            fix="place one of them again",
        )
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) < 4 or spread[-1] <= PLANE_SHARE * spread[0]:
        found = f"there are {len(points)}" if len(points) < 4 else "all are in one plane"
        yield Finding(
            "template-landmarks",
            f"four landmarks that do not lie in a plane are needed: {found}",
            why="the map to a patient is undefined in the third direction",
        )


def _check_landmark_places(template: TemplateData, skull: Surface | None) -> Iterator[Finding]:
    """Left landmarks on the left, and all of them on the skull."""
    pairs = side_vectors(template.landmarks)
    swapped = wrong_sides(template.landmarks)
    if swapped:
        everything = len(swapped) == len(pairs)
        yield Finding(
            "left-right-swapped",
            "left and right are swapped in "
            + ("every pair" if everything else f"{len(swapped)} pairs")
            + f": {_listed(swapped)}",
            why="muscles would be inverted when they are fitted to a patient",
            fix="the set is mirrored, or in another frame than LPS"
            if everything
            else "swap their labels: _L is the patient's left, at greater x in LPS",
        )
    if skull is None:
        return
    points = np.array(list(template.landmarks.values()))
    for name, distance in zip(template.landmarks, distances(points, skull), strict=True):
        if distance > LANDMARK_DISTANCE:
            yield Finding(
                "template-off",
                f"{name} lies {distance:.1f} mm from the skull reference (at most "
                f"{LANDMARK_DISTANCE:g})",
                why="muscles would be pulled to a place without bone",
                fix="place it on the bone, in the frame and units of the skull reference",
            )


def _check_skull(template: TemplateData) -> Iterator[Finding]:
    vertices = template.skull.vertices
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    low, high = SKULL_EXTENT
    if not low <= extent <= high:
        yield Finding(
            "surface-units",
            f"the skull reference is {extent:.3g} mm long (a head has {low:g} to {high:g})",
            severity="error",
            why="its unit is not mm, or it is not a skull",
            fix='state the unit of the files: units = "cm"',
        )


def _check_partner(muscle: MuscleSurface, kinds: Mapping[str, str]) -> Iterator[Finding]:
    """A name that says another side than the muscle has, and a muscle on one side alone."""
    ending = muscle.name[-2:] if muscle.name[-2:] in {"_L", "_R"} else ""
    if ending != ("" if muscle.side == "both" else f"_{muscle.side}"):
        yield Finding(
            "template-sides",
            f"the side is {muscle.side!r}, the name ends in {ending or 'no side'!r}",
            severity="error",
            why="muscles are addressed by names that state their side",
            fix="end the name in _L or _R, or in neither for side both",
        )
    elif ending:
        partner = muscle.name[:-1] + ("R" if muscle.side == "L" else "L")
        if partner not in kinds:
            yield Finding("template-sides", f"there is no {partner}", severity="warning")
        elif muscle.side == "L" and kinds[partner] != muscle.kind:
            yield Finding(
                "template-sides",
                f"it is a {muscle.kind}, {partner} a {kinds[partner]}",
                severity="warning",
                why="fibres would differ between the sides",
                fix="give both the same kind",
            )


def _check_muscle(muscle: MuscleSurface, skull: Surface | None) -> Iterator[Finding]:
    yield from _check_muscle_surface(muscle)
    if skull is None or not len(muscle.surface.vertices):
        return
    nearest = float(distances(muscle.surface.vertices, skull).min())
    if nearest > MUSCLE_DISTANCE:
        yield Finding(
            "template-off",
            f"its distance from the skull is never below {nearest:.0f} mm (at most "
            f"{MUSCLE_DISTANCE:g})",
        )
    yield from _check_course(muscle)


def _check_muscle_surface(muscle: MuscleSurface) -> Iterator[Finding]:
    report = check_surface(muscle.surface)
    if report.volume < 0.0:
        yield Finding(
            "surface-normals",
            f"it encloses {report.volume:.0f} mm³: normals point inwards",
            severity="error",
        )
    if not report.is_closed:
        length = sum(loop.length for loop in report.borders)
        yield Finding(
            "surface-open",
            f"{len(report.borders)} borders, {length:.1f} mm long",
            severity="warning",
            why="near a gap, the winding number changes gradually from 1 to 0 instead of abruptly",
            fix="close it (cmfsim.repair_surface)",
        )
    if len(report.non_manifold) or report.inconsistent:
        yield Finding(
            "surface-non-manifold",
            f"{len(report.non_manifold)} edges of more than two triangles, {report.inconsistent} "
            "between triangles that face opposite ways",
        )
    if report.crossings is not None and len(report.crossings):
        yield Finding(
            "surface-crossing",
            f"{len(report.crossings)} pairs of triangles intersect",
            severity="note",
            why="winding numbers above ½ count as inside, so only folds of the surface are "
            "affected",
            fix="nothing to do if the muscle looks right",
        )


def _check_course(muscle: MuscleSurface) -> Iterator[Finding]:
    """Fibre lines that leave their muscle."""
    body = _searchable(muscle.surface)
    if body is None:
        return
    for number, line in enumerate(muscle.course):
        outside = body.winding_number(line) < 0.5
        away = float(distances(line, body)[outside].max(initial=0.0))
        if away > COURSE_DISTANCE:
            yield Finding(
                "template-off",
                f"fibre line {number} leaves it by {away:.1f} mm (at most {COURSE_DISTANCE:g})",
                why="the line may belong to another muscle",
                fix="correct the line",
            )


def _check_side(muscle: MuscleSurface, middles: Mapping[str, float]) -> Iterator[Finding]:
    """A left muscle on the left of its right one: x grows to the patient's left."""
    partner = f"{muscle.name[:-1]}R"
    if muscle.side != "L" or partner not in middles:
        return
    across = middles[muscle.name] - middles[partner]
    if across < 0.0:
        yield Finding(
            "left-right-swapped",
            f"it lies {-across:.0f} mm to the right of {partner}",
            fix="swap the names, or correct the frame: x grows to the patient's left",
        )
