"""Pictures of a plan and of the face that it is predicted to give, also on its way there."""

import base64
import html
import io
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.pictures import canvas
from cmfsim.pictures.anatomy import SKIN_COLOUR, add_bone
from cmfsim.processes.worker import run_program
from cmfsim.values.anatomy import segment_colours
from cmfsim.values.checks import AnyPath, Floats
from cmfsim.values.clinical_motion import plan_lines
from cmfsim.values.patient_model import PatientModel
from cmfsim.values.prediction import Prediction
from cmfsim.values.surface_data import SurfaceData

# What is left off, in edges.
RIM = 2.0
# A skin's upper end is a cut, not a crown, where its topmost rim is wider than this share of it.
CUT_WIDTH = 0.5


@dataclass(frozen=True)
class SkinEnds:
    """How far back, down and up a skin is drawn, mm along P and S."""

    back: float
    below: float
    above: float

    def within(self, corners: Floats) -> Floats:
        """The box between these ends, (2, 3)."""
        box: Floats = np.array(corners)
        box[1, 1] = min(box[1, 1], self.back)
        box[0, 2], box[1, 2] = max(box[0, 2], self.below), min(box[1, 2], self.above)
        return box


def skin_ends(skin: SurfaceData) -> SkinEnds:
    """The ends of a skin, short of its ragged rim; of one a few edges across nothing is cut."""
    vertices, triangles = skin.vertices, skin.triangles
    edge = float(np.median(np.linalg.norm(np.diff(vertices[triangles[:, :2]], axis=1), axis=2)))
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    if (high - low).max() < 20.0 * RIM * edge:
        return SkinEnds(*(float(value) for value in (high[1], low[2], high[2])))
    top = vertices[vertices[:, 2] > high[2] - RIM * edge]
    is_cut = np.ptp(top[:, 0]) > CUT_WIDTH * (high[0] - low[0])
    return SkinEnds(
        back=float(high[1]) - RIM * edge,
        below=float(low[2]) + RIM * edge,
        above=float(high[2]) - (RIM * edge if is_cut else 0.0),
    )


def trimmed(shape: Any, ends: SkinEnds) -> Any:
    """A skin as PyVista has it, cut off at its ends; values at its vertices are kept."""
    shape = shape.clip("y", origin=(0, ends.back, 0))
    shape = shape.clip("-z", origin=(0, 0, ends.below))
    return shape.clip("z", origin=(0, 0, ends.above))


# Of six views in two rows, pixels.
TWO_ROWS = (1650, 1240)
# Of its letters, so that they are legible where the chart has it small: 6 points.
LETTERS = 18
# The same in a notebook.
NOTEBOOK = (990, 744)
# Skin shines a little.
SKIN_SHADING = {"smooth_shading": True, "ambient": 0.12, "specular": 0.12, "specular_power": 12}
# Movement that fills the colour scale at least, mm.
LEAST_SCALE = 0.01
# Of bone where it was before the operation.
GHOST_COLOUR = "#7f8c9a"
# A segment that moves less than this, mm, is drawn where it was: two surfaces in one place flicker.
STAYS = 0.5


def add_skin(plotter: Any, shape: Any, colours: NDArray[np.uint8] | None) -> None:
    """Adds skin to a view, with the colours of its vertices where there are any."""
    if colours is None:
        plotter.add_mesh(shape, color=SKIN_COLOUR, **SKIN_SHADING)
    else:
        shape.point_data["colour"] = colours
        plotter.add_mesh(shape, scalars="colour", rgb=True, **SKIN_SHADING)


def picture_prediction(
    path: AnyPath, prediction: Prediction, *, size: tuple[int, int] = TWO_ROWS
) -> None:
    """Writes a picture of a face before and after, and how far each point of it moves.

    path: Ends in `.png`.
    size: pixels.
    Raises `CaseError`: PyVista or OpenGL is missing, another ending.

    Examples
    --------
    >>> import cmfsim.pictures
    >>> cmfsim.pictures.picture_prediction("prediction.png", prediction)  # doctest: +SKIP
    """
    prediction_picture(prediction, size=size)(path)


