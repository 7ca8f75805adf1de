"""A web server in a thread, behind a door and a guard: for the operator's page and for Foxglove."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.service.outputs.access import Access, is_loopback
from stereo_sfm.service.outputs.door import BACKLOG, IDLE_S, Door
from stereo_sfm.service.outputs.settings import SecurityConfig

if TYPE_CHECKING:
    from starlette.types import ASGIApp

    from stereo_sfm.service.outputs.guard import Guard

END_S = 0.8
HANDED_OVER = 16  # connections that the door gives it before it looks after the others again
MESSAGE_BYTES = 1 << 16  # of a WebSocket, from a client


class WebServer:
    """Serves one application."""

    def __init__(self, name: str, address: str, port: int, rules: Access, security: SecurityConfig) -> None:
        """Args: name, for messages. address and port, where to listen. rules, security: for who connects."""
        self._name, self._address, self._port = name, address, port
        self._rules, self._security = rules, security
        self._server: Any = None
        self._thread: threading.Thread | None = None
        self.door: Door | None = None

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return self.door.getsockname()[1] if self.door is not None and self.door.fileno() >= 0 else 0

    def open(self, make: Callable[[Guard], ASGIApp], origins: Iterable[str] = ()) -> None:
        """Listen.

        Args: make, the application for its guard. origins: of web applications that may use it.

        Raises:
            StereoSfmError: the port is taken, or the address is not of this computer.
        """
        import uvicorn

        from stereo_sfm.service.outputs.guard import Guard

        family = socket.AF_INET6 if ":" in self._address else socket.AF_INET
        try:
            listening = socket.create_server((self._address, self._port), family=family, backlog=BACKLOG)
            self.door = Door.of(listening, speak=True)
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise StereoSfmError(f"{self._name}: cannot listen on {self._address}:{self._port}: {why}") from None
        guard = Guard(self.door, self._rules, is_loopback(self._address), origins)
        guard.app = make(guard)
        encrypted = self._rules.tls is not None
        config = uvicorn.Config(
            guard,
            loop="asyncio",  # it calls the door's `accept`
            backlog=HANDED_OVER,
            http=_protocol(),
            ws="websockets-sansio",
            ws_max_size=MESSAGE_BYTES,
            ws_per_message_deflate=False,
            log_level="critical",  # the guard answers what goes wrong
            access_log=False,
            proxy_headers=False,  # who is at the other end is what the system says, not what the client does
            lifespan="off",
            timeout_keep_alive=int(IDLE_S),
            timeout_graceful_shutdown=1,
            server_header=False,
            ssl_certfile=self._security.tls_cert if encrypted else None,
            ssl_keyfile=self._security.tls_key or None if encrypted else None,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self.door],), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        if self._server is not None and self._thread is not None:
            self._server.should_exit = self._server.force_exit = True
            self._thread.join(END_S)
        if self.door is not None:
            self.door.close()


def _protocol() -> type[Any]:
    """Uvicorn's, which refuses a bad body of a HEAD request, too: its reason would be a body, where none may be."""
    import h11
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Protocol(H11Protocol):
        def send_400_response(self, msg: str) -> None:
            with suppress(h11.LocalProtocolError):
                super().send_400_response(msg)
            self.transport.close()

    return Protocol
