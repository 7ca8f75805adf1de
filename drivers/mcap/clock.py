"""The clock of a recording of another program: one for all its topics, and what its images' stamps say.

The stamps in the messages' headers count where every image topic has them, of one clock; else the times at which
messages were logged do, for all topics. A sensor without header stamps gets its log times on the clock of the headers.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from stereo_sfm.drivers.text_file import nanoseconds
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import I64

LOOKED_AT = 40  # images of each topic
USUAL_NS = 100_000_000  # between images, where one alone tells nothing


@dataclass(frozen=True)
class Clock:
    """Which stamps count."""

    by_header: bool
    header_minus_log_ns: int  # median of the images
    period_ns: int  # between the left camera's images
    skew_ns: int  # median difference from a left image to the nearest of the other camera, 0 where none is near

    def stamp(self, header_ns: int, log_ns: int) -> int:
        """Of a message on this clock."""
        if not self.by_header:
            return log_ns
        return header_ns if header_ns else log_ns + self.header_minus_log_ns

    @property
    def tolerance_ns(self) -> int:
        """Largest difference between the stamps of a pair."""
        return self.period_ns * 2 // 5


def clock_of(name: str, topics: list[str], stamps: Callable[[str], Iterable[tuple[int, int]]]) -> tuple[Clock, str]:
    """The clock of a recording, and a warning about it, "" where nothing is wrong.

    Args:
        name: of the recording. topics: of the images, the left one first.
        stamps: (header_ns, log_ns) of a topic's messages, in their order.

    Raises:
        StereoSfmError: nothing tells when the images were taken.
    """
    rows = [[*itertools.islice(stamps(topic), LOOKED_AT)] for topic in topics]
    tables = [nanoseconds(itertools.chain(*row), name).reshape(-1, 2) for row in rows]
    headers, logs = ([table[:, k] for table in tables] for k in (0, 1))
    silent = [topic for topic, column in zip(topics, headers, strict=True) if not _runs(column)]
    if silent and not all(map(_runs, logs)):
        raise StereoSfmError(
            f"{name}: nothing tells when its images were taken: the header stamps of {', '.join(silent)} are all the "
            "same, and so are the log times: extract the images and run them with 'images:FOLDER?fps=N'"
        )
    warning = f"the header stamps of {', '.join(silent)} are all the same: the times of logging count" if silent else ""
    if not silent and len(topics) > 1 and _skew_ns(*headers) is None and _skew_ns(*logs) is not None:
        apart_s = abs(float(np.median(headers[1])) - float(np.median(headers[0]))) * 1e-9
        silent = topics
        warning = (
            f"the header stamps of {topics[0]} and {topics[1]} are of two clocks, {apart_s:.3g} s apart: the times of "
            "logging count"
        )
    columns = logs if silent else headers
    skew_ns = _skew_ns(*columns) if len(columns) > 1 else None
    offset_ns = 0 if silent else int(np.median(headers[0] - logs[0])) if len(logs[0]) else 0
    return Clock(not silent, offset_ns, _period_ns(columns[0]), skew_ns or 0), warning


def _period_ns(stamps: I64) -> int:
    """Between images."""
    steps = np.diff(stamps)
    return int(np.median(steps[steps > 0])) if (steps > 0).any() else USUAL_NS


def _skew_ns(left: I64, right: I64) -> int | None:
    """Median difference from the left stamps to the nearest right ones, where both cameras have some; None if at no
    time both have."""
    if not len(left) or not len(right):
        return None
    period_ns = _period_ns(left)
    both = left[(left > right.min() - period_ns) & (left < right.max() + period_ns)]
    return int(np.median(_distances(both, right))) if len(both) else None


def _runs(stamps: I64) -> bool:
    """Whether a clock goes on; one image alone says so by any stamp."""
    return not len(stamps) or (bool(stamps.any()) and (len(stamps) == 1 or bool(np.ptp(stamps) > 0)))


def _distances(left: I64, right: I64) -> Any:
    """(N,) ns from each left stamp to the nearest right one."""
    order = np.sort(right)
    after = np.clip(np.searchsorted(order, left), 0, len(order) - 1)
    return np.minimum(np.abs(order[after] - left), np.abs(order[np.maximum(after - 1, 0)] - left))
