"""`stereo-sfm viz`: show a run, a saved map, a surface, or any MCAP recording, in rerun."""

from __future__ import annotations

import argparse
import signal
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from stereo_sfm.commands._options import add_viewer_address, typed
from stereo_sfm.errors import StereoSfmError, require
from stereo_sfm.storage.remote import InputPath

if TYPE_CHECKING:
    from stereo_sfm.calib.rig import Rig
    from stereo_sfm.drivers.source import Source
    from stereo_sfm.log.reader import LogReader
    from stereo_sfm.messages import Sink
    from stereo_sfm.types import StereoImage, Trajectory
    from stereo_sfm.viz.sink import RerunSink

MESH = "mesh.ply"  # in a folder of `dense`


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.add_argument(
        "file", type=InputPath, help="run.mcap, a run's folder, a saved map, a folder of dense, or any recording"
    )
    parser.add_argument("--source", help="source of the images, for a run whose log has none")
    parser.add_argument("--serve", action="store_true", help="serve the viewer to browsers instead of opening a window")
    add_viewer_address(parser)
    parser.add_argument("--save", type=Path, metavar="FILE.rrd", help="write a rerun file instead of showing it")
    parser.add_argument("--overwrite", action="store_true", help="replace the file of --save")


@dataclass(frozen=True)
class VizOptions:
    """Options of this command, as the parser names them."""

    file: Path
    source: str | None
    serve: bool
    viz_address: str
    save: Path | None
    overwrite: bool

    @property
    def mode(self) -> str:
        """save | serve | spawn."""
        return "save" if self.save else "serve" if self.serve else "spawn"

    def sink(self, rig: Rig, name: str, truth: Trajectory | None = None) -> RerunSink:
        """The viewer for these options."""
        from stereo_sfm.viz.sink import RerunSink

        return RerunSink(rig, name, self.mode, self.save, truth, self.viz_address)


def run(args: argparse.Namespace) -> int:
    """Send a log, a saved map or a surface to the viewer; with --serve, until interrupted."""
    options = typed(VizOptions, args)
    file = options.file
    is_map, is_surface = (file / "map.json").is_file(), (file / MESH).is_file()
    path = file / "run.mcap" if file.is_dir() else file
    if not is_map and not is_surface and not path.exists():
        raise StereoSfmError(f"no recording, no saved map and no surface at {file}")
    if options.save is not None and options.save.is_file() and not options.overwrite:
        raise StereoSfmError(f"{options.save} exists: choose another name or give --overwrite")
    require(("rerun",), "viewer", "the viewer")
    if is_map:
        _show_map(options)
    elif is_surface:
        _show_surface(options)
    else:
        _show_log(path, options)
    if options.save is not None:
        print(f"written to {options.save}: open it with 'rerun {options.save}'")
    elif options.serve:
        print("all data sent; press Ctrl-C to stop")
        signal.pause()
    return 0


def _show_map(options: VizOptions) -> None:
    """A saved map: its keyframes and points at once, as one message of the mapper."""
    from stereo_sfm.maps.saved_map import as_update, load_map

    saved = load_map(options.file)
    sink = options.sink(saved.rig, options.file.name)
    sink.put(as_update(saved))
    sink.close()


def _show_surface(options: VizOptions) -> None:
    """The mesh of `dense`."""
    from stereo_sfm.dense.files import read_mesh
    from stereo_sfm.viz.sink import end_recording, open_recording
    from stereo_sfm.viz.surface import show_surface, surface_blueprint

    mesh = read_mesh(options.file / MESH)
    layout = surface_blueprint(options.file.resolve().name)
    recording = open_recording(options.mode, layout, options.save, options.viz_address)
    show_surface(recording, *mesh)
    end_recording(recording, options.mode)


def _show_log(path: Path, options: VizOptions) -> None:
    from stereo_sfm.log import topics
    from stereo_sfm.log.attached import attached_rig, attached_truth
    from stereo_sfm.log.provenance import METADATA
    from stereo_sfm.log.reader import LogReader

    with LogReader(path) as reader:
        names = {t.topic for t in reader.topics}
        rig = attached_rig(reader)
        name = reader.metadata(METADATA).get("source") or path.stem
        if rig is None or options.source is not None or topics.LEFT_IMAGE in names:
            with _images(reader, path, options.source) as source:
                sink = options.sink(source.rig, name, source.ground_truth)
                _play(reader, iter(source), sink)
        else:
            sink = options.sink(rig, name, attached_truth(reader))
            _play(reader, iter(()), sink)
        sink.close()


def _images(reader: LogReader, path: Path, spec: str | None) -> Source:
    """The source of the images, opened as the run opened its own."""
    from stereo_sfm.drivers.choice import SourceChoice
    from stereo_sfm.log.recorded import read_opening

    if spec is None:
        return SourceChoice(str(path))()
    opening = read_opening(reader)
    return SourceChoice(spec, opening.rig, rectify=opening.rectify)()


def _play(reader: LogReader, images: Iterator[StereoImage], sink: Sink) -> None:
    """Send the messages in the order of the log, each image before its frame."""
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
