"""`stereo-sfm convert-calib IN OUT`: convert between calibration formats."""

from __future__ import annotations

import argparse
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stereo_sfm.calib import Rig

log = logging.getLogger("stereo_sfm")

# Kept here so that `--help` needs no import; stereo_sfm.calib.formats.FORMATS is the table (a test compares them).
NAMES = ("rig", "kalibr", "ros", "opencv", "euroc", "kitti", "basalt", "colmap", "foxglove", "kapture", "depthai")

SETTINGS = ("orbslam", "stella", "vins", "openvins")  # read, not written; likewise
UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("input", type=Path, help="calibration file, or folder with one file per camera")
    parser.add_argument("output", type=Path, help="file, or folder for ros, euroc, colmap and kapture")
    parser.add_argument(
        "--from",
        dest="source",
        choices=(*NAMES, *SETTINGS),
        default=None,
        help="input format (default: by its content)",
    )
    parser.add_argument(
        "--to", dest="target", choices=NAMES, default=None, help="output format (default: by the file name, else rig)"
    )
    parser.add_argument("--size", default=None, metavar="WxH", help="image size, for files that do not state it")
    parser.add_argument("--pair", default=None, metavar="L,R", help="numbers of the left and right camera in the file")
    parser.add_argument(
        "--unit",
        default=None,
        metavar="UNIT",
        help="of the file's lengths: mm, cm, m, in, or metres (the size of a target's squares)",
    )
    parser.add_argument(
        "--lens",
        default=None,
        metavar="MODEL",
        help="lens model, for opencv, ros and foxglove files: plumb_bob, fisheye",
    )
    parser.add_argument(
        "--wheel", type=Path, default=None, metavar="FILE", help="the T265's calibration_odometry.json, for the output"
    )
    parser.add_argument(
        "--wheel-output",
        type=Path,
        default=None,
        metavar="FILE",
        help="write the wheels as calibration_odometry.json, too",
    )
    parser.add_argument("--overwrite", action="store_true", help="write over an existing file or into a folder")


def run(args: argparse.Namespace) -> int:
    """Read, write, and print a description."""
    from stereo_sfm.calib import load_rig, save_rig
    from stereo_sfm.calib.formats import recognise
    from stereo_sfm.calib.lens_doubts import doubts
    from stereo_sfm.errors import StereoSfmError

    if not args.input.exists():
        raise StereoSfmError(f"no calibration at {args.input}")
    if args.output.exists() and not args.overwrite:
        raise StereoSfmError(f"{args.output} exists: choose another name or give --overwrite")
    source = args.source or recognise(args.input)
    rig = load_rig(args.input, source, **_options(args.size, args.pair, args.unit, args.lens))
    for doubt in doubts(rig):
        log.warning("%s: %s", args.input, doubt)
    if args.wheel is not None:
        from dataclasses import replace

        from stereo_sfm.calib.formats.wheel_files import read_t265_odometry

        rig = replace(rig, wheel=read_t265_odometry(args.wheel, rig.left_T_right))
    if args.wheel_output is not None:
        _write_wheel(rig, args.wheel_output, args.overwrite)
    save_rig(rig, args.output, args.target)
    cameras = rig.left.model if rig.right is None else f"{rig.left.model} pair, baseline {1000 * rig.baseline:.2f} mm"
    print(f"{source}: {cameras}, {rig.left.width}x{rig.left.height} px -> {args.output}")
    return 0


def _options(size: str | None, pair: str | None, unit: str | None, lens: str | None) -> dict[str, Any]:
    """Of the reader, as given."""
    from stereo_sfm.commands.rectify import parse_size
    from stereo_sfm.errors import StereoSfmError

    given: dict[str, Any] = {} if size is None else {"size": parse_size(size)}
    if lens is not None:
        given["lens"] = lens
    try:
        if pair is not None:
            left, right = (int(number) for number in pair.split(","))
            given["pair"] = left, right
        if unit is not None:
            given["unit"] = UNITS.get(unit) or float(unit)
    except ValueError:
        raise StereoSfmError(
            "--pair is two numbers, as in '--pair 0,2', and --unit one of "
            f"{', '.join(UNITS)} or its length in metres, as in '--unit 0.025'"
        ) from None
    return given


def _write_wheel(rig: Rig, path: Path, overwrite: bool) -> None:
    from stereo_sfm.calib.formats.wheel_files import write_t265_odometry
    from stereo_sfm.errors import StereoSfmError

    if rig.wheel is None:
        raise StereoSfmError(f"the rig says nothing about wheels: {path} would be empty")
    if path.exists() and not overwrite:
        raise StereoSfmError(f"{path} exists: choose another name or give --overwrite")
    write_t265_odometry(rig.wheel, rig.left_T_right, path)
