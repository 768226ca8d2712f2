"""Pictures drawn in a separate process, in parallel with work that does not need them.

VTK takes seconds to load and to draw, on one core. Where it crashes for want of OpenGL, it takes
that process along and no other.
"""

import base64
import contextlib
import pickle
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType

from cmfsim.errors import CaseError, CaseInputError
from cmfsim.pictures.canvas import NO_OPENGL, Picture, pyvista_module, without_probe
from cmfsim.processes.worker import Worker, WorkerEndedError


class Painter:
    """A process that draws pictures one after another while the caller continues.

    It starts with the first picture, or with `load`. Used in a `with` statement, it ends with that.
    """

    def __init__(self) -> None:
        self._queue = ThreadPoolExecutor(1)
        self._worker: Worker | None = None

    def __enter__(self) -> "Painter":
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
            worker.ask("cmfsim.pictures.painting:load", {})

    @staticmethod
    def _draw(worker: Worker, picture: Picture, path: Path) -> None:
        packed = base64.b64encode(pickle.dumps(picture)).decode()
        try:
            worker.ask(
                "cmfsim.pictures.painting:draw_packed",
                {"path": str(path.absolute()), "packed": packed},
            )
        except WorkerEndedError as error:
            raise CaseInputError(
                f"{path.name}: the picture cannot be drawn (OpenGL does not work); {NO_OPENGL}"
            ) from error


def load() -> None:
    """Loads the libraries that draw."""
    pyvista_module().Plotter  # noqa: B018 (loaded when it is first asked for)


def draw_packed(path: str, packed: str) -> None:
    """Draws a picture of `Painter`, in its process."""
    picture: Picture = pickle.loads(base64.b64decode(packed))  # noqa: S301 (of the own parent)
    with without_probe():
        picture(Path(path))
