"""Speed and size of each image format of `record` on one core, and the cost of each PNG setting.

    python benchmarks/record_speed.py [SOURCE ...] [--frames 150] [--encoders]

The default source is the simulated T265 (2 x 848 x 800). Frames are held in memory, so that only the recording is
timed; the process is pinned to one core. "of a core" is the processor time at 30 frames a second: below 100 % it is
fast enough. The wall time is longer where other programs use the same core.
"""

from __future__ import annotations

import argparse
import itertools
import os
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import zstandard

from stereo_sfm.drivers import Source, open_source
from stereo_sfm.drivers.memory import MemorySource
from stereo_sfm.log.images import FORMATS, PNG_OPTIONS
from stereo_sfm.recording.record import record
from stereo_sfm.types import U8, StereoImage

RATE = 30.0


def load(spec: str, distinct: int) -> tuple[Source, list[StereoImage]]:
    """Up to `distinct` frames of a source."""
    with open_source(spec) as source:
        return source, list(itertools.islice(source, distinct))


def measure_recording(source: Source, images: list[StereoImage], count: int, folder: Path) -> None:
    """One line per image format."""
    raw_bytes = sum(pixels.nbytes for pixels in (images[0].left, images[0].right) if pixels is not None)
    titles = ("ms/frame", "CPU ms", "of a core", "MB/s at 30 Hz", "of raw", "CPU ms to read")
    print(f"{'format':8}" + "".join(f"{title:>15}" for title in titles))
    for image_format in FORMATS:
        path = folder / f"{image_format}.mcap"
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in record(MemorySource(source.rig, images, name=source.name, count=count), path, image_format):
            pass
        wall, cpu = (time.perf_counter() - wall) / count, (time.process_time() - cpu) / count
        size = path.stat().st_size / count
        begin = time.process_time()
        with open_source(path) as back:
            assert sum(1 for _ in back) == count
        reading = (time.process_time() - begin) / count
        numbers = (f"{wall * 1e3:.2f}", f"{cpu * 1e3:.2f}", f"{cpu * RATE:.0%}", f"{size * RATE / 1e6:.2f}")
        numbers += (f"{size / raw_bytes:.3f}", f"{reading * 1e3:.2f}")
        print(f"{image_format:8}" + "".join(f"{number:>15}" for number in numbers))
        path.unlink()


def encoders() -> dict[str, Callable[[U8], bytes]]:
    """Ways to store an image that were considered."""

    def png(*options: int) -> Callable[[U8], bytes]:
        return lambda image: cv2.imencode(".png", image, options)[1].tobytes()

    def jpeg(quality: int) -> Callable[[U8], bytes]:
        return lambda image: cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, quality))[1].tobytes()

    level1 = (cv2.IMWRITE_PNG_COMPRESSION, 1)
    table: dict[str, Callable[[U8], bytes]] = {
        "raw": lambda image: image.tobytes(),
        "raw, zstd 1": lambda image: zstandard.compress(image.tobytes(), 1),
        "raw, zstd 3": lambda image: zstandard.compress(image.tobytes(), 3),
        "png, OpenCV's default": png(),
        "png 1": png(*level1),
        "png, ours": png(*PNG_OPTIONS),
    }
    for strategy in ("FILTERED", "HUFFMAN_ONLY", "RLE"):
        for filters in ("SUB", "UP", "AVG", "PAETH"):
            table[f"png 1 {strategy} {filters}"] = png(
                *level1,
                cv2.IMWRITE_PNG_STRATEGY,
                getattr(cv2, f"IMWRITE_PNG_STRATEGY_{strategy}"),
                cv2.IMWRITE_PNG_FILTER,
                getattr(cv2, f"IMWRITE_PNG_FILTER_{filters}"),
            )
    return table | {f"jpeg {quality}": jpeg(quality) for quality in (80, 90, 95)}


def measure_encoders(images: list[StereoImage], count: int) -> None:
    """One line per way to store an image."""
    arrays = [pixels for image in images for pixels in (image.left, image.right) if pixels is not None][:count]
    for name, encode in encoders().items():
        encode(arrays[0])
        begin = time.process_time()
        size = sum(len(encode(pixels)) for pixels in arrays)
        spent = (time.process_time() - begin) / len(arrays)
        print(f"{name:28} {spent * 1e3:7.2f} ms an image  {size / sum(pixels.nbytes for pixels in arrays):.3f} of raw")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="*", default=["sim:loop?frames=12"])
    parser.add_argument("--frames", type=int, default=150, help="frames to record in each format")
    parser.add_argument("--distinct", type=int, default=12, help="different frames held in memory")
    parser.add_argument("--encoders", action="store_true", help="compare ways to store an image")
    parser.add_argument("--folder", type=Path, help="where to write (default: a temporary folder)")
    args = parser.parse_args()
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    cv2.setNumThreads(1)
    for spec in args.sources:
        source, images = load(spec, args.distinct)
        height, width = images[0].left.shape
        print(f"\n{spec}: {len(images)} different frames of {1 if images[0].right is None else 2} x {width}x{height}")
        with TemporaryDirectory(dir=args.folder) as folder:
            measure_recording(source, images, args.frames, Path(folder))
        if args.encoders:
            measure_encoders(images, 24)


if __name__ == "__main__":
    main()
