"""Views of a head side by side, drawn off screen by PyVista and written as PNG.

Cameras look along the patient's axes (LPS) and depend on the bounds alone, so that pictures of two
plans lie on top of each other.
"""

import base64
import contextlib
import io
import os
import pickle
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextvars import ContextVar
from dataclasses import dataclass
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cmfsim.errors import CaseError, CaseInputError, third_party
from cmfsim.processes.worker import SILENT, Worker, WorkerEndedError
from cmfsim.values.checks import AnyPath, Floats, as_positive

# What draws a picture at a path: a function of this package with all else that it takes, which can
# be pickled.
Picture = partial[None]
SIZE = (1650, 820)
# Where the camera stands, as a direction from the head, in LPS.
DIRECTIONS: Mapping[str, tuple[float, float, float]] = MappingProxyType({
    "front": (0.0, -1.0, 0.0), "left": (1.0, 0.0, 0.0), "right": (-1.0, 0.0, 0.0),
    "left front": (0.7, -0.7, 0.1), "behind": (0.35, 0.9, 0.1), "above": (0.0, 0.0, 1.0),
    "below": (0.0, 0.0, -1.0),
})  # fmt: skip
MARGIN = 1.04
TEXT_SIZE, DPI = 9, 72
LEGEND_ROW = 26  # pixels
# White, in pixels, that keeps the heads of neighbouring views apart.
BETWEEN = MappingProxyType({"border": True, "border_color": "white", "border_width": 5})
# Pixels left of texts below the views, and from a swatch to its text.
EDGE, SWATCH = 12, 26
# Opacity of the ground of a caption, and pixels between a scale and its title.
CAPTION_GROUND, TITLE_GAP = 0.8, 14
# Of zlib: level 6 takes longer for files that are a few percent smaller.
PNG_LEVEL = 4
# Mean width of a letter of this size, pixels, as VTK draws them: the widest of many lines.
LETTER = 9.5
# Time after which the probe counts as failed, s; it takes half a second.
PROBE_TIME = 60.0
NO_OPENGL = (
    "on a machine without a screen, install OpenGL for software rendering (Debian: libgl1, "
    "libegl1, libosmesa6)"
)

_may_crash: ContextVar[bool] = ContextVar("_may_crash", default=False)


@dataclass(frozen=True)
class View:
    """One of the views side by side: where the camera stands, and what is written below."""

    direction: str
    caption: str
    bare: bool = False
    text_size: int = TEXT_SIZE


def draw(
    path: AnyPath,
    views: Sequence[View],
    corners: Floats,
    size: tuple[int, int],
    paint: Callable[[Any, View], None],
    **below: Any,
) -> None:
    """Writes the views as `drawn` makes them, under a temporary name first."""
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise CaseInputError(f"{path.name}: a picture is written as .png, not {path.suffix!r}")
    write_picture(path, drawn(path.name, views, corners, size, paint, **below))


