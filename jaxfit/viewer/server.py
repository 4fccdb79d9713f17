"""The server of the page. It answers only this computer, only with the token of its address, and takes no path."""

from __future__ import annotations

import hmac
import logging
import secrets
import socket
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import uvicorn
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from jaxfit.foundation.errors import InputError
from jaxfit.foundation.reading import parse_json
from jaxfit.viewer.blank import Blank
from jaxfit.viewer.film import Pictures, film_times, is_played
from jaxfit.viewer.page import FILES, index, policy
from jaxfit.viewer.session import EditsChangedError, Session
from jaxfit.viewer.shown import Shown, frames_of

_logger = logging.getLogger(__name__)

HOST = "127.0.0.1"
LARGEST_BODY = 1 << 20
"""Bytes that the page may send at once."""


@dataclass
class Viewer:
    """What one page shows: results of one film, and the corrections of the first result."""

    results: Sequence[Shown | Blank]
    video: Path | None
    session: Session | None
    open_result: Callable[[Path], Shown] | None = None
    """Opens the new result after corrections."""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    def __post_init__(self):
        self._content = self._film_content()

    def _film_content(self) -> tuple[int, int] | None:
        """Return size and time of the last change of the film; None without a film. A folder may get more pictures."""
        if self.video is None or not self.video.exists():
            return None
        found = self.video.stat()
        return (0, 0) if self.video.is_dir() else (found.st_size, found.st_mtime_ns)

    def existing_film(self) -> Path:
        """Return the film, as it was when the page was opened.

        Raises:
            HTTPException: there is no film.
            InputError: the film was removed or replaced.
        """
        if self.video is None:
            raise HTTPException(404)
        if self._film_content() != self._content:
            remedy = "start `jaxfit view` again"
            raise InputError(self.video, "was removed or changed while it is shown", remedy)
        return self.video

    @cached_property
    def film(self) -> dict[str, Any] | None:
        """How the page shows the film; None without a film."""
        if self.video is None:
            return None
        source = "film" if is_played(self.video) else None
        times_s = film_times(self.video, frames_of(self.results)) if source else None
        return {"source": source, "times_s": times_s, "pictures": True}

    @cached_property
    def pictures(self) -> Pictures:
        """The pictures of the film, which exists."""
        assert self.video is not None
        return Pictures(self.video, frames_of(self.results))

    def show_refit(self, folder: Path) -> None:
        """Show the result of a refit, in place of an earlier one, beside the result."""
        assert self.open_result is not None
        self.results = [self.results[0], self.open_result(folder)]

    def facts(self) -> dict[str, Any]:
        """Return what the page needs first."""
        corrections = None
        if self.session is not None:
            corrections = {
                "edits": [str(edit) for edit in self.session.edits],
                "file": self.session.edits_path.name,
                "labels": self.session.labels_path.name,
            }
        return {
            "results": [each.facts() for each in self.results],
            "film": self.film,
            "corrections": corrections,
        }


def application(viewer: Viewer, port: int) -> ASGIApp:
    """Return the server of a page as an ASGI application.

    Args:
        viewer: what the page shows.
        port: the port that the server listens on, which belongs to the address of the page.
    """

    async def page(request: Request) -> Response:
        return Response(index(), media_type="text/html", headers={"Content-Security-Policy": policy()})

    async def page_file(request: Request) -> Response:
        name = request.path_params["name"]
        if name not in FILES:
            raise HTTPException(404)
        kinds = {".js": "text/javascript", ".css": "text/css"}
        return Response(FILES[name].read_bytes(), media_type=kinds.get(Path(name).suffix, "text/plain"))

    async def facts(request: Request) -> Response:
        return JSONResponse(await run_in_threadpool(viewer.facts))

    async def binary(request: Request) -> Response:
        result, kind = _number(request.path_params["result"]), request.path_params["kind"]
        if not result < len(viewer.results):
            raise HTTPException(404)
        argument = request.path_params.get("number")
        content = await run_in_threadpool(_content, viewer.results[result], kind, argument)
        return Response(content, media_type="application/octet-stream")

    async def film(request: Request) -> Response:
        if viewer.existing_film().is_dir():
            raise HTTPException(404)
        return FileResponse(viewer.existing_film())  # answers byte ranges

    async def picture(request: Request) -> Response:
        number = _number(request.path_params["number"])
        viewer.existing_film()
        return Response(await run_in_threadpool(viewer.pictures.picture, number), media_type="image/jpeg")

    async def change(request: Request) -> Response:
        session = viewer.session
        if session is None:
            raise InputError("this page", "takes no corrections", "open one result, without --save")
        sent = parse_json((await _body(request)).decode("utf-8", "replace"), "the page")
        action = request.path_params["action"]
        if action == "edits":
            await run_in_threadpool(session.set_edits, _list_of(sent, "edits", str), _list_of(sent, "known", str))
            return JSONResponse({"edits": list(map(str, session.edits))})
        if action == "refit":
            known = _list_of(sent, "known", str)
            work = session.refit(viewer.show_refit, known)
        elif action == "close":
            viewer.results = viewer.results[:1]
            return JSONResponse({})
        elif action == "mark":
            work = session.mark(_list_of(sent, "frames", int))
        else:
            raise HTTPException(404)
        return JSONResponse(work.entries())

    async def work(request: Request) -> Response:
        running = None if viewer.session is None else viewer.session.work
        return JSONResponse({"done": True, "kind": ""} if running is None else running.entries())

    async def refused(request: Request, error: Exception) -> Response:
        if viewer.session is None or not isinstance(error, EditsChangedError):
            return JSONResponse({"problem": str(error)}, 400)
        return JSONResponse({"problem": str(error), "edits": list(map(str, viewer.session.edits))}, 409)

    inside = Starlette(
        routes=[
            Route("/", page),
            Route("/page/{name}", page_file),
            Route("/facts", facts),
            Route("/results/{result}/{kind}", binary),
            Route("/results/{result}/{kind}/{number}", binary),
            Route("/film", film),
            Route("/frames/{number}", picture),
            Route("/work", work),
            Route("/change/{action}", change, methods=["POST"]),
        ],
        exception_handlers={InputError: refused},
    )
    return Guard(inside, viewer.token, port)


