"""The requests that the page's server accepts: fixed files, the live state, commands, and recordings by their id.

Nothing that a client sends becomes a path. Commands must come as JSON with a header of their own, which pages of other
sites cannot send; on the loopback the server accepts this computer's names only (DNS rebinding).
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
from stereo_sfm.service.page.verdicts import Verdicts
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
REPLY_S = 30.0  # more than the service takes for any command
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
        self._verdicts = Verdicts(self._folder_of)

    def app(self) -> ASGIApp:
        """The application."""
        guarded: list[tuple[str, Handler]] = [
            ("/api/live", self._live),
            ("/api/map", self._map),
            ("/api/image.jpg", self._image),
            ("/api/floor_plan.png", self._floor_plan),
            ("/api/settings", self._settings),
            ("/api/recordings", self._recordings),
            ("/api/recordings/{id}", self._files),
            ("/api/recordings/{id}/{number:int}", self._download),
        ]
        routes = [Route(path, self._file) for path in FILES]
        routes += [Route("/login", self._login, methods=["POST"])]
        routes += [Route(path, self._guarded(handler)) for path, handler in guarded]
        routes += [Route("/api/command/{name}", self._guarded(self._command), methods=["POST"])]
        return _Safe(Starlette(routes=routes), not self._rules.token)

    # -- access ------------------------------------------------------------------------------------------------------

    def _guarded(self, handler: Handler) -> Handler:
        async def guarded(request: Request) -> Response:
            return await handler(request) if self._known(request) else _refusal(401, "the token is needed")

        return guarded

    def _known(self, request: Request) -> bool:
        """Whether a request has a session, or the token in its header."""
        if not self._rules.token:
            return True
        scheme, _, token = request.headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self._rules.allows(token)
        return self._sessions.get(request.cookies.get(COOKIE, ""), 0.0) > time.monotonic()

    async def _login(self, request: Request) -> Response:
        try:
            values = await _object(request)
        except StereoSfmError as error:
            return _refusal(400, str(error))
        if not self._logins.take():
            return _refusal(429, "too many attempts: wait a moment")
        if not self._rules.allows(str(values.get("token", ""))):
            return _refusal(401, "this is not the token")
        now = time.monotonic()
        alive = {key: until for key, until in self._sessions.items() if until > now}
        self._sessions = dict(list(alive.items())[1 - MOST_SESSIONS :])
        key = secrets.token_urlsafe(32)
        self._sessions[key] = now + SESSION_S
        response = JSONResponse({"ok": True})
        secure = self._rules.tls is not None
        response.set_cookie(COOKIE, key, int(SESSION_S), httponly=True, samesite="strict", secure=secure)
        return response

    # -- content ----------------------------------------------------------------------------------------------------

    async def _file(self, request: Request) -> Response:
        name, kind = FILES[request.url.path]
        file = resources.files("stereo_sfm.service.page").joinpath("static", name)
        return Response(file.read_bytes(), media_type=kind)

    async def _live(self, request: Request) -> Response:
        if self._viewers >= MOST_VIEWERS:
            return _refusal(503, "too many pages are open")
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

    async def _floor_plan(self, request: Request) -> Response:
        data = self._state.floor_plan()
        return Response(data, media_type="image/png") if data else Response(status_code=204)

    async def _settings(self, request: Request) -> Response:
        reply = await self._call("status", {})
        return JSONResponse(reply.data.get("settings", {}))

    async def _recordings(self, request: Request) -> Response:
        reply = await self._call("recordings", {})
        return JSONResponse(self._verdicts.add(reply.data.get("recordings", [])) if reply.ok else [])

    def _folder_of(self, id: str) -> Path | None:
        """The folder of a recording, from the files that the service lists."""
        files = self._service.call("recording_files", id=id).data.get("files", [])
        return Path(files[0]).parent if files else None

    async def _files(self, request: Request) -> Response:
        """Names and sizes of a recording's files; their numbers are their places in this list."""
        reply = await self._call("recording_files", {"id": request.path_params["id"]})
        if not reply.ok:
            return _refusal(404, reply.text)
        files = [Path(text) for text in reply.data.get("files", [])]
        return JSONResponse([{"name": f.name, "bytes": f.stat().st_size if f.is_file() else 0} for f in files])

    async def _download(self, request: Request) -> Response:
        """One file of a recording, from the list that the service gives."""
        reply = await self._call("recording_files", {"id": request.path_params["id"]})
        files: list[str] = reply.data.get("files", [])
        number = request.path_params["number"]
        if not reply.ok or not 0 <= number < len(files):
            return _refusal(404, reply.text or "no such file")
        path = Path(files[number])
        if not path.is_file():
            return _refusal(404, "the file no longer exists")
        return FileResponse(path, filename=f"{path.parent.name}_{path.name}", media_type="application/octet-stream")

    async def _command(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in COMMANDS:
            return _refusal(404, "no such command")
        if HEADER not in request.headers:
            return _refusal(403, "commands need the header X-Stereo-Sfm: 1")
        try:
            values = await _object(request)
        except StereoSfmError as error:
            return _refusal(400, str(error))
        if not self._commands.take():
            return _refusal(429, "too many commands: wait a moment")
        reply = await self._call(name, values)
        return JSONResponse({"ok": reply.ok, "text": reply.text})

    async def _call(self, name: str, values: dict[str, Any]) -> Reply:
        def call() -> Reply:
            try:
                return self._service.call(name, REPLY_S, **values)
            except StereoSfmError as error:
                return Reply(False, str(error))

        return await run_in_threadpool(call)


class _Safe:
    """Refuses requests under other host names, adds the security headers, and ends quietly with the server."""

    def __init__(self, app: ASGIApp, local: bool) -> None:
        self._app, self._local = app, local

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return

        begun: list[bool] = []

        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                begun.append(True)
                message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in SAFE.items())]
            await send(message)

        if self._local and not _is_local(dict(scope["headers"]).get(b"host", b"").decode("latin-1")):
            await _refusal(421, "use localhost or 127.0.0.1 as the host name")(scope, receive, with_headers)
            return
        try:
            await self._app(scope, receive, with_headers)
        except asyncio.CancelledError:  # the server ends; the client may have gone away long before
            if begun:
                await send({"type": "http.response.body"})
            else:
                await _refusal(503, "the service has ended")(scope, receive, with_headers)


def _is_local(host: str) -> bool:
    return any(host == name or host.startswith(f"{name}:") for name in LOCAL_NAMES)


async def _object(request: Request) -> dict[str, Any]:
    """The JSON object of a request.

    Raises:
        StereoSfmError: it is not declared as JSON, is too large, or is something else.
    """
    if not request.headers.get("content-type", "").startswith("application/json"):
        raise StereoSfmError("send the header Content-Type: application/json")
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > BODY_BYTES:
            raise StereoSfmError(f"the body is larger than {BODY_BYTES} bytes")
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise StereoSfmError("the body is not a JSON object, such as {}")
    return values  # pyright: ignore[reportUnknownVariableType]


def _refusal(code: int, text: str) -> Response:
    return JSONResponse({"ok": False, "text": text}, code)
