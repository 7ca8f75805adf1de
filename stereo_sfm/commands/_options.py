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


def add_source(parser: argparse.ArgumentParser, default: str = "", metavar: str | None = None) -> None:
    """The argument that names what is read; `default` says what is read without it."""
    from stereo_sfm.drivers.registry import kinds

    text = f"a folder or file, or KIND:PLACE?OPTION=VALUE of {', '.join(kinds())} ('stereo-sfm sources KIND')"
    text += f" (default: {default})" if default else ""
    parser.add_argument("source", nargs="?" if default else None, metavar=metavar, help=text)


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that choose the calibration and a part of a source."""
    from stereo_sfm.drivers.choice import RECTIFY

    parser.add_argument("--rig", type=Path, metavar="FILE", help="calibration instead of the source's own")
    parser.add_argument(
        "--rectify",
        choices=RECTIFY,
        default="none",
        help="turn the images into rectified ones first: pinhole (crops a fisheye), wide (keeps its view)",
    )
    parser.add_argument("--start", type=float, default=0.0, metavar="S", help="seconds to leave out at the beginning")
    parser.add_argument("--duration", type=float, default=float("inf"), metavar="S", help="seconds to use")
    parser.add_argument("--frame-skip", type=int, default=1, metavar="K", help="use every K-th frame")
    parser.add_argument("--max-frames", type=int, metavar="N", help="stop after N frames")


def add_config_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that make the configuration."""
    parser.add_argument("-c", "--config", type=Path, metavar="FILE", help="configuration in TOML")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="one value, as tracker.max_features=600"
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
    parser.add_argument("--seed", type=int, help="of everything random (seed and loop.seed of the configuration)")


def add_wiring_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that say how the stages run, and what is logged and shown.

    They never change the result of lockstep, but for JPEG images: the tracker sees what the log holds.
    """
    parser.add_argument("--inline", action="store_true", help="all stages in one process; the same bits")
    parser.add_argument(
        "--mode",
        choices=("lockstep", "realtime"),
        help="lockstep waits for every stage (files); realtime drops what comes too fast (devices); default by source",
    )
    parser.add_argument(
        "--realtime", action="store_true", help="--mode realtime; recordings and sim: play at their own speed"
    )
    parser.add_argument("--speed", type=float, metavar="X", help="play a recording as if live, X times as fast")
    parser.add_argument(
        "--log",
        choices=("full", "lean", "none"),
        help="run.mcap with images, without them, or none (default: full for devices, lean for recordings)",
    )
    parser.add_argument(
        "--image-format",
        choices=("png", "raw", "jpeg"),
        help="images of --log full (default: raw for devices, which leaves the time to track; else png)",
    )
    parser.add_argument(
        "--viz", choices=("none", "spawn", "serve", "save"), default="none", help="show it in rerun; save: run.rrd"
    )
    add_viewer_address(parser)


def add_viewer_address(parser: argparse.ArgumentParser) -> None:
    """Option that opens a viewer to other computers."""
    parser.add_argument(
        "--viz-address",
        default="127.0.0.1",
        metavar="ADDRESS",
        help="what a served viewer listens on (default: this computer only; 0.0.0.0 lets everybody look and write)",
    )


def add_talk_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that say how much is told."""
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress and no summary")
    parser.add_argument(
        "-v", "--verbose", action="store_true", help="say what happens: lost, found again, loops, jumps of the map"
    )


def load_config(args: argparse.Namespace) -> Config:
    """The configuration that the options of `add_config_arguments` ask for."""
    from stereo_sfm import config

    overrides = [f"odometry.method={args.odometry}"] if args.odometry is not None else []
    overrides += [f"features.kind={args.features}"] if args.features is not None else []
    overrides += [f"self_calibration.mode={args.self_calibrate}"] if args.self_calibrate is not None else []
    overrides += list(args.set) + ([f"seed={args.seed}", f"loop.seed={args.seed}"] if args.seed is not None else [])
    chosen = config.load(args.config, overrides, preset(args.preset))
    if args.features is not None and chosen.odometry.method == "flow":
        raise StereoSfmError("--features needs an estimator that uses descriptors: add --odometry em-r (or another)")
    if chosen.odometry.scale != "stereo" and chosen.odometry.method == "flow":
        logging.getLogger("stereo_sfm").warning(
            "odometry.scale does nothing with the default tracker, whose steps have a length: it is for --odometry"
        )
    return chosen


def source_choice(args: argparse.Namespace, realtime: bool = False, speed: float | None = None) -> SourceChoice:
    """The source that the options of `add_source_arguments` ask for; `realtime`: recordings at their own speed."""
    from stereo_sfm.demo import demo_recording
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.drivers.selection import Selection
    from stereo_sfm.drivers.source import is_device

    spec = args.source if args.source is not None else str(demo_recording())
    if speed is None and realtime and not is_device(spec):
        speed = 1.0
    part = Selection(args.start, args.duration, args.frame_skip, args.max_frames)
    return SourceChoice.of(spec, args.rig, part, args.rectify, speed)


def wiring_of(args: argparse.Namespace) -> Wiring:
    """What the options of `add_wiring_arguments` ask for."""
    from stereo_sfm.pipeline.session import Wiring

    mode = "realtime" if args.realtime else args.mode
    return Wiring(args.inline, mode, args.log, args.image_format, args.viz, args.viz_address)
