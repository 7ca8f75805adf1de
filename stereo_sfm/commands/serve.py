"""`stereo-sfm serve`: the service on a robot."""

from __future__ import annotations

import argparse
import json
import logging
import os
import signal
import socket
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from stereo_sfm.service.config import RobotConfig

log = logging.getLogger("stereo_sfm")

PROBE_S = 2.0  # seconds to wait for the page of a running service
OTHERS = 0o027  # images show people: files that the service writes are not for other users


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("source", nargs="?", metavar="SOURCE", help="instead of robot.toml's: as `run` takes it")
    parser.add_argument("--rig", type=Path, metavar="FILE", help="calibration to use instead of the source's own")
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="robot.toml")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="set one value, as in source.spec=t265:"
    )
    parser.add_argument("--pose-socket", metavar="ADDRESS", help="send poses on tcp://ADDRESS:PORT or a local socket")
    parser.add_argument("--print-ports", action="store_true", help="print what would listen, and who can reach it")
    parser.add_argument("--print-link", action="store_true", help="print a link to the page of a running service")
    parser.add_argument("--print-config", action="store_true", help="print every setting with its description")
    parser.add_argument("-q", "--quiet", action="store_true", help="print errors only")
    parser.add_argument("-v", "--verbose", action="store_true", help="print what goes well, too")


def override(name: str, text: str) -> str:
    """A setting with a text of the command line, whatever is in it."""
    return f"{name}={json.dumps(text, ensure_ascii=False)}"  # a string of JSON is one of TOML


def _check_page(config: RobotConfig) -> None:
    """Warn where nobody answers at the page's port."""
    page = config.page
    try:
        socket.create_connection((page.address, page.port), PROBE_S).close()
    except OSError:
        why = "" if page.enabled else ", and page.enabled is false"
        log.warning("no service answers at %s, port %d%s: the link opens nothing", page.address, page.port, why)


def run(args: argparse.Namespace) -> int:
    """Serve until the source ends, SIGTERM or Ctrl-C."""
    from stereo_sfm.pipeline.fork_server import kill_fork_server
    from stereo_sfm.service.config import explain, load
    from stereo_sfm.service.outputs.access import page_link
    from stereo_sfm.service.service import Service

    section = "outputs.pose_socket"
    poses = [f"{section}.enabled=true", override(f"{section}.address", args.pose_socket)] if args.pose_socket else []
    source = [override("source.spec", args.source)] if args.source else []
    source += [override("source.rig", str(args.rig.resolve()))] if args.rig else []
    config = load(args.config, [*source, *args.set, *poses])
    if args.print_ports:
        from stereo_sfm.service.outputs.ports import ports

        print("\n".join(ports(config)))
        return 0
    if args.print_link:
        print(page_link(config))
        _check_page(config)
        return 0
    if args.print_config:
        print(explain(config), end="")
        return 0
    os.umask(os.umask(0) | OTHERS)
    if config.map.bucket:
        from stereo_sfm.fleet.copies import fetch_released
        from stereo_sfm.storage.remote import Remote

        fetch_released(Remote.of(config.map.bucket), config.map.robot, Path(config.map.folder))
    service = Service(config)

    def stop(number: int, frame: FrameType | None) -> None:
        service.stop(f"{signal.Signals(number).name} received")

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        if (number, signal.getsignal(number)) != (signal.SIGHUP, signal.SIG_IGN):
            signal.signal(number, stop)
    with service:
        printed = args.quiet
        while not service.wait(1.0 if printed else 0.1):  # a short wait lets signals through
            if not printed and "page" in service.open_outputs:
                print(f"the page: {page_link(config)}", flush=True)
                printed = True
    kill_fork_server()  # which may still load its code, where the service ended while it started
    if service.error is not None:
        raise service.error
    sys.stdout.flush()
    return 0