def prediction_picture(
    prediction: Prediction, *, size: tuple[int, int] = TWO_ROWS
) -> canvas.Picture:
    """The picture that `picture_prediction` writes, to be drawn later."""
    return partial(
        picture_faces,
        before=prediction.face_before,
        after=prediction.face,
        ends=skin_ends(prediction.skin_before),
        # The mesh's own skin ends in a ragged rim; a whole head goes on past the picture.
        is_trimmed=prediction.patient.face is None,
        size=size,
        colours=prediction.face_colours,
    )


def picture_faces(
    path: AnyPath,
    *,
    before: SurfaceData,
    after: SurfaceData,
    ends: SkinEnds,
    is_trimmed: bool,
    size: tuple[int, int],
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Writes a picture of a face before and after; see `picture_prediction`."""
    moved = np.linalg.norm(after.vertices - before.vertices, axis=1)
    largest = max(float(moved.max()), LEAST_SCALE)

    def paint(plotter: Any, view: canvas.View) -> None:
        surface = before if view.caption == "before" else after
        shape = canvas.polydata(surface.vertices, surface.triangles)
        shape.point_data["movement"] = moved
        if is_trimmed:
            shape = trimmed(shape, ends)
        if view.caption != "movement":
            add_skin(plotter, shape, colours)
            return
        canvas.add_sizes(plotter, shape, "movement", largest)
        if view.direction == "left":
            # Before the forehead: the head fills the other side.
            canvas.add_scale_bar(plotter, (0.03, 0.5), 4, "%.1f", 2 * LETTERS)

    names = ("before", "after", "movement")
    views = tuple(
        canvas.View(d, name, text_size=LETTERS) for d in ("front", "left") for name in names
    )
    corners = ends.within(canvas.bounds([before.vertices, after.vertices]))
    canvas.draw(path, views, corners, size, paint, columns=len(names))


def prediction_html(prediction: Prediction) -> str:
    """What a notebook shows of a prediction: its lines, and its picture if one can be drawn."""
    lines = f"<pre>{html.escape(repr(prediction))}</pre>"
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "prediction.png"
        try:
            picture_prediction(path, prediction, size=NOTEBOOK)
        except CaseInputError:
            return lines
        data = base64.b64encode(path.read_bytes()).decode()
    return f'{lines}<img alt="prediction" src="data:image/png;base64,{data}">'


def plan_picture(patient: PatientModel, motions: Mapping[str, Any]) -> canvas.Picture:
    """The picture of a plan, to be drawn later; `motions` as in a summary.

    Bone segments where they go, behind them where they were, and below each motion in words.
    """
    after = patient.planned_bones
    plan = {name: m["clinical"] for name, m in motions.items()}
    return partial(
        picture_motions,
        before={s.name: s.surface for s in patient.segments},
        after={
            name: SurfaceData(vertices, surface.triangles)
            for name, (surface, vertices) in after.items()
        },
        still=[
            name
            for name, (surface, vertices) in after.items()
            if np.quantile(np.linalg.norm(vertices - surface.vertices, axis=1), 0.99) < STAYS
        ],
        words=plan_lines(plan),
    )


def picture_motions(
    path: AnyPath,
    *,
    before: Mapping[str, SurfaceData],
    after: Mapping[str, SurfaceData],
    still: Sequence[str],
    words: Sequence[str],
) -> None:
    """Writes a picture of segments of bone before and after; see `plan_picture`."""
    colours = segment_colours(list(before))
    corners = canvas.bounds([s.vertices for s in (*before.values(), *after.values())])
    shown = canvas.Shown()

    def ghost(plotter: Any, surface: SurfaceData) -> Any:
        shape = canvas.polydata(surface.vertices, surface.triangles)
        return plotter.add_mesh(shape, color=GHOST_COLOUR, opacity=0.3, smooth_shading=True)

    def paint(plotter: Any, _: canvas.View) -> None:
        for name, now in after.items():
            shown.add(plotter, name, partial(add_bone, plotter, now, colours[name]))
            if name not in still:
                shown.add(plotter, f"{name} before", partial(ghost, plotter, before[name]))

    views = tuple(canvas.View(name, name) for name in ("right", "front", "left"))
    legend = [*colours.items(), ("before", GHOST_COLOUR)]
    canvas.draw(path, views, corners, canvas.SIZE, paint, legend=legend, words=words)


# Pixels, even as films need it; pictures of the way, and how long each and both ends are seen, ms.
FILM_SIZE, STEPS, EACH, HELD = (960, 520), 12, 80, 1000
# A film of these few pictures takes a second or two.
FILM_SECONDS = 120.0
# What moves by more than this, mm, decides what is seen, with so much of its size around it.
MOVES, AROUND = 0.1, 0.15
ENDINGS = (".gif", ".mp4")


def animate_face(
    path: AnyPath, before: SurfaceData, after: Floats, colours: NDArray[np.uint8] | None = None
) -> None:
    """Writes an animation of a face, from the front and the left: before, after, and back.

    path: Ends in `.gif`, or in `.mp4` where ffmpeg is installed.
    after: Its vertices after the operation, mm.
    Raises `CaseError`: As `Prediction.animate`.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in ENDINGS:
        raise CaseInputError(f"{path.name}: an animation is written as {' or '.join(ENDINGS)}")
    if ending == ".mp4" and shutil.which("ffmpeg") is None:
        raise CaseInputError(
            f"{path.name}: films need ffmpeg, which is not installed: write a .gif"
        )
    if not path.parent.is_dir():
        raise CaseInputError(f"{path}: there is no folder {path.parent}: make it, or give another")
    shift = after - before.vertices
    moving = np.linalg.norm(shift, axis=1) > MOVES
    if not moving.any():
        raise CaseInputError(f"{path.name}: no point of the face moves by more than {MOVES} mm")
    corners = canvas.bounds([before.vertices[moving], after[moving]])
    corners += AROUND * np.ptp(corners, axis=0) * np.array([[-1.0], [1.0]])
    frame = partial(_frame, path.name, colours, corners)
    frames = [
        frame(share, canvas.polydata(before.vertices + share * shift, before.triangles))
        # Slowly at both ends.
        for share in 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, STEPS + 1))
    ]
    frames += frames[-2:0:-1]
    times = [HELD if i % STEPS == 0 else EACH for i in range(len(frames))]
    data = _gif(frames, times) if ending == ".gif" else _film(path.name, frames, times)
    canvas.write_whole(path, data)


