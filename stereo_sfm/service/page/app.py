"""The requests that the page's server accepts: fixed files, the live state, commands, and recordings by their id.

Nothing that a client sends becomes a path. Commands must come as JSON with a header of their own, which pages of other
sites cannot send. The guard before it checks the rest.
"""

from __future__ import annotations

import asyncio
import json
import secrets
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar

from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route, Router
from starlette.types import ASGIApp

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.outputs.access import Access, Bucket, Links, TooManyAttempts, used_links
from stereo_sfm.service.outputs.door import HANDSHAKE_S
from stereo_sfm.service.outputs.guard import Guard, refusal
from stereo_sfm.service.page import playback
from stereo_sfm.service.page.settings_form import settings_form
from stereo_sfm.service.page.state import PageState
from stereo_sfm.service.page.surface import SurfacePicture, SurfacePictures
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

Handler = Callable[[Request], Awaitable[Response]]
T = TypeVar("T")


class Page:
    """The handlers of the page."""

    def __init__(
        self, state: PageState, service: ServiceClient, rules: Access, guard: Guard, surface: str = ""
    ) -> None:
        """Args:
        state: what is shown. service: carries out commands. rules: who may connect. guard: before it.
        surface: folder of `dense`, if any.
        """
        self._state, self._service, self._rules, self._guard = state, service, rules, guard
        self._surfaces = SurfacePictures(Path(surface)) if surface else None
        self._links = Links(rules.token, kept=used_links()) if rules.token else None
        self._sessions: dict[str, tuple[str, float]] = {}  # id -> whose, until when
        self._commands = Bucket(5, 20)
        self._viewers = 0
        self._verdicts = Verdicts(self._folder_of)

    def app(self) -> ASGIApp:
        """The application."""
        guarded: list[tuple[str, Handler]] = [
            ("/api/live", self._live),
            ("/api/map", self._map),
            ("/api/image.jpg", self._image),
            ("/api/floor_plan.png", self._floor_plan),
            ("/api/surface", self._surface),
            ("/api/surface.png", self._surface_png),
            ("/api/settings", self._settings),
            ("/api/recordings", self._recordings),
            ("/api/recordings/{id}", self._files),
            ("/api/recordings/{id}/timeline", self._timeline),
            ("/api/recordings/{id}/thumbnails/{number:int}", self._thumbnail),
            ("/api/recordings/{id}/{number:int}", self._download),
        ]
        routes = [Route(path, self._file) for path in FILES]
        routes += [Route("/login", self._login, methods=["POST"])]
        routes += [Route(path, self._guarded(handler)) for path, handler in guarded]
        routes += [Route("/api/command/{name}", self._guarded(self._command), methods=["POST"])]
        return Router(routes)

    # -- access ------------------------------------------------------------------------------------------------------

    def _guarded(self, handler: Handler) -> Handler:
        async def guarded(request: Request) -> Response:
            refused = self._guard.admit(request.scope, self._has_session(request))
            return await handler(request) if refused is None else refused

        return guarded

    def _has_session(self, request: Request) -> bool:
        """Of this peer: browsers send the cookie to every port of a host, and so to other users of this computer."""
        peer, until = self._sessions.get(request.cookies.get(COOKIE, ""), ("", 0.0))
        return until > time.monotonic() and peer == self._guard.peer(request.scope)

    async def _login(self, request: Request) -> Response:
        """A session for the token, or for the code of a link."""
        peer = self._guard.peer(request.scope)
        try:
            values = await _object(request)
            sent = str(values.get("token", ""))
            by_link = self._links is not None and self._links.take(sent)
            if not by_link and not self._rules.allows(sent, peer):
                return refusal(401, "this is not the token")
        except TooManyAttempts as error:
            return refusal(429, str(error))
        except StereoSfmError as error:
            return refusal(400, str(error))
        now = time.monotonic()
        alive = {key: session for key, session in self._sessions.items() if session[1] > now}
        self._sessions = dict(list(alive.items())[1 - MOST_SESSIONS :])
        key = secrets.token_urlsafe(32)
        self._sessions[key] = peer, now + SESSION_S
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
            return refusal(503, "too many pages are open")
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

    async def _surface(self, request: Request) -> Response:
        found = await self._newest_surface()
        return Response(status_code=204) if found is None else JSONResponse(found.extent)

    async def _surface_png(self, request: Request) -> Response:
        found = await self._newest_surface()
        return Response(status_code=204) if found is None else Response(found.png, media_type="image/png")

    async def _newest_surface(self) -> SurfacePicture | None:
        if self._surfaces is None or self._state.axes is None:
            return None
        return await run_in_threadpool(self._surfaces.newest, self._state.axes)

    async def _settings(self, request: Request) -> Response:
        reply = await self._call("status", {})
        return JSONResponse(settings_form(reply.data.get("settings", {})))

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
            return refusal(404, reply.text)
        files = [Path(text) for text in reply.data.get("files", [])]
        return JSONResponse([{"name": f.name, "bytes": f.stat().st_size if f.is_file() else 0} for f in files])

    async def _download(self, request: Request) -> Response:
        """One file of a recording, from the list that the service gives."""
        reply = await self._call("recording_files", {"id": request.path_params["id"]})
        files: list[str] = reply.data.get("files", [])
        number = request.path_params["number"]
        if not reply.ok or not 0 <= number < len(files):
            return refusal(404, reply.text or "no such file")
        path = Path(files[number])
        if not path.is_file():
            return refusal(404, "the file no longer exists")
        return FileResponse(path, filename=f"{path.parent.name}_{path.name}", media_type="application/octet-stream")

    async def _timeline(self, request: Request) -> Response:
        """Seconds of a recording's thumbnails."""
        found = await self._played(request, playback.timeline)
        return found if isinstance(found, Response) else JSONResponse(found)

    async def _thumbnail(self, request: Request) -> Response:
        number = request.path_params["number"]
        found = await self._played(request, lambda folder: playback.thumbnail(folder, number))
        if isinstance(found, Response):
            return found
        kept = {"Cache-Control": "private, max-age=3600"}
        return Response(found, media_type="image/jpeg", headers=kept) if found else Response(status_code=204)

    async def _played(self, request: Request, read: Callable[[Path], T]) -> T | Response:
        """What is read from a recording's folder, or why it cannot be."""
        try:
            folder = await run_in_threadpool(self._folder_of, request.path_params["id"])
            return refusal(404, "no such recording") if folder is None else await run_in_threadpool(read, folder)
        except (StereoSfmError, OSError) as error:
            return refusal(404, str(error))

    async def _command(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in COMMANDS:
            return refusal(404, "no such command")
        if HEADER not in request.headers:
            return refusal(403, "commands need the header X-Stereo-Sfm: 1")
        try:
            values = await _object(request)
        except StereoSfmError as error:
            return refusal(400, str(error))
        if not self._commands.take():
            return refusal(429, "too many commands: wait a moment")
        reply = await self._call(name, values)
        return JSONResponse({"ok": reply.ok, "text": reply.text})

    async def _call(self, name: str, values: dict[str, Any]) -> Reply:
        def call() -> Reply:
            try:
                return self._service.call(name, REPLY_S, **values)
            except StereoSfmError as error:
                return Reply(False, str(error))

        return await run_in_threadpool(call)


async def _object(request: Request) -> dict[str, Any]:
    """The JSON object of a request.

    Raises:
        StereoSfmError: it is not declared as JSON, is too large, or is something else.
    """
    if not request.headers.get("content-type", "").startswith("application/json"):
        raise StereoSfmError("send the header Content-Type: application/json")
    data = b""
    try:
        async with asyncio.timeout(HANDSHAKE_S):
            async for part in request.stream():
                data += part
                if len(data) > BODY_BYTES:
                    raise StereoSfmError(f"the body is larger than {BODY_BYTES} bytes")
    except ClientDisconnect:
        raise StereoSfmError("the connection was closed before the end of the body") from None
    try:
        values = json.loads(data)
    except (ValueError, RecursionError):
        values = None
    if not isinstance(values, dict):
        raise StereoSfmError("the body is not a JSON object, such as {}")
    return values  # pyright: ignore[reportUnknownVariableType]
