"""Lists of the times of images as people write them: with a header, with file names or numbers beside, in any unit."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

from stereo_sfm.drivers.image_lists import MIN_STAMP, stamp_from_text, unit_of
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.errors import StereoSfmError


@dataclass(frozen=True)
class Times:
    """The lines of a list."""

    stamp_ns: list[int]
    names: list[str]  # of the images, without folder and suffix; empty where the lines have none


def read_times(path: Path) -> Times:
    """Read a list: one line for each image, or all times in one line.

    Columns are separated by blanks, commas or semicolons. Numbers that count the lines are not times.

    Raises:
        StereoSfmError: no times.
    """
    lines = [line.strip() for line in read_text(path).splitlines()]
    rows = [re.split(r"[,;\s]+", line.strip(",;")) for line in lines if line and not line.startswith("#")]
    if rows and not any(map(_numeric, rows[0])):
        rows = rows[1:]  # a header
    if len(rows) == 1 and all(map(_number, rows[0])):
        rows = [[cell] for cell in rows[0]]
    width = min(map(len, rows), default=0)
    columns = [[row[k] for row in rows] for k in range(width)]
    names = next((column for column in columns if not any(map(_number, column))), [])
    parts = next((both for both in itertools.pairwise(columns) if _seconds_and_rest(*both)), None)
    if parts is not None:
        stamps = [int(a) * 10**9 + int(b) for a, b in zip(*parts, strict=True)]
        return Times(stamps, [Path(name).stem for name in names])
    numbers = [column for column in columns if all(map(_number, column))]
    growing = [column for column in numbers if _grows(column)] or numbers[:1]
    times = [column for column in growing if not _counts(column)] or growing
    if not times:
        raise StereoSfmError(f"{path} must have one time in seconds or a smaller unit in each line")
    return Times(_stamps_ns(path, times[0]), [Path(name).stem for name in names])


def _numeric(text: str) -> bool:
    """Whether a cell is a number, NaN and infinity included."""
    try:
        Decimal(text)
    except InvalidOperation:
        return False
    return True


def _number(text: str) -> bool:
    return _numeric(text) and Decimal(text).is_finite()


def _grows(column: list[str]) -> bool:
    """Whether numbers ascend, but for a clock that was set back; exposures beside times do not."""
    up = [Decimal(b) > Decimal(a) for a, b in itertools.pairwise(column)]
    return 10 * sum(up) >= 9 * len(up)


def _seconds_and_rest(seconds: list[str], rest: list[str]) -> bool:
    """Whether two columns are whole seconds, as of several images each, and the nanoseconds since then."""
    if not all(text.isdecimal() for text in (*seconds, *rest)) or len({*seconds}) == len(seconds):
        return False
    if max(map(int, rest)) >= 10**9 or len({*rest}) == 1:
        return False
    joined = [str(int(a) * 10**9 + int(b)) for a, b in zip(seconds, rest, strict=True)]
    return _grows(joined) and not _counts(rest)


def _counts(column: list[str]) -> bool:
    """7, 8, 9, ..., with zeros before them or not."""
    numbers = [Decimal(text) for text in column if text.isdecimal()]
    steps = {b - a for a, b in itertools.pairwise(numbers)}
    return len(numbers) == len(column) and steps <= {1} and numbers[-1] < MIN_STAMP


def _stamps_ns(path: Path, texts: list[str]) -> list[int]:
    """Of seconds, or of whole numbers that count a smaller unit."""
    values = [Decimal(text) for text in texts]
    if max(values) < MIN_STAMP or any(value % 1 for value in values):
        stamps = [stamp_from_text(text) for text in texts]
    else:
        unit = unit_of(sorted({int(value) for value in values}))
        stamps = [None if unit is None else int(value) * unit for value in values]
    for stamp, text in zip(stamps, texts, strict=True):
        if stamp is None:
            raise StereoSfmError(f"{path}: '{text}' is not a time in seconds, or since 1970 in a smaller unit")
    return [stamp or 0 for stamp in stamps]