def drawn(
    name: str,
    views: Sequence[View],
    corners: Floats,
    size: tuple[int, int],
    paint: Callable[[Any, View], None],
    *,
    legend: Sequence[tuple[str, str]] = (),
    columns: int | None = None,
    words: Sequence[str] = (),
) -> NDArray[np.uint8]:
    """The views side by side, in rows of `columns`, (h, w, 3); `name` is the file's, for messages.

    Below them stand the legend and the words, a paragraph each; the views shrink for them, by half
    at most.
    """
    width, height = (int(as_positive("picture size", n)) for n in size)
    pv = pyvista_module()
    check_can_draw(name)
    texts, swatches, below = _placed(legend, words, width)
    band = below * LEGEND_ROW + 16 if below else 0
    height = max(height - band, height // 2)
    # One scale for all views.
    columns = columns or len(views)
    rows = -(-len(views) // columns)
    half = max(_half_height(view, corners, width / columns, height / rows) for view in views)
    try:
        # PyVista and VTK warn of missing screens; whether the picture was made decides here.
        with silent_vtk(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            plotter = pv.Plotter(
                off_screen=True, shape=(rows, columns), window_size=[width, height], **BETWEEN
            )
            try:
                plotter.enable_anti_aliasing("ssaa")
                for place, view in enumerate(views):
                    plotter.subplot(*divmod(place, columns))
                    plotter.set_background("white")
                    _place_camera(plotter, view, corners, half)
                    paint(plotter, view)
                    plotter.reset_camera_clipping_range()
                    caption = plotter.add_text(
                        view.caption, position=(10, 10), font_size=view.text_size, color="black"
                    )
                    # Legible where the head lies behind it.
                    caption.prop.background_color = "white"
                    caption.prop.background_opacity = CAPTION_GROUND
                image = np.array(plotter.screenshot(return_img=True))[:, :, :3]
            finally:
                plotter.close()
            if band:
                written = _band_of_text(texts, width, band)
    except (RuntimeError, OSError, AttributeError) as error:
        raise CaseInputError(
            f"{name}: the picture cannot be drawn ({error}); {NO_OPENGL}"
        ) from error
    if not band:
        return image
    for left, row, colour in swatches:
        top = 12 + row * LEGEND_ROW
        written[top - 1 : top + 19, left - 1 : left + 19] = 90
        rgb = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
        written[top : top + 18, left : left + 18] = rgb
    return np.concatenate([image, written])


def _placed(
    legend: Sequence[tuple[str, str]], words: Sequence[str], width: int
) -> tuple[list[tuple[int, int, str]], list[tuple[int, int, str]], int]:
    """The texts and the swatches below the views: pixels from the left, row, text or colour.

    Entries of a legend stand beside each other, in as many rows as they need; the last value is the
    number of all rows.
    """
    texts, swatches = [], []
    left, row = EDGE, 0
    for text, colour in legend:
        length = SWATCH + int(LETTER * len(text)) + 24
        if left > EDGE and left + length > width:
            left, row = EDGE, row + 1
        swatches.append((left, row, colour))
        texts.append((left + SWATCH, row, text))
        left += length
    row += bool(legend)
    wide = max(int((width - 2 * EDGE) / LETTER), 20)
    lines = [w for text in words for w in textwrap.wrap(text, wide, subsequent_indent="    ")]
    texts += [(EDGE, row + k, line) for k, line in enumerate(lines)]
    return texts, swatches, row + len(lines)


def _band_of_text(
    texts: Sequence[tuple[int, int, str]], width: int, height: int
) -> NDArray[np.uint8]:
    """Texts on white, (height, width, 3)."""
    # As a window shows them, which takes longer to open than all texts to draw.
    core, image_data = import_module("vtkmodules.vtkRenderingCore"), pyvista_module().ImageData
    font = core.vtkTextProperty()
    font.SetFontSize(2 * TEXT_SIZE)
    band = np.full((height, width, 3), 255, dtype=np.uint8)
    for left, row, text in texts:
        if not text.strip():
            continue
        # The fonts that come with VTK have no minus sign; it sets formulas between dollars.
        shown = "".join(c if c.isprintable() and c != "$" else "?" for c in text.replace("−", "-"))
        image, size = image_data(), [0, 0]
        core.vtkTextRenderer.GetInstance().RenderString(font, shown, image, size, DPI)
        across, up, _ = image.dimensions
        # Its rows run upwards, and its last channel is how black a pixel is.
        ink = image.active_scalars.reshape(up, across, -1)[: size[1], : min(size[0], width - left)]
        bottom = 8 + (row + 1) * LEGEND_ROW
        place = band[bottom - len(ink) : bottom, left : left + ink.shape[1]]
        np.minimum(place, 255 - ink[::-1, :, 3:], out=place)
    return band


class Shown:
    """The shapes of a picture: one that an earlier view shows is not prepared a second time."""

    def __init__(self) -> None:
        self._actors: dict[str, Any] = {}

    def add(self, plotter: Any, name: str, make: Callable[[], Any]) -> None:
        """Adds a shape to a view; `make` adds it to the first, and returns its actor."""
        if name in self._actors:
            plotter.add_actor(self._actors[name], reset_camera=False, render=False)
        else:
            self._actors[name] = make()


def add_sizes(plotter: Any, shape: Any, name: str, largest: float, **more: Any) -> None:
    """Adds a surface to a view, coloured by sizes at its vertices from 0 to the largest."""
    looks = {"smooth_shading": True, "ambient": 0.3, "show_scalar_bar": False, **more}
    plotter.add_mesh(shape, scalars=name, clim=(0.0, largest), cmap="viridis", **looks)


def add_scale_bar(
    plotter: Any, place: tuple[float, float], labels: int, form: str, letters: int = 14
) -> None:
    """Adds an upright scale in mm to a view, with its lower left corner at shares of it.

    form, letters: Of its numbers, as printf has it, and their height, pixels.
    """
    bar = plotter.add_scalar_bar(
        title="mm",
        n_labels=labels,
        fmt=form,
        vertical=True,
        position_x=place[0],
        position_y=place[1],
        width=0.1,
        height=0.45,
        color="black",
        title_font_size=letters + 2,
        label_font_size=letters,
    )
    bar.SetUnconstrainedFontSize(True)  # noqa: FBT003 (VTK's own signature)
    bar.SetVerticalTitleSeparation(TITLE_GAP)


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Writes an (h, w, 3) image as PNG, under a temporary name first."""
    write_whole(path, _png(image))


def write_whole(path: Path, data: bytes) -> None:
    """Writes a file under a temporary name first."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _toward(direction: str) -> Floats:
    """The unit vector from the head to the camera."""
    vector = np.array(DIRECTIONS[direction])
    unit: Floats = vector / np.linalg.norm(vector)
    return unit


def _upright(direction: str) -> tuple[float, float, float]:
    """What is up in a view: the front, where the camera looks along the head."""
    return (0.0, -1.0, 0.0) if direction in ("above", "below") else (0.0, 0.0, 1.0)


def _half_height(view: View, corners: Floats, width: float, height: float) -> float:
    """Half the height, in mm, that a view needs to show the whole box."""
    toward = _toward(view.direction)
    across = np.cross(toward, _upright(view.direction))
    across = across / np.linalg.norm(across)
    box = np.array([[corners[i >> a & 1, a] for a in range(3)] for i in range(8)])
    box -= corners.mean(axis=0)
    upright = np.abs(box @ np.cross(across, toward)).max()
    return MARGIN * float(max(upright, np.abs(box @ across).max() * height / width))


def look_at(plotter: Any, view: View, corners: Floats, aspect: float) -> None:
    """Places the camera so that the whole box is seen in a window of this width to height."""
    _place_camera(plotter, view, corners, _half_height(view, corners, aspect, 1.0))


def _place_camera(plotter: Any, view: View, corners: Floats, half_height: float) -> None:
    """Looks at the middle of the box in parallel projection."""
    middle = corners.mean(axis=0)
    distance = 4.0 * float(np.linalg.norm(corners[1] - corners[0]))
    plotter.enable_parallel_projection()
    camera = plotter.camera
    camera.focal_point = tuple(middle)
    camera.position = tuple(middle + distance * _toward(view.direction))
    camera.up = _upright(view.direction)
    camera.parallel_scale = half_height
    # A camera that was set by hand must not be put back when the first mesh comes.
    plotter.camera_set = True


def _png(image: NDArray[np.uint8]) -> bytes:
    """The bytes of a PNG file of an (h, w, 3) image, the same for the same image."""
    file = io.BytesIO()
    pillow = third_party("PIL.Image", "pictures are written", "view")
    pillow.fromarray(image).save(file, "PNG", compress_level=PNG_LEVEL)
    return file.getvalue()


def bounds(clouds: Sequence[ArrayLike]) -> Floats:
    """Lowest and highest corner of all points, (2, 3)."""
    arrays = [np.asarray(c, dtype=np.float64) for c in clouds]
    low = np.min([a.min(axis=0) for a in arrays], axis=0)
    return np.array([low, np.max([a.max(axis=0) for a in arrays], axis=0)])


def polydata(vertices: ArrayLike, triangles: ArrayLike) -> Any:
    """A triangle surface as PyVista has it."""
    return pyvista_module().PolyData.from_regular_faces(
        np.asarray(vertices, dtype=np.float64), np.asarray(triangles, dtype=np.int64)
    )


def check_can_draw(name: str) -> None:
    """Refuses to draw where OpenGL does not work: VTK would end the process.

    Raises `CaseError`: It does not.
    """
    if not (_may_crash.get() or _candraw()):
        raise CaseInputError(
            f"{name}: the picture cannot be drawn (OpenGL does not work); {NO_OPENGL}"
        )


@contextlib.contextmanager
def without_probe() -> Iterator[None]:
    """Draws without asking another process first: for one that may crash, as its parent notices."""
    token = _may_crash.set(True)
    try:
        yield
    finally:
        _may_crash.reset(token)


@cache
def _candraw() -> bool:
    """Whether VTK can draw here: where OpenGL is missing it ends its process instead of raising."""
    if not sys.executable:
        return True
    try:
        with Worker(log=SILENT) as worker:
            worker.ask("cmfsim.pictures.canvas:draw_nothing", {}, seconds=PROBE_TIME)
    except (CaseError, OSError):
        return False
    return True


def draw_nothing() -> None:
    """Draws into a small window."""
    import_module("vtkmodules.vtkRenderingOpenGL2")
    window = import_module("vtkmodules.vtkRenderingCore").vtkRenderWindow()
    window.SetOffScreenRendering(True)  # noqa: FBT003 (VTK's)
    window.SetSize(8, 8)
    window.Render()


@contextlib.contextmanager
def silent_vtk() -> Iterator[None]:
    """Keeps VTK's warnings, as of a screen that is not there, off the standard error."""
    logger = import_module("vtkmodules.vtkCommonCore").vtkLogger
    before = logger.GetCurrentVerbosityCutoff()
    logger.SetStderrVerbosity(logger.VERBOSITY_ERROR)
    try:
        yield
    finally:
        logger.SetStderrVerbosity(before)


def pyvista_module() -> Any:
    """PyVista, of the extra `view`; a named error where it cannot be imported."""
    try:
        with warnings.catch_warnings():
            # What it loads in turn (pooch, tqdm) asks for ipywidgets in notebooks.
            warnings.filterwarnings("ignore", message="IProgress not found")
            return import_module("pyvista")
    except ImportError as error:
        # VTK without libGL fails as an ImportError that names the library.
        raise CaseInputError(
            f"pictures are drawn with PyVista, which cannot be imported ({error}): pip install "
            "'.[view]' in cmfsim's folder, and install libGL if it is missing (Debian: libgl1)"
        ) from error


class Painter:
    """A process that draws pictures one after another while the caller continues.

    It starts with the first picture, or with `load`. Used in a `with` statement, it ends with that.
    """

    def __init__(self) -> None:
        self._queue = ThreadPoolExecutor(1)
        self._worker: Worker | None = None

    def __enter__(self) -> "Painter":
        return self

    def __exit__(self, *_: object) -> None:
        if self._worker is not None:
            self._worker.end()
        self._queue.shutdown(cancel_futures=True)

    def load(self) -> None:
        """Starts the process, which loads its libraries: ahead of a picture that is to come."""
        # Where this Python cannot start another, pictures are drawn in turn.
        if self._worker is None and sys.executable:
            self._worker = Worker(threads=1)
            self._queue.submit(self._load, self._worker)

    def begin(self, picture: Picture, path: Path) -> "Future[None]":
        """The picture to come; its result raises what drawing it here would.

        What the picture shows is taken now: it may not change afterwards.
        """
        self.load()
        if self._worker is None:
            return self._queue.submit(picture, path)
        return self._queue.submit(self._draw, self._worker, picture, path)

    @staticmethod
    def _load(worker: Worker) -> None:
        # What is wrong is raised for the first picture.
        with contextlib.suppress(CaseError):
            worker.ask("cmfsim.pictures.canvas:load", {})

    @staticmethod
    def _draw(worker: Worker, picture: Picture, path: Path) -> None:
        packed = base64.b64encode(pickle.dumps(picture)).decode()
        try:
            place = {"path": str(path.absolute()), "packed": packed}
            worker.ask("cmfsim.pictures.canvas:draw_packed", place)
        except WorkerEndedError as error:
            raise CaseInputError(
                f"{path.name}: the picture cannot be drawn (OpenGL does not work); {NO_OPENGL}"
            ) from error


def load() -> None:
    """Loads the libraries that draw."""
    pyvista_module().Plotter  # noqa: B018 (loaded when it is first asked for)
    # For the tracing, which comes last; without it, that alone is left out.
    with contextlib.suppress(ImportError):
        import_module("matplotlib.figure")
        import_module("matplotlib.backends.backend_agg")


def draw_packed(path: str, packed: str) -> None:
    """Draws a picture of `Painter`, in its process."""
    picture: Picture = pickle.loads(base64.b64decode(packed))  # noqa: S301 (of the own parent)
    with without_probe():
        picture(Path(path))
