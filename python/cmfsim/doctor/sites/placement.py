"""Whether skin, bones and landmarks are in plausible places: units, frames, sides, distances."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cmfsim.doctor.evidence import Body, Evidence, distances_from, place_text
from cmfsim.doctor.sites.landmarks import (
    Nearest,
    check_landmarks,
    nearest_of_level,
    nearest_of_surfaces,
)
from cmfsim.errors import ImageError
from cmfsim.io import Case
from cmfsim.registration import side_vectors, wrong_sides
from cmfsim.surfaces.checks import check_surface
from cmfsim.surfaces.depth import distances
from cmfsim.surfaces.repair import INNER_WALL
from cmfsim.values.case_parts import SKIN_EXTENT, UNITS
from cmfsim.values.checks import Floats
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.image_data import ImageData

# Longest extents that other units give a head, and their name; normalised to 1 or to −1…1.
OTHER_UNITS: Sequence[tuple[str, float, float, float]] = (
    ("m", 0.11, 0.42, 1000.0),
    ("normalised coordinates", 0.42, 2.05, 0.0),
    ("inch", 4.3, 10.9, 25.4),
    ("cm", 10.9, 42.0, 10.0),
    ("um", 110_000.0, 420_000.0, 0.001),
)
# Longest extent of a bone as a share of the skin's: a chin is a tenth of a head, a skull less than
# all of it. Beyond these bounds, the nearest unit shows which one is wrong.
BONE_SHARE = (0.04, 1.15)
# Share of a bone's points outside the skin above which it is misplaced, not merely too far out.
ELSEWHERE_SHARE = 0.4
# Another frame explains this if no more than this share is outside in it.
FITTING_SHARE = 0.05
# Mean thickness below which a skin is a shell, mm: a whole head has 40 and more.
SHELL_THICKNESS = 20.0
# Distance of bone outside the skin above which it is reported, mm: the accuracy of two surfaces.
THROUGH_SKIN = 0.1
# Distances of a set of landmarks from its surface, mm, at which it fits, and at which another frame
# or unit is tried.
LANDMARK_WARNING, LANDMARK_ERROR = 5.0, 15.0
# Number of landmarks on a single given bone above which they are not there by chance.
OF_ONE_BONE = 4
# Smallest share of the landmarks that are then far from it.
OF_OTHERS = 0.25
# HU at which bone and skin begin where the case does not state it, as in `SegmentOptions`.
THRESHOLDS = {"skull": 250.0, "skin": -300.0}
# Distance of two groups of landmarks below which they give no direction, mm.
SHORTEST = 5.0
# Share of the length of a direction that its main axis must have for the head to be upright.
MAIN_AXIS = 0.5

FRONT = ("nasion", "glabella", "supradentale", "infradentale", "pogonion", "pronasale", "subnasale")
BACK = ("supraglenoid", "gonion", "occlusal_line", "exocanthion")
ABOVE = ("supraglabella", "glabella", "nasion")
BELOW = ("menton", "pogonion", "infradentale", "labiale_inferius")
HALF_TURN = np.array([-1.0, -1.0, 1.0])


def check_placement(evidence: Evidence) -> list[Finding]:
    """Findings about positions; a fault that causes others is reported alone."""
    findings: list[Finding] = []
    if (skin := evidence.skin) is not None:
        findings += findings_at(skin.where, _check_skin_size(evidence.case, skin))
        findings += _check_bone_sizes(evidence, skin)
    if findings:
        return findings
    for name, body in evidence.bones.items():
        findings += _check_bone_inside(evidence, name, body)
        if any(finding.code == INNER_WALL for finding in findings):
            # The skin's fault, the same for every bone.
            break
    if any(finding.severity == "error" for finding in findings):
        return findings
    turned = False
    for key, landmarks in (("skull", evidence.skull_landmarks), ("skin", evidence.skin_landmarks)):
        if not landmarks:
            continue
        where = evidence.case.where(f"landmarks.{key}")
        checks = (
            _check_landmark_fit(evidence, key, landmarks),
            _check_within_image(evidence.image, landmarks),
            _check_directions(landmarks),
            _check_sides(landmarks),
        )
        wrong = next(filter(None, (list(findings_at(where, found)) for found in checks)), [])
        if not wrong:
            nearest = _nearest_point(evidence, key, landmarks)
            wrong = check_landmarks(key, landmarks, where, nearest)
        turned |= any(f.code == "frame-turned" and f.severity == "error" for f in wrong)
        findings += wrong
    if not turned:
        findings += _check_bone_directions(evidence)
    findings += _check_bone_overlap(evidence)
    return findings


def _extent(points: Floats) -> float:
    return float(np.ptp(points, axis=0).max())


def _check_skin_size(case: Case, skin: Body) -> Iterator[Finding]:
    extent = _extent(skin.repaired.vertices)
    low, high = SKIN_EXTENT
    if low <= extent <= high:
        return
    stated = case.surfaces.units if case.surfaces else "mm"
    # In the numbers of the file: if another unit is stated, they may simply be mm.
    numbers = extent / UNITS[stated]
    if low <= numbers <= high:
        yield Finding(
            "surface-units",
            f"the skin is {numbers:.4g} long in the numbers of the file: they look like mm but "
            f"are read as {stated} ({extent:.4g} mm)",
            severity="error",
        )
        return
    for name, least, most, factor in OTHER_UNITS:
        if least <= extent <= most:
            fix = (
                f'write units = "{name}" under [surfaces]'
                if factor and stated == "mm"
                else "export the surfaces in mm, or correct units under [surfaces]"
            )
            yield Finding(
                "surface-units",
                f"the skin is {extent:.4g} mm long: this looks like {name}, read as {stated}",
                severity="error",
                fix=fix,
            )
            return
    yield Finding(
        "surface-units",
        f"the skin is {extent:.4g} mm long",
        severity="error" if not 0.5 * low <= extent <= 2.0 * high else "warning",
        why=f"a head or face is {low:g} to {high:g} mm long",
        fix="check the units, and that the file holds the skin alone",
    )


def _check_bone_sizes(evidence: Evidence, skin: Body) -> Iterator[Finding]:
    size = _extent(skin.repaired.vertices)
    low, high = SKIN_EXTENT
    if not low <= size <= high:
        return
    for name, body in evidence.bones.items():
        extent = _extent(body.repaired.vertices)
        if BONE_SHARE[0] * size <= extent <= BONE_SHARE[1] * size:
            continue
        yield Finding(
            "surface-units",
            f"bone {name} is {extent:.4g} mm long, the skin {size:.4g} mm",
            severity="error",
            where=body.where,
            why="all surfaces of a case must have the same units and the same frame",
            fix="export it in the units of the skin",
        )


def _bodies(evidence: Evidence, key: str) -> list[Body]:
    if key == "skull":
        given = evidence.case.surfaces
        # With a bone missing, its landmarks would seem to lie far from the others.
        is_whole = given is not None and set(evidence.bones) == set(given.bones)
        return list(evidence.bones.values()) if is_whole else []
    return [evidence.skin] if evidence.skin else []


def _check_landmark_fit(
    evidence: Evidence, key: str, landmarks: Mapping[str, Floats]
) -> Iterator[Finding]:
    """Landmarks that fit their surface only in another frame or in other units."""
    bodies = _bodies(evidence, key)
    if not bodies:
        return
    points = np.stack(list(landmarks.values()))
    nearest = np.sort(distances_from(bodies, points))
    median = float(np.median(nearest))
    if median <= LANDMARK_ERROR:
        return
    if key == "skull" and _is_part(bodies, points):
        # The others belong to the bone that is not given.
        return
    surface = "bones" if key == "skull" else "skin"
    what = f"half of the landmarks are more than {median:.0f} mm from the {surface}"
    tries = {
        "frame": (HALF_TURN, "converted from RAS to LPS"),
        "m": (np.full(3, 1000.0), "read as metres"),
        "cm": (np.full(3, 10.0), "read as cm"),
        "um": (np.full(3, 0.001), "read as µm"),
        "inch": (np.full(3, 25.4), "read as inches"),
    }
    for name, (factors, done) in tries.items():
        fitted = float(np.median(distances_from(bodies, points * factors)))
        if fitted <= LANDMARK_WARNING:
            is_frame = name == "frame"
            yield Finding(
                "landmark-frame",
                f"{what}; {done}, {fitted:.1f} mm",
                fix="correct coordinateSystem in the file (LPS or RAS), or frame under "
                "[surfaces] if it is the surfaces that have the wrong frame"
                if is_frame
                else "correct coordinateUnits in the file, or save it again in mm",
            )
            return
    yield Finding("landmark-frame", what)


def _check_within_image(
    image: ImageData | None, landmarks: Mapping[str, Floats]
) -> Iterator[Finding]:
    """Landmarks outside the CT, or inside it only in another frame."""
    if image is None:
        return
    points = np.stack(list(landmarks.values()))

    def outside(places: Floats) -> NDArray[np.bool_]:
        beyond = (places < image.lowest - LANDMARK_WARNING) | (
            places > image.highest + LANDMARK_WARNING
        )
        outside: NDArray[np.bool_] = np.any(beyond, axis=1)
        return outside

    wrong = outside(points)
    if not wrong.any():
        return
    turned = outside(points * HALF_TURN)
    is_frame = int(turned.sum()) < 0.5 * int(wrong.sum())
    names = [name for name, is_wrong in zip(landmarks, wrong, strict=True) if is_wrong]
    more = ", …" if len(names) > 4 else ""
    yield Finding(
        "landmark-frame" if is_frame else "landmark-outside-image",
        f"{len(names)} of {len(landmarks)} landmarks lie outside the image"
        + (f", converted from RAS to LPS {int(turned.sum())}" if is_frame else "")
        + f": {', '.join(names[:4])}{more}",
        severity="error" if is_frame or wrong.mean() > ELSEWHERE_SHARE else "warning",
        fix="correct coordinateSystem in the file (LPS or RAS)"
        if is_frame
        else "check that landmarks and image are from one patient and in mm, and that the scan is "
        "complete",
    )


def _mean(landmarks: Mapping[str, Floats], names: Sequence[str]) -> Floats | None:
    """Mean of the available landmarks; pairs count only if both sides are available."""
    found: list[Floats] = []
    for name in names:
        if name in landmarks:
            found.append(landmarks[name])
        elif f"{name}_L" in landmarks and f"{name}_R" in landmarks:
            found.append(0.5 * (landmarks[f"{name}_L"] + landmarks[f"{name}_R"]))
    return np.mean(found, axis=0) if found else None


def _direction(
    one: Floats | None, other: Floats | None, across: Floats | None = None
) -> Floats | None:
    """The unit vector from the second to the first point, at right angles to another if given."""
    if one is None or other is None:
        return None
    vector = one - other
    return _unit(vector if across is None else vector - (vector @ across) * across)


def _unit(vector: Floats) -> Floats | None:
    """The unit vector; None if the vector is too short to have a direction."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > SHORTEST else None


