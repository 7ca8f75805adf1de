"""Which segments are deleted when the recordings exceed their quota."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from stereo_sfm.recording.segments import Segment, recordings, segments

GB = 1_000_000_000
AUTOMATIC_SHARE = 0.5  # of the quota: as much for what the service marked as for everything else


@dataclass(frozen=True)
class Disk:
    """Total and free bytes of the disk of a folder."""

    total: int
    free: int

    @staticmethod
    def of(folder: Path) -> Disk:
        usage = shutil.disk_usage(folder)
        return Disk(usage.total, usage.free)


@dataclass(frozen=True)
class Quota:
    """Limits of all recordings in a folder."""

    bytes: float
    percent: float = 100.0  # of the disk
    min_free: float = 0.0  # bytes
    sent_only: bool = False  # what is to be in the bucket and is not there yet is never deleted
    black_box: bool = False  # images of unmarked segments are not to be there

    def most(self, disk: Disk) -> float:
        """Bytes that recordings may have."""
        return min(self.bytes, disk.total * self.percent / 100.0)

    def excess(self, used: int, disk: Disk) -> float:
        """Bytes of recordings that are too many."""
        return max(used - self.most(disk), 0.0)

    def lacking(self, disk: Disk) -> float:
        """Bytes that should be free and are not."""
        return max(self.min_free - disk.free, 0.0)

    def waiting(self, segment: Segment) -> list[Path]:
        """Files of a segment that are not to be deleted before they are sent."""
        return segment.unsent(self.black_box) if self.sent_only else []


def used_bytes(root: Path) -> int:
    """Bytes of all recordings."""
    return sum(segment.bytes for folder in recordings(root) for segment in segments(folder))


def make_room(root: Path, quota: Quota, current: Segment | None, disk: Callable[[Path], Disk] = Disk.of) -> float:
    """Delete segments until the quota is kept, and images until enough is free; the oldest first.

    Segments that a person marked stay. Those that the service marked itself count as marked while they are the newest
    ones in a part of the quota, and go after the unmarked ones: however many losses there are, there is room for what
    comes. Poses are never deleted because something else has filled the disk. What waits for its upload stays.

    Args:
        root: of the recordings. current: being written, never deleted. disk: how full the disk is.

    Returns:
        Bytes by which the quota is still exceeded: everything else was marked by a person, or waits for its upload.
    """
    excess = quota.excess(used_bytes(root), disk(root))
    share = AUTOMATIC_SHARE * quota.most(disk(root))
    whole = _in_order(root, share, current, lambda s: not quota.waiting(s)) if excess > 0 else []
    for segment in whole:
        excess -= segment.bytes
        segment.delete()
        if excess <= 0:
            break
    images = _in_order(root, share, current, lambda s: s.images not in quota.waiting(s))
    excess -= _free_images(images, max(excess, quota.lacking(disk(root))))
    return max(excess, 0.0)


def _in_order(root: Path, share: float, current: Segment | None, may_go: Callable[[Segment], bool]) -> list[Segment]:
    """The segments that `may_go`, first those that go first; neither the current one nor those that a person marked.

    Args: share, bytes of the newest segments with automatic marks that go last.
    """
    first, last = list[Segment](), list[Segment]()
    for segment in (s for folder in reversed(recordings(root)) for s in reversed(segments(folder))):
        if segment == current or segment.marked_by_hand or not may_go(segment):
            continue
        share -= segment.bytes if segment.marked else 0
        (last if segment.marked and share >= 0 else first).append(segment)
    return [*reversed(first), *reversed(last)]


def _free_images(candidates: list[Segment], lacking: float) -> int:
    """Delete images in this order until so many bytes are free; returns the bytes that were deleted."""
    freed = 0
    for segment in candidates:
        if freed >= lacking:
            break
        if segment.images.exists():
            freed += segment.images.stat().st_size
            segment.images.unlink()
    return freed


def forget_images(root: Path, keep_s: float, segment_s: float, current: Segment | None) -> int:
    """Black box: delete images of unmarked segments older than the last `keep_s` seconds of recorded time.

    Time is counted in recorded seconds, newest first, so that setting the clock deletes nothing. The last segment of a
    recording counts as `segment_s` long.

    Returns:
        How many segments lost their images.
    """
    kept_s, count = 0.0, 0
    for folder in reversed(recordings(root)):
        following: int | None = None
        for segment in reversed(segments(folder)):
            length_s = segment_s if following is None else float(following - segment.second)
            following = segment.second
            if segment != current:
                if kept_s >= keep_s and not segment.marked and segment.images.exists():
                    segment.images.unlink(missing_ok=True)
                    count += 1
                kept_s += length_s
    return count
