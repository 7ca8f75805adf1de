"""A loss of tracking: for how long there has been no pose, and when tracking begins anew instead of waiting."""

from __future__ import annotations

OCCLUDED_SHARE = 0.1  # of the time that the view is covered: counts as time with an open view


class Loss:
    """One `add` per image without a pose, one `end` per image with one."""

    def __init__(self, longest_s: float) -> None:
        """`longest_s`: with an open view but no pose, after which tracking begins anew."""
        self._longest_s = longest_s
        self.frames = 0  # successive ones without a pose
        self._last_ns = 0  # the last of them
        self._unobstructed_s = 0.0  # for which the view has been unobstructed without a pose
        self._occluded_s = 0.0  # and covered
        self._begun_ns = 0  # the first image of this submap, if nothing was lost just before
        self._again = False  # tracking began anew because its second image was lost

    def end(self) -> None:
        """An image has a pose."""
        self.frames, self._unobstructed_s, self._occluded_s = 0, 0.0, 0.0

    def followed(self) -> None:
        """That image's points were followed from another one."""
        self._again = False

    def begin(self, stamp_ns: int) -> None:
        """A submap begins at a time: a loss of its second image is nothing to wait for, but once only."""
        self._begun_ns = -1 if self._again else stamp_ns

    def add(self, stamp_ns: int, pose_ns: int, seen: bool, unobstructed: bool) -> bool:
        """An image without a pose; whether tracking begins anew.

        Args:
            pose_ns: time of the last pose. seen: whether the image counts, which a dark one does not that is bridged.
            unobstructed: whether the view is.
        """
        self.frames += 1
        if seen:
            unseen = (stamp_ns - pose_ns) * 1e-9 if self.frames == 1 else 0.0  # without any image
            seconds = (stamp_ns - self._last_ns) * 1e-9 if self.frames > 1 else 0.0
            self._unobstructed_s = self._unobstructed_s + seconds if unobstructed else 0.0
            self._occluded_s += unseen if unobstructed else seconds + unseen
        self._last_ns = stamp_ns
        second = pose_ns == self._begun_ns
        self._again |= second
        return second or max(self._unobstructed_s, OCCLUDED_SHARE * self._occluded_s) > self._longest_s
