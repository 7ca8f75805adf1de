"""Debian's Chromium and Firefox without a screen, each driven over its own debugging protocol."""

from __future__ import annotations

import base64
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from abc import ABC, abstractmethod
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

CHROMIUM_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0",
)  # fmt: skip
FIREFOX_FLAGS = ("--headless", "--no-remote", "--remote-debugging-port=0")
CHROMIUM, FIREFOX = shutil.which("chromium"), shutil.which("firefox")


class Browser(ABC):
    """One page of a browser of its own."""

    def __init__(self, program: str | None, *flags: str, profile: str) -> None:
        assert program is not None
        self._open = ExitStack()
        self._profile = Path(tempfile.mkdtemp(prefix="browser"))
        self._open.callback(shutil.rmtree, self._profile, ignore_errors=True)
        command = [program, *flags, profile.format(self._profile)]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        self._open.callback(process.wait, 20)
        self._open.callback(process.terminate)
        self._numbers = itertools.count(1)
        self._socket: Any = None

    @abstractmethod
    def run(self, script: str) -> Any:
        """The value of an expression, of a promise when it is one."""

    @abstractmethod
    def go(self, address: str) -> None:
        """Load a page and wait for it."""

    @abstractmethod
    def picture(self) -> str:
        """The whole page as PNG in base 64."""

    def connect(self, address: str) -> None:
        from websockets.sync.client import connect

        self._socket = self._open.enter_context(connect(address, max_size=None))

    def written(self, name: str) -> str:
        """A file that the browser writes into its profile when it listens."""
        file, end = self._profile / name, time.monotonic() + 60
        while not file.exists() or not file.read_text().strip():
            assert time.monotonic() < end, f"{type(self).__name__} does not start"
            time.sleep(0.1)
        return file.read_text()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            said = json.loads(self._socket.recv(timeout=120))
            if said.get("id") == number:
                assert "error" not in said, said
                return said["result"]

    def until(self, script: str, seconds: float = 20) -> Any:
        """Wait for an expression to be true. One that raises is not true yet: its page is still loading."""
        end = time.monotonic() + seconds
        while not (value := self.run(f"(async () => ({script}))().catch(() => false)")):
            assert time.monotonic() < end, (
                f"never true: {script}; the page shows: {self.run('document.body.innerText')}"
            )
            time.sleep(0.1)
        return value

    def screenshot(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.picture()))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()


class Chromium(Browser):
    """Over the DevTools protocol, which has keys and fingers, too."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__(CHROMIUM, *CHROMIUM_FLAGS, f"--window-size={width},{height}", profile="--user-data-dir={}")
        port = self.written("DevToolsActivePort").splitlines()[0]
        pages = json.load(urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=10))
        self.connect(next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page"))
        mobile = width < 600
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=mobile)
        self.call("Page.enable")

    def run(self, script: str) -> Any:
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def go(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        self.until(f"location.href === '{address}' && document.readyState === 'complete'")

    def picture(self) -> str:
        return self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)["data"]


class Firefox(Browser):
    """Over WebDriver BiDi."""

    def __init__(self, width: int, height: int) -> None:
        super().__init__(FIREFOX, *FIREFOX_FLAGS, "--profile", profile="{}")
        listens = json.loads(self.written("WebDriverBiDiServer.json"))
        self.connect(f"ws://{listens['ws_host']}:{listens['ws_port']}/session")
        self.call("session.new", capabilities={})
        self._page: str = self.call("browsingContext.getTree")["contexts"][0]["context"]
        size = {"width": width, "height": height}
        self.call("browsingContext.setViewport", context=self._page, viewport=size)

    def run(self, script: str) -> Any:
        page = {"context": self._page}
        found = self.call("script.evaluate", expression=script, target=page, awaitPromise=True)
        assert found["type"] == "success", found
        return found["result"].get("value")

    def go(self, address: str) -> None:
        self.call("browsingContext.navigate", context=self._page, url=address, wait="complete")

    def picture(self) -> str:
        return self.call("browsingContext.captureScreenshot", context=self._page, origin="document")["data"]