def _check_directions(landmarks: Mapping[str, Floats]) -> Iterator[Finding]:
    """A head that does not look along −P with its left along +L and its crown along +S."""
    pairs = side_vectors(landmarks)
    left = _unit(np.mean(list(pairs.values()), axis=0)) if pairs else None
    up = _direction(_mean(landmarks, ABOVE), _mean(landmarks, BELOW))
    # At right angles to the face, or points that lie behind and above it would point upwards.
    back = _direction(_mean(landmarks, BACK), _mean(landmarks, FRONT), up)
    signs = [
        0 if v is None or abs(v[axis]) < MAIN_AXIS else int(np.sign(v[axis]))
        for axis, v in enumerate((left, back, up))
    ]
    if signs[0] < 0 and signs[1] < 0:
        yield Finding(
            "frame-turned",
            "the face looks towards +P and its left side lies towards R: these are RAS coordinates "
            "read as LPS",
            severity="error",
            fix='state the frame: "coordinateSystem": "RAS" in the file, and frame = "RAS" under '
            "[surfaces] if the surfaces are in it as well",
        )
    elif signs[0] < 0:
        yield Finding(
            "left-right-swapped",
            f"of {len(pairs)} pairs of landmarks, the left ones are on the right (R) side",
            why="either the labels are swapped or the data are mirrored; a plan would move the "
            "wrong side",
            fix="swap the labels _L and _R; if the labels are right, the images or surfaces are "
            "mirrored: export them again",
        )
    elif signs[1] < 0 or signs[2] < 0:
        what = "the face looks backwards" if signs[1] < 0 else "the head is upside down"
        yield Finding("frame-turned", f"according to its landmarks, {what}", severity="error")
    elif any(v is not None and s == 0 for v, s in zip((left, back, up), signs, strict=True)):
        yield Finding(
            "frame-turned",
            "according to its landmarks, the head is rotated by more than 60° from the axes",
            severity="warning",
            why="default planes are placed along the axes",
            fix="rotate the data upright, or give posterior_plane and the planes of the cuts",
        )


