"""Viewers are found, listen on this computer only by default, and end with their process."""

from __future__ import annotations

import importlib.util
import socket
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.viz import server


@pytest.fixture
def ports(monkeypatch: pytest.MonkeyPatch) -> tuple[int, int]:
    """Two free ones instead of rerun's own."""
    with socket.socket() as one, socket.socket() as other:
        for probe in (one, other):
            probe.bind(("", 0))
        found = one.getsockname()[1], other.getsockname()[1]
    monkeypatch.setattr(server, "WEB_PORT", found[0])
    monkeypatch.setattr(server, "GRPC_PORT", found[1])
    return found


SERVE = """
import sys
from stereo_sfm.viz import server
server.WEB_PORT, server.GRPC_PORT = int(sys.argv[1]), int(sys.argv[2])
print(*server.serve(sys.argv[3]), sep="\\n", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize(
    ("address", "who"), [("127.0.0.1", "this computer only"), ("0.0.0.0", "anyone who can reach 0.0.0.0")]
)
def test_a_served_viewer_listens_on_its_address_and_reports_it(ports: tuple[int, int], address: str, who: str) -> None:
    command = [sys.executable, "-c", SERVE, *map(str, ports), address]
    parent = subprocess.Popen(command, stdin=-1, stdout=-1, text=True)
    assert parent.stdout is not None
    destination, message = parent.stdout.readline().strip(), parent.stdout.readline()
    assert destination == f"rerun+http://127.0.0.1:{ports[1]}/proxy"
    assert who in message and str(ports[0]) in message
    (viewer,) = psutil.Process(parent.pid).children()
    listening = {(c.laddr.ip, c.laddr.port) for c in viewer.net_connections() if c.status == psutil.CONN_LISTEN}
    assert listening == {(address, port) for port in ports}
    parent.kill()
    parent.wait()
    viewer.wait(5)


def test_an_occupied_port_is_reported(ports: tuple[int, int]) -> None:
    for port in ports:
        with socket.socket() as taken:
            taken.bind(("127.0.0.1", port))
            taken.listen()
            with pytest.raises(StereoSfmError, match=rf"port {port} of 127.0.0.1 is in use: is another viewer open\?"):
                server.serve("127.0.0.1")


@pytest.mark.parametrize("address", ["no such host", "192.0.2.77"])
def test_a_foreign_address_is_reported(ports: tuple[int, int], address: str) -> None:
    with pytest.raises(StereoSfmError, match=address):
        server.serve(address)


@pytest.mark.parametrize("path", ["/usr/bin:/bin", ""])
def test_the_viewer_of_this_interpreter_is_found(monkeypatch: pytest.MonkeyPatch, path: str) -> None:
    monkeypatch.setenv("PATH", path)
    monkeypatch.delenv("RERUN_CLI_PATH", raising=False)
    assert Path(server._executable()).is_file()


def test_a_viewer_that_ends_at_once_is_one_line(ports: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "_executable", lambda: "false")
    with pytest.raises(
        StereoSfmError, match=r"^cannot open the viewer: rerun ended with exit code 1; try --viz serve or save$"
    ):
        server.open_window()


def test_no_viewer_is_one_line(ports: tuple[int, int], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("RERUN_CLI_PATH", raising=False)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(StereoSfmError, match="there is no 'rerun'"):
        server.open_window()
