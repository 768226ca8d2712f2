"""A predicted skin against the post-operative one: errors per vertex, figures, regions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim._core import Surface, ThinPlateSpline
from cmfsim.errors import CaseInputError, LandmarkError, LandmarkInputError, RegistrationInputError
from cmfsim.evaluation.regions import Matches, Skin, match_skins, skin_regions
from cmfsim.evaluation.statistics import DistanceStatistics, distance_statistics
from cmfsim.registration import match_landmarks
from cmfsim.values.checks import Floats, as_indices, as_rows, brief, check_one_of, frozen, plain
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import SKIN_LANDMARKS
from cmfsim.values.surface_data import SurfaceData

MATCHINGS = ("landmarks", "closest")
# Matches at a border, of the part that was to be evaluated, from which on a finding is made.
MANY_AT_BORDER = 0.05

Landmarks: TypeAlias = Mapping[str, ArrayLike] | ArrayLike
Choice: TypeAlias = ArrayLike | str | None


@dataclass(frozen=True, eq=False)
class SkinComparison:
    """Distances of a predicted skin from the post-operative one.

    Attributes
    ----------
    method : str
        How partners were found: "landmarks" or "closest".
    vertices : (k,) uint32
        The vertices of the predicted skin that were evaluated.
    signed : (k,) float64, mm
        Distance of each from its partner; negative where the prediction lies behind the
        post-operative skin.
    partners : (k, 3) float64, mm
        On the post-operative skin.
    statistics : DistanceStatistics
        From the prediction to the post-operative skin.
    back_signed : (b,) float64, mm
        The other direction: distance of post-operative vertices from their partners on the
        prediction, with the same sign: negative where the prediction lies behind.
    back_vertices : (b,) uint32
        Those vertices.
    backward : DistanceStatistics or None
        Of `back_signed`; None if no post-operative vertex faces the evaluated part.
    symmetric : DistanceStatistics or None
        Of both directions with equal weight.
    regions : mapping of str to DistanceStatistics
        From the prediction to the post-operative skin, by region; regions without an evaluated
        vertex are omitted.
    region_vertices : mapping of str to (r,) uint32
        The evaluated vertices in each.
    share : float
        Area of the evaluated vertices, of the area of the predicted skin.
    n_masked : int
        Vertices of the prediction outside the mask.
    n_covered, back_covered : int
        Vertices inside the mask that other skin covers, of the prediction and of the post-operative
        skin: they are not evaluated.
    n_border, back_border : int
        Excluded vertices, with a partner on the border of the other skin, where the distance
        depends on where the scan was cut; in either direction.
    findings : tuple of Finding
    """

    method: str
    vertices: NDArray[np.uint32]
    signed: Floats
    partners: Floats
    statistics: DistanceStatistics
    back_signed: Floats
    back_vertices: NDArray[np.uint32]
    backward: DistanceStatistics | None
    symmetric: DistanceStatistics | None
    regions: Mapping[str, DistanceStatistics]
    region_vertices: Mapping[str, NDArray[np.uint32]]
    share: float
    n_masked: int
    n_covered: int
    n_border: int
    back_covered: int
    back_border: int
    findings: tuple[Finding, ...]

    __repr__ = brief

    @property
    def mean(self) -> float:
        """Mean |distance| from the prediction, mm."""
        return self.statistics.mean

    @property
    def std(self) -> float:
        """Standard deviation of |distance|, mm."""
        return self.statistics.std

    @property
    def median(self) -> float:
        """Median |distance|, mm."""
        return self.statistics.median

    @property
    def rms(self) -> float:
        """Root of the mean square distance, mm."""
        return self.statistics.rms

    @property
    def p90(self) -> float:
        """90th percentile of |distance|, mm."""
        return self.statistics.p90

    @property
    def p95(self) -> float:
        """95th percentile of |distance|, mm."""
        return self.statistics.p95

    @property
    def max(self) -> float:
        """Largest |distance|, mm."""
        return self.statistics.max

    @property
    def signed_mean(self) -> float:
        """Mean distance with its sign, mm: negative, the prediction lies behind."""
        return self.statistics.signed_mean

    @property
    def within(self) -> Mapping[float, float]:
        """Share of vertices with |distance| up to 1, 1.5, 2, 3 mm."""
        return self.statistics.within

    @property
    def hausdorff(self) -> float:
        """Largest |distance| of both directions, mm."""
        return max(self.max, self.backward.max if self.backward is not None else 0.0)

    def field(self, n_vertices: int) -> Any:
        """The signed distances on all vertices of the predicted skin; masked where not evaluated.

        Parameters
        ----------
        n_vertices : int
            Of the predicted skin.

        Returns
        -------
        (n,) numpy masked array, mm
        """
        if len(self.vertices) and n_vertices <= int(self.vertices.max()):
            raise CaseInputError(
                f"vertex {int(self.vertices.max())} was evaluated, so this skin of {n_vertices} "
                "vertices is a different one"
            )
        values, masked = np.zeros(n_vertices), np.ones(n_vertices, dtype=bool)
        values[self.vertices] = self.signed
        masked[self.vertices] = False
        return np.ma.array(values, mask=masked)

    def as_dict(self) -> dict[str, Any]:
        """Plain values with units in their names, as JSON holds them; no arrays."""
        return {
            "method": self.method,
            "prediction_to_postoperative": self.statistics.as_dict(),
            "postoperative_to_prediction": plain(self.backward),
            "symmetric": plain(self.symmetric),
            "hausdorff_mm": self.hausdorff,
            "regions": plain(self.regions),
            "evaluated_share_of_area": self.share,
            "excluded": {
                "masked": self.n_masked,
                "covered": self.n_covered,
                "border": self.n_border,
                "covered_backward": self.back_covered,
                "border_backward": self.back_border,
            },
            "findings": [
                {"severity": f.severity, "code": f.code, "what": f.what} for f in self.findings
            ],
        }


def compare_skins(
    simulated: SurfaceData | Surface,
    postoperative: SurfaceData | Surface,
    *,
    landmarks: tuple[Landmarks, Landmarks] | None = None,
    method: str | None = None,
    mask: Choice = None,
    regions: Mapping[str, ArrayLike] | None = None,
) -> SkinComparison:
    """The distances of a predicted skin from the post-operative one.

    Parameters
    ----------
    simulated, postoperative : SurfaceData or Surface
        Skins in one frame with outward normals; they may be open, for example at the neck.
    landmarks : (landmarks, landmarks), optional
        Of the simulated and of the post-operative skin: mappings of name to place, matched by name
        (`match_landmarks`), or (n, 3) arrays in one order, mm.
    method : str, optional
        "landmarks": a thin-plate spline through the landmarks carries the simulated skin near the
        post-operative one, and the point closest to the carried vertex is its partner (Kim et al.
        2010, section 3.2). "closest": the point closest to the vertex itself. Default: the first if
        there are landmarks.
    mask : (n,) bool, (k,) indices or "face", optional
        The vertices of the simulated skin to evaluate, such as those that the simulation could
        move; "face" takes the face by its landmarks. Default: all.
    regions : mapping of str to (n,) bool or (k,) indices, optional
        Regions to report separately. Default: `skin_regions` if the landmarks have the usual names.

    Raises
    ------
    RegistrationError
        (also `ValueError`) No vertex is left; landmarks in one plane, coincident, too few.
    LandmarkError
        (also `ValueError`) Landmarks are missing, swapped between left and right, or are no face's.
    CaseError
        (also `ValueError`) An unknown method, a mask or region of another skin.
    MeshError
        (also `ValueError`) A surface with degenerate triangles.

    Notes
    -----
    Vertices with other skin within 3 mm in front of them, such as between closed lips, are not
    evaluated, because no scan shows them; they are counted.

    The error is the distance of the *unwarped* vertex from its partner. It is at least the distance
    to the closest point, and more where skin moved along itself: corners of the mouth, wings of
    the nose.

    Examples
    --------
    >>> import cmfsim
    >>> square = [[x, y, 0.0] for y in range(5) for x in range(5)]
    >>> cells = [5 * j + i for j in range(4) for i in range(4)]
    >>> triangles = [t for c in cells for t in ([c, c + 1, c + 6], [c, c + 6, c + 5])]
    >>> after = cmfsim.SurfaceData(square, triangles)
    >>> predicted = cmfsim.SurfaceData([[x, y, z - 0.5] for x, y, z in square], triangles)
    >>> report = cmfsim.compare_skins(predicted, after)
    >>> report.mean, report.signed_mean, report.n_border, report.within[1.0]
    (0.5, -0.5, 16, 1.0)
    """
    if method is None:
        method = "closest" if landmarks is None else "landmarks"
    check_one_of("method", method, MATCHINGS)
    skin, other = Skin(simulated), Skin(postoperative)
    warps = _warps(landmarks) if method == "landmarks" else _Warps()
    names = landmarks[0] if landmarks is not None else None
    parts = _parts(skin, regions, names)
    asked = _chosen_vertices(mask, skin, parts)
    chosen, seen = _uncovered(skin, asked), ~other.covered()
    matches = match_skins(skin, chosen, other, warp=warps.forth)
    _check_matched(matches)
    backward = _backward((other, seen), (skin, chosen), warp=warps.back)
    found = _findings(matches, int(chosen.sum()), warps.forth, skin.vertices[chosen])
    areas = skin.vertex_areas()
    return SkinComparison(
        method=method,
        vertices=frozen(matches.vertices.astype(np.uint32)),
        signed=frozen(matches.signed),
        partners=frozen(matches.partners),
        statistics=distance_statistics(matches.signed),
        **_from_behind(matches, backward),
        n_covered=int(asked.sum() - chosen.sum()),
        back_covered=int(len(seen) - seen.sum()),
        **_by_region(matches, parts),
        share=float(areas[matches.vertices].sum() / areas.sum()),
        n_masked=int(len(asked) - asked.sum()),
        n_border=matches.n_border,
        findings=(*warps.findings, *found),
    )


def _uncovered(skin: Skin, asked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    chosen = asked & ~skin.covered()
    if not chosen.any():
        raise RegistrationInputError(
            f"all {asked.sum()} vertices to evaluate have other skin within 3 mm in front of them: "
            "check that the predicted skin is one surface whose normals point outwards"
        )
    return chosen


@dataclass(frozen=True)
class _Warps:
    """Splines between two skins, in both directions; None where vertices are not carried."""

    forth: ThinPlateSpline | None = None
    back: ThinPlateSpline | None = None
    findings: tuple[Finding, ...] = ()


def _warps(landmarks: tuple[Landmarks, Landmarks] | None) -> _Warps:
    if landmarks is None:
        raise LandmarkInputError(
            "method is 'landmarks', but there are none: give landmarks=(of the simulated skin, "
            "of the post-operative skin), or use method='closest'"
        )
    ours, theirs, findings = _paired(*landmarks)
    return _Warps(ThinPlateSpline(ours, theirs), ThinPlateSpline(theirs, ours), findings)


def _check_matched(matches: Matches) -> None:
    if not len(matches.vertices):
        raise RegistrationInputError(
            f"all {matches.n_border} vertices are matched to the border of the post-operative "
            "skin; check that both are in one frame and unit (in a case: frame, units, aligned in "
            "[postoperative]; aligned = false registers them), and the mask is on the scanned face"
        )


def _from_behind(matches: Matches, backward: Matches) -> dict[str, Any]:
    """What a `SkinComparison` has from the post-operative skin, and from both directions."""
    # Seen from the post-operative side, behind is in front.
    signed = -backward.signed
    both = (matches.signed, signed)
    # Half of the weight to each direction.
    weights = np.concatenate([np.full(len(v), 0.5 / max(len(v), 1)) for v in both])
    return {
        "back_signed": frozen(signed),
        "back_vertices": frozen(backward.vertices.astype(np.uint32)),
        "backward": distance_statistics(signed) if len(signed) else None,
        "symmetric": distance_statistics(np.concatenate(both), weights=weights)
        if len(signed)
        else None,
        "back_border": backward.n_border,
    }


def _by_region(matches: Matches, parts: Mapping[str, NDArray[np.bool_]]) -> dict[str, Any]:
    """Statistics and vertices of the regions that have any."""
    inside = {name: part[matches.vertices] for name, part in parts.items()}
    inside = {name: part for name, part in inside.items() if part.any()}
    return {
        "regions": MappingProxyType(
            {name: distance_statistics(matches.signed[part]) for name, part in inside.items()}
        ),
        "region_vertices": MappingProxyType(
            {n: frozen(matches.vertices[i].astype(np.uint32)) for n, i in inside.items()}
        ),
    }


def _paired(ours: Landmarks, theirs: Landmarks) -> tuple[Floats, Floats, tuple[Finding, ...]]:
    """Landmarks of two skins in one order, by name or as they stand, and what to know of them."""
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        try:
            # Those that both have are enough; the others are findings.
            match = match_landmarks(ours, theirs, required=())
        except LandmarkError as error:
            raise LandmarkInputError(
                f"landmarks of the predicted skin (source) and the post-operative one (target): "
                f"{error}"
            ) from error
        return match.source, match.target, match.findings
    if isinstance(ours, Mapping) or isinstance(theirs, Mapping):
        raise LandmarkInputError(
            "one set of landmarks has names and the other does not: give two mappings, or two "
            "arrays"
        )
    first, second = (as_rows("landmarks", given, 3) for given in (ours, theirs))
    if len(first) != len(second):
        raise LandmarkInputError(
            f"there are {len(first)} landmarks of one skin and {len(second)} of the other: both "
            "must have the same number, in the same order"
        )
    return first, second, ()


def _parts(
    skin: Skin, regions: Mapping[str, ArrayLike] | None, names: Landmarks | None
) -> dict[str, NDArray[np.bool_]]:
    """The vertices of each region to report."""
    if regions is not None:
        count = len(skin.vertices)
        return {n: _as_choice(f"region {n!r}", v, count) for n, v in regions.items()}
    if isinstance(names, Mapping) and all(name in names for name in SKIN_LANDMARKS):
        return skin_regions(skin.vertices, names)
    return {}


def _chosen_vertices(
    mask: Choice, skin: Skin, parts: Mapping[str, NDArray[np.bool_]]
) -> NDArray[np.bool_]:
    if isinstance(mask, str):
        if mask not in parts:
            raise LandmarkInputError(
                f"mask is {mask!r}, but there are regions {', '.join(parts) or 'none'}: give all "
                "landmarks of the skin by name, or a mask of its vertices"
            )
        return parts[mask]
    if mask is None:
        return np.ones(len(skin.vertices), dtype=bool)
    return _as_choice("mask", mask, len(skin.vertices))


def _as_choice(name: str, value: ArrayLike, count: int) -> NDArray[np.bool_]:
    """Chosen vertices as (count,) bool, from bools or indices; at least one."""
    given = np.asarray(value)
    if given.dtype.kind == "b":
        if given.shape != (count,):
            raise CaseInputError(f"{name} has shape {given.shape}, but the skin {count} vertices")
        chosen = given.copy()
    else:
        chosen = np.zeros(count, dtype=bool)
        chosen[as_indices(name, value, count)] = True
    if not chosen.any():
        raise CaseInputError(f"{name} contains no vertex")
    return chosen


def _backward(
    seen_part: tuple[Skin, NDArray[np.bool_]],
    evaluated: tuple[Skin, NDArray[np.bool_]],
    *,
    warp: ThinPlateSpline | None,
) -> Matches:
    """Partners of the post-operative vertices on the evaluated part of the simulated skin."""
    (other, seen), (skin, chosen) = seen_part, evaluated
    part = skin if chosen.all() else skin.part(chosen)
    if part is None:
        none = np.zeros(0, dtype=np.int64)
        return Matches(none, np.zeros((0, 3)), np.zeros(0), 0)
    return match_skins(other, seen, part, warp=warp)


def _findings(
    matches: Matches, n_chosen: int, warp: ThinPlateSpline | None, places: Floats
) -> Sequence[Finding]:
    found = []
    if matches.n_border > MANY_AT_BORDER * n_chosen:
        found.append(
            Finding(
                "many-border-matches",
                f"{matches.n_border} of {n_chosen} vertices are matched to the border of the "
                "post-operative skin and excluded",
            )
        )
    folds = warp.folds(places) if warp is not None else None
    if folds is not None and folds.count:
        found.append(
            Finding(
                "correspondence-folds",
                f"the map between the landmarks folds at {folds.count} of {n_chosen} vertices",
            )
        )
    return found