def _check_sides(landmarks: Mapping[str, Floats]) -> Iterator[Finding]:
    wrong = wrong_sides(landmarks)
    if wrong:
        names = ", ".join(wrong)
        yield Finding("left-right-swapped", f"left and right are swapped in: {names}")


def _nearest_point(evidence: Evidence, key: str, landmarks: Mapping[str, Floats]) -> Nearest | None:
    """Closest points on the bones or the skin of the case, if it has them."""
    bodies = _bodies(evidence, key)
    if key == "skull" and _is_part(bodies, np.stack(list(landmarks.values()))):
        return None
    if bodies:
        return nearest_of_surfaces([body.index for body in bodies])
    given, image = evidence.case.image, evidence.image
    if given is None or image is None:
        return None
    stated = given.bone_threshold if key == "skull" else given.skin_threshold
    # A case of surfaces loads nothing of imaging.
    from cmfsim.imaging.intensities.intensity import calibration  # noqa: PLC0415

    try:
        to_hu = calibration(image.values, given.rescale)
    except ImageError:
        # No CT: reported where the image is segmented.
        return None
    threshold = THRESHOLDS[key] if stated is None else stated
    return nearest_of_level(image, (threshold - to_hu.offset) / to_hu.slope, landmarks)


def _is_part(bodies: Sequence[Body], points: Floats) -> bool:
    """Whether the landmarks belong to a whole skull, of which a single bone is given."""
    if len(bodies) != 1:
        return False
    nearest = distances_from(bodies, points)
    return int((nearest <= LANDMARK_WARNING).sum()) >= OF_ONE_BONE and bool(
        np.quantile(nearest, 1.0 - OF_OTHERS) > LANDMARK_ERROR
    )


