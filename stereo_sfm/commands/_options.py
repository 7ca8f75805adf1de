"""Options that several commands share: how a parser takes them, and the typed values that they become.

A command turns its `argparse.Namespace` into typed options once, at its entry; nothing behind it sees the namespace.
"""

from __future__ import annotations

import argparse
import dataclasses
import logging
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from stereo_sfm.config import estimator_names
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.presets import PRESETS, preset

if TYPE_CHECKING:
    from stereo_sfm.config import Config
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.pipeline.session import Wiring

T = TypeVar("T")


def typed(kind: type[T], args: argparse.Namespace) -> T:
    """The options dataclass of a command, filled from the parsed arguments of the same names."""
    names = [f.name for f in dataclasses.fields(kind)]  # pyright: ignore[reportArgumentType]
    return kind(**{name: getattr(args, name) for name in names})


def check_counts(options: dict[str, int]) -> None:
    """Raises StereoSfmError where one of the options, by their names on the command line, is less than 1."""
    for option, value in options.items():
        if value < 1:
            raise StereoSfmError(f"{option} must be at least 1, not {value}")


def add_source(parser: argparse.ArgumentParser, default: str = "", metavar: str | None = None) -> None:
    """The argument that names the source; `default` describes what is used without it."""
    from stereo_sfm.drivers.registry import kinds

    text = f"a folder or file, or KIND:PLACE?OPTION=VALUE of {', '.join(kinds())} ('stereo-sfm sources KIND')"
    text += f" (default: {default})" if default else ""
    parser.add_argument("source", nargs="?" if default else None, metavar=metavar, help=text)


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that choose the calibration and a part of a source."""
    from stereo_sfm.drivers.choice import RECTIFY

    parser.add_argument("--rig", type=Path, metavar="FILE", help="calibration file to use instead of the source's own")
    parser.add_argument(
        "--rectify",
        choices=RECTIFY,
        default="none",
        help="rectify the images first: pinhole (crops a fisheye image), wide (keeps its field of view)",
    )
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="skip the first S seconds")
    parser.add_argument("--duration", type=float, default=float("inf"), metavar="S", help="stop after S seconds")
    parser.add_argument("--frame-skip", type=int, default=1, metavar="K", help="use every K-th frame")
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop after N frames")


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that set the configuration."""
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="configuration file (TOML)")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="set one value, as in tracker.max_features=600"
    )
    parser.add_argument("--preset", default="default", metavar="NAME", help=f"one of {', '.join(PRESETS)}")
    parser.add_argument("--features", metavar="NAME", help="descriptors of --odometry: orb, sift, akaze")
    parser.add_argument(
        "--odometry", metavar="NAME", help=f"motion estimator: flow (default), {', '.join(estimator_names())}"
    )
    parser.add_argument(
        "--self-calibrate",
        choices=("auto", "off", "only-report"),
        help="correct the rotation of the right camera from what is seen, where the evidence is there (default: auto)",
    )
    parser.add_argument(
        "--calibrate-sensors",
        action="store_true",
        help="estimate time offset and rotation of the IMU, radii, track and pose of the wheels, and use them",
    )
    parser.add_argument("--seed", type=int, help="random seed (sets seed and loop.seed)")


def add_wiring_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for how the stages run, and what is logged and shown.

    They never change the result in lockstep, except for JPEG images: the tracker sees them as logged.
    """
    parser.add_argument("--inline", action="store_true", help="run all stages in one process; the result is the same")
    parser.add_argument(
        "--mode",
        choices=("lockstep", "realtime"),
        help="lockstep waits for every stage (default for files); realtime drops images (default for devices)",
    )
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="same as --mode realtime; recordings and sim: are played at their own speed",
    )
    parser.add_argument("--speed", type=float, metavar="X", help="play a recording as if live, at X times its speed")
    parser.add_argument(
        "--log",
        choices=("full", "lean", "none"),
        help="write run.mcap with images (full), without (lean), or not at all (default: full for devices, else lean)",
    )
    parser.add_argument(
        "--image-format",
        choices=("png", "raw", "jpeg"),
        help="image format of --log full (default: raw, the fastest, for devices; png for others)",
    )
    parser.add_argument(
        "--viz",
        choices=("none", "spawn", "serve", "save"),
        default="none",
        help="show the run in rerun: open the viewer (spawn), serve browsers (serve) or write run.rrd (save)",
    )
    add_viewer_address(parser)


def add_viewer_address(parser: argparse.ArgumentParser) -> None:
    """Option that makes a served viewer reachable from other computers."""
    parser.add_argument(
        "--viz-address",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="address a served viewer listens on (default: this computer only; 0.0.0.0: anyone can view and write)",
    )


def add_verbosity_arguments(parser: argparse.ArgumentParser) -> None:
    """Options for how much is printed."""
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress and no summary")
    parser.add_argument(
        "-v",
        "--verbose",
        action="store_true",
        help="print events: loss and recovery of tracking, loops, map corrections",
    )


def load_config(args: argparse.Namespace) -> Config:
    """The configuration given by the options of `add_config_arguments`."""
    from stereo_sfm import config

    overrides = [f"odometry.method={args.odometry}"] if args.odometry is not None else []
    overrides += [f"features.kind={args.features}"] if args.features is not None else []
    overrides += [f"self_calibration.mode={args.self_calibrate}"] if args.self_calibrate is not None else []
    overrides += ["tracker.calibrate_sensors=true"] if args.calibrate_sensors else []
    overrides += list(args.set) + ([f"seed={args.seed}", f"loop.seed={args.seed}"] if args.seed is not None else [])
    chosen = config.load(args.config, overrides, preset(args.preset))
    if args.features is not None and chosen.odometry.method == "flow":
        raise StereoSfmError("--features needs an estimator that uses descriptors: add --odometry em-r (or another)")
    if chosen.tracker.calibrate_sensors and chosen.odometry.method != "flow":
        raise StereoSfmError("--calibrate-sensors is for the default tracker: leave --odometry away")
    if chosen.odometry.scale != "stereo" and chosen.odometry.method == "flow":
        logging.getLogger("stereo_sfm").warning(
            "odometry.scale has no effect on the default tracker, which knows the scale: it is for --odometry"
        )
    return chosen


def source_choice(
    args: argparse.Namespace, realtime: bool = False, speed: float | None = None, camera_store: Path | None = None
) -> SourceChoice:
    """The source given by the options of `add_source_arguments`; `realtime`: recordings at their own speed."""
    from stereo_sfm.demo import demo_recording
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.drivers.selection import Selection
    from stereo_sfm.drivers.source import is_device

    spec = args.source if args.source is not None else str(demo_recording())
    if speed is None and realtime and not is_device(spec):
        speed = 1.0
    part = Selection(args.start, args.duration, args.frame_skip, args.max_frames)
    return SourceChoice.of(spec, args.rig, part, args.rectify, speed, camera_store)


def wiring_of(args: argparse.Namespace) -> Wiring:
    """The wiring given by the options of `add_wiring_arguments`."""
    from stereo_sfm.pipeline.session import Wiring

    mode = "realtime" if args.realtime else args.mode
    return Wiring(args.inline, mode, args.log, args.image_format, args.viz, args.viz_address)
