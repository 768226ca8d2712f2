"""The muscle template: loaded, saved, and carried to a patient by landmarks."""

import os
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from cmfsim._core import ThinPlateSpline
from cmfsim.errors import CaseInputError, LandmarkError
from cmfsim.io.cases.templates import read_template, write_template
from cmfsim.io.landmarks import read_landmark_file
from cmfsim.muscles.template.checking import check_contents, template_path
from cmfsim.registration import LandmarkAgreement, LandmarkMatch, leave_one_out, match_landmarks
from cmfsim.values.checks import Floats, as_number
from cmfsim.values.finding import Finding
from cmfsim.values.landmark_sites import is_lower_site
from cmfsim.values.musculature import Musculature, TemplateData
from cmfsim.values.surface_data import SurfaceData


class MuscleTemplate(TemplateData):
    """Facial muscles of one head, to be mapped to others by landmarks (Kim et al. 2010, 2.2).

    Attributes
    ----------
    name : str
    muscles : tuple of MuscleSurface
    skull : SurfaceData
        The bones that the muscles lie on, LPS mm.
    landmarks : mapping of str to (3,) float64, mm
        On that skull; `cmfsim.SKULL_LANDMARKS` has the usual 32 names and their positions in words.
    licence, attribution, source : str
        Terms of use, attribution and origin.
    definitions : mapping of str to str
        Where each landmark lies, in words.
    concepts : mapping of str to tuple of str
        Names of muscles in an outside vocabulary, such as their FMA ids.
    findings : tuple of Finding
        Findings of its creation or reading.

    Raises
    ------
    CaseError
        (also `ValueError`) No muscle, a name twice or one that cannot be a file name, no licence.
    LandmarkError
        (also `ValueError`) No landmark, or one that is not three finite numbers.

    Examples
    --------
    >>> import cmfsim
    >>> template = cmfsim.MuscleTemplate.load("default")
    >>> len(template.musculature), len(template.landmarks)
    (38, 32)
    >>> muscles = template.morph({n: 1.1 * p for n, p in template.landmarks.items()})
    >>> muscles["masseter_L"].kind
    'strap'
    """

    @classmethod
    def load(cls, folder_or_name: str | os.PathLike[str] = "default") -> "MuscleTemplate":
        """The template of a folder or `.npz` archive, or a built-in one by its name.

        Parameters
        ----------
        folder_or_name : path or str
            "default" is the built-in one; `./default` would be a folder.

        Raises
        ------
        FileNotFoundError
            No such template, or a file that it names is missing.
        CaseError
            (also `ValueError`) It cannot be read: file, line and key.

        Examples
        --------
        >>> import cmfsim
        >>> cmfsim.MuscleTemplate.load("default").licence
        'MIT OR Apache-2.0'
        """
        return cls.of(read_template(template_path(folder_or_name)))

    @classmethod
    def of(cls, data: TemplateData) -> "MuscleTemplate":
        """The template with the contents of another."""
        return cls(**{f.name: getattr(data, f.name) for f in fields(TemplateData)})

    def save(
        self, path: str | os.PathLike[str], *, report: Mapping[str, Any] | None = None
    ) -> None:
        """Writes the template: a folder, or one archive if the name ends in `.npz`.

        Parameters
        ----------
        path : path
            An existing folder is replaced as a whole if it contains a template and nothing else.
        report : mapping, optional
            Plain values that are written next to it as `report.json`.

        Raises
        ------
        CaseError
            (also `ValueError`) The folder holds files that are not of a template.
        OSError
            The place cannot be written to.
        """
        write_template(path, self, report)

    def check(self) -> tuple[Finding, ...]:
        """All problems of the template, each with its place and fix; see `check_template`."""
        return check_contents(self)

    def morph(
        self, landmarks: Mapping[str, ArrayLike] | str | os.PathLike[str], *, smoothing: float = 0.0
    ) -> "MorphedMusculature":
        """The template's muscles in a patient, by a thin-plate spline through the landmarks.

        Surfaces, fibre courses and skull are all carried along (Bookstein 1989).

        Parameters
        ----------
        landmarks : mapping of str to (3,) float64, mm, or path
            The patient's, by the template's names, or a `.mrk.json` or `.fcsv` file of them. Four
            that are not in one plane are enough; names that only one side has are ignored, with
            findings.
        smoothing : float, mm
            0 matches every landmark exactly; larger values give a smoother map that misses the
            landmarks by more.

        Raises
        ------
        FileNotFoundError
            The landmark file does not exist.
        LandmarkError
            (also `ValueError`) Fewer than four common names, landmarks in a plane, in the same
            place, or on the wrong side.
        RegistrationError
            The spline cannot be solved for.

        Examples
        --------
        >>> import cmfsim
        >>> template = cmfsim.MuscleTemplate.load("default")
        >>> patient = {n: p + [0, 5, 0] for n, p in template.landmarks.items()}
        >>> muscles = template.morph(patient)
        >>> round(float(muscles.skull.vertices[0, 1] - template.skull.vertices[0, 1]), 9)
        5.0
        """
        return morph_template(self, landmarks, smoothing=smoothing)


