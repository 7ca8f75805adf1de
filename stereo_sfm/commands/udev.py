"""`stereo-sfm udev`: print the udev rules for using the cameras without root."""

from __future__ import annotations

import argparse
import sys


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("-q", "--quiet", action="store_true", help="print the rules without instructions")


def run(args: argparse.Namespace) -> int:
    """Print the rules on standard output, for piping, and the instructions on standard error."""
    from stereo_sfm.drivers.devices import UDEV_FILE, udev_rules

    print(udev_rules(), end="")
    if not args.quiet:
        print(
            f"\nInstall:  stereo-sfm udev -q | sudo tee {UDEV_FILE}\n"
            "          sudo udevadm control --reload-rules && sudo udevadm trigger\n"
            "then reconnect the camera. In a container: mount /dev/bus/usb and allow the device class 'c 189:* rmw'.",
            file=sys.stderr,
        )
    return 0
