"""`stereo-sfm record`: write a source to an MCAP file."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._stop import INTERRUPTED, StopRequest
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from drivers.source import Source
    from stereo_sfm.log.provenance import Opening
    from stereo_sfm.recording.record import Progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("source", help="t265, oak, sim:SCENE, a dataset folder, an .mcap file, or KIND:PATH")
    add_output_arguments(parser)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that `record` and `convert` share."""
    from stereo_sfm.commands.run import add_source_arguments

    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.mcap", help="file to write")
    parser.add_argument(
        "--image-format",
        choices=("png", "raw", "jpeg"),
        default="png",
        help="png: lossless and small (default); raw: lossless and fast; jpeg: lossy and tiny",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing file")
    parser.add_argument("-q", "--quiet", action="store_true", help="no progress and no summary")
    add_source_arguments(parser)
    parser.add_argument("--frames", type=int, dest="max_frames", metavar="N", help="same as --max-frames")


def run(args: argparse.Namespace) -> int:
    """Record until the source ends, the duration is over, or Ctrl-C."""
    from stereo_sfm.commands.run import source_choice

    choice = source_choice(args)
    choice.refuse_to_overwrite(args.output)
    with choice() as source:
        return write(source, args, "record", choice.opening)


def write(source: Source, args: argparse.Namespace, mode: str, opening: Opening | None = None) -> int:
    """Write an entered source and say what came of it."""
    from stereo_sfm.recording.record import record

    path: Path = args.output
    if path.suffix != ".mcap":
        raise StereoSfmError(f"{path} does not end in .mcap: recordings are MCAP files")
    last: Progress | None = None
    show = _Line(source.frame_count, args.quiet)
    with StopRequest() as stop:
        frames = record(source, path, args.image_format, overwrite=args.overwrite, mode=mode, opening=opening)
        for last in frames:
            show(last)
            if stop.asked:
                break
        frames.close()
    show.end()
    if last is not None and not args.quiet:
        size = path.stat().st_size
        print(
            f"{path}: {last.frames} frames, {last.seconds:.1f} s, {last.dropped} dropped, {size / 1e6:.1f} MB "
            f"({size / max(last.seconds, 1e-9) / 1e6:.1f} MB/s as {args.image_format})"
        )
    return INTERRUPTED if stop.asked and not source.live else 0


class _Line:
    """One line on a terminal that is rewritten twice a second."""

    def __init__(self, total: int | None, quiet: bool) -> None:
        self._on = sys.stderr.isatty() and not quiet
        self._of = f"/{total}" if total else ""
        self._next = 0.0
        self._begin = time.perf_counter()

    def __call__(self, state: Progress) -> None:
        now = time.perf_counter()
        if not self._on or now < self._next:
            return
        self._next = now + 0.5
        rate = state.frames / max(now - self._begin, 1e-9)
        text = f"{state.frames}{self._of} frames  {state.seconds:.1f} s  {rate:.1f} frames/s  {state.dropped} dropped"
        print(f"\r{text}  {state.bytes_written / 1e6:.1f} MB ", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Leave the line."""
        if self._on:
            print(file=sys.stderr)
