"""Lists of the times of images as people write them: with a header, with file names or numbers beside, in any unit."""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

from stereo_sfm.drivers.image_lists import stamp_from_text
from stereo_sfm.drivers.text_file import read_text
from stereo_sfm.errors import StereoSfmError

NANOSECONDS = Decimal(10**14)  # larger numbers than that are nanoseconds, smaller ones seconds


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
    if rows and not any(map(_number, rows[0])):
        rows = rows[1:]  # a header
    if len(rows) == 1 and all(map(_number, rows[0])):
        rows = [[cell] for cell in rows[0]]
    width = min(map(len, rows), default=0)
    columns = [[row[k] for row in rows] for k in range(width)]
    numbers = [column for column in columns if all(map(_number, column))]
    times = [column for column in numbers if len(numbers) == 1 or not _counts(column)] or numbers[:1]
    if not times:
        raise StereoSfmError(f"{path} must have one time in seconds or nanoseconds in each line")
    names = next((column for column in columns if not any(map(_number, column))), [])
    return Times([_stamp_ns(path, text) for text in times[0]], [Path(name).stem for name in names])


def _number(text: str) -> bool:
    try:
        return Decimal(text).is_finite()
    except InvalidOperation:
        return False


def _counts(column: list[str]) -> bool:
    """0, 1, 2, ... or 1, 2, 3, ..."""
    first = column[0]
    return first in ("0", "1") and column == [str(int(first) + k) for k in range(len(column))]


def _stamp_ns(path: Path, text: str) -> int:
    value = Decimal(text)
    stamp = int(value) if value >= NANOSECONDS else stamp_from_text(text)
    if stamp is None:
        raise StereoSfmError(f"{path}: '{text}' is not a time in seconds or nanoseconds")
    return stamp
