"""Whether surfaces and the ends of the tissue are sound, and fine enough to mesh between."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cmfsim.doctor.evidence import Body, Evidence, distances_from, place_text
from cmfsim.values.finding import Finding, findings_at
from cmfsim.values.landmark_sites import label_key

# Spacing above which thin structures of a face are lost, mm: half the thickness of lips and lids.
COARSE_SPACING = 2.5
# A border longer than this many extents of the skin surrounds the face, not the neck: a cap over it
# replaces the back of the head.
WIDE_BORDER = 2.0
# Shares of slivers above which they are reported, and above which normals are doubtful.
SOME_SLIVERS, SLIVER_SHARE = 0.01, 0.05
# Share of crossing triangles above which the enclosed volume is implausible.
CROSSING_SHARE = 0.02
# Share of the skin with tissue thinner than an edge, above which it is reported.
THIN_SHARE = 0.02


def check_image(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the voxels of the CT, before any of it is segmented."""
    image = evidence.image
    if image is None:
        return
    largest = float(np.max(image.spacing))
    if largest > COARSE_SPACING:
        size = " × ".join(f"{s:.2f}" for s in image.spacing)
        yield Finding(
            "ct-spacing-coarse",
            f"voxels are {size} mm",
            where=evidence.case.where("image.file"),
            why=f"above {COARSE_SPACING:g} mm, thin bone, lids and lips are lost between voxels",
            fix="use the thin series of the scan (1 mm or below) if there is one",
        )


def check_surfaces(evidence: Evidence) -> Iterator[Finding]:
    """Findings about each surface separately."""
    checks = (
        _check_borders, _check_orientation, _check_edges, _check_crossings, _check_pieces,
        _check_triangles,
    )  # fmt: skip
    for body in [*([evidence.skin] if evidence.skin else []), *evidence.bones.values()]:
        yield from body.walls
        for check in checks:
            yield from findings_at(body.where, check(body))


def _check_borders(body: Body) -> Iterator[Finding]:
    report = body.report
    if not report.borders:
        return
    longest = report.borders[0]
    lengths = ", ".join(f"{loop.length:.1f}" for loop in report.borders[:4])
    more = ", …" if len(report.borders) > 4 else ""
    extent = float((report.highest - report.lowest).max())
    wide = longest.length > WIDE_BORDER * extent
    yield Finding(
        "surface-open",
        f"{len(report.borders)} open borders of {lengths}{more} mm, the longest around "
        f"{place_text(longest.centre)}",
        severity="warning" if wide or body.name != "skin" else "note",
        why="only a closed surface has an inside and an outside: gaps are capped"
        + (", and the shape of a cap this wide is invented" if wide else ""),
    )


def _check_orientation(body: Body) -> Iterator[Finding]:
    report = body.report
    if report.inconsistent or not report.orientable:
        yield Finding(
            "surface-normals",
            f"{report.inconsistent} edges have triangles that face opposite ways"
            + ("" if report.orientable else "; a part has only one side (Möbius)"),
            severity="warning",
            why="inside and outside differ from place to place; the smaller part is flipped",
        )
    elif report.volume < 0.0:
        yield Finding(
            "surface-normals",
            f"normals point inwards (volume {report.volume:.0f} mm³)",
            severity="warning",
            why="inside and outside are swapped; build flips it",
        )


def _check_edges(body: Body) -> Iterator[Finding]:
    """Edges at which a surface forks."""
    report = body.report
    if len(report.non_manifold):
        vertex = body.surface.vertices[report.non_manifold[0, 0]]
        yield Finding(
            "surface-non-manifold",
            f"{len(report.non_manifold)} edges have more than two triangles, first at "
            f"{place_text(vertex)}",
        )


def _check_crossings(body: Body) -> Iterator[Finding]:
    report = body.report
    if report.crossings is None:
        yield Finding(
            "surface-crossing",
            "triangles are too crowded to check for intersections",
            severity="warning",
            fix="remesh it with triangles of about equal size",
        )
    elif len(report.crossings) and report.crossing_points is not None:
        share = len(np.unique(report.crossings)) / max(report.n_triangles, 1)
        yield Finding(
            "surface-crossing",
            f"{len(report.crossings)} pairs of triangles intersect, first at "
            f"{place_text(report.crossing_points[0])}",
            severity="warning" if share > CROSSING_SHARE or body.name == "skin" else "note",
        )


def _check_pieces(body: Body) -> Iterator[Finding]:
    """Islands: several pieces, of which the small ones are debris."""
    report = body.report
    largest, *others = report.components
    # Inside out, a piece within another is a hollow and belongs there.
    solid = [piece for piece in others if piece.volume * report.volume >= 0.0]
    if not solid or body.walls:
        return
    share = sum(piece.area for piece in solid) / largest.area
    yield Finding(
        "surface-islands",
        f"{len(solid)} pieces besides the largest, with {share:.1%} of its area; the next has "
        f"{solid[0].n_triangles} triangles at {place_text(solid[0].centre)}",
        severity="warning" if body.name == "skin" else "note",
    )


def _check_triangles(body: Body) -> Iterator[Finding]:
    report = body.report
    if len(report.degenerate) or len(report.duplicate):
        yield Finding(
            "surface-degenerate",
            f"{len(report.degenerate)} triangles without area and {len(report.duplicate)} repeated",
            severity="note",
            why="they have no normal, or their volume counts twice; they are removed",
            fix="nothing to do",
        )
    share = len(report.slivers) / max(report.n_triangles, 1)
    if share > SOME_SLIVERS:
        yield Finding(
            "surface-degenerate",
            f"{len(report.slivers)} of {report.n_triangles} triangles are slivers, over a "
            "hundred times longer than high",
            severity="warning" if share > SLIVER_SHARE else "note",
            fix="remesh it if tissue slides on it" if share <= SLIVER_SHARE else "remesh it",
        )


