"""The robot at rest: IMU, wheels and images all say that nothing moves; its pose is then held."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.types import F64

STILL_NS = 500_000_000  # over which nothing moves
SEEN = 1.5e-3, np.radians(0.06)  # m, rad that a pose from images may change in that time
HELD = 4e-3, np.radians(0.15)  # and how far it may be from the held one
MEAN = 30  # images whose mean is held


class Rest:
    """Holds the pose while the robot stands."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, F64]] = deque()
        self._held: F64 | None = None
        self._count = 0

    def settled(self, stamp_ns: int, odom_T_cam: F64, sensors_still: Callable[[], bool]) -> F64:
        """The pose (4, 4) of an image: the held one while nothing moves, else as the images say.

        `sensors_still`: asked only where the images say that nothing moves.
        """
        self._seen.append((stamp_ns, odom_T_cam))
        while len(self._seen) > 2 and self._seen[1][0] <= stamp_ns - STILL_NS:
            self._seen.popleft()
        held, (first_ns, first) = self._held, self._seen[0]
        if held is None:
            still = stamp_ns - first_ns >= STILL_NS and se3.within(first, odom_T_cam, *SEEN)
        else:
            still = se3.within(held, odom_T_cam, *HELD)
        if not still or not sensors_still():
            self._held, self._count = None, 0
            return odom_T_cam
        if held is None:
            held = self._held = odom_T_cam
        if self._count < MEAN:
            self._count += 1
            held = self._held = held @ se3.exp(se3.log(se3.inverse(held) @ odom_T_cam) / self._count)
        return held

    def forget(self) -> None:
        """The odometry begins anew."""
        self._seen.clear()
        self._held, self._count = None, 0
