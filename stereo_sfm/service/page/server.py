"""The operator's page as an output of the service."""

from __future__ import annotations

import socket
import threading
from typing import TYPE_CHECKING, Any

from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.service.messages import EVERYTHING, ServiceMessage
from stereo_sfm.service.outputs.access import Access, access
from stereo_sfm.service.outputs.settings import SecurityConfig
from stereo_sfm.service.publisher import ServiceClient

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig

MOST_CONNECTIONS = 64
IDLE_S = 15
END_S = 0.8


def make(config: RobotConfig) -> PageOutput:
    """The output."""
    require(("starlette", "uvicorn"), "serve", "the operator's page")
    page = config.page
    return PageOutput(page.address, page.port, page.picture_hz, access(config.security, page.address), config.security)


class PageOutput:
    """Serves the page in a thread."""

    wants = EVERYTHING

    def __init__(
        self,
        address: str,
        port: int,
        preview_hz: float,
        rules: Access | None = None,
        security: SecurityConfig | None = None,
    ) -> None:
        """Args: address and port, where to listen. preview_hz: images a second. rules, security: for who connects."""
        from stereo_sfm.service.page.state import PageState

        self._address, self._port, self.preview_hz = address, port, preview_hz
        self._rules, self._security = rules or Access(), security or SecurityConfig()
        self._state = PageState()
        self._server: Any = None
        self._thread: threading.Thread | None = None
        self._socket: socket.socket | None = None

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return self._socket.getsockname()[1] if self._socket is not None else 0

    def open(self, service: ServiceClient) -> None:
        """Listen.

        Raises:
            StereoSfmError: the port is taken, or the address is not of this computer.
        """
        import uvicorn

        from stereo_sfm.service.page.app import Page

        family = socket.AF_INET6 if ":" in self._address else socket.AF_INET
        try:
            self._socket = socket.create_server((self._address, self._port), family=family)
        except OSError as error:
            raise StereoSfmError(f"page: cannot listen on {self._address}:{self._port}: {error.strerror}") from None
        encrypted = self._rules.tls is not None
        config = uvicorn.Config(
            Page(self._state, service, self._rules).app(),
            log_level="error",
            access_log=False,
            lifespan="off",
            limit_concurrency=MOST_CONNECTIONS,
            timeout_keep_alive=IDLE_S,
            timeout_graceful_shutdown=1,
            server_header=False,
            ssl_certfile=self._security.tls_cert if encrypted else None,
            ssl_keyfile=self._security.tls_key or None if encrypted else None,
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), daemon=True)
        self._thread.start()

    def put(self, message: ServiceMessage) -> None:
        """Show a message."""
        self._state.put(message)

    def close(self) -> None:
        """Stop."""
        if self._server is not None and self._thread is not None:
            self._server.should_exit = self._server.force_exit = True
            self._thread.join(END_S)
        if self._socket is not None:
            self._socket.close()