# How many landmarks a finding lists.
MOST_NAMES = 6
# Landmarks below which a map is little more than affine.
FEW_LANDMARKS = 6
# A map of space needs as many places.
LEAST_LANDMARKS = 4
# Landmarks that place a jaw, and the share of a muscle's vertices from which on it is at one.
LEAST_OF_JAW, AT_JAW = 3, 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class MorphedMusculature(Musculature):
    """The muscles of a template in a patient, with the map from template to patient.

    It is a `Musculature` and can be used wherever muscles are expected.

    Attributes
    ----------
    muscles : tuple of MuscleSurface
        Surfaces and fibre courses in the patient, LPS mm.
    findings : tuple of Finding
        Landmarks that only one side has, one that disagrees with the others, folds.
    template : TemplateData
        The template that was mapped.
    warp : ThinPlateSpline
        From the template to the patient; `warp(points)`.
    skull : SurfaceData
        The template's skull in the patient.
    landmarks : mapping of str to (3,) float64, mm
        The patient's landmarks that were used.
    residuals : mapping of str to float, mm
        Distance of each warped landmark from the patient's: rounding without smoothing.
    leave_one_out : LandmarkAgreement or None
        Distance of each landmark from where the others would place it; None if too few landmarks
        are left.
    missing : tuple of str
        The template's landmarks that the patient lacks.
    folds : mapping of str to int
        Vertices of each muscle at which the map turns space inside out; muscles without such
        vertices are omitted.

    Examples
    --------
    >>> import cmfsim
    >>> template = cmfsim.MuscleTemplate.load("default")
    >>> muscles = template.morph(template.landmarks)
    >>> max(muscles.residuals.values()) < 1e-9, len(muscles.folds)
    (True, 0)
    """

    template: TemplateData
    warp: ThinPlateSpline
    skull: SurfaceData
    landmarks: Mapping[str, Floats]
    residuals: Mapping[str, float]
    leave_one_out: LandmarkAgreement | None
    missing: tuple[str, ...]
    folds: Mapping[str, int]

    def save(
        self,
        path: str | os.PathLike[str],
        *,
        name: str | None = None,
        report: Mapping[str, Any] | None = None,
    ) -> None:
        """Writes the muscles as a new template: a folder, or one `.npz` archive.

        `MuscleTemplate.load` reads them back; licence and attribution stay the template's.

        Parameters
        ----------
        path : path
        name : str, optional
            Default: that of the template.
        report : mapping, optional
            Plain values that are written next to it as `report.json`, such as `summary()`.
        """
        write_template(path, self.as_template(name=name), report)

    def as_template(self, *, name: str | None = None) -> TemplateData:
        """The muscles, the skull and the landmarks of the patient as a template."""
        source = f"the template {self.template.name} morphed to {len(self.landmarks)} landmarks"
        if self.template.source:
            source += f"; {self.template.source}"
        return TemplateData(
            name=self.template.name if name is None else name,
            muscles=self.muscles,
            skull=self.skull,
            landmarks=self.landmarks,
            licence=self.template.licence,
            attribution=self.template.attribution,
            source=source,
            definitions={k: v for k, v in self.template.definitions.items() if k in self.landmarks},
            concepts=self.template.concepts,
        )

    def summary(self) -> dict[str, Any]:
        """The figures of the landmarks as plain values, for `report.json`."""
        left_out = self.leave_one_out
        return {
            "template": self.template.name,
            "licence": self.template.licence,
            "attribution": self.template.attribution,
            "muscles": [muscle.name for muscle in self.muscles],
            "smoothing": self.warp.smoothing,
            "bending_energy": self.warp.bending_energy,
            "landmarks": list(self.landmarks),
            "missing": list(self.missing),
            "residuals": dict(self.residuals),
            "leave_one_out": None
            if left_out is None
            else {
                "worst": left_out.worst,
                "outliers": list(left_out.outliers),
                "distances": dict(zip(left_out.names, left_out.distances.tolist(), strict=True)),
                "scores": dict(zip(left_out.names, left_out.scores.tolist(), strict=True)),
            },
            "folds": dict(self.folds),
        }


