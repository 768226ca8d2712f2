"""Writes DICOM series as scanners and archives do: tilted, shuffled, gapped, doubled, mixed.

The slices of a series are values, each with the place of its first pixel; a variant changes the
list before it is written.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path

import numpy as np

from cmfsim import ImageData


@dataclass(frozen=True, eq=False)
class DicomSlice:
    """One slice: pixels (rows, columns) in HU, the place of the first, and further tags."""

    pixels: np.ndarray
    position: np.ndarray
    row: tuple[float, float, float] = (1.0, 0.0, 0.0)
    column: tuple[float, float, float] = (0.0, 1.0, 0.0)
    spacing: tuple[float, float] = (1.0, 1.0)
    slope: float = 1.0
    intercept: float = -1024.0
    tags: dict[str, str] = field(default_factory=dict)

    def with_tags(self, **tags: str) -> "DicomSlice":
        """With further tags, written t0020_0012="2"."""
        more = {name[1:].replace("_", "|"): text for name, text in tags.items()}
        return replace(self, tags={**self.tags, **more})


def axial(image: ImageData) -> list[DicomSlice]:
    """The slices of an image as they lie in it, from below."""
    dx, dy, dz = np.asarray(image.spacing)
    return [
        DicomSlice(
            np.asarray(image.values[:, :, k]).T,
            image.lowest + [0.0, 0.0, k * dz],
            spacing=(float(dx), float(dy)),
        )
        for k in range(image.values.shape[2])
    ]


def tilted(
    image: ImageData, degrees: float, gap: float, spacing: float, *, smooth: bool = False
) -> list[DicomSlice]:
    """Slices of a scan with a tilted gantry: turned about x, each shifted along the table alone.

    Values between voxels are linear, or those of a cubic spline, which has no kinks: a scanner sees
    none either.
    """
    sample = _spline(image) if smooth else image.sample
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    row, column = np.array([1.0, 0.0, 0.0]), np.array([0.0, c, s])
    low, high = image.lowest, image.highest
    columns = int((high[0] - low[0]) / spacing) + 1
    rows = int((high[1] - low[1]) / spacing / c) + 1
    rise = (rows - 1) * spacing * s
    # A tilted gantry goes along the table, so that slices of a gap lie farther apart along it.
    step = gap / c
    begin = low[2] - max(rise, 0.0)
    count = int((high[2] - low[2] + abs(rise)) / step) + 1
    made = []
    for k in range(count):
        first = np.array([low[0], low[1], begin + k * step])
        u, v = np.meshgrid(np.arange(columns) * spacing, np.arange(rows) * spacing)
        points = first + u[..., None] * row + v[..., None] * column
        values = sample(points.reshape(-1, 3)).reshape(rows, columns)
        inside = (points[..., 2] >= low[2]) & (points[..., 2] <= high[2])
        pixels = np.where(inside, values, -1024.0)
        made.append(
            DicomSlice(
                np.round(pixels).astype(np.int16), first, tuple(row), tuple(column),
                (spacing, spacing), tags={"0018|1120": f"{degrees:g}"},
            )
        )  # fmt: skip
    return made


def _spline(image: ImageData) -> Callable[[np.ndarray], np.ndarray]:
    ndimage = import_module("scipy.ndimage")
    voxels = np.asarray(image.values, dtype=np.float64)
    known = ndimage.spline_filter(voxels, order=3, mode="mirror")

    def sample(points: np.ndarray) -> np.ndarray:
        place = (points - image.lowest) / np.asarray(image.spacing)
        return ndimage.map_coordinates(known, place.T, order=3, mode="nearest", prefilter=False)

    return sample


def write_series(
    folder: Path,
    slices: list[DicomSlice],
    *,
    uid: str = "1.2.3",
    names: list[str] | None = None,
    modality: str = "CT",
    description: str = "head",
    number: str = "1",
    study: str = "1.2",
) -> None:
    """Nothing; each slice is in a file of its own, called after its number or as given."""
    sitk = import_module("SimpleITK")
    folder.mkdir(parents=True, exist_ok=True)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    writer.SetImageIO("GDCMImageIO")
    for k, one in enumerate(slices):
        image = sitk.GetImageFromArray(np.ascontiguousarray(one.pixels))
        image.SetSpacing([float(s) for s in one.spacing])
        tags = {
            "0008|0008": "ORIGINAL\\PRIMARY\\AXIAL",
            "0008|0060": modality,
            "0008|103e": description,
            "0010|0020": "P1",
            "0020|000d": study,
            "0020|000e": uid,
            "0020|0011": number,
            "0020|0012": "1",
            "0020|0013": str(k + 1),
            "0020|0052": f"{study}.9",
            "0008|0018": f"{uid}.{k + 1}",
            "0020|0032": "\\".join(f"{x:.8g}" for x in one.position),
            "0020|0037": "\\".join(f"{x:.8g}" for x in (*one.row, *one.column)),
            "0028|1052": f"{one.intercept:g}",
            "0028|1053": f"{one.slope:g}",
            **one.tags,
        }
        for tag, text in tags.items():
            image.SetMetaData(tag, text)
        writer.SetFileName(str(folder / (names[k] if names else f"{uid}_{k:04d}.dcm")))
        writer.Execute(image)


ENHANCED_CT = "1.2.840.10008.5.1.4.1.1.2.1"


def write_enhanced(path: Path, slices: list[DicomSlice]) -> None:
    """Nothing; all slices are frames of one enhanced CT, in the order given."""
    first = slices[0]
    rows, columns = first.pixels.shape
    stored = [np.round((s.pixels - s.intercept) / s.slope).astype("<u2") for s in slices]
    spacing = _text(0x0028, 0x0030, "DS", _backslashed(first.spacing[::-1]))
    orientation = _text(0x0020, 0x0037, "DS", _backslashed((*first.row, *first.column)))
    shared = _item(_sequence(0x0028, 0x9110, [spacing]) + _sequence(0x0020, 0x9116, [orientation]))
    frames = b"".join(
        _item(
            _sequence(0x0020, 0x9113, [_text(0x0020, 0x0032, "DS", _backslashed(s.position))])
            + _sequence(
                0x0028,
                0x9145,
                [
                    _text(0x0028, 0x1052, "DS", f"{s.intercept:g}")
                    + _text(0x0028, 0x1053, "DS", f"{s.slope:g}")
                    + _text(0x0028, 0x1054, "LO", "HU")
                ],
            )
        )
        for s in slices
    )
    body = (
        _text(0x0008, 0x0008, "CS", "ORIGINAL\\PRIMARY\\AXIAL")
        + _text(0x0008, 0x0016, "UI", ENHANCED_CT)
        + _text(0x0008, 0x0018, "UI", "1.2.3.4.5")
        + _text(0x0008, 0x0060, "CS", "CT")
        + _text(0x0020, 0x000D, "UI", "1.2")
        + _text(0x0020, 0x000E, "UI", "1.2.3")
        + _short(0x0028, 0x0002, 1)
        + _text(0x0028, 0x0004, "CS", "MONOCHROME2")
        + _text(0x0028, 0x0008, "IS", str(len(slices)))
        + _short(0x0028, 0x0010, rows)
        + _short(0x0028, 0x0011, columns)
        + _short(0x0028, 0x0100, 16)
        + _short(0x0028, 0x0101, 16)
        + _short(0x0028, 0x0102, 15)
        + _short(0x0028, 0x0103, 0)
        + _element(0x5200, 0x9229, "SQ", shared)
        + _element(0x5200, 0x9230, "SQ", frames)
        + _element(0x7FE0, 0x0010, "OW", b"".join(p.tobytes() for p in stored))
    )
    _write(path, ENHANCED_CT, body)


CLASSIC_CT = "1.2.840.10008.5.1.4.1.1.2"


def write_classic_frames(
    path: Path, slices: list[DicomSlice], more: dict[int, str], *, placed: bool = True
) -> None:
    """Nothing; all slices are frames of one CT that states the place of the first alone.

    `more` has further numbers in text, by tag.
    """
    first = slices[0]
    rows, columns = first.pixels.shape
    texts = {
        0x00080008: ("CS", "ORIGINAL\\PRIMARY\\AXIAL"),
        0x00080016: ("UI", CLASSIC_CT),
        0x00080018: ("UI", "1.2.3.4.5"),
        0x00080060: ("CS", "CT"),
        0x0020000E: ("UI", "1.2.3"),
        0x00200052: ("UI", "1.2.9"),
        0x00280004: ("CS", "MONOCHROME2"),
        0x00280008: ("IS", str(len(slices))),
        0x00280030: ("DS", _backslashed(first.spacing[::-1])),
        0x00281052: ("DS", f"{first.intercept:g}"),
        0x00281053: ("DS", f"{first.slope:g}"),
        **{tag: ("DS", text) for tag, text in more.items()},
    }
    if placed:
        texts[0x00200032] = ("DS", _backslashed(first.position))
        texts[0x00200037] = ("DS", _backslashed((*first.row, *first.column)))
    numbers = {0x00280002: 1, 0x00280010: rows, 0x00280011: columns}
    numbers |= {0x00280100: 16, 0x00280101: 16, 0x00280102: 15, 0x00280103: 0}
    elements = {t: _text(t >> 16, t & 0xFFFF, *given) for t, given in texts.items()}
    elements |= {t: _short(t >> 16, t & 0xFFFF, n) for t, n in numbers.items()}
    stored = [np.round((s.pixels - s.intercept) / s.slope).astype("<u2") for s in slices]
    pixels = _element(0x7FE0, 0x0010, "OW", b"".join(p.tobytes() for p in stored))
    _write(path, CLASSIC_CT, b"".join(elements[tag] for tag in sorted(elements)) + pixels)


def _write(path: Path, kind: str, body: bytes) -> None:
    meta = (
        _element(0x0002, 0x0001, "OB", b"\0\1")
        + _text(0x0002, 0x0002, "UI", kind)
        + _text(0x0002, 0x0003, "UI", "1.2.3.4.5")
        + _text(0x0002, 0x0010, "UI", "1.2.840.10008.1.2.1")
    )
    length = _element(0x0002, 0x0000, "UL", len(meta).to_bytes(4, "little"))
    path.write_bytes(bytes(128) + b"DICM" + length + meta + body)


def _element(group: int, number: int, kind: str, value: bytes) -> bytes:
    value += (b"\0" if kind in {"UI", "OB", "OW"} else b" ") * (len(value) % 2)
    head = group.to_bytes(2, "little") + number.to_bytes(2, "little") + kind.encode()
    if kind in {"OB", "OW", "SQ", "UN"}:
        return head + b"\0\0" + len(value).to_bytes(4, "little") + value
    return head + len(value).to_bytes(2, "little") + value


def _text(group: int, number: int, kind: str, text: str) -> bytes:
    return _element(group, number, kind, text.encode())


def _short(group: int, number: int, value: int) -> bytes:
    return _element(group, number, "US", value.to_bytes(2, "little"))


def _item(value: bytes) -> bytes:
    return b"\xfe\xff\x00\xe0" + len(value).to_bytes(4, "little") + value


def _sequence(group: int, number: int, items: list[bytes]) -> bytes:
    return _element(group, number, "SQ", b"".join(_item(item) for item in items))


def _backslashed(numbers) -> str:
    return "\\".join(f"{x:.8g}" for x in numbers)
