"""`stereo-sfm udev`: the rules that let people use the cameras without being root."""

from __future__ import annotations

import argparse
import sys


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("-q", "--quiet", action="store_true", help="the rules only, without what to do with them")


def run(args: argparse.Namespace) -> int:
    """Rules on standard output, so that they can be piped; the way on standard error."""
    from stereo_sfm.drivers.devices import UDEV_FILE, udev_rules

    print(udev_rules(), end="")
    if not args.quiet:
        print(
            f"\nInstall:  stereo-sfm udev -q | sudo tee {UDEV_FILE}\n"
            "          sudo udevadm control --reload-rules && sudo udevadm trigger\n"
            "then replug the camera. In a container: mount /dev/bus/usb and allow the device class 'c 189:* rmw'.",
            file=sys.stderr,
        )
    return 0
