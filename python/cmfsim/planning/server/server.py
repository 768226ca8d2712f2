"""The server of a planning page: sends the page, and exact solutions of the plans it receives."""

import asyncio
import contextlib
import json
import secrets
import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from cmfsim.errors import CmfsimError, third_party
from cmfsim.planning.page import PageContent, page_text
from cmfsim.planning.replanning import PlanningModel
from cmfsim.planning.server.requests import (
    MOST_BYTES,
    RefusedError,
    check_headers,
    check_token,
    plan_of_body,
)

__all__ = ["PlanningServer", "check_serving", "serve_planning"]

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
# Time that open connections have to finish after Ctrl-C, s.
LAST_SECONDS = 1


class PlanningServer:
    """A local server for one patient.

    Parameters
    ----------
    planning : PlanningModel
    content : PageContent
    case_file : str
        For the command that the page shows.
    port : int
        0 picks a free one.

    Attributes
    ----------
    url : str
        Address of the page, including the token of this launch.

    Raises
    ------
    CaseError
        (also `ValueError`) Starlette or Uvicorn, of the extra `serve`, is not installed.
    OSError
        The port is taken.
    """

    def __init__(
        self,
        planning: PlanningModel,
        content: PageContent,
        *,
        case_file: str = "case.toml",
        port: int = 0,
    ) -> None:
        self._planning = planning
        self._token = secrets.token_urlsafe(32)
        self._page = page_text(content, case_file=case_file, is_served=True)
        self._uvicorn = _module("uvicorn")
        self._responses = _module("starlette.responses")
        application = self._application()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._socket.bind((HOST, port))
            # Listens from now on, so that a page opened immediately waits for its response.
            self._socket.listen()
        except OSError:
            self._socket.close()
            raise
        self._address = f"{HOST}:{self._socket.getsockname()[1]}"
        self.url = f"http://{self._address}/{self._token}/"
        config = self._uvicorn.Config(
            application,
            log_level="warning",
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=LAST_SECONDS,
        )
        self._server = self._uvicorn.Server(config)

    def run(self) -> None:
        """Serves until `stop` is called or the process is interrupted."""
        try:
            self._server.run(sockets=[self._socket])
        finally:
            self._socket.close()

    def stop(self) -> None:
        """Ends `run` from another thread."""
        self._server.should_exit = True

    def _application(self) -> Any:
        applications, routing = _module("starlette.applications"), _module("starlette.routing")
        # Created in the serving loop: plans are solved one at a time, with all threads.
        turn: list[asyncio.Lock] = []

        async def page(request: Any) -> Any:
            return self._guarded(request, sends=False) or self._responses.HTMLResponse(
                self._page, headers=SAFE_HEADERS
            )

        async def solve(request: Any) -> Any:
            refused = self._guarded(request, sends=True)
            if refused is not None:
                return refused
            turn[:] = turn or [asyncio.Lock()]
            try:
                body = await _limited_body(request)
                plan = plan_of_body(self._planning, body)
                async with turn[0]:
                    return await asyncio.to_thread(self._solved, plan)
            except RefusedError as error:
                return self._refusal(error)
            except CmfsimError as error:
                return self._refusal(RefusedError(422, str(error)))

        return applications.Starlette(
            routes=[
                routing.Route("/{token}/", page, methods=["GET"]),
                routing.Route("/{token}/solve", solve, methods=["POST"]),
            ]
        )

    def _guarded(self, request: Any, *, sends: bool) -> Any:
        """The refusal of a request that the page did not send; None otherwise."""
        try:
            check_headers(request.headers, self._address, sends=sends)
            check_token(request.path_params["token"], self._token)
        except RefusedError as error:
            return self._refusal(error)
        return None

    def _refusal(self, error: RefusedError) -> Any:
        return self._responses.PlainTextResponse(
            str(error), status_code=error.status, headers=SAFE_HEADERS
        )

    def _solved(self, plan: Any) -> Any:
        """The exact displacements of the skin's nodes, float32, with a summary of the solution."""
        begun = time.perf_counter()
        prediction = self._planning.solve(plan)
        shift = np.ascontiguousarray(prediction.skin_displacements, dtype="<f4")
        figures = {
            "seconds": time.perf_counter() - begun,
            "contact_converged": bool(prediction.result.summary["contact_converged"]),
        }
        return self._responses.Response(
            shift.tobytes(),
            media_type="application/octet-stream",
            headers={**SAFE_HEADERS, "X-Solution": json.dumps(figures)},
        )


async def _limited_body(request: Any) -> bytes:
    """The body, as far as its limit: a length that was stated may be untrue."""
    body = b""
    async for chunk in request.stream():
        body += chunk
        if len(body) > MOST_BYTES:
            raise RefusedError(413, f"a plan has at most {MOST_BYTES} bytes")
    return body


def serve_planning(
    planning: PlanningModel,
    content: PageContent,
    *,
    case_file: str = "case.toml",
    port: int = 0,
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
    port : int
        0 picks a free one.
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
    server = PlanningServer(planning, content, case_file=case_file, port=port)
    if on_start is not None:
        on_start(server.url)
    # Uvicorn closes its connections first, then raises it again.
    with contextlib.suppress(KeyboardInterrupt):
        server.run()


def check_serving() -> None:
    """Checks that pages can be served, before any work is done.

    Raises
    ------
    CaseError
        (also `ValueError`) Starlette or Uvicorn, of the extra `serve`, is not installed.
    """
    for name in ("starlette.applications", "uvicorn"):
        _module(name)


def _module(name: str) -> Any:
    return third_party(name, "planning pages are served", "serve")
