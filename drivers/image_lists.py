"""Lists of image files: order, stamps, and pairing of left and right images.

Images are paired by their names: by stamps where the names are times, by numbers otherwise. Positions in the list are
unreliable once an image is missing, so lists with other names are refused.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import numpy as np

from stereo_sfm.drivers.ground_truth import stamp_from_seconds
from stereo_sfm.drivers.text_file import LAST_NS, nanoseconds
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.input_file import visible
from stereo_sfm.pixels import SUFFIXES
from stereo_sfm.types import F64, Trajectory

log = logging.getLogger("stereo_sfm")

EARLIEST_NS, LATEST_NS = 10**17, 4 * 10**18  # names that are dates are between 1973 and 2096
MIN_STAMP = 10**9  # smaller whole numbers are frame numbers
UNITS_NS = (1, 10**3, 10**6, 10**9)
APART_NS = 3600 * 10**9  # images are not so far apart
USUAL_STEP_NS = 2 * 10**6, 2 * 10**9  # between images: 500 to 0.5 Hz, which only one unit makes of any step
MAX_SKEW_NS = 3_000_000  # maximum difference of the stamps of a synchronised pair
Listing = list[tuple[int, Path]]  # (stamp_ns, file) of one camera


def list_images(folder: Path) -> list[Path]:
    """The image files of a folder in the order of their numbers (image2 before image10)."""
    if not folder.is_dir():
        raise StereoSfmError(f"no image folder {folder}")
    files = [p for p in visible(folder) if p.suffix.lower() in SUFFIXES]
    if not files:
        raise StereoSfmError(f"no images in {folder}")
    return sorted(files, key=natural_key)


def natural_key(path: Path) -> tuple[tuple[Decimal, str], ...]:
    """Sort key that compares runs of digits as numbers, those of seconds since 1970 with their decimals."""
    parts = [p for p in re.split(r"((?<![0-9])[0-9]{10}\.[0-9]+|[0-9]+)", path.stem) if p]
    text = Decimal(-1)
    return (*((Decimal(p), "") if p[0] in "0123456789" else (text, p) for p in parts), (text, path.name))


def numbers_of(images: list[Path]) -> list[int] | None:
    """The frame numbers in files' names: the last digits that no two files share (left_12 and 12_cam0 -> 12).

    None where the names have no such digits.
    """
    digits = [[int(d) for d in re.findall(r"[0-9]+", p.stem)] for p in images]
    for place in range(1, min(map(len, digits), default=0) + 1):
        numbers = [d[-place] for d in digits]
        if len(set(numbers)) == len(numbers):
            return numbers
    return None


def stamps_of(files: Sequence[Path], like: Sequence[Path] = ()) -> list[int] | None:
    """The stamps in ns in file names (cam0_1403636579763555584, 1305031102.175304); None if these are not times.

    Of several numbers in a name, the first that differs in all files and is a time counts. Whole numbers count
    nanoseconds, microseconds, milliseconds or seconds of Unix time, or since a camera was started: the unit that makes
    them dates, unless images would then be hours apart, else that of a usual frame rate.

    Args:
        like: files of the other camera, which determine the unit.
    """
    columns = zip(_numbers_in(files), _numbers_in(like or files), strict=False)
    return next((stamps for texts, others in columns if (stamps := _times(texts, others)) is not None), None)


def _numbers_in(files: Sequence[Path]) -> list[list[str]]:
    """The numbers in the files' names, by their place in them; none where names have different counts of them."""
    rows = [re.findall(r"[0-9]+(?:\.[0-9]+)?", p.stem) for p in files]
    return [list(column) for column in zip(*rows, strict=True)] if len({len(row) for row in rows}) == 1 else []


