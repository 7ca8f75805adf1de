"""`stereo-sfm service`: install the service on this computer, remove it, show its state."""

from __future__ import annotations

import argparse
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import typed

if TYPE_CHECKING:
    from stereo_sfm.service.install import Place


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("action", choices=("install", "uninstall", "status"), help="what to do")
    parser.add_argument("--user", default="stereo-sfm", metavar="NAME", help="it runs as (default: stereo-sfm)")
    parser.add_argument(
        "-c", "--config", type=Path, default=Path("/etc/stereo-sfm/robot.toml"), metavar="FILE", help="its robot.toml"
    )
    parser.add_argument("--writable", type=Path, action="append", default=[], metavar="DIR", help="it may write here")
    parser.add_argument("--root", type=Path, default=Path("/"), metavar="DIR", help="install below this folder")
    parser.add_argument("--dry-run", action="store_true", help="print the files and commands, change nothing")


@dataclass(frozen=True)
class ServiceOptions:
    """Options of `service`, as the parser names them."""

    action: str
    user: str
    config: Path
    writable: list[Path]
    root: Path
    dry_run: bool


def run(args: argparse.Namespace) -> int:
    """Do what was asked."""
    from stereo_sfm.service import install
    from stereo_sfm.service.install import Place, this_program

    o = typed(ServiceOptions, args)
    if o.action == "status":
        print(install.status())
        return 0
    place = Place(this_program(), o.user, o.config.absolute(), o.root)
    writable = tuple(path.absolute() for path in o.writable)
    if o.dry_run:
        _print_plan(o.action, place, writable)
    elif o.action == "uninstall":
        for path in install.uninstall(place):
            print(f"removed {path}")
        print(f"maps and recordings in {place.at(install.STATE)} and {place.at(place.config)} stay")
    else:
        for path in install.install(place, writable):
            print(f"wrote {path}")
        print(f"name the source in {place.at(place.config)}, then: sudo systemctl start {install.UNIT_NAME}")
    return 0


def _print_plan(action: str, place: Place, writable: tuple[Path, ...]) -> None:
    from stereo_sfm.drivers.devices import UDEV_FILE
    from stereo_sfm.service import install

    if action == "uninstall":
        print(f"systemctl disable --now {install.UNIT_NAME}\nrm {place.at(install.UNIT_FILE)} {place.at(UDEV_FILE)}")
        return
    for path, text in install.files(place, writable):
        print(f"# ---- {path}\n{text}")
    for command in install.commands(place):
        print(shlex.join(command))
