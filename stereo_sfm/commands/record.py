"""`stereo-sfm record`: write a source to an MCAP file."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_source, add_source_arguments, source_choice, typed
from stereo_sfm.commands._progress import progress
from stereo_sfm.commands._stop import INTERRUPTED, StopRequest
from stereo_sfm.errors import StereoSfmError

if TYPE_CHECKING:
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.drivers.source import Source
    from stereo_sfm.log.provenance import Opening
    from stereo_sfm.recording.record import Progress


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    add_source(parser)
    add_output_arguments(parser)


def add_output_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that `record` and `convert` share."""
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="FILE.mcap",
        help="file to write, also in a bucket: s3://BUCKET/FILE.mcap",
    )
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


@dataclass(frozen=True)
class RecordOptions:
    """Options of `record` and `convert`, as the parser names them."""

    output: str  # a path, or the address of an object in a bucket
    image_format: str
    overwrite: bool
    quiet: bool


def run(args: argparse.Namespace) -> int:
    """Record until the source ends, the duration is over, or Ctrl-C."""
    options, choice = typed(RecordOptions, args), source_choice(args)
    return to_place(options, choice, "record")


def to_place(options: RecordOptions, choice: SourceChoice, mode: str) -> int:
    """Write a source to a file. One for a bucket is written here first, and stays here until it has arrived."""
    from stereo_sfm.storage.remote import Remote, place

    target = place(options.output)
    if not isinstance(target, Remote):
        choice.refuse_to_overwrite(target)
        with choice() as source:
            return write(source, target, options, mode, choice.opening(source.rig))
    from stereo_sfm.storage.spool import Spool

    spool = Spool.of(target, options.overwrite)
    with choice() as source:
        code = write(source, spool.file, options, mode, choice.opening(source.rig))
    spool.send()
    if not options.quiet:
        print(f"sent to {target}")
    return code


def write(source: Source, path: Path, options: RecordOptions, mode: str, opening: Opening | None = None) -> int:
    """Write an entered source and print a summary."""
    from stereo_sfm.recording.record import record

    if path.suffix != ".mcap":
        raise StereoSfmError(f"{path} does not end in .mcap: recordings are MCAP files")
    last: Progress | None = None
    with StopRequest() as stop, progress(source.name, source.frame_count, options.quiet) as bar:
        frames = record(source, path, options.image_format, overwrite=options.overwrite, mode=mode, opening=opening)
        try:
            for last in frames:
                bar.step(f"{last.seconds:.1f} s · {last.dropped} dropped · {last.bytes_written / 1e6:.1f} MB")
                if stop.asked:
                    break
            frames.close()
        except BaseException as error:  # such as a second Ctrl-C: what is cut off replaces no older file
            frames.throw(error)
    if last is not None and not options.quiet:
        size = path.stat().st_size
        print(
            f"{path}: {last.frames} frames, {last.seconds:.1f} s, {last.dropped} dropped, {size / 1e6:.1f} MB "
            f"({size / max(last.seconds, 1e-9) / 1e6:.1f} MB/s as {options.image_format})"
        )
    return INTERRUPTED if stop.asked and not source.live else 0
