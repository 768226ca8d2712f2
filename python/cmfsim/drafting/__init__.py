"""A first case file from what lies in a folder: `cmfsim init`.

`finds` reads and measures files, `scene_finds` what a scene of 3D Slicer holds, `gathering` both;
`roles` knows what names say; `surfaces`, `choices` and `motions` decide what each thing is for, and
turn what they cannot decide into questions; `draft` writes the case file.
"""

import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

from cmfsim.drafting.draft import CaseDraft, draft_case
from cmfsim.drafting.finds import CASE_FILE, EXTRACTED, Taken
from cmfsim.drafting.gathering import gather
from cmfsim.drafting.motions import TypedPlan, read_moves
from cmfsim.drafting.written import check_written
from cmfsim.errors import CaseInputError, CmfsimError, LandmarkError
from cmfsim.io import Case, replacing
from cmfsim.pipeline.building.inputs import read_anatomy
from cmfsim.pipeline.proposing import proposed_head
from cmfsim.values.checks import AnyPath
from cmfsim.values.proposed_landmarks import ProposedSite

__all__ = ["CASE_FILE", "CaseDraft", "Taken", "init_case", "read_moves"]

SCENES = (".mrml", ".mrb")


def init_case(
    path: AnyPath,
    *,
    force: bool = False,
    cuts: Sequence[str] = (),
    moves: Mapping[str, Mapping[str, float]] = MappingProxyType({}),
    progress: Callable[[str], None] = lambda _: None,
) -> CaseDraft:
    """Writes a `case.toml` for the files in a folder, and states what each file was taken for.

    Parameters
    ----------
    path : path
        A folder, or a scene of 3D Slicer (`.mrml`, `.mrb`): its folder becomes the case's.
    force : bool
        Whether an existing case file is replaced.
    cuts : sequence of str
        Procedures, such as "le_fort_1", besides those that the plan needs.
    moves : mapping of str to mapping of str to float
        How segments move: forwards, backwards, up, down, left, right in mm; pitch (front up), yaw
        (front to the left) and roll (left side up) in degrees, about the teeth or the chin, which
        are found automatically if no file of landmarks is there.
    progress : callable
        Called with the name of each stage.

    Raises
    ------
    FileNotFoundError
        The path does not exist.
    CaseError
        (also `ValueError`) A case file exists already; the folder has no usable files; several
        scenes; a scene that is damaged, or whose transforms are not rigid; cuts or moves that do
        not suit the head. Not `ValueError`: the
        case that was written reads as something else than was found; it is removed again.

    Examples
    --------
    >>> import cmfsim
    >>> draft = cmfsim.init_case("planning.mrb")  # doctest: +SKIP
    >>> for taken in draft.taken:  # doctest: +SKIP
    ...     print(taken.label, taken.taken_for, taken.why)
    """
    typed = TypedPlan(tuple(dict.fromkeys(cuts)), moves)
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such folder or scene")
    is_scene = path.is_file()
    if is_scene and path.suffix.lower() not in SCENES:
        raise CaseInputError(
            f"{path.name}: name a folder, or a scene of 3D Slicer ({', '.join(SCENES)})"
        )
    folder = path.parent if is_scene else path
    case_file = folder / CASE_FILE
    if case_file.exists() and not force:
        raise CaseInputError(f"{case_file}: already exists; --force replaces it")
    with tempfile.TemporaryDirectory(prefix="cmfsim-init-") as unpacked:
        draft = _drafted(folder, path if is_scene else None, Path(unpacked), typed, progress)
    if draft.files:
        (folder / EXTRACTED).mkdir(exist_ok=True)
    for name, write in draft.files.items():
        write(folder / name)
    before = case_file.read_bytes() if case_file.exists() else None
    _write(case_file, draft.text.encode())
    progress("reading the case back")
    try:
        check_written(case_file, draft.shown, is_open=bool(draft.questions))
    except CaseInputError:
        # It is the case's owner who has to correct it.
        raise
    except CmfsimError:
        if before is None:
            case_file.unlink()
        else:
            _write(case_file, before)
        raise
    return draft


def _write(path: Path, data: bytes) -> None:
    with replacing(path) as file:
        file.write(data)


def _drafted(
    folder: Path,
    scene: Path | None,
    unpacked: Path,
    typed: TypedPlan,
    progress: Callable[[str], None],
) -> CaseDraft:
    found = gather(folder, scene, unpacked, progress)
    if not found.surfaces and not any(not image.error for image in found.images):
        reasons = [f"{other.label}: {other.why}" for other in found.others]
        reasons += [f"{image.label}: {image.error}" for image in found.images if image.error]
        more = f" ({'; '.join(reasons[:5])})" if reasons else ""
        raise CaseInputError(
            f"{folder}: contains neither a CT nor surfaces that can be read{more}. Looked for: "
            "DICOM, NRRD, NIfTI, MetaImage, STL, PLY, OBJ, VTP, VTK, .seg.nrrd, .mrml and .mrb"
        )
    progress("identifying the files")
    name = folder.resolve().name or "case"
    sites: Mapping[str, ProposedSite] = {}
    if typed.turns and not found.landmarks:
        draft = draft_case(found, unpacked, name, replace(typed, moves={}))
        if not draft.questions and not draft.files:
            sites = _found_sites(folder, draft, progress)
    return draft_case(found, unpacked, name, typed, sites)


def _found_sites(
    folder: Path, draft: CaseDraft, progress: Callable[[str], None]
) -> Mapping[str, ProposedSite]:
    """The landmarks of the skull as `cmfsim predict` would find them; none where it finds none."""
    handle, beside = tempfile.mkstemp(".toml", ".cmfsim-init-", folder)
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(draft.text.encode())
        case = Case.load(beside)
        anatomy, _ = read_anatomy(case, {}, progress)
        progress("finding the landmarks")
        return proposed_head(case, anatomy, progress).landmarks.skull
    except LandmarkError:
        return {}
    finally:
        Path(beside).unlink()