def morph_template(
    template: TemplateData,
    landmarks: Mapping[str, ArrayLike] | str | os.PathLike[str],
    *,
    smoothing: float = 0.0,
) -> MorphedMusculature:
    """The muscles of a template in a patient; see `MuscleTemplate.morph`."""
    smoothing = as_number("smoothing", smoothing)
    if smoothing < 0.0:
        raise CaseInputError(f"smoothing is {smoothing:g}: must be 0 or more")
    findings: list[Finding] = [f for f in template.findings if f.severity != "note"]
    if isinstance(landmarks, str | os.PathLike):
        file = read_landmark_file(landmarks)
        findings += file.findings
        landmarks = file.points
    matched = match_landmarks(template.landmarks, landmarks, required=())
    findings += [f for f in matched.findings if f.code != "landmark-extra"]
    findings += missing_landmarks(template, matched.names)
    warp = ThinPlateSpline(matched.source, matched.target, smoothing=smoothing)
    left_out, doubts = _agreement(matched)
    findings += doubts
    folds, (smallest, name, place) = _folds(template, warp)
    if folds:
        where = ", ".join(f"{x:.1f}" for x in place)
        folded = Finding(
            "correspondence-folds",
            f"the map turns {sum(folds.values())} vertices of {len(folds)} muscles inside out, "
            f"most severely in {name} (Jacobian {smallest:.2g})",
            where=f"template, at ({where}) mm",
            why="muscles overlap themselves there, and their fibres point in wrong directions",
            fix="check the landmarks nearby, or smooth the map",
        )
        findings.append(folded)
    return MorphedMusculature(
        muscles=tuple(
            replace(m, surface=_warped(m.surface, warp), course=tuple(map(warp, m.course)))
            for m in template.muscles
        ),
        findings=tuple(findings),
        template=template,
        warp=warp,
        skull=_warped(template.skull, warp),
        landmarks=MappingProxyType(dict(zip(matched.names, matched.target, strict=True))),
        residuals=MappingProxyType(dict(zip(matched.names, warp.residuals.tolist(), strict=True))),
        leave_one_out=left_out,
        missing=tuple(name for name in template.landmarks if name not in matched.names),
        folds=MappingProxyType(folds),
    )


def without_lost(morphed: MorphedMusculature) -> MorphedMusculature:
    """The musculature without muscles at a jaw that has too few landmarks to place them.

    A muscle is at a jaw if enough of its vertices lie nearest to a landmark of that in the
    template. Where no jaw is short of landmarks, the same object.
    """
    template = morphed.template
    names = list(template.landmarks)
    lower = np.array([is_lower_site(name) for name in names])
    known = np.array([name in morphed.landmarks for name in names])
    # A jaw turns and moves as a whole: three places of it say how.
    short = [
        side
        for side, own in ((True, lower), (False, ~lower))
        if int((known & own).sum()) < min(LEAST_OF_JAW, int(own.sum()))
    ]
    if not short:
        return morphed
    places = np.array(list(template.landmarks.values()))
    lost = []
    for muscle in template.muscles:
        vertices = muscle.surface.vertices
        away = np.linalg.norm(vertices[:, None] - places[None], axis=2)
        at_lower = float(lower[np.argmin(away, axis=1)].mean())
        if any((at_lower if side else 1.0 - at_lower) > AT_JAW for side in short):
            lost.append(muscle.name)
    if not lost:
        return morphed
    jaws = " and ".join("lower jaw" if side else "cranium" for side in short)
    reason = f"fewer than {LEAST_OF_JAW} landmarks of the {jaws} are known"
    return replace(
        morphed,
        muscles=tuple(muscle for muscle in morphed.muscles if muscle.name not in lost),
        findings=(*morphed.findings, muscles_left_out(lost, reason)),
    )


