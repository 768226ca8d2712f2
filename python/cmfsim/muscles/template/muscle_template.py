"""The muscle template: loaded, saved, checked, and carried to a patient by landmarks."""

import os
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

from numpy.typing import ArrayLike

from cmfsim.io.cases.templates import read_template, write_template
from cmfsim.muscles.template.checking import check_contents, template_path
from cmfsim.muscles.template.morphing import MorphedMusculature, morph_template
from cmfsim.values.finding import Finding
from cmfsim.values.musculature import TemplateData


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
    ) -> MorphedMusculature:
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