def _frame(
    name: str, colours: NDArray[np.uint8] | None, corners: Floats, share: float, shape: Any
) -> NDArray[np.uint8]:
    def paint(plotter: Any, _: canvas.View) -> None:
        add_skin(plotter, shape, colours)

    way = {0.0: "before", 1.0: "after"}.get(round(share, 3), f"{share:.0%} of the way")
    views = (canvas.View("front", f"{way}, front"), canvas.View("left", f"{way}, left"))
    return canvas.drawn(name, views, corners, FILM_SIZE, paint)


def _gif(frames: Sequence[NDArray[np.uint8]], times: Sequence[int]) -> bytes:
    picture = third_party("PIL.Image", "animations are written", "report")
    # The colours of one frame for all: others would flicker.
    first = picture.fromarray(frames[STEPS // 2]).quantize(256)
    rest = [picture.fromarray(frame).quantize(palette=first, dither=0) for frame in frames]
    file = io.BytesIO()
    times_and_loop = {"duration": [*times], "loop": 0, "optimize": False}
    rest[0].save(file, "GIF", save_all=True, append_images=rest[1:], **times_and_loop)
    return file.getvalue()


def _film(name: str, frames: Sequence[NDArray[np.uint8]], times: Sequence[int]) -> bytes:
    """The bytes of an MP4, which is streamed, so that it can be piped; held frames are repeated."""
    repeated = [f.tobytes() for f, ms in zip(frames, times, strict=True) for _ in range(ms // EACH)]
    width, height = FILM_SIZE
    command = (
        f"ffmpeg -v error -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {1000 / EACH} -i - "
        "-pix_fmt yuv420p -movflags frag_keyframe+empty_moov -f mp4 -"
    )
    given = b"".join(repeated)
    run = run_program("ffmpeg", command.split(), given, seconds=FILM_SECONDS)
    if run.returncode or not run.stdout:
        reason = run.stderr.decode(errors="replace").strip()
        raise CaseInputError(f"{name}: ffmpeg ended with code {run.returncode}: {reason[-200:]}")
    return run.stdout