def _check_bone_directions(evidence: Evidence) -> Iterator[Finding]:
    """A lower jaw that does not lie in front of and below the cranium."""
    cranium, mandible = evidence.bones.get("cranium"), evidence.bones.get("mandible")
    if cranium is None or mandible is None:
        return
    lowest, highest = cranium.report.lowest, cranium.report.highest
    middle = 0.5 * (lowest + highest)
    jaw = 0.5 * (mandible.report.lowest + mandible.report.highest)
    away = jaw - middle
    margin = 0.05 * (highest - lowest)
    if away[1] > margin[1] or away[2] > margin[2]:
        direction = "behind" if away[1] > margin[1] else "above"
        yield Finding(
            "surface-frame",
            f"the mandible lies {direction} the middle of the cranium",
            where=mandible.where,
            why="in LPS the face looks along −P and the crown along +S",
            fix='write frame = "RAS" under [surfaces] if the files are in RAS; otherwise '
            "check their axes",
        )


def _check_bone_inside(evidence: Evidence, name: str, body: Body) -> Iterator[Finding]:
    skin = evidence.skin
    if skin is None:
        return
    # Behind the region, a face mask has no skin.
    points = body.samples[evidence.in_region(body.samples)]
    points = points if len(points) else body.samples
    outside = skin.index.winding_number(points) < 0.5
    if not outside.any():
        return
    depth = np.zeros(len(points))
    depth[outside] = distances(points[outside], skin.index)
    share = float(outside.mean())
    if share > ELSEWHERE_SHARE and (thickness := _shell_thickness(skin, body)) is not None:
        yield Finding(
            INNER_WALL,
            f"{share:.0%} of bone {name} lies outside the skin, which is a shell some "
            f"{thickness:.0f} mm thick around it: its outer and inner wall are joined",
            severity="error",
            where=skin.where,
            why="between the bone and the inner wall there would be no tissue",
            fix="export the skin as a solid, its outer wall alone (in 3D Slicer: fill the segment, "
            "or undo Hollow)",
        )
        return
    if share > ELSEWHERE_SHARE:
        turned = float((skin.index.winding_number(points * HALF_TURN) < 0.5).mean())
        is_frame = turned <= FITTING_SHARE
        yield Finding(
            "surface-frame",
            f"{share:.0%} of bone {name} lies outside the skin"
            + (f", converted from RAS to LPS {turned:.0%}" if is_frame else ""),
            where=body.where,
        )
        return
    if depth.max() <= THROUGH_SKIN:
        return
    worst = int(np.argmax(depth))
    yield Finding(
        "bone-outside-skin",
        f"bone {name} protrudes from the skin by {depth[worst]:.1f} mm at "
        f"{place_text(points[worst])}, with {share:.1%} of its points",
        where=body.where,
        why="no tissue covers it, so the skin there is bone",
        fix="correct the surface there; build cuts the bone off at the skin",
    )


