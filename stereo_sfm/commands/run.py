"""`stereo-sfm run`: turn a source into a trajectory."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._stop import INTERRUPTED, StopRequest
from stereo_sfm.errors import StereoSfmError, from_os_error
from stereo_sfm.presets import PRESETS, preset

if TYPE_CHECKING:
    from drivers.choice import SourceChoice
    from stereo_sfm.commands._step import Stepper
    from stereo_sfm.config import Config
    from stereo_sfm.eval.record import RunRecord
    from stereo_sfm.log.recorded import RecordedRun
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.messages import Sink
    from stereo_sfm.pipeline.session import Session
    from stereo_sfm.viz.match_pictures import MatchPictures

TRACKING_FAILED = 4


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
    add_wiring_arguments(parser)
    parser.add_argument("--map-in", type=Path, metavar="DIR", help="go on with a saved map of this place")
    parser.add_argument("--localize-only", action="store_true", help="find the camera in --map-in, change no map")
    parser.add_argument("--map-out", type=Path, metavar="DIR", help="save the map (merged with --map-in, if given)")
    parser.add_argument("--frame", choices=("cam0", "body"), default="cam0", help="whose poses the trajectories hold")
    parser.add_argument(
        "--max-lost", type=float, default=20.0, metavar="PERCENT", help="exit with 4 when more frames have no pose"
    )
    parser.add_argument(
        "--matches", type=int, metavar="K", help="every K frames a picture of the matches with the last keyframe"
    )
    add_talk_arguments(parser)


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that choose the calibration and a part of a source."""
    from drivers.choice import RECTIFY

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
        "--odometry", metavar="NAME", help="motion estimator: flow (default), em-r, vp-r, r-um, um, eight-point, pnp"
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
    """The configuration that the options ask for."""
    from stereo_sfm import config

    overrides = [f"odometry.method={args.odometry}"] if args.odometry is not None else []
    overrides += [f"features.kind={args.features}"] if args.features is not None else []
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
    from drivers.choice import SourceChoice
    from drivers.selection import Selection
    from drivers.source import is_device
    from stereo_sfm.demo import demo_recording

    spec = args.source if args.source is not None else str(demo_recording())
    if speed is None and realtime and not is_device(spec):
        speed = 1.0
    part = Selection(args.start, args.duration, args.frame_skip, args.max_frames)
    return SourceChoice.of(spec, args.rig, part, args.rectify, speed)


def run(args: argparse.Namespace) -> int:
    """Run, write the output folder, print the closing summary."""
    from stereo_sfm.maps.folders import MapFolders

    folders = MapFolders(args.map_in, args.localize_only, args.map_out)
    folders.check(args.overwrite)
    return execute(args, source_choice(args, args.realtime, args.speed), load_config(args), folders)[0]


def execute(
    args: argparse.Namespace,
    choice: SourceChoice,
    config: Config,
    folders: MapFolders,
    replayed: RecordedRun | None = None,
) -> tuple[int, Path]:
    """One run: its exit code and its output folder. `replayed` is an earlier run whose schedule is followed."""
    from stereo_sfm.eval.record import RunRecord
    from stereo_sfm.eval.run_results import write_results
    from stereo_sfm.eval.statistics import failure, summary
    from stereo_sfm.export.run_folder import link_latest
    from stereo_sfm.log.events import EventLines
    from stereo_sfm.pipeline.session import Session, Wiring

    choice.refuse_to_overwrite(args.output)
    record, pictures = RunRecord.of(config, folders.localize_only), _match_pictures(getattr(args, "matches", None))
    sinks: list[Sink] = [record] if pictures is None else [record, pictures]
    if args.verbose:
        sinks.append(EventLines())
    # Images reach the sinks only where the stages share this process.
    mode = "realtime" if args.realtime else args.mode
    stepper = _stepper(args)
    inline = args.inline or pictures is not None or stepper is not None  # the next frame waits for the user
    wiring = Wiring(inline, mode, args.log, args.image_format, args.viz, args.viz_address)
    with StopRequest() as stop:
        with Session(choice, config, sinks, wiring, folders, args.output, args.overwrite, replayed) as session:
            stop.then = session.stop
            if stop.asked:  # while it was opened
                session.stop()
            if pictures is not None:
                pictures.folder = session.folder / "matches"
            begin = time.perf_counter()
            interrupted, problem = _follow(session, record, stop, args.quiet or stepper is not None, stepper)
            wall_s = time.perf_counter() - begin
        stop.then = None
        folder, info = session.folder, session.info
        stats, evaluations = write_results(
            folder, info.name, info.rig, config, record, wall_s, info.ground_truth, args.frame, choice.numbering,
            args.max_lost,
        )  # fmt: skip
        link_latest(folder)
    if not args.quiet:
        print("\n".join([*summary(stats, evaluations), f"written to {folder} (start with {folder / 'report.md'})"]))
    if problem is not None:
        raise problem
    if interrupted:
        return INTERRUPTED, folder
    failed = failure(stats)
    if failed:
        print(f"stereo-sfm {args.command}: {failed}; {folder / 'report.md'} says why", file=sys.stderr)
        return TRACKING_FAILED, folder
    return 0, folder


def _match_pictures(every: int | None) -> MatchPictures | None:
    if every is None:
        return None
    if every < 1:
        raise StereoSfmError("--matches takes a number of frames of at least 1")
    from stereo_sfm.viz.match_pictures import MatchPictures

    return MatchPictures(every)


def _stepper(args: argparse.Namespace) -> Stepper | None:
    if not getattr(args, "step", False):
        return None
    from stereo_sfm.commands._step import Stepper

    return Stepper(args.seek)


def _follow(
    session: Session, record: RunRecord, stop: StopRequest, quiet: bool, stepper: Stepper | None
) -> tuple[bool, StereoSfmError | None]:
    """To the end, to Ctrl-C, or to an error; what was tracked until then stays in the record."""
    from stereo_sfm.commands._progress import progress

    with progress(session.info.name, session.info.frame_count, quiet) as bar:
        try:
            for frame in session:
                bar.show(frame)
                if stepper is not None and not stepper.go_on(frame):
                    session.stop()
        except KeyboardInterrupt:
            return True, None
        except (StereoSfmError, OSError) as error:
            said = from_os_error(error) if isinstance(error, OSError) else error
            if said is None or not len(record.frames):
                raise
            return False, said
        return stop.asked, None
