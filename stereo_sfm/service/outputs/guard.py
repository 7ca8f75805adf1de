"""What stands before every page and WebSocket of the service: whatever a client sends ends in an answer 4xx."""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections.abc import Iterable, Mapping
from typing import Any
from urllib.parse import parse_qs

from h11 import LocalProtocolError
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.utils import ClientDisconnected

from stereo_sfm.service.outputs.access import Access, TooManyAttempts
from stereo_sfm.service.outputs.door import UNREAD_S, Door, Visit

log = logging.getLogger("stereo_sfm")

SAFE = {
    "content-security-policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'; base-uri 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-store",
    "cross-origin-resource-policy": "same-origin",
}
MOST_KINDS = 64  # of failures that are logged


class Guard:
    """Checks Host and Origin, bounds the time of every answer, and answers what nothing else did."""

    def __init__(self, door: Door, access: Access, local: bool, origins: Iterable[str] = ()) -> None:
        """Args:
        door: the connections. access: for the token.
        local: it listens on this computer only, so that only its names are right (DNS rebinding).
        origins: of web applications that may use it, besides its own pages.
        """
        self.app: ASGIApp = refusal(404, "nothing is here")  # what is behind it
        self._door, self._access = door, access
        self._local, self._origins = local, frozenset(origins)
        self._failures: set[tuple[str, str]] = set()

    def admit(self, scope: Scope, authorized: bool = False) -> Response | None:
        """Give one who is authorized, or sends the token, a place among the known; else the answer.

        Args: scope, of the request. authorized: it has shown so in another way.
        """
        visit = self._door.visit(scope.get("client"))
        if visit is None:
            return refusal(400, "the connection is gone")
        try:
            if not authorized and not self._access.allows(sent_token(scope), visit.peer):
                return refusal(401, "the token is needed")
        except TooManyAttempts as error:
            return refusal(429, str(error))
        return None if self._door.welcome(visit) else refusal(503, "too many clients are connected")

    def peer(self, scope: Scope) -> str:
        """Who sent a request."""
        visit = self._door.visit(scope.get("client"))
        return "?" if visit is None else visit.peer

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request."""
        visit = self._door.visit(scope.get("client"))
        answer = _Answer(send, visit)
        try:
            refused = self._refused(headers_of(scope))
            await (refused or self.app)(scope, receive, answer.send)
        except asyncio.CancelledError:  # the server ends; the client may have gone away long before
            if not answer.begun:
                await refusal(503, "the service has ended")(scope, receive, answer.send)
            elif scope["type"] == "http":
                await send({"type": "http.response.body"})
        except (ConnectionError, TimeoutError, ClientDisconnected):  # the client has gone away, or does not read
            if visit is not None:
                visit.end()
        except Exception as error:
            self._report(scope, error)
            if not answer.begun:
                await refusal(400, "this request cannot be answered")(scope, receive, answer.send)
            elif visit is not None:
                visit.end()
        finally:
            if visit is not None:
                self._door.rest(visit)

    def _refused(self, headers: Mapping[str, str]) -> Response | None:
        host, origin = headers.get("host", ""), headers.get("origin")
        if self._local and not _is_local(host):
            return refusal(421, "use localhost or 127.0.0.1 as the host name")
        if origin is not None and origin not in self._origins and origin.partition("://")[2] != host:
            return refusal(403, "pages of other sites may not use this")
        return None

    def _report(self, scope: Scope, error: Exception) -> None:
        """Once for each kind: it may be a mistake of ours, and anybody can send it a thousand times a second."""
        kind = type(error).__name__, str(error)[:100]
        if kind not in self._failures and len(self._failures) < MOST_KINDS:
            self._failures.add(kind)
            log.info("a request for %r ended in %s: %r", str(scope.get("path"))[:100], *kind)


class _Answer:
    """Sends within a time, with the headers of all answers; closes connections of strangers after each."""

    def __init__(self, send: Send, visit: Visit | None) -> None:
        self._send, self._visit = send, visit
        self.begun = False

    async def send(self, message: Message) -> None:
        """A message of the server's protocol.

        Raises:
            OSError: the client does not read, or cannot be answered.
        """
        if message["type"] in ("http.response.start", "websocket.http.response.start", "websocket.accept"):
            self.begun = True
        if message["type"].endswith("http.response.start"):
            more = SAFE if self._visit is not None and self._visit.known else SAFE | {"connection": "close"}
            message["headers"] = [*message["headers"], *((k.encode(), v.encode()) for k, v in more.items())]
        try:
            async with asyncio.timeout(UNREAD_S):
                await self._send(message)
        except LocalProtocolError as error:  # what it sent after its request is no request
            raise ConnectionError(str(error)) from None


def headers_of(scope: Scope) -> dict[str, str]:
    """The headers of a request; of several with one name, the last."""
    return {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope.get("headers", ())}


def sent_token(scope: Scope) -> str:
    """The token in a request's header, or, of a WebSocket, in its address: Foxglove can send it nowhere else."""
    scheme, _, token = headers_of(scope).get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return token
    if scope["type"] == "websocket":
        return parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
    return ""


def refusal(code: int, text: str, data: Mapping[str, Any] | None = None) -> Response:
    """An answer that says why not."""
    return JSONResponse({"ok": False, "text": text, **(data or {})}, code)


def _is_local(host: str) -> bool:
    """Whether a Host header names this computer by a name that nobody else can have."""
    name, _, port = host.rpartition(":") if not host.endswith("]") and ":" in host else (host, "", "")
    if port and not port.isdigit():
        return False
    if name.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(name.strip("[]")).is_loopback
    except ValueError:
        return False
