"""`stereo-sfm replay`: repeat a run from its log, bit for bit."""

from __future__ import annotations

import argparse
import dataclasses
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_verbosity_arguments, add_wiring_arguments, typed, wiring_of
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.storage.remote import InputPath

if TYPE_CHECKING:
    from stereo_sfm.commands._execute import RunOptions
    from stereo_sfm.config import Config
    from stereo_sfm.log.provenance import Opening
    from stereo_sfm.maps.folders import MapFolders
    from stereo_sfm.pipeline.session import Wiring
    from stereo_sfm.types import Frame

DIFFERENT = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("run", type=InputPath, help="run.mcap or the folder of a run")
    parser.add_argument("--source", help="source of the images (default: the log, else the run's own source)")
    parser.add_argument("-o", "--output", type=Path, help="output folder (default: runs/DATE_NAME)")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing run in the output folder")
    parser.add_argument(
        "--schedule",
        choices=("recorded", "lockstep"),
        help="when map updates reach the tracker: as recorded, or by the lockstep rule (default: as in the run)",
    )
    parser.add_argument("--until", type=float, metavar="S", help="stop after S seconds")
    parser.add_argument("--step", action="store_true", help="describe every frame and wait for Enter (in one process)")
    parser.add_argument("--seek", type=float, default=0.0, metavar="S", help="with --step: go to second S first")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="change a configuration value, to compare"
    )
    parser.add_argument("--check", action="store_true", help="compare with the run; exit with 3 if they differ")
    add_wiring_arguments(parser)
    parser.add_argument(
        "--frame", choices=("cam0", "body"), default="cam0", help="frame whose poses the trajectories contain"
    )
    parser.add_argument("--max-lost", type=float, default=100.0, metavar="PERCENT", help=argparse.SUPPRESS)
    add_verbosity_arguments(parser)


@dataclass(frozen=True)
class ReplayOptions:
    """Options of this command, as the parser names them."""

    run: Path
    source: str | None
    output: Path | None
    overwrite: bool
    schedule: str | None
    until: float | None
    step: bool
    seek: float
    set: list[str]
    check: bool
    frame: str
    max_lost: float
    quiet: bool
    verbose: bool

    @property
    def log_file(self) -> Path:
        """The log of the run."""
        return self.run / "run.mcap" if self.run.is_dir() else self.run


def run(args: argparse.Namespace) -> int:
    """Read the run, repeat it, and compare if asked to."""
    if args.realtime or args.mode == "realtime" or args.speed is not None:
        raise StereoSfmError("a replay takes its timing from the run: --realtime and --speed go with 'run'")
    wiring = wiring_of(args)
    if args.check and wiring.log == "none":
        raise StereoSfmError("--check compares the logs of both runs: it needs --log lean or full")
    wiring = dataclasses.replace(wiring, mode=wiring.mode or "lockstep", log=wiring.log or "lean")
    return replay(typed(ReplayOptions, args), wiring)


def replay(options: ReplayOptions, wiring: Wiring) -> int:
    """The exit code."""
    from stereo_sfm.commands._execute import execute

    _check(options)
    chosen = _run_again(options, wiring)
    code, folder = execute(chosen)
    return _compare(options.log_file, folder / "run.mcap") if options.check and code == 0 else code


def _check(options: ReplayOptions) -> None:
    """Raises StereoSfmError for incompatible options, and for a run that does not exist."""
    path = options.log_file
    if options.seek and not options.step:
        raise StereoSfmError("--seek goes with --step: all earlier frames must be executed to reach a later one")
    if options.check and options.until is not None:
        raise StereoSfmError("--check compares whole runs: omit --until")
    if options.until is not None and not options.until >= 0:
        raise StereoSfmError(f"--until takes seconds after the first frame, got {options.until:g}")
    if options.output is not None and options.output.resolve() == path.resolve().parent:
        raise StereoSfmError(f"{options.output} contains the run to be replayed: choose another -o")
    if not path.exists():
        raise StereoSfmError(f"no run at {path}: 'stereo-sfm run' writes run.mcap into its folder")


