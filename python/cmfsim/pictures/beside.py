"""Pictures drawn in a process of their own, beside the work that they are not needed for.

VTK takes seconds to load and to draw, on one core. Where it crashes for want of OpenGL, it takes
that process along and no other.
"""

import base64
import contextlib
import pickle
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from cmfsim.errors import CaseError, CaseInputError
from cmfsim.io.parallel import Worker
from cmfsim.pictures.canvas import NO_OPENGL, pyvista_module, without_probe

__all__ = ["Painter", "PictureJob", "draw_packed", "load"]


class PictureJob:
    """A function of this package that draws a picture, and what it takes beside the path."""

    def __init__(self, function: Callable[..., None], /, **given: Any) -> None:
        self.function = function
        self.given: Mapping[str, Any] = given

    def draw(self, path: Path) -> None:
        """Draws it in this process."""
        self.function(path, **self.given)


class Painter:
    """A process that draws pictures one after the other, while the caller goes on.

    It loads its libraries as soon as it is made. Used in a `with` statement, it ends with that.
    """

    def __init__(self) -> None:
        self._queue = ThreadPoolExecutor(1)
        # Where this Python cannot start another, pictures are drawn in turn.
        self._worker = Worker() if sys.executable else None
        if self._worker is not None:
            self._queue.submit(self._load, self._worker)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._worker is not None:
            self._worker.end()
        self._queue.shutdown(cancel_futures=True)

    def begin(self, job: PictureJob, path: Path) -> "Future[None]":
        """The picture to come; its result raises what `draw` does.

        What the picture shows is taken now: it may not change afterwards.
        """
        if self._worker is None:
            return self._queue.submit(job.draw, path)
        return self._queue.submit(self._draw, self._worker, job, path)

    @staticmethod
    def _load(worker: Worker) -> None:
        # What is wrong is raised for the first picture.
        with contextlib.suppress(CaseError):
            worker.answer("cmfsim.pictures.beside:load", {})

    @staticmethod
    def _draw(worker: Worker, job: PictureJob, path: Path) -> None:
        packed = base64.b64encode(pickle.dumps((job.function, dict(job.given)))).decode()
        try:
            worker.answer(
                "cmfsim.pictures.beside:draw_packed",
                {"path": str(path.absolute()), "packed": packed},
            )
        except CaseError as error:
            if not worker.has_ended:
                raise
            raise CaseInputError(
                f"{path.name}: the picture cannot be drawn (OpenGL does not work); {NO_OPENGL}"
            ) from error


def load() -> None:
    """Loads the libraries that draw."""
    pyvista_module().Plotter  # noqa: B018 (loaded when it is first asked for)


def draw_packed(path: str, packed: str) -> None:
    """Draws a picture of `Painter`, in its process."""
    function, given = pickle.loads(base64.b64decode(packed))  # noqa: S301 (of the own parent)
    with without_probe():
        function(Path(path), **given)
