"""Write a source to a file, for `stereo-sfm record` and `convert`."""

from __future__ import annotations

import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.drivers.source import Source
from stereo_sfm.errors import StereoSfmError, one_of
from stereo_sfm.log.image_log import ImageLog
from stereo_sfm.log.images import FORMATS, encode_pair
from stereo_sfm.log.provenance import TOTALS, Opening, write_provenance
from stereo_sfm.log.writer import LogWriter


@dataclass(frozen=True)
class Progress:
    """Progress of a recording."""

    frames: int
    dropped: int
    seconds: float  # of sensor time
    bytes_written: int


def record(
    source: Source,
    path: Path,
    image_format: str = "png",
    *,
    overwrite: bool = False,
    mode: str = "record",
    clock: Callable[[], int] = time.time_ns,
    opening: Opening | None = None,
) -> Generator[Progress, None, None]:
    """Write every frame of an open source; yields after each one. Close the iterator to stop.

    Args:
        source: entered by the caller.
        path: the .mcap file.
        image_format: "png" (lossless), "raw" or "jpeg" (lossy).
        overwrite: replace an existing file.
        mode: for the metadata.
        clock: wall clock in nanoseconds, for `publish_time`.
        opening: how the source was opened.

    Raises:
        StereoSfmError: the file cannot be written, the disk is full, the source fails, or it yields no frame.
    """
    one_of(image_format, FORMATS, "image format")
    frames, dropped, first_ns = 0, 0, None
    with LogWriter(path, overwrite=overwrite, compress=image_format != "raw", clock=clock) as writer:
        write_provenance(
            writer, source=source.name, serial=source.rig.serial, mode=mode, image_format=image_format, opening=opening
        )
        images = ImageLog(writer, source.rig, source.ground_truth, image_format)
        try:
            for image in source:
                images.image(encode_pair(image, image_format, decode=False))
                first_ns = image.stamp_ns if first_ns is None else first_ns
                frames += 1
                dropped += image.dropped_before
                yield Progress(frames, dropped, (image.stamp_ns - first_ns) / 1e9, writer.bytes_written)
        finally:
            if not writer.closed:
                counted = {name: f"{value:g}" for name, value in source.counters.items() if value}
                writer.metadata(TOTALS, counted | images.totals)
            if not frames:
                writer.discard()  # it contains only a calibration
    if not frames:
        raise StereoSfmError(f"{source.name} yielded no image: nothing was recorded")
