"""`stereo-sfm run`: turn a source into a trajectory."""

from __future__ import annotations

import argparse
import time
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.presets import PRESETS, preset

if TYPE_CHECKING:
    from drivers.source import Source
    from stereo_sfm.config import Config
    from stereo_sfm.eval.record import RunRecord

TRACKING_FAILED = 4
INTERRUPTED = 130


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument(
        "source",
        nargs="?",
        help="a dataset folder, an .mcap file, sim:SCENE, t265, oak, or KIND:PATH (default: the bundled recording)",
    )
    parser.add_argument("-o", "--output", type=Path, help="output folder (default: runs/DATE_NAME)")
    parser.add_argument("--overwrite", action="store_true", help="replace the run that lies in the output folder")
    add_source_arguments(parser)
    add_config_arguments(parser)
    parser.add_argument("--frame", choices=("cam0", "body"), default="cam0", help="whose poses the trajectories hold")
    parser.add_argument(
        "--max-lost", type=float, default=20.0, metavar="PERCENT", help="exit with 4 when more frames have no pose"
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress and no summary")
    parser.add_argument("-v", "--verbose", action="store_true", help="say more on standard error")


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that choose the calibration and a part of a source."""
    parser.add_argument("--rig", type=Path, metavar="FILE", help="calibration instead of the source's own")
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
        "--odometry", metavar="NAME", help="motion estimator: flow (default), em-r, vp-r, r-um, um, eight-point, pnp"
    )
    parser.add_argument("--seed", type=int, help="of everything random (same as --set seed=N)")


def load_config(args: argparse.Namespace) -> Config:
    """The configuration that the options ask for."""
    from stereo_sfm import config

    overrides = [f"odometry.method={args.odometry}"] if args.odometry is not None else []
    overrides += [f"features.kind={args.features}"] if args.features is not None else []
    overrides += list(args.set) + ([f"seed={args.seed}"] if args.seed is not None else [])
    chosen = config.load(args.config, overrides, preset(args.preset))
    if args.features is not None and chosen.odometry.method == "flow":
        raise StereoSfmError("--features needs an estimator that uses descriptors: add --odometry em-r (or another)")
    return chosen


def open_chosen(args: argparse.Namespace) -> Source:
    """The source that the options ask for, not yet entered."""
    from drivers.select import SelectedFrames
    from drivers.source import open_source
    from stereo_sfm.demo import demo_recording

    spec = args.source if args.source is not None else str(demo_recording())
    source = open_source(spec, **({"rig": args.rig} if args.rig is not None else {}))
    if (args.start, args.duration, args.frame_skip, args.max_frames) == (0.0, float("inf"), 1, None):
        return source
    return SelectedFrames(source, args.start, args.duration, args.frame_skip, args.max_frames)


def run(args: argparse.Namespace) -> int:
    """Run, write the output folder, print the closing summary."""
    from stereo_sfm.eval.record import RunRecord
    from stereo_sfm.eval.run_results import write_results
    from stereo_sfm.eval.statistics import failure, summary
    from stereo_sfm.export.run_folder import default_folder, link_latest, prepare_folder

    config = load_config(args)
    if args.output is not None:
        prepare_folder(args.output, args.overwrite)
    with open_chosen(args) as source:
        folder: Path = args.output or default_folder(source.name, datetime.now())
        if args.output is None:
            prepare_folder(folder, args.overwrite)
        record = RunRecord()
        begin = time.perf_counter()
        interrupted, problem = _track(source, config, record, args.quiet)
        wall_s = time.perf_counter() - begin
        stats, evaluations = write_results(
            folder, source.name, source.rig, config, record, wall_s, source.ground_truth, args.frame, args.frame_skip
        )
    link_latest(folder)
    if not args.quiet:
        print("\n".join([*summary(stats, evaluations), f"written to {folder} (start with {folder / 'report.md'})"]))
    if problem is not None:
        raise problem
    if interrupted:
        return INTERRUPTED
    failed = failure(stats, args.max_lost)
    if failed:
        import sys

        print(f"stereo-sfm run: {failed}; {folder / 'report.md'} says why", file=sys.stderr)
        return TRACKING_FAILED
    return 0


def _track(source: Source, config: Config, record: RunRecord, quiet: bool) -> tuple[bool, StereoSfmError | None]:
    """Run to the end, to Ctrl-C, or to an error of the source; what was tracked until then stays in the record."""
    from stereo_sfm.commands._progress import progress
    from stereo_sfm.commands._stop import StopRequest
    from stereo_sfm.pipeline.run import run as run_source

    with progress(source.name, source.frame_count, quiet) as bar, StopRequest() as stop:
        try:
            for frame in run_source(source, config, [record]):
                bar.show(frame)
                if stop.asked:
                    return True, None
        except KeyboardInterrupt:
            return True, None
        except StereoSfmError as error:
            if not record.frames:
                raise
            return False, error
    return False, None