def check_mesh_size(evidence: Evidence) -> Iterator[Finding]:
    """Findings about tissue that is thinner than the tets that should fill it."""
    case, skin = evidence.case, evidence.skin
    if skin is None or not evidence.bones or case.mesh.file is not None:
        return
    points = skin.samples[evidence.in_region(skin.samples)]
    if not len(points):
        return
    thickness = distances_from(evidence.bones.values(), points)
    edge = case.mesh.edge_length
    thin = thickness < edge
    if thin.mean() <= THIN_SHARE:
        return
    place = points[int(np.argmin(thickness))]
    refined = case.mesh.refine
    yield Finding(
        "edge-length-coarse",
        f"{thin.mean():.0%} of the skin of the region lies closer to bone than "
        f"an edge of {edge:g} mm, {thickness.min():.1f} mm at {place_text(place)}",
        severity="note" if refined else "warning",
        where=case.where("mesh.edge_length"),
        why="layers thinner than an edge are lost or too stiff"
        + (" unless refined" if refined else ""),
        fix="nothing to do"
        if refined
        else f"set edge_length to {0.5 * edge:g} or below, or refine",
    )


CORNERS = ("cheilion_R", "cheilion_L")
BORDERS = ("labiale_superius", "labiale_inferius")
# Methods that solve contact of the lips.
METHODS = ("auto", "pcg")

# What moves the chin, and the landmarks at its lower and upper border.
LOWER_JAW = frozenset({"mandible", "mandible_body", "chin"})
LOWEST, HIGHEST = "menton", "infradentale"
# Soft tissue follows a bone that moves over about its own thickness, mm.
NEAR_END = 20.0


def check_ends(evidence: Evidence) -> Iterator[Finding]:
    """A finding where the chin moves and the tissue below it is fixed close by."""
    case = evidence.case
    moving = {*case.plan, *(n for cut in case.osteotomies for n in cut.segments)} & LOWER_JAW
    if not moving:
        return
    if (found := _chin(evidence)) is None:
        return
    place, top, where = found
    ends = []
    if case.region.lower is not None:
        ends.append(
            (case.region.lower, case.where("region.lower"), "move lower in [region] further down")
        )
    if evidence.image is not None:
        key = case.where("image.file")
        ends.append(
            (float(evidence.image.lowest[2]), key, "use an image that extends further down")
        )
    if not ends:
        return
    end, key, how = max(ends)
    room = place - end
    # A jaw that lies beyond the end altogether is another finding's.
    if room >= NEAR_END or top < end:
        return
    yield Finding(
        "segment-near-end",
        f"{', '.join(sorted(moving))} moves, and the tissue ends, fixed, {max(room, 0.0):.1f} mm "
        f"below {where} (z = {place:.1f} mm, end at {end:.1f} mm; at least {NEAR_END:g} mm is "
        "needed)",
        where=key,
        fix=f"{how}, or leave chin and throat out of the evaluation",
    )


def _chin(evidence: Evidence) -> tuple[float, float, str] | None:
    """The heights of the lower border of the chin and of the jaw's top, and their source."""
    points = evidence.skull_landmarks
    if LOWEST in points:
        heights = [float(points[n][2]) for n in (LOWEST, HIGHEST) if n in points]
        return heights[0], max(heights), f"the landmark {LOWEST}"
    if "mandible" in evidence.bones:
        heights = evidence.bones["mandible"].surface.vertices[:, 2].tolist()
        return min(heights), max(heights), "the mandible"
    return None


def check_lips(evidence: Evidence) -> Iterator[Finding]:
    """Findings about the contact of the lips, where a case asks for it."""
    case = evidence.case
    lips = case.lips
    if not lips.contact:
        return
    if case.solver.method not in METHODS:
        yield Finding(
            "lips-contact",
            f"contact of the lips is not solved by method = {case.solver.method!r}",
            severity="error",
            where=case.where("solver.method"),
            why="the solver would end with an error",
            fix=f"write one of {', '.join(METHODS)}, or contact = false in [lips]",
        )
    if case.node_kinds.get("sliding") is False:
        yield Finding(
            "lips-contact",
            "contact of the lips is enabled, but tissue does not slide on the teeth",
            severity="warning",
            where=case.where("node_kinds.sliding"),
            why="the lips stay attached to the teeth and can hardly meet",
            fix="remove sliding = false from [node_kinds], or set contact = false in [lips]",
        )
    if isinstance(lips.seam, Path):
        return
    known = {label_key(name) for name in evidence.skin_landmarks}
    missing = [name for name in (*CORNERS, *BORDERS) if label_key(name) not in known]
    if not missing:
        return
    if lips.seam == "landmarks":
        yield Finding(
            "landmark-missing",
            f'seam = "landmarks", and the skin landmarks {", ".join(missing)} are missing',
            severity="error",
            where=case.where("lips.seam"),
            why="the lips would not be separated",
            fix='place them, or set seam = "auto" in [lips]',
        )
        return
    yield Finding(
        "landmark-missing",
        f"the skin landmarks {', '.join(missing)} are missing",
        severity="note",
        where=case.where("landmarks.skin"),
        why="the line between the lips and the corners of the mouth are then found on the skin "
        "alone and cannot be checked; if the skin shows neither gap nor crease, the lips "
        "are not separated",
    )
