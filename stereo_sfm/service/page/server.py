"""The operator's page as an output of the service."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stereo_sfm.errors import require
from stereo_sfm.service.messages import EVERYTHING, ServiceMessage
from stereo_sfm.service.outputs.access import Access, access
from stereo_sfm.service.outputs.settings import SecurityConfig
from stereo_sfm.service.outputs.web_server import WebServer
from stereo_sfm.service.publisher import ServiceClient
from stereo_sfm.types import LiveDepth

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig


def make(config: RobotConfig) -> PageOutput:
    """The output."""
    require(("starlette", "uvicorn", "websockets"), "serve", "the operator's page")
    page = config.page
    rules = access(config.security, page.address)
    return PageOutput(page.address, page.port, page.picture_hz, rules, config.security, page.surface)


class PageOutput:
    """Serves the page in a thread."""

    wants = EVERYTHING - {LiveDepth}

    def __init__(
        self,
        address: str,
        port: int,
        preview_hz: float,
        rules: Access | None = None,
        security: SecurityConfig | None = None,
        surface: str = "",
    ) -> None:
        """Listen at `open`.

        Args:
            address, port: where. preview_hz: images a second. rules, security: for who connects.
            surface: folder of `dense`, if any.
        """
        from stereo_sfm.service.page.state import PageState

        self.preview_hz, self._rules = preview_hz, rules or Access()
        self._state, self._surface = PageState(), surface
        self._web = WebServer("page", address, port, self._rules, security or SecurityConfig())

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return self._web.port

    def open(self, service: ServiceClient) -> None:
        """Listen.

        Raises:
            StereoSfmError: the port is taken, or the address is not of this computer.
        """
        from stereo_sfm.service.page.app import Page

        self._web.open(lambda guard: Page(self._state, service, self._rules, guard, self._surface).app())

    def put(self, message: ServiceMessage) -> None:
        """Show a message."""
        self._state.put(message)

    def close(self) -> None:
        """Stop."""
        self._web.close()