class Guard:
    """Passes on the requests of this server's own page, and rejects all others.

    A request needs the token as the first part of its path. Its `Host` must be this computer, so that a foreign name
    that leads here (DNS rebinding) fails. An `Origin` or `Sec-Fetch-Site` of another page fails too; only a link may
    lead from elsewhere to the page itself.
    """

    def __init__(self, inside: ASGIApp, token: str, port: int):
        self._inside, self._token = inside, token
        self._hosts = {f"{name}:{port}" for name in (HOST, "localhost")}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._inside(scope, receive, send)
            return
        problem = self._problem(scope)
        if problem is not None:
            await PlainTextResponse(problem, 403)(scope, receive, send)
            return

        async def guarded(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *_HEADERS]
            await send(message)

        prefix = f"/{self._token}"
        path = scope["path"].removeprefix(prefix)
        inside = {**scope, "path": path, "raw_path": path.encode(), "root_path": ""}
        try:
            await self._inside(inside, receive, guarded)
        except ClientDisconnect:
            pass
        except Exception as error:  # such as a film that becomes shorter while it is sent
            _logger.warning("the viewer could not answer %s: %s: %s", path[:80], type(error).__name__, error)
            raise  # uvicorn closes the connection

    def _problem(self, scope: Scope) -> str | None:
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        if headers.get("host") not in self._hosts:
            return "jaxfit answers only this computer"
        if "origin" in headers and headers["origin"] not in {f"http://{host}" for host in self._hosts}:
            return "jaxfit answers only its own page"
        is_link = headers.get("sec-fetch-mode") == "navigate" and scope["path"].count("/") == 2
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin") and not (
            is_link and scope["path"].endswith("/") and scope["method"] == "GET"
        ):
            return "jaxfit answers only its own page"
        token = scope["path"].split("/")[1] if scope["path"].startswith("/") else ""
        if not hmac.compare_digest(token.encode(), self._token.encode()) or scope["path"].count("/") < 2:
            return "the address has no token, or the token of another run: use the address that jaxfit printed"
        return None


_HEADERS = [
    (b"cache-control", b"no-store"),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"x-frame-options", b"DENY"),
]


def _content(result: Shown | Blank, kind: str, argument: str | None) -> bytes:
    """Return arrays of a result: `rig`, `flags`, `poses/3`, `outlines/3`, `why/120`, `values/speed`."""
    if kind in ("rig", "flags") and argument is None:
        return result.rig() if kind == "rig" else result.flags()
    numbered = {"poses": result.part, "outlines": result.outlines, "why": result.why}
    if kind in numbered and argument is not None:
        return numbered[kind](_number(argument))
    if isinstance(result, Shown) and kind == "values" and argument in [each["name"] for each in result.kinds_of_values]:
        return result.values(argument)
    raise HTTPException(404)


def _number(text: str) -> int:
    """Return a number of a path."""
    if not (text.isascii() and text.isdecimal() and len(text) < 10):
        raise HTTPException(404)
    return int(text)


async def _body(request: Request) -> bytes:
    content = b""
    async for part in request.stream():
        content += part
        if len(content) > LARGEST_BODY:
            raise HTTPException(413)
    return content


def _list_of(sent: Any, name: str, kind: type) -> list[Any]:
    values = sent.get(name) if isinstance(sent, dict) else None
    if not isinstance(values, list) or not all(type(value) is kind for value in values):
        raise InputError("the page", f"sent no list of {name}", "reload the page")
    return values


def listening(port: int | None) -> socket.socket:
    """Return a socket that listens on a port of this computer only; None takes a free port.

    Raises:
        InputError: the port is in use, or may not be used.
    """
    sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    if sys.platform != "win32":  # there, the option would share a port that is in use
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        sock.bind((HOST, port or 0))
        sock.listen()
    except (OSError, OverflowError) as error:
        sock.close()
        problem = f"is {port}, which cannot be used: {getattr(error, 'strerror', None) or error}"
        raise InputError("--port", problem, "leave --port out, which takes a free port") from error
    return sock


def server_config(viewer: Viewer, port: int) -> uvicorn.Config:
    """Return the settings of the server, whose tracebacks `jaxfit --verbose` shows."""
    return uvicorn.Config(application(viewer, port), log_config=None, lifespan="off", server_header=False)


def serve(viewer: Viewer, sock: socket.socket, started: Callable[[str], None]) -> None:
    """Serve a page until the process is interrupted.

    Args:
        viewer: what the page shows.
        sock: where to listen, from `listening`.
        started: is called with the address of the page when the server answers.
    """
    port = sock.getsockname()[1]
    config = server_config(viewer, port)

    class Server(uvicorn.Server):
        async def startup(self, sockets: Any = None) -> None:
            await super().startup(sockets)
            started(f"http://{HOST}:{port}/{viewer.token}/")

    Server(config).run(sockets=[sock])
