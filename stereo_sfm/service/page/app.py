"""What a browser may ask the page's server: fixed files, the live state, commands, and recordings by their id.

Nothing that a client sends becomes a path. Commands must come as JSON with a header of their own, which pages of other
sites cannot send; on the loopback the server answers to this computer's names only (DNS rebinding).
"""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib import resources
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route
from starlette.types import ASGIApp, Receive, Scope, Send

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.outputs.access import Access
from stereo_sfm.service.page.state import PageState
from stereo_sfm.service.publisher import Reply, ServiceClient

FILES = {
    "/": ("index.html", "text/html"),
    "/page.js": ("page.js", "text/javascript"),
    "/page.css": ("page.css", "text/css"),
}
COMMANDS = (
    "save_map", "load_map", "reset", "relocalize", "start_recording", "stop_recording", "mark", "delete_recording",
    "set_setting",
)  # fmt: skip
HEADER = "x-stereo-sfm"  # must be there with every command
COOKIE = "stereo-sfm-session"
SESSION_S = 12 * 3600.0
MOST_SESSIONS = 64
BODY_BYTES = 1 << 14
LIVE_S = 0.2  # between two states
MOST_VIEWERS = 16
ANSWER_S = 60.0
LOCAL_NAMES = ("127.0.0.1", "localhost", "[::1]")
SAFE = {
    "content-security-policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
}

Handler = Callable[[Request], Awaitable[Response]]


class Bucket:
    """Lets `rate` a second through, and `burst` at once."""

    def __init__(self, rate: float, burst: int) -> None:
        self._rate, self._burst = rate, burst
        self._left, self._at = float(burst), time.monotonic()

    def take(self) -> bool:
        """Whether one more may pass now."""
        now = time.monotonic()
        self._left, self._at = min(self._burst, self._left + (now - self._at) * self._rate), now
        if self._left < 1:
            return False
        self._left -= 1
        return True


