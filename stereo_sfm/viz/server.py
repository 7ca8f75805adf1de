"""rerun's viewers as separate processes, since only then the address to listen on can be chosen.

Anyone who can reach a viewer's ports can view the data and write to it: they are open to this computer only unless
the user asks for another address.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import time
from pathlib import Path
from typing import Any
from urllib.parse import quote

from stereo_sfm.errors import StereoSfmError

LOOPBACK = "127.0.0.1"
EVERYWHERE = ("0.0.0.0", "::")
WEB_PORT, GRPC_PORT = 9090, 9876
MEMORY_LIMIT = "1GB"  # of the viewer's history
START_S = 20.0  # time for a viewer to start listening
PR_SET_PDEATHSIG = 1


def serve(address: str) -> tuple[str, str]:
    """Start a server for browsers; it ends with this process.

    Args:
        address: of the network interface to listen on; one of `EVERYWHERE` for all.

    Returns:
        Where to send a recording, and a line with the viewer's address and who can reach it.

    Raises:
        StereoSfmError: a port is in use, the address is not one of this computer, or the server does not start.
    """
    _check_free(address, GRPC_PORT, WEB_PORT)
    ports = ("--port", str(GRPC_PORT), "--web-viewer-port", str(WEB_PORT))
    options = ("--serve-web", "--bind", address, *ports, "--server-memory-limit", MEMORY_LIMIT)
    end_with_us = functools.partial(end_with_parent, os.getpid())
    process = subprocess.Popen([_executable(), *options], **_SILENT, preexec_fn=end_with_us)
    here = LOOPBACK if address in EVERYWHERE else address
    _wait_for(process, here, GRPC_PORT, WEB_PORT)
    host = socket.gethostname() if address in EVERYWHERE else address
    page = f"http://{_url_host(host)}:{WEB_PORT}/?url={quote(_proxy(host), safe='')}"
    who = "this computer only" if address == LOOPBACK else f"anyone who can reach {address} can view and write"
    return _proxy(here), f"viewer: {page} (ports {WEB_PORT} and {GRPC_PORT} of {address}: {who})"


def open_window() -> str:
    """Open a viewer on this computer, or use the one that is open; returns where to send a recording.

    Raises:
        StereoSfmError: there is no viewer or no screen.
    """
    if not _answers(LOOPBACK, GRPC_PORT):
        options = ("--bind", LOOPBACK, "--port", str(GRPC_PORT), "--memory-limit", MEMORY_LIMIT, "--expect-data-soon")
        process = subprocess.Popen([_executable(), *options], **_SILENT, start_new_session=True)
        _wait_for(process, LOOPBACK, GRPC_PORT)
    return _proxy(LOOPBACK)


_SILENT: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}


def _executable() -> str:
    """The viewer of the installed rerun-sdk, regardless of the PATH: another version would not work."""
    package = importlib.util.find_spec("rerun_cli")
    folder = Path(package.origin).parent if package is not None and package.origin is not None else None
    bundled = None if folder is None else shutil.which("rerun", path=f"{folder}:{folder}/Rerun.app/Contents/MacOS")
    viewer = os.environ.get("RERUN_CLI_PATH") or bundled or shutil.which("rerun")
    if viewer is None:
        raise StereoSfmError("cannot open the viewer: there is no 'rerun' (pip install rerun-sdk)")
    return viewer


def end_with_parent(parent: int) -> None:
    """In a child that is another program: end with the thread that started it, however that ends (Linux).

    Args: parent, number of the process that started it, which may have ended already.
    """
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


def _wait_for(process: subprocess.Popen[Any], address: str, *ports: int) -> None:
    until = time.monotonic() + START_S
    while not all(_answers(address, port) for port in ports):
        if process.poll() is not None:
            raise StereoSfmError(
                f"cannot open the viewer: rerun ended with exit code {process.returncode}; try --viz serve or save"
            )
        if time.monotonic() > until:
            process.kill()
            raise StereoSfmError(f"cannot open the viewer: rerun has not started after {START_S:.0f} s; try --viz save")
        time.sleep(0.05)


def _answers(address: str, port: int) -> bool:
    with contextlib.suppress(OSError), socket.create_connection((address, port), 0.5):
        return True
    return False


def _check_free(address: str, *ports: int) -> None:
    try:
        family = socket.getaddrinfo(address, 0)[0][0]
    except socket.gaierror:
        raise StereoSfmError(f"'{address}' is not an address to listen on: try 127.0.0.1 or 0.0.0.0") from None
    for port in ports:
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((address, port))
            except OSError as error:
                why = "is another viewer open?" if _answers(address, port) else str(error.strerror)
                raise StereoSfmError(f"port {port} of {address} is in use: {why}") from None


def _url_host(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _proxy(host: str) -> str:
    return f"rerun+http://{_url_host(host)}:{GRPC_PORT}/proxy"
