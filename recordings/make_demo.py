"""Makes demo.mcap, the bundled recording: once round a gondola of a small simulated store, with ground truth.

    python recordings/make_demo.py [OUTPUT.mcap]

Half-size fisheye images at 12 a second, as JPEG so that the file stays under 10 MB. The pictures are the same bits
wherever this runs; the file differs in its wall-clock times only.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2

from stereo_sfm.drivers.sim.source import SimSource
from stereo_sfm.drivers.source import open_source
from stereo_sfm.log.image_log import ImageLog
from stereo_sfm.log.images import LoggedImage
from stereo_sfm.log.provenance import write_provenance
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.types import U8

SOURCE = "sim:demo?size=424x400&rate=12&noise=0.5"
QUALITY = 66
LIMIT_BYTES = 10_000_000


def _jpeg(image: U8) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()


def make(path: Path) -> int:
    """Write the recording; its size in bytes."""
    source = open_source(SOURCE)
    assert isinstance(source, SimSource)
    with source, LogWriter(path, overwrite=True, compress=True) as writer:
        write_provenance(writer, source=SOURCE, serial=source.rig.serial, mode="record", image_format="jpeg")
        log = ImageLog(writer, source.rig, source.ground_truth, "jpeg")
        for image in source:
            assert image.right is not None
            log.image(LoggedImage(image, _jpeg(image.left), _jpeg(image.right), "jpeg"))
            print(f"\r{image.frame_id + 1}/{source.frame_count}", end="", file=sys.stderr)
    print(file=sys.stderr)
    return path.stat().st_size


def main() -> int:
    """Entry point."""
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("demo.mcap")
    size = make(path)
    print(f"{path}: {size / 1e6:.2f} MB")
    return 0 if size <= LIMIT_BYTES else 1


if __name__ == "__main__":
    sys.exit(main())
