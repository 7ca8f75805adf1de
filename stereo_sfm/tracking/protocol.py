"""What every tracker is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from stereo_sfm.types import F64, Frame, Keyframe, MapUpdate, StereoImage


class AnyTracker(Protocol):
    """One image in, one frame and perhaps a keyframe out; map updates when the schedule says so."""

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]: ...

    def apply(self, update: MapUpdate) -> None: ...


class Places(Protocol):
    """Finds a camera that lost its way in what it saw before."""

    def add(self, keyframe: Keyframe) -> None:
        """Remember the newest keyframe."""
        ...

    def find(self, seen: Keyframe, expected: F64) -> Iterator[F64]:
        """Poses odom_T_cam (4, 4) from which a camera expected at (4, 4) may see this; likely ones first."""
        ...
