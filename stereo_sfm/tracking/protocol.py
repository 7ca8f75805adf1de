"""What every tracker is."""

from __future__ import annotations

from typing import Protocol

from stereo_sfm.types import Frame, Keyframe, MapUpdate, StereoImage


class AnyTracker(Protocol):
    """One image in, one frame and perhaps a keyframe out; map updates when the schedule says so."""

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]: ...

    def apply(self, update: MapUpdate) -> None: ...