class Page:
    """The handlers of the page."""

    def __init__(self, state: PageState, service: ServiceClient, rules: Access) -> None:
        """Args: state, what is shown. service: carries out commands. rules: who may connect."""
        self._state, self._service, self._rules = state, service, rules
        self._sessions: dict[str, float] = {}  # id -> until when
        self._logins, self._commands = Bucket(0.5, 5), Bucket(5, 20)
        self._viewers = 0

    def app(self) -> ASGIApp:
        """The application."""
        asked: list[tuple[str, Handler]] = [
            ("/api/live", self._live),
            ("/api/map", self._map),
            ("/api/image.jpg", self._image),
            ("/api/settings", self._settings),
            ("/api/recordings", self._recordings),
            ("/api/recordings/{id}", self._files),
            ("/api/recordings/{id}/{number:int}", self._download),
        ]
        routes = [Route(path, self._file) for path in FILES]
        routes += [Route("/login", self._login, methods=["POST"])]
        routes += [Route(path, self._guarded(handler)) for path, handler in asked]
        routes += [Route("/api/command/{name}", self._guarded(self._command), methods=["POST"])]
        return _Safe(Starlette(routes=routes), not self._rules.token)

    # -- who ----------------------------------------------------------------------------------------------------------

    def _guarded(self, handler: Handler) -> Handler:
        async def answer(request: Request) -> Response:
            return await handler(request) if self._known(request) else _no(401, "the token is needed")

        return answer

    def _known(self, request: Request) -> bool:
        """Whether a request has a session, or says the token in its header."""
        if not self._rules.token:
            return True
        scheme, _, said = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self._rules.allows(said)
        return self._sessions.get(request.cookies.get(COOKIE, ""), 0.0) > time.monotonic()

    async def _login(self, request: Request) -> Response:
        values = await _object(request)
        if values is None or not self._logins.take():
            return _no(429 if values is not None else 400, "too many attempts: wait a moment")
        if not self._rules.allows(str(values.get("token", ""))):
            return _no(401, "this is not the token")
        now = time.monotonic()
        alive = {key: until for key, until in self._sessions.items() if until > now}
        self._sessions = dict(list(alive.items())[1 - MOST_SESSIONS :])
        key = secrets.token_urlsafe(32)
        self._sessions[key] = now + SESSION_S
        response = JSONResponse({"ok": True})
        secure = self._rules.tls is not None
        response.set_cookie(COOKIE, key, int(SESSION_S), httponly=True, samesite="strict", secure=secure)
        return response

    # -- what ---------------------------------------------------------------------------------------------------------

    async def _file(self, request: Request) -> Response:
        name, kind = FILES[request.url.path]
        file = resources.files("stereo_sfm.service.page").joinpath("static", name)
        return Response(file.read_bytes(), media_type=kind)

    async def _live(self, request: Request) -> Response:
        if self._viewers >= MOST_VIEWERS:
            return _no(503, "too many pages are open")
        return StreamingResponse(self._states(request), media_type="text/event-stream")

    async def _states(self, request: Request) -> AsyncIterator[str]:
        self._viewers += 1
        try:
            while not await request.is_disconnected():
                yield f"data: {self._state.snapshot()}\n\n"
                await asyncio.sleep(LIVE_S)
        finally:
            self._viewers -= 1

    async def _map(self, request: Request) -> Response:
        return Response(self._state.map(), media_type="application/json")

    async def _image(self, request: Request) -> Response:
        data = self._state.jpeg()
        return Response(data, media_type="image/jpeg") if data else Response(status_code=204)

    async def _settings(self, request: Request) -> Response:
        reply = await self._call("status", {})
        return JSONResponse(reply.data.get("settings", {}))

    async def _recordings(self, request: Request) -> Response:
        reply = await self._call("recordings", {})
        return JSONResponse(reply.data.get("recordings", []) if reply.ok else [])

    async def _files(self, request: Request) -> Response:
        """Names and sizes of a recording's files; their numbers are their places in this list."""
        reply = await self._call("recording_files", {"id": request.path_params["id"]})
        if not reply.ok:
            return _no(404, reply.text)
        files = [Path(text) for text in reply.data.get("files", [])]
        return JSONResponse([{"name": f.name, "bytes": f.stat().st_size if f.is_file() else 0} for f in files])

    async def _download(self, request: Request) -> Response:
        """One file of a recording: the service says which files those are."""
        reply = await self._call("recording_files", {"id": request.path_params["id"]})
        files: list[str] = reply.data.get("files", [])
        number = request.path_params["number"]
        if not reply.ok or not 0 <= number < len(files):
            return _no(404, reply.text or "no such file")
        path = Path(files[number])
        if not path.is_file():
            return _no(404, "the file is gone")
        return FileResponse(path, filename=f"{path.parent.name}_{path.name}", media_type="application/octet-stream")

    async def _command(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in COMMANDS:
            return _no(404, "no such command")
        if HEADER not in request.headers:
            return _no(403, f"commands need the header {HEADER}")
        values = await _object(request)
        if values is None:
            return _no(400, "a command takes a small JSON object")
        if not self._commands.take():
            return _no(429, "too many commands: wait a moment")
        reply = await self._call(name, values)
        return JSONResponse({"ok": reply.ok, "text": reply.text})

    async def _call(self, name: str, values: dict[str, Any]) -> Reply:
        def ask() -> Reply:
            try:
                return self._service.call(name, ANSWER_S, **values)
            except StereoSfmError as error:
                return Reply(False, str(error))

        return await run_in_threadpool(ask)


class _Safe:
    """Refuses other names of this computer, and tells browsers what the page needs."""

    def __init__(self, app: ASGIApp, local: bool) -> None:
        self._app, self._local = app, local

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in SAFE.items())]
            await send(message)

        if self._local and not _is_local(dict(scope["headers"]).get(b"host", b"").decode("latin-1")):
            await _no(421, "ask for this computer by its own name")(scope, receive, with_headers)
            return
        await self._app(scope, receive, with_headers)


def _is_local(host: str) -> bool:
    return any(host == name or host.startswith(f"{name}:") for name in LOCAL_NAMES)


async def _object(request: Request) -> dict[str, Any] | None:
    """The JSON object of a request, None for anything else or too much."""
    if not request.headers.get("content-type", "").startswith("application/json"):
        return None
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > BODY_BYTES:
            return None
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        return None
    return values if isinstance(values, dict) else None  # pyright: ignore[reportUnknownVariableType]


def _no(code: int, text: str) -> Response:
    return JSONResponse({"ok": False, "text": text}, code)