def _times(texts: list[str], others: list[str]) -> list[int] | None:
    """Nanoseconds of numbers, whose unit `others` determine; None if they are no times."""
    if len(set(texts)) < len(texts):
        return None  # of a camera or a part
    if any("." in text for text in others):
        stamps = [stamp_from_text(text) for text in texts]
        return None if any(s is None or s <= EARLIEST_NS for s in stamps) else [s or 0 for s in stamps]
    if any(text.startswith("0") for text in others):
        return None  # a frame number of fixed width
    unit = unit_of(sorted({int(text) for text in others}))
    return None if unit is None or not all(map(str.isdecimal, texts)) else [int(text) * unit for text in texts]


def unit_of(numbers: list[int]) -> int | None:
    """Nanoseconds of the unit in which ascending whole numbers count time; None for frame numbers."""
    if numbers[-1] < MIN_STAMP:
        return None
    dated = next((unit for unit in UNITS_NS if EARLIEST_NS < numbers[-1] * unit < LATEST_NS), None)
    step = sorted(b - a for a, b in pairwise(numbers))[len(numbers) // 2 - 1] if len(numbers) > 1 else 0
    if dated is not None and step * dated < APART_NS:
        return dated
    low, high = USUAL_STEP_NS
    return next((unit for unit in UNITS_NS if low <= step * unit < high and numbers[-1] * unit < LATEST_NS), None)


def stamp_from_text(text: str) -> int | None:
    """Nanoseconds from '1403636579763555584' or '1305031102.175304'; None if it is neither."""
    if text.isdecimal() and 15 <= len(text) <= 19 and int(text) <= LAST_NS:
        return int(text)
    try:
        return stamp_from_seconds(text)
    except ValueError:
        return None


def pair_files(name: str, left: list[Path], right: list[Path]) -> list[tuple[Path, Path]]:
    """Left and right images of the same moment, paired by the stamps, else by the numbers in their names.

    Unpaired images are skipped with a warning.

    Raises:
        StereoSfmError: the names do not determine the pairs.
    """
    stamps = stamps_of(left), stamps_of(right, left)
    if stamps[0] is not None and stamps[1] is not None:
        a, b = (list(zip(s, files, strict=True)) for s, files in ((stamps[0], left), (stamps[1], right)))
        return [(left[i], right[j]) for i, j in pair_listings(name, a, b)]
    pairs = _by_key([p.stem for p in left], [p.stem for p in right]) or _by_key(numbers_of(left), numbers_of(right))
    if pairs is None and len(left) == len(right) == 1:
        pairs = [(0, 0)]
    if pairs is None:
        raise StereoSfmError(
            f"{name}: cannot pair the left images ({left[0].name}, ...) with the "
            f"right images ({right[0].name}, ...): name both images of a pair by the same number or by their stamps"
        )
    _warn_unpaired(name, len(left), len(right), len(pairs))
    return [(left[i], right[j]) for i, j in pairs]


def _by_key(left: Sequence[object] | None, right: Sequence[object] | None) -> list[tuple[int, int]] | None:
    """Indices of equal keys; None where keys are missing, repeated, or not shared."""
    if left is None or right is None:
        return None
    place = {key: j for j, key in enumerate(right)}
    if len(place) < len(right) or len(set(left)) < len(left):
        return None
    return [(i, place[key]) for i, key in enumerate(left) if key in place] or None


def pair_listings(name: str, left: Listing, right: Listing) -> list[tuple[int, int]]:
    """Indices (i, j) of simultaneous images of two cameras, by their stamps.

    Raises:
        StereoSfmError: no pair; the message states the stamp difference.
    """
    stamps = [s for s, _ in left], [s for s, _ in right]
    pairs = pair_by_stamp(*stamps, MAX_SKEW_NS)
    if not pairs and left and right:
        difference_ms = _median_distance(*stamps) / 1e6
        raise StereoSfmError(
            f"{name}: the stamps of left and right images differ by {difference_ms:.6g} ms, more than the allowed "
            f"{MAX_SKEW_NS / 1e6:g} ms: both cameras must be triggered together and share a clock"
        )
    _warn_unpaired(name, len(left), len(right), len(pairs))
    return pairs


def _median_distance(left: Sequence[int], right: Sequence[int]) -> float:
    """Median distance from a left stamp to the nearest right one, nanoseconds."""
    a, b = nanoseconds(left, "the images"), np.sort(nanoseconds(right, "the images"))
    after = np.clip(np.searchsorted(b, a), 0, len(b) - 1)
    return float(np.median(np.minimum(np.abs(b[after] - a), np.abs(b[np.maximum(after - 1, 0)] - a))))


def _warn_unpaired(name: str, left: int, right: int, pairs: int) -> None:
    if pairs < max(left, right):
        log.warning("%s: %d left and %d right images, the %d pairs are used", name, left, right, pairs)


def lines_of(name: str, images: list[Path], lines: int, what: str, first: int | None = None) -> dict[Path, int]:
    """The line of each image in a list of `lines` stamps; images after the last line are skipped.

    Images and lines are matched in order if their counts are equal, else by the images' numbers.

    Args:
        name: of the source, for messages.
        images: files in order.
        lines: of the list.
        what: the list's name, for messages.
        first: number of the first line's image; None: detect whether it is 0 or 1.

    Raises:
        StereoSfmError: the numbers do not determine the lines.
    """
    if len(images) == lines:
        return {image: line for line, image in enumerate(images)}
    numbers = numbers_of(images)
    if numbers is not None and first is None:
        first = 0 if min(numbers) == 0 else 1 if max(numbers) == lines else None
    if numbers is None or first is None or min(numbers) < first:
        raise StereoSfmError(
            f"{name}: {len(images)} images but {lines} lines in {what}, and the numbers in the image names do not "
            "match the lines"
        )
    places = {image: n - first for image, n in zip(images, numbers, strict=True) if n - first < lines}
    log.warning("%s: %d images and %d lines in %s, %d matched", name, len(images), lines, what, len(places))
    return places


def truth_of_lines(
    name: str,
    poses: F64,
    what: str,
    images: list[Path],
    stamps: Mapping[Path, int],
    first: int | None = None,
) -> Trajectory | None:
    """The poses of images from a list without stamps, matched as by `lines_of`. None, with a warning, if none can be.

    Args:
        poses: (N, 4, 4), one a line.
        stamps: of the images. name, what, images, first: as of `lines_of`.
    """
    try:
        line = lines_of(name, images, len(poses), what, first)
    except StereoSfmError as error:
        log.warning("%s: there is no ground truth", error)
        return None
    used = [image for image in images if image in line and image in stamps]
    if not used:
        return None
    return Trajectory(np.array([stamps[image] for image in used], np.int64), poses[[line[image] for image in used]])


def frame_numbers(images: list[Path]) -> list[int]:
    """Frame indices 0, 1, ... of images by their numbers, whose common step is one frame; by order without numbers."""
    numbers = numbers_of(images)
    if numbers is None or sorted(numbers) != numbers:
        return list(range(len(images)))
    step = math.gcd(*(n - numbers[0] for n in numbers)) or 1
    return [(n - numbers[0]) // step for n in numbers]


def pair_by_stamp(a: Sequence[int], b: Sequence[int], max_difference_ns: int) -> list[tuple[int, int]]:
    """Indices (i, j) of the pairs whose stamps differ least; each entry is used once, smallest differences first."""
    if not a or not b:
        return []
    stamps_a, stamps_b = nanoseconds(a, "the images"), nanoseconds(b, "the images")
    order = np.argsort(stamps_b, kind="stable")
    right_of = np.searchsorted(stamps_b[order], stamps_a)
    candidates: list[tuple[int, int, int]] = []
    for i, position in enumerate(right_of):
        for j in {max(position - 1, 0), min(position, len(order) - 1)}:
            difference = abs(int(stamps_a[i]) - int(stamps_b[order[j]]))
            if difference <= max_difference_ns:
                candidates.append((difference, i, int(order[j])))
    pairs: list[tuple[int, int]] = []
    used_a: set[int] = set()
    used_b: set[int] = set()
    for _, i, j in sorted(candidates):
        if i not in used_a and j not in used_b:
            used_a.add(i)
            used_b.add(j)
            pairs.append((i, j))
    return sorted(pairs)
