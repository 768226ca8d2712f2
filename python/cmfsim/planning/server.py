"""A local server for pages: the planning page, whose plans it solves as they are made, and others.

It listens on the local address only, but any web site open in the same browser can send requests to
it. Every request must therefore have the random token of this launch in its path and the exact host
and port as Host (against DNS rebinding). If it sends data, its Origin must be the page's own.
"""

import asyncio
import contextlib
import hmac
import json
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any, TypeVar

import numpy as np

from cmfsim.errors import BoundaryError, CaseInputError, CmfsimError, third_party
from cmfsim.planning.page import PageContent, page_text
from cmfsim.planning.replanning.model import PlanningModel
from cmfsim.values.checks import Floats

# A plan of fifty segments takes about 16 kB.
MOST_BYTES = 65_536
# Longest motion of a plan, mm: anything longer is a wrong unit.
MOST_SHIFT = 1000.0

# Local address only: no other machine on the network can connect.
HOST = "127.0.0.1"
# Headers of every response: never cached, never framed, never read by another site.
SAFE_HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
# Methods of requests, all of which are checked before they are answered.
METHODS = ("GET", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
# Status of an answer that nobody waits for any more.
GONE = 408
# The call of which only the newest waits.
SOLVE = "solve"
T = TypeVar("T")
# Time that open connections have to finish after Ctrl-C, s.
LAST_SECONDS = 1


class RefusedError(Exception):
    """A request that is answered with an error."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status


NOT_FOUND = RefusedError(404, "not found")


def check_headers(headers: Mapping[str, str], address: str, *, sends: bool) -> None:
    """Refuses, by `RefusedError`, requests that the page at this address did not send.

    headers: With names in lower case.
    address: Host and port, such as "127.0.0.1:8765".
    """
    if headers.get("host") != address:
        raise RefusedError(403, "wrong host")
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{address}":
        raise RefusedError(403, "wrong origin")
    if not sends:
        return
    if origin is None:
        raise RefusedError(403, "no origin")
    if headers.get("content-type") != "application/json":
        raise RefusedError(415, "application/json is needed")
    length = headers.get("content-length", "")
    if not length.isdecimal():
        raise RefusedError(411, "the length of the body is needed")
    if int(length) > MOST_BYTES:
        raise RefusedError(413, f"at most {MOST_BYTES} bytes can be sent")


def plan_of_body(planning: PlanningModel, body: bytes) -> dict[str, Floats]:
    """The plan in a request: JSON with `motions`, 16 numbers for each segment in the page's order.

    Raises `RefusedError`: Anything else; a motion that is not rigid, or longer than a metre.
    """
    try:
        given = json.loads(body)["motions"]
        if not _are_numbers(given):
            raise RefusedError(400, "motions are needed as lists of numbers")
        rows = np.array(given, dtype=np.float64)
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        raise RefusedError(400, "motions are needed as JSON") from error
    if rows.shape != (len(planning.segments), 16) or not np.isfinite(rows).all():
        count = len(planning.segments)
        raise RefusedError(400, f"16 finite numbers are needed for each of {count} segments")
    plan = {name: row.reshape(4, 4) for name, row in zip(planning.segments, rows, strict=True)}
    for name, segment in zip(planning.segments, planning.columns.centres, strict=True):
        way = plan[name][:3, :3] @ segment + plan[name][:3, 3] - segment
        if float(np.linalg.norm(way)) > MOST_SHIFT:
            raise RefusedError(400, f"{name} would move by more than {MOST_SHIFT:g} mm")
    try:
        return planning.whole(plan)
    except (BoundaryError, CaseInputError) as error:
        raise RefusedError(400, str(error)) from error


def _are_numbers(given: object) -> bool:
    """Whether a value is lists of numbers: numpy takes texts, true and null for some as well."""
    return isinstance(given, list) and all(
        isinstance(row, list)
        and all(isinstance(v, int | float) and not isinstance(v, bool) for v in row)
        for row in given
    )


@dataclass(frozen=True)
class Reply:
    """What a request is answered with: a media type, and headers besides `SAFE_HEADERS`."""

    body: bytes
    kind: str = "text/html; charset=utf-8"
    headers: Mapping[str, str] = field(default_factory=dict)


class LocalServer:
    """A local server of pages, and of what they ask for.

    pages: What GET is answered with, by the name behind the token; "" is the first page.
    calls: What POST of a body is answered with. It may raise `RefusedError` or a `CmfsimError`.
    port: 0 picks a free one; or what `open_port` returned, which raises the same.
    url: Address of the first page, including the token of this launch.
    """

    def __init__(
        self,
        pages: Mapping[str, Callable[[], Reply]],
        calls: Mapping[str, Callable[[bytes], Reply]],
        *,
        port: int | socket.socket = 0,
    ) -> None:
        self._pages, self._calls = pages, calls
        self._token = secrets.token_urlsafe(32)
        self._line = _Line()
        self._uvicorn = _module("uvicorn")
        self._responses = _module("starlette.responses")
        application = self._application()
        self._socket = open_port(port) if isinstance(port, int) else port
        # Listens from now on, so that a page opened immediately waits for its response.
        self._socket.listen()
        self._address = f"{HOST}:{self._socket.getsockname()[1]}"
        self.url = f"http://{self._address}/{self._token}/"
        config = self._uvicorn.Config(
            application,
            # What is still solved at Ctrl-C is given up: no reason for a traceback.
            log_level="critical",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=LAST_SECONDS,
        )
        self._server = self._uvicorn.Server(config)

    def run(self) -> None:
        """Serves until `stop` is called or the process is interrupted."""
        # Uvicorn closes its connections first, then raises it again.
        with contextlib.suppress(KeyboardInterrupt):
            try:
                self._server.run(sockets=[self._socket])
            finally:
                self._socket.close()

    def stop(self) -> None:
        """Ends `run` from another thread."""
        self._server.should_exit = True

    def _application(self) -> Any:
        applications, routing = _module("starlette.applications"), _module("starlette.routing")

        async def answer(request: Any) -> Any:
            try:
                reply = await self._reply(request)
            except RefusedError as error:
                return self._refusal(error)
            except CmfsimError as error:
                return self._refusal(RefusedError(422, str(error)))
            return self._responses.Response(
                reply.body, media_type=reply.kind, headers={**SAFE_HEADERS, **reply.headers}
            )

        route = routing.Route("/{place:path}", answer, methods=METHODS)
        application = applications.Starlette(routes=[route])
        # Starlette would redirect before any check.
        application.router.redirect_slashes = False
        return application

    async def _reply(self, request: Any) -> Reply:
        """The answer to a request, once it is known to come from the page."""
        check_headers(request.headers, self._address, sends=False)
        token, slash, name = request.path_params["place"].partition("/")
        # Of this launch, compared in constant time.
        is_ours = hmac.compare_digest(token.encode(), self._token.encode())
        if not is_ours or (name not in self._pages and name not in self._calls):
            raise NOT_FOUND
        if slash and request.method == "GET" and name in self._pages:
            return await _in_thread(self._pages[name])
        if request.method != "POST" or name not in self._calls:
            raise RefusedError(405, "method not allowed")
        check_headers(request.headers, self._address, sends=True)
        body = await _limited_body(request)
        if name != SOLVE:
            return await _in_thread(partial(self._calls[name], body))
        async with self._line.turn():
            # Nothing is solved for a page that has gone.
            if await request.is_disconnected():
                raise RefusedError(GONE, "the page has gone")
            return await _in_thread(partial(self._calls[name], body))

    def _refusal(self, error: RefusedError) -> Any:
        return self._responses.PlainTextResponse(
            str(error), status_code=error.status, headers=SAFE_HEADERS
        )


def solved_plan(planning: PlanningModel, plan: Mapping[str, Floats]) -> tuple[Floats, Any]:
    """The exact displacements of the skin's nodes, mm, with a summary of the solution."""
    begun = time.perf_counter()
    prediction = planning.solve(plan)
    return prediction.skin_displacements, {
        "seconds": time.perf_counter() - begun,
        "contact_converged": bool(prediction.result.summary["contact_converged"]),
    }


def solved_reply(shift: Floats, figures: Any) -> Reply:
    """The answer to a plan that was solved: float32, with the summary in a header."""
    body = np.ascontiguousarray(shift, dtype="<f4").tobytes()
    return Reply(body, "application/octet-stream", {"X-Solution": json.dumps(figures)})


class _Line:
    """Plans are solved one at a time, with all threads; of those that wait, the newest is next."""

    def __init__(self) -> None:
        self._is_solving = False
        self._waiting: asyncio.Future[bool] | None = None

    @contextlib.asynccontextmanager
    async def turn(self) -> AsyncIterator[None]:
        """A context in which nothing else is solved.

        Raises `RefusedError`: A newer plan came while this one waited.
        """
        if self._is_solving:
            if self._waiting is not None and not self._waiting.done():
                self._waiting.set_result(False)
            mine = self._waiting = asyncio.get_running_loop().create_future()
            if not await mine:
                raise RefusedError(409, "a newer plan is solved instead")
        self._is_solving = True
        try:
            yield
        finally:
            if self._waiting is not None and not self._waiting.done():
                # The turn passes on without a gap.
                self._waiting.set_result(True)
            else:
                self._is_solving = False


async def _in_thread(work: Callable[[], T]) -> T:
    """What a function returns, called in a thread that does not keep the process from ending."""
    answer: Future[T] = Future()
    # From now on it cannot be cancelled: nobody may wait for it any more when it is there.
    answer.set_running_or_notify_cancel()

    def run() -> None:
        try:
            answer.set_result(work())
        except Exception as error:  # noqa: BLE001 (raised again where it is waited for)
            answer.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return await asyncio.wrap_future(answer)


async def _limited_body(request: Any) -> bytes:
    """The body, as far as its limit: a length that was stated may be untrue."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BYTES:
            raise RefusedError(413, f"at most {MOST_BYTES} bytes can be sent")
    return body


def planning_server(
    planning: PlanningModel,
    content: PageContent,
    *,
    case_file: str = "case.toml",
    port: int | socket.socket = 0,
) -> LocalServer:
    """The server of `serve_planning`, which does not run yet."""
    page = page_text(content, case_file=case_file, is_served=True).encode()

    def solve(body: bytes) -> Reply:
        return solved_reply(*solved_plan(planning, plan_of_body(planning, body)))

    return LocalServer({"": lambda: Reply(page)}, {SOLVE: solve}, port=port)


def serve_planning(
    planning: PlanningModel,
    content: PageContent,
    *,
    case_file: str = "case.toml",
    port: int | socket.socket = 0,
    on_start: Callable[[str], None] | None = None,
) -> None:
    """Serves a planning page on this machine until it is interrupted (Ctrl-C).

    Parameters
    ----------
    planning : PlanningModel
    content : PageContent
        Of the same model.
    case_file : str
        For the command that the page shows.
    port : int or socket
        0 picks a free one; or what `open_port` returned.
    on_start : callable, optional
        Called with the address of the page, including the token of this launch.

    Raises
    ------
    CaseError
        (also `ValueError`) Starlette or Uvicorn, of the extra `serve`, is not installed.
    OSError
        The port is taken.

    Examples
    --------
    >>> import cmfsim
    >>> cmfsim.serve_planning(planning, content, on_start=print)  # doctest: +SKIP
    http://127.0.0.1:41037/kXm…/
    """
    server = planning_server(planning, content, case_file=case_file, port=port)
    if on_start is not None:
        on_start(server.url)
    server.run()


def open_port(port: int = 0) -> socket.socket:
    """A socket that holds a port of this machine; `LocalServer` takes it in place of a number.

    Raises `CaseError`: Starlette or Uvicorn, of the extra `serve`, is not installed.
    Raises `OSError`: The port is taken, or may not be used.
    """
    for name in ("starlette.applications", "uvicorn"):
        _module(name)
    opened = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        opened.bind((HOST, port))
    except OSError as error:
        opened.close()
        raise OSError(
            f"port {port} cannot be used ({error.strerror}): choose another with --port, or leave "
            "it out for a free one"
        ) from error
    return opened


def _module(name: str) -> Any:
    return third_party(name, "planning pages are served", "serve")
