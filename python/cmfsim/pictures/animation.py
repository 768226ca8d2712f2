"""A face on its way from before to after an operation, as a GIF or a film."""

import io
import os
import shutil
import subprocess
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cmfsim.errors import CaseInputError, third_party
from cmfsim.pictures.canvas import View, bounds, drawn, polydata, write_whole
from cmfsim.pictures.faces import add_skin
from cmfsim.values.checks import Floats
from cmfsim.values.surface_data import SurfaceData

# Pixels, even as films need it; pictures of the way, and how long each and both ends are seen, ms.
SIZE, STEPS, EACH, HELD = (960, 520), 12, 80, 1000
# What moves by more than this, mm, decides what is seen, with so much of its size around it.
MOVES, AROUND = 0.1, 0.15
ENDINGS = (".gif", ".mp4")


def animate_face(
    path: str | os.PathLike[str],
    before: SurfaceData,
    after: Floats,
    colours: NDArray[np.uint8] | None = None,
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
    shift = after - before.vertices
    moving = np.linalg.norm(shift, axis=1) > MOVES
    if not moving.any():
        raise CaseInputError(f"{path.name}: no point of the face moves by more than {MOVES} mm")
    corners = bounds([before.vertices[moving], after[moving]])
    corners += AROUND * np.ptp(corners, axis=0) * np.array([[-1.0], [1.0]])
    frame = partial(_frame, path.name, colours, corners)
    frames = [
        frame(share, polydata(before.vertices + share * shift, before.triangles))
        # Slowly at both ends.
        for share in 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, STEPS + 1))
    ]
    frames += frames[-2:0:-1]
    times = [HELD if i % STEPS == 0 else EACH for i in range(len(frames))]
    data = _gif(frames, times) if ending == ".gif" else _film(path.name, frames, times)
    write_whole(path, data)


def _frame(
    name: str, colours: NDArray[np.uint8] | None, corners: Floats, share: float, shape: Any
) -> NDArray[np.uint8]:
    def paint(plotter: Any, view: View) -> None:
        del view
        add_skin(plotter, shape, colours)

    way = {0.0: "before", 1.0: "after"}.get(round(share, 3), f"{share:.0%} of the way")
    return drawn(
        name, (View("front", f"{way}, front"), View("left", f"{way}, left")), corners, SIZE, paint
    )


def _gif(frames: Sequence[NDArray[np.uint8]], times: Sequence[int]) -> bytes:
    picture = third_party("PIL.Image", "animations are written", "report")
    # The colours of one frame for all: others would flicker.
    first = picture.fromarray(frames[STEPS // 2]).quantize(256)
    rest = [picture.fromarray(frame).quantize(palette=first, dither=0) for frame in frames]
    file = io.BytesIO()
    rest[0].save(
        file,
        "GIF",
        save_all=True,
        append_images=rest[1:],
        duration=[*times],
        loop=0,
        optimize=False,
    )
    return file.getvalue()


def _film(name: str, frames: Sequence[NDArray[np.uint8]], times: Sequence[int]) -> bytes:
    """The bytes of an MP4, which is streamed, so that it can be piped; held frames are repeated."""
    repeated = [f.tobytes() for f, ms in zip(frames, times, strict=True) for _ in range(ms // EACH)]
    width, height = SIZE
    command = (
        f"ffmpeg -v error -f rawvideo -pix_fmt rgb24 -s {width}x{height} -r {1000 / EACH} -i - "
        "-pix_fmt yuv420p -movflags frag_keyframe+empty_moov -f mp4 -"
    )
    given = b"".join(repeated)
    run = subprocess.run(command.split(), input=given, capture_output=True, check=False)  # noqa: S603
    if run.returncode or not run.stdout:
        reason = run.stderr.decode(errors="replace").strip()
        raise CaseInputError(f"{name}: ffmpeg ended with code {run.returncode}: {reason[-200:]}")
    return run.stdout
