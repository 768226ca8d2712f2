"""A synthetic case: the phantom's CT and landmarks with a case file, ready to build."""

import os
from pathlib import Path

from cmfsim.io import write_image, write_landmarks
from cmfsim.io.files.reading_writing import replacing
from cmfsim.phantom import PhantomHead

CASE = """\
# A synthetic head: no patient. `cmfsim build case.toml` makes its model.
format = "cmfsim-case"
version = 1
name = "phantom"

[image]
file = "ct.nrrd"

[landmarks]
skull = "skull.mrk.json"
skin = "skin.mrk.json"

[[osteotomies]]
procedure = "le_fort_1"

[[osteotomies]]
procedure = "bsso"

[plan.maxilla]                    # 5 mm forwards
translation = [0, -5, 0]

[plan.mandible_body]              # 3 mm backwards
translation = [0, 3, 0]

[mesh]
edge_length = 4.0

[output]
folder = "out"
"""


def write_phantom_case(
    folder: str | os.PathLike[str], head: PhantomHead, *, spacing: float = 1.0, seed: int = 0
) -> Path:
    """The path of a new `case.toml` next to the CT and the landmarks of a synthetic head.

    Parameters
    ----------
    folder : path
        Created if it does not exist.
    head : PhantomHead
    spacing : float, mm
        Of the CT.
    seed : int
        Of its noise.

    Raises
    ------
    OSError
        The folder cannot be created or written to.

    Examples
    --------
    >>> import cmfsim
    >>> case = cmfsim.write_phantom_case("head", cmfsim.make_head())  # doctest: +SKIP
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_image(head.ct((spacing, spacing, spacing), seed=seed), folder / "ct.nrrd")
    write_landmarks(folder / "skull.mrk.json", head.skull_landmarks)
    write_landmarks(folder / "skin.mrk.json", head.skin_landmarks)
    with replacing(folder / "case.toml") as file:
        file.write(CASE.encode())
    return folder / "case.toml"
