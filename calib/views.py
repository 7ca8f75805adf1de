"""Images of a target from a folder of left and right images or from any source."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from stereo_sfm.calib.coverage import is_new
from stereo_sfm.calib.targets import Detection, Target
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import read_bytes
from stereo_sfm.pixels import SUFFIXES
from stereo_sfm.types import U8, U16, StereoImage

_SIDES = ((r"left", "right"), (r"cam0", "cam1"), (r"_0(?=\.)", "_1"), (r"_l(?=\.)", "_r"))


def find_pairs(folder: Path) -> list[tuple[Path, Path]]:
    """left*/right*, cam0/cam1 or *_0/*_1 images of a folder, in the order of the numbers in their names."""
    files = {str(p.relative_to(folder)): p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES}
    files = {name: path for name, path in files.items() if "/." not in f"/{name}"}  # as `visible`, at every depth
    for left, right in _SIDES:
        pairs: list[tuple[Path, Path]] = []
        for name, path in files.items():
            other = re.sub(left, right, name)
            if other != name and other in files and re.search(r"\d", name.replace("cam0", "")):
                pairs.append((path, files[other]))
        if pairs:
            return sorted(pairs, key=lambda p: _natural(str(p[0])))
    return []


def _natural(name: str) -> list[int | str]:
    return [int(part) if part.isdigit() else part for part in re.split(r"(\d+)", name)]


def read_pairs(pairs: list[tuple[Path, Path]]) -> Iterator[tuple[U8, U8]]:
    """Grey images.

    Raises:
        StereoSfmError: a file is not an image, or the sizes differ.
    """
    from stereo_sfm.pixels import BitsSoFar, decode_gray, eight_bits

    size, used = (0, 0), BitsSoFar()
    for paths in pairs:
        images: list[U8 | U16] = []
        for path in paths:
            try:
                image = decode_gray(read_bytes(path))
            except (OSError, ValueError):
                raise StereoSfmError(f"cannot read the image {path}: remove it, or export it again") from None
            found = (image.shape[1], image.shape[0])
            size = found if size == (0, 0) else size
            if found != size:
                raise StereoSfmError(f"{path} is {found[0]}x{found[1]} px, the other images are {size[0]}x{size[1]}")
            images.append(image)
        bits = used.including(images)
        yield eight_bits(images[0], bits), eight_bits(images[1], bits)


def gather(
    pairs: Iterator[tuple[U8, U8]],
    target: Target,
    limit: int,
    every_view: bool,
    report: Callable[[int, list[Detection], list[Detection], tuple[int, int]], None],
) -> tuple[list[Detection], list[Detection], list[tuple[U8, U8]], tuple[int, int]]:
    """Detect the target and keep views that add information.

    Args:
        pairs: grey images of both cameras.
        limit: maximum number of views.
        every_view: keep views similar to earlier ones too (images taken one by one).
        report: called after each kept view with its number, the detections of both cameras so far and the image size.

    Returns:
        Detections of the left and right camera, the kept images, and (width, height) px.
    """
    left: list[Detection] = []
    right: list[Detection] = []
    kept: list[tuple[U8, U8]] = []
    size = (0, 0)
    for a, b in pairs:
        size = (a.shape[1], a.shape[0])
        da, db = target.detect(a), target.detect(b)
        seen, before = (da, left) if len(da) else (db, right)
        if not len(seen) or not (every_view or is_new(seen, before, size[0])):
            continue
        left.append(da)
        right.append(db)
        kept.append((a, b))
        report(len(left), left, right, size)
        if len(left) >= limit:
            break
    return left, right, kept, size


def stereo_pairs(images: Iterator[StereoImage]) -> Iterator[tuple[U8, U8]]:
    """The stereo images of a source."""
    for image in images:
        if image.right is None:
            raise StereoSfmError("the source has one camera: a stereo calibration needs two")
        yield image.left, image.right
