"""`stereo-sfm viz`: show a run, or any MCAP recording, in rerun."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_viewer_address
from stereo_sfm.errors import StereoSfmError, require

if TYPE_CHECKING:
    from drivers.source import Source
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.messages import Sink
    from stereo_sfm.types import StereoImage


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument("file", type=Path, help="run.mcap, a run's folder, or any recording")
    parser.add_argument("--source", help="where the images are, for a run whose log has none")
    parser.add_argument("--serve", action="store_true", help="to browsers, instead of opening a window")
    add_viewer_address(parser)
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a rerun file instead of showing it")
    parser.add_argument("--overwrite", action="store_true", help="replace the file of --save")


def run(args: argparse.Namespace) -> int:
    """Feed a log to the viewer; with --serve stay until interrupted."""
    path: Path = args.file / "run.mcap" if args.file.is_dir() else args.file
    if not path.exists():
        raise StereoSfmError(f"no recording at {path}")
    if args.save is not None and args.save.is_file() and not args.overwrite:
        raise StereoSfmError(f"{args.save} exists: choose another name or give --overwrite")
    from stereo_sfm.log import topics
    from stereo_sfm.log.attached import attached_rig, attached_truth
    from stereo_sfm.log.provenance import METADATA
    from stereo_sfm.log.reader import LogReader

    require(("rerun",), "viewer", "the viewer")
    from stereo_sfm.viz.sink import RerunSink

    mode = "save" if args.save else "serve" if args.serve else "spawn"
    with LogReader(path) as reader:
        names = {t.topic for t in reader.topics}
        rig = attached_rig(reader)
        name = reader.metadata(METADATA).get("source") or path.stem
        has_images = args.source is not None or topics.LEFT_IMAGE in names or rig is None
        if has_images:
            with _images(reader, path, args.source) as source:
                sink = RerunSink(source.rig, name, mode, args.save, source.ground_truth, args.viz_address)
                _play(reader, iter(source), sink)
        else:
            assert rig is not None
            sink = RerunSink(rig, name, mode, args.save, attached_truth(reader), args.viz_address)
            _play(reader, iter(()), sink)
        sink.close()
    if mode == "serve":
        print("everything is sent; Ctrl-C ends")
        signal.pause()
    return 0


def _images(reader: LogReader, path: Path, spec: str | None) -> Source:
    """Where the images come from: another source is opened as the run opened it."""
    from drivers.choice import SourceChoice
    from stereo_sfm.log.recorded import read_opening

    if spec is None:
        return SourceChoice(str(path))()
    opening = read_opening(reader)
    return SourceChoice(spec, opening.rig, rectify=opening.rectify)()


def _play(reader: LogReader, images: Iterator[StereoImage], sink: Sink) -> None:
    """The answers in the order of the log, every image before the frame that was tracked in it."""
    from stereo_sfm.log import recorded, topics
    from stereo_sfm.types import Frame

    shown = (topics.FRAME, topics.KEYFRAME, topics.MAP_UPDATE, topics.LOOP)
    shown += (topics.STAGE_TIMES, topics.HEALTH, topics.DROPPED)
    last = -1
    for _, message in recorded.messages(reader, shown):
        if isinstance(message, Frame):
            while last < message.frame_id and (image := next(images, None)) is not None:
                sink.put(image)
                last = image.frame_id
        sink.put(message)
    for image in images:
        sink.put(image)
