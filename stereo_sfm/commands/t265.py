"""`stereo-sfm t265`: install or check the firmware of a T265, or reset the camera."""

from __future__ import annotations

import argparse
from pathlib import Path

from stereo_sfm.errors import StereoSfmError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)
    firmware = actions.add_parser("firmware", help="install or check the firmware file (Intel's, not included here)")
    kinds = firmware.add_subparsers(dest="kind", metavar="ACTION", required=True)
    extract = kinds.add_parser("extract", help="extract it from a librealsense library or a pyrealsense2 wheel")
    extract.add_argument("file", type=Path, help="librealsense2.so, a pyrealsense2 .so, .pyd or .whl, or the .mvcmd")
    extract.add_argument("-o", "--output", type=Path, help="file to write (default: where the driver looks for it)")
    extract.add_argument("--overwrite", action="store_true", help="replace an existing file")
    kinds.add_parser("check", help="check that the file is installed and intact")
    reset = actions.add_parser("reset", help="restart a camera that does not respond")
    reset.add_argument("--serial", default="", help="serial number of the camera (default: the only one)")


def run(args: argparse.Namespace) -> int:
    """Dispatch."""
    if args.action == "reset":
        return _reset(args.serial)
    return _extract(args.file, args.output, args.overwrite) if args.kind == "extract" else _check()


def _extract(file: Path, output: Path | None, overwrite: bool) -> int:
    from stereo_sfm.drivers.t265 import firmware

    target: Path = output or firmware.default_path()
    if target.exists() and not overwrite:
        raise StereoSfmError(f"{target} exists: add --overwrite to replace it")
    found = firmware.extract(file)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(found.data)
    except OSError as error:
        raise StereoSfmError(f"cannot write {target}: {error}") from None
    print(f"T265 firmware {firmware.VERSION}, {len(found.data)} bytes, SHA-1 {firmware.SHA1}: written to {target}")
    return 0


def _check() -> int:
    from stereo_sfm.drivers.t265 import firmware

    path = firmware.find()
    firmware.load()
    print(f"T265 firmware {firmware.VERSION} at {path}: SHA-1 is correct")
    return 0


def _reset(serial: str) -> int:
    from stereo_sfm.drivers.live.counters import Counters
    from stereo_sfm.drivers.t265.acquire import Access, acquire
    from stereo_sfm.drivers.t265.usb_device import default_backend

    camera = acquire(Access(default_backend(), serial, allow_slow=True), Counters())
    camera.link.reset()
    camera.link.close()
    print(f"T265 {camera.info.serial} was reset; the next run or recording boots it")
    return 0