def _run_again(options: ReplayOptions, wiring: Wiring) -> RunOptions:
    """The run of a log as options."""
    from stereo_sfm.commands._execute import RunOptions
    from stereo_sfm.drivers.choice import ReplayChoice
    from stereo_sfm.drivers.source import is_device, path_of
    from stereo_sfm.log import recorded, topics
    from stereo_sfm.log.reader import LogReader

    path = options.log_file
    with LogReader(path) as reader:
        before = recorded.read_run(reader)
        frames: list[Frame] = [message for _, message in recorded.messages(reader, (topics.FRAME,))]
    if not frames:
        raise StereoSfmError(f"{path} contains no frames: nothing to replay")
    left_out = sum(drop.count for drop in before.dropped if drop.where == "log")
    if left_out and options.source is None:
        text = "%s lacks %d tracked images (the log was too slow): the replay will differ"
        logging.getLogger("stereo_sfm").warning(text, path, left_out)
    follow = options.schedule == "recorded" or (options.schedule is None and before.mode == "realtime")
    logged = options.source is None and before.image_format != "none"  # the images that the tracker saw
    spec = str(path) if logged else options.source or before.source
    if not logged and is_device(spec) and not path_of(spec).is_file():
        raise StereoSfmError(f"{path} has no images, and its source {spec} is a camera: run it with --log full")
    rig, rectify = (None, "none") if logged else (before.opening.rig, before.opening.rectify)
    frame_ids = tuple(f.frame_id for f in frames if _within(f, frames[0], options.until))
    return RunOptions(
        ReplayChoice(
            spec,
            rig,
            rectify=rectify,
            start_check=before.start_check,
            paired=logged,
            frame_ids=frame_ids,
            recorded_skip=before.opening.frame_skip,
        ),
        _changed(before.config, options.set),
        wiring,
        map_folders(before.opening),
        output=options.output,
        overwrite=options.overwrite,
        frame=options.frame,
        max_lost_percent=options.max_lost,
        quiet=options.quiet,
        verbose=options.verbose,
        step_from_s=options.seek if options.step else None,
        replayed=before if follow else None,
        command="replay",
    )


def map_folders(opening: Opening) -> MapFolders:
    """The saved map that the run started from, as it was then."""
    from stereo_sfm.maps.folders import MapFolders, map_sha256

    if not opening.map_in:
        return MapFolders()
    folder = Path(opening.map_in)
    if not (folder / "map.json").exists() or map_sha256(folder) != opening.map_sha256:
        raise StereoSfmError(
            f"the run started from the map in {folder}, which is missing or has changed since: restore it"
        )
    return MapFolders(folder, opening.localize_only)


def _within(frame: Frame, first: Frame, until_s: float | None) -> bool:
    return until_s is None or (frame.stamp_ns - first.stamp_ns) * 1e-9 <= until_s


def _changed(config: Config, overrides: list[str]) -> Config:
    from stereo_sfm.config import load

    return load(None, overrides, dataclasses.asdict(config)) if overrides else config


def _compare(run: Path, replay: Path) -> int:
    from stereo_sfm.log import topics
    from stereo_sfm.log.diff import diff
    from stereo_sfm.log.provenance import other_conditions
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.log.recorded import ended_early

    images = (topics.IMAGE_INFO, topics.LEFT_IMAGE, topics.RIGHT_IMAGE, topics.DEPTH_IMAGE, topics.IMU, topics.WHEEL,
              topics.FEATURES)  # fmt: skip
    with LogReader(run) as a, LogReader(replay) as b:
        both = {t.topic for t in a.topics} & {t.topic for t in b.topics}
        not_logged = set(images) - both  # read, but not logged without --log full
        differences = [d for d in diff(a, b) if d.topic not in not_logged]
        same = "identical"
        if ended_early(a):  # the replay ends with the last logged frame, where the mapper of the run continued
            end = max((record.sequence for record in a.messages((topics.KEYFRAME,))), default=0)
            known = {t.topic for t in a.topics}
            differences = [d for d in differences if (0 <= d.frame_id < end or (d.frame_id < 0 and d.topic in known))]
            same = f"identical before frame {end}, the last keyframe of a run that was killed"
        conditions = other_conditions(a, b) if differences else []
    print("\n".join(str(d) for d in differences) or same)
    if conditions:
        print("possible reason: the versions or the processor are different:")
        print("\n".join(f"  {line}" for line in conditions))
    return DIFFERENT if differences else 0
