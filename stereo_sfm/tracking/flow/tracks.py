"""Tracked points: one row each, with the patch of their first appearance."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from operator import attrgetter

import numpy as np

from stereo_sfm.tracking.flow.klt import Appearances
from stereo_sfm.tracking.flow.window_curvature import OFFSETS
from stereo_sfm.types import F64, I32, I64, Bool


@dataclass
class Tracks:
    """Columns of N points. A point is P = origin + direction / rho in the odometry frame.

    `right_offset` is how far from its epipolar curve a point's first stereo match was. An error of the rig or of a lens
    stays about the same while the point is tracked: the pose is solved from right pixels without it.
    """

    point_ids: I64 = field(default_factory=lambda: np.zeros(0, np.int64))
    uv: F64 = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) px in the last tracked frame
    uv_right: F64 = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) px, NaN where unseen
    origin: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    direction: F64 = field(default_factory=lambda: np.zeros((0, 3)))
    rho: F64 = field(default_factory=lambda: np.zeros(0))  # 1/m
    variance: F64 = field(default_factory=lambda: np.zeros(0))  # of rho
    age: I32 = field(default_factory=lambda: np.zeros(0, np.int32))  # frames tracked
    misses: I32 = field(default_factory=lambda: np.zeros(0, np.int32))  # successive frames as an outlier
    warp: F64 = field(default_factory=lambda: np.zeros((0, 2, 2)))  # deformation since the first appearance
    slot: I64 = field(default_factory=lambda: np.zeros(0, np.int64))  # row in the `Patches`
    moving: Bool = field(default_factory=lambda: np.zeros(0, bool))  # on something that moves: counts for nothing
    mapped: Bool = field(default_factory=lambda: np.zeros(0, bool))  # position given by the map
    right_offset: F64 = field(default_factory=lambda: np.zeros((0, 2)))  # (N, 2) px from the epipolar curve, see below
    disagreed: Bool = field(default_factory=lambda: np.zeros(0, bool))  # itself, since it is marked as moving

    def __len__(self) -> int:
        return len(self.point_ids)

    def right_on_curve(self) -> F64:
        """(N, 2) px in the right image, without the offset from the epipolar curve."""
        return self.uv_right - self.right_offset

    def points(self) -> F64:
        """(N, 3) metres, odometry frame."""
        return self.origin + self.direction / self.rho[:, None]

    def keep(self, mask: Bool) -> Tracks:
        """The rows where `mask` is True."""
        return self.take(np.flatnonzero(mask))  # once: numpy would look for them in each column, in four times the time

    def take(self, rows: I64) -> Tracks:
        """These rows."""
        return Tracks(*[column.take(rows, 0) for column in _columns(self)])

    def append(self, other: Tracks) -> Tracks:
        """These rows, then the other's."""
        return Tracks(*map(np.concatenate, zip(_columns(self), _columns(other), strict=True)))


_columns = attrgetter(*(f.name for f in fields(Tracks)))


class Patches:
    """First appearances of points, in reusable slots."""

    def __init__(self, capacity: int) -> None:
        self.windows = Appearances.empty(capacity)
        self.rays: F64 = np.zeros((capacity, len(OFFSETS), 3))  # around their centres, odometry axes
        self.origin: F64 = np.zeros((capacity, 3))  # of the camera, odometry frame
        self._free = np.ones(capacity, bool)

    def take(self, count: int) -> I64:
        """Free slots, lowest first."""
        slots = np.flatnonzero(self._free)[:count]
        self._free[slots] = False
        return slots

    def keep_only(self, slots: I64) -> None:
        """Free all other slots."""
        self._free[:] = True
        self._free[slots] = False