def _shell_thickness(skin: Body, bone: Body) -> float | None:
    """The mean thickness of a skin that is a shell around a bone, mm; None if it is none."""
    outer, inner = skin.repaired.vertices, bone.samples
    is_above = (inner.min(axis=0) >= outer.min(axis=0)).all()
    is_around = is_above and (inner.max(axis=0) <= outer.max(axis=0)).all()
    # A shell has two walls, and the area of both.
    report = check_surface(skin.repaired, crossings=False)
    thickness = 2.0 * report.volume / report.area
    return thickness if is_around and 0.0 < thickness < SHELL_THICKNESS else None


# Depth below its surface at which a bone is tested for being inside another, mm: surfaces that
# merely touch, as in joints and at cuts, do not count.
UNDER_SURFACE = 0.5
# Share of a bone's points inside another above which it is reported as being inside it.
OVERLAP_SHARE = 0.05


def _check_bone_overlap(evidence: Evidence) -> Iterator[Finding]:
    for name, body in evidence.bones.items():
        inner = body.samples - UNDER_SURFACE * body.index.closest(body.samples)[1]
        for other_name, other in evidence.bones.items():
            # Each pair once, with the smaller bone inside the other.
            size, other_size = body.report.area, other.report.area
            if (size, name) >= (other_size, other_name):
                continue
            share = float((other.index.winding_number(inner) > 0.5).mean())
            if share > OVERLAP_SHARE:
                yield Finding(
                    "bone-overlap",
                    f"{share:.0%} of bone {name} lies within bone {other_name}",
                    where=body.where,
                    facts={"name": name, "other_name": other_name},
                )
