"""Ascending stamps, which every stage and every trajectory file relies on, whatever a source yields.

An image that is not later than the one before it is skipped: it is doubled, late, or its clock stands still. Where
several in a row are not later but ascend among themselves, the clock was set back: theirs go on one usual interval
after the last. Both are logged, and skipped images count as dropped.
"""

from __future__ import annotations

import itertools
import logging
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from stereo_sfm.drivers.repeated import shifted
from stereo_sfm.drivers.source import Stamps
from stereo_sfm.drivers.wrapped import WrappedSource
from stereo_sfm.types import I64, StereoImage, Trajectory

log = logging.getLogger("stereo_sfm")

SET_BACK = 3  # images that are not later but ascend: one or two may be late messages
USUAL = 15  # intervals whose median is the usual one


class AscendingStamps:
    """Maps the stamps of successive images to ascending ones."""

    def __init__(self) -> None:
        self.shift_ns = 0  # added to the source's stamps since its clock was set back
        self.skipped = 0
        self._last_ns: int | None = None
        self._steps: deque[int] = deque(maxlen=USUAL)
        self._waiting: list[int] = []  # stamps that are not later than the last, but ascend

    def step(self, stamp_ns: int) -> list[int]:
        """The ascending stamps of the newest images that are now known to be good, of which this is the last; none
        where this image waits for the next ones, or is skipped."""
        if self._last_ns is None or stamp_ns + self.shift_ns > self._last_ns:
            return self._take([stamp_ns])
        ascend = bool(self._waiting) and stamp_ns > self._waiting[-1]
        self.skipped += 0 if ascend else len(self._waiting)
        self._waiting = [*self._waiting, stamp_ns] if ascend else [stamp_ns]
        if len(self._waiting) < SET_BACK:
            return []
        usual_ns = int(np.median(self._steps or np.diff(self._waiting)))
        self.shift_ns = self._last_ns + usual_ns - self._waiting[0]
        known, self._waiting = self._waiting, []
        return self._take(known)

    def end(self) -> None:
        """No image follows: those that wait are skipped."""
        self.skipped += len(self._waiting)
        self._waiting = []

    def _take(self, stamps: list[int]) -> list[int]:
        self.end()
        out = [stamp_ns + self.shift_ns for stamp_ns in stamps]
        before = out if self._last_ns is None else [self._last_ns, *out]
        self._steps.extend(b - a for a, b in itertools.pairwise(before))
        self._last_ns = out[-1]
        return out


def ascending(images: Iterable[StereoImage], name: str) -> Iterator[StereoImage]:
    """The images with ascending stamps; the same objects where they ascend already.

    Args:
        images: of any source. name: of the source, for messages.
    """
    clock, waiting = AscendingStamps(), list[StereoImage]()
    for image in images:
        waiting.append(image)
        shift_ns, skipped = clock.shift_ns, clock.skipped
        stamps = clock.step(image.stamp_ns)
        if clock.skipped and not skipped:
            log.warning("%s: images whose stamps are not later than the one before are skipped", name)
        if clock.shift_ns != shift_ns:
            log.warning(
                "%s: its clock was set back before image %d: %.3f s are added to the stamps from there on",
                name, waiting[-len(stamps)].frame_id, clock.shift_ns * 1e-9,
            )  # fmt: skip
        while len(waiting) > len(stamps) > 0:
            skipped = waiting.pop(0)
            waiting[0] = waiting[0].following([skipped], 1 + skipped.dropped_before)
        for good, stamp_ns in zip(waiting if stamps else (), stamps, strict=True):
            yield _stamped(good, stamp_ns)
        waiting = [] if stamps else waiting
    clock.end()
    if clock.skipped:
        log.warning("%s: %d images were skipped, their stamps were not later than those before", name, clock.skipped)


def _stamped(image: StereoImage, stamp_ns: int) -> StereoImage:
    """On the ascending clock: another one for the samples, too."""
    shift_ns = stamp_ns - image.stamp_ns
    return image if not shift_ns else shifted(image, image.frame_id, shift_ns)


def _kept(stamp_ns: I64) -> tuple[list[int], I64]:
    """Rows of stamps (N,) that are not skipped, and the ascending stamps that they get."""
    clock, rows, stamps, waiting = AscendingStamps(), list[int](), list[int](), list[int]()
    for k, stamp in enumerate(stamp_ns.tolist()):
        waiting.append(k)
        if good := clock.step(stamp):
            rows.extend(waiting[-len(good) :])
            stamps.extend(good)
            waiting = []
    return rows, np.array(stamps, np.int64)


class AscendingSource(WrappedSource):
    """Wraps a source: its images with ascending stamps."""

    @property
    def ground_truth(self) -> Trajectory | None:
        """One pose for each image has the stamps of the source, and goes on with those of the images."""
        truth = self.source.ground_truth
        if truth is None or (np.diff(truth.stamp_ns) > 0).all():
            return truth
        rows, stamps = _kept(truth.stamp_ns)
        return Trajectory(stamps, truth.poses[rows], truth.oriented)

    def stamps(self) -> Stamps | None:
        found = self.source.stamps()
        if found is None or (np.diff(found.stamp_ns) > 0).all():
            return found
        return replace(found, stamp_ns=_kept(found.stamp_ns)[1])

    def at(self, positions: Sequence[int]) -> Iterator[StereoImage]:
        found = self.source.stamps()
        ascend = found is not None and bool((np.diff(found.stamp_ns) > 0).all())
        return self.source.at(positions) if ascend else super().at(positions)

    def __iter__(self) -> Iterator[StereoImage]:
        return ascending(self.source, self.name)
