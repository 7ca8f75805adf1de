"""`stereo-sfm dense`: a mesh, a cloud and a costmap from a run's or a map's keyframes."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.commands._options import typed
from stereo_sfm.storage.remote import InputPath


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("source", type=InputPath, metavar="RUN|MAP", help="folder of a run, or of a saved map")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder to write or to go on")
    parser.add_argument(
        "--images",
        action="append",
        default=[],
        metavar="SOURCE",
        help="recording that holds the images (default: the run's log or its source); again for each session of a map",
    )
    parser.add_argument("--rig", type=Path, metavar="FILE", help="calibration of --images instead of its own")
    parser.add_argument("--voxel", type=float, default=0.02, metavar="M", help="side of a voxel (default: 0.02)")
    parser.add_argument(
        "--slice",
        action="append",
        default=[],
        metavar="LOW,HIGH",
        help="a further costmap, of what stands between these heights in metres; again for each",
    )
    parser.add_argument(
        "--jobs", type=int, default=2, metavar="N", help="processes; the result is the same (default: 2)"
    )
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress and no summary")


@dataclass(frozen=True)
class DenseOptions:
    """Options of this command, as the parser names them."""

    source: Path
    output: Path
    images: list[str]
    rig: Path | None
    voxel: float
    slice: list[str]
    jobs: int
    quiet: bool


def run(args: argparse.Namespace) -> int:
    """Reconstruct, write the files, print what they hold."""
    options = typed(DenseOptions, args)
    from stereo_sfm.dense.build import ROBOT, build
    from stereo_sfm.dense.files import FILES, write_all
    from stereo_sfm.dense.inputs import find_input
    from stereo_sfm.dense.report import write_report
    from stereo_sfm.errors import StereoSfmError, writing_to
    from stereo_sfm.folder_lock import FolderLock

    if not 0.005 <= options.voxel <= 0.2:
        raise StereoSfmError("--voxel must be between 0.005 and 0.2 metres")
    if options.jobs < 1:
        raise StereoSfmError("--jobs must be at least 1")
    bands = (*ROBOT, *map(_band, options.slice))
    given = find_input(options.source, options.images, options.rig)
    with writing_to(options.output):
        options.output.mkdir(parents=True, exist_ok=True)
        with FolderLock(options.output, "choose another -o, or wait for its end"):
            bars = _Bars(options.quiet)
            volume = build(given, options.output, options.voxel, options.jobs, bars)
            numbers = write_all(volume, options.output, bands)
            report = write_report(options.output, str(options.source), options.voxel, numbers)
    if not options.quiet:
        print(", ".join(f"{value:.0f} {name}" for name, value in numbers.items()))
        print(f"written to {options.output} (start with {report}): {FILES}")
    return 0


def _band(text: str) -> tuple[float, float]:
    """Heights of a slice.

    Raises:
        StereoSfmError: not two numbers, or not in order.
    """
    from stereo_sfm.errors import StereoSfmError

    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        low = high = 0.0
    if not -10 <= low < high <= 100:
        raise StereoSfmError(f"--slice takes two heights in metres, as 0.1,0.6; got '{text}'")
    return low, high


class _Bars:
    """One progress bar after the other, with the time left."""

    def __init__(self, quiet: bool) -> None:
        self._quiet, self._what = quiet, ""

    def __call__(self, what: str, done: int, total: int) -> None:
        from stereo_sfm.commands._progress import progress

        if what != self._what:
            self._what = what
            self._bar = progress(what, total, self._quiet, what)
            self._bar.__enter__()
        self._bar.step("")
        if done == total:
            self._bar.__exit__(None, None, None)