def too_few(template: TemplateData, known: Collection[str]) -> Finding | None:
    """The warning that all muscles are left out, where too few of the landmarks are known."""
    common = [label for label in template.landmarks if label in known]
    if len(common) >= LEAST_LANDMARKS:
        return None
    reason = f"{len(common)} of its landmarks are known, and {LEAST_LANDMARKS} are needed"
    return muscles_left_out([muscle.name for muscle in template.muscles], reason)


def muscles_left_out(names: Sequence[str], reason: str) -> Finding:
    """The warning that muscles are left out."""
    what = f"{len(names)} muscles are left out: {_listed(names)}: {reason}"
    return Finding("muscles-left-out", what, where="landmarks")


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_NAMES} more" if len(names) > MOST_NAMES else ""
    return ", ".join(names[:MOST_NAMES]) + more


def missing_landmarks(
    template: TemplateData, used: Collection[str], where: str = "landmarks"
) -> tuple[Finding, ...]:
    """A warning with the template's landmarks that a patient lacks, who has those `used`."""
    missing = [name for name in template.landmarks if name not in used]
    if not missing:
        return ()
    few = len(used) < FEW_LANDMARKS
    return (
        Finding(
            "template-landmarks-missing",
            f"{len(missing)} of the template's {len(template.landmarks)} landmarks are missing: "
            f"{_listed(missing)}; muscles are placed by the other {len(used)}",
            where=where,
            why=f"fewer than {FEW_LANDMARKS} landmarks scale and rotate the muscles, but do not "
            "fit their shape"
            if few
            else "muscles near the missing landmarks follow their neighbours; with only six "
            "landmarks, well spread, the predicted skin changes by about 0.3 mm",
        ),
    )


def _agreement(matched: LandmarkMatch) -> tuple[LandmarkAgreement | None, list[Finding]]:
    """The agreement of the landmarks, and the outliers; None if there are too few landmarks."""
    try:
        left_out = leave_one_out(matched.source, matched.target, matched.names)
    except LandmarkError as error:
        what = f"landmarks cannot be compared with one another: {error}"
        return None, [Finding("template-landmarks-few", what, where="landmarks")]
    if not left_out.misplaced:
        return left_out, []
    distances = dict(zip(left_out.names, left_out.distances, strict=True))
    away = [f"{name} {distances[name]:.1f} mm" for name in left_out.misplaced]
    listed = ", ".join(away[:MOST_NAMES]) + (", …" if len(away) > MOST_NAMES else "")
    finding = Finding(
        "landmark-disagrees",
        f"{len(away)} landmarks are far from where the others place them: {listed}",
        where="landmarks",
        fix="check the first one in both heads; place it again or omit it, and morph again",
    )
    return left_out, [finding]


def _warped(surface: SurfaceData, warp: ThinPlateSpline) -> SurfaceData:
    return replace(surface, vertices=warp(surface.vertices))


def _folds(
    template: TemplateData, warp: ThinPlateSpline
) -> tuple[dict[str, int], tuple[float, str, Floats]]:
    """Vertices of each muscle at which space is turned inside out, and the worst such place."""
    found: dict[str, int] = {}
    worst: tuple[float, str, Floats] = (np.inf, "", np.zeros(3))
    for muscle in template.muscles:
        points = muscle.surface.vertices
        folds = warp.folds(points)
        if not folds.count or folds.worst is None or folds.smallest is None:
            continue
        found[muscle.name] = folds.count
        if folds.smallest < worst[0]:
            worst = (folds.smallest, muscle.name, points[folds.worst])
    return found, worst
