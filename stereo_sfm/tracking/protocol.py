"""The protocol of trackers."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Protocol

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.timing import NoSpans
from stereo_sfm.types import F64, Frame, Keyframe, MapUpdate, StereoImage, Trajectory


class AnyTracker(Protocol):
    """One image in, one frame and perhaps a keyframe out; map updates when the schedule says so.

    `describe` completes the keyframe of the last step: the frame does not wait for its new points and descriptors.
    """

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]: ...

    def describe(self, keyframe: Keyframe) -> Keyframe: ...

    def apply(self, update: MapUpdate) -> None: ...


class TrackerPlugin(Protocol):
    """A module with trackers besides the default one."""

    def make_tracker(
        self, config: Config, rig: Rig, spans: NoSpans | None = None, ground_truth: Trajectory | None = None
    ) -> AnyTracker:
        """The tracker that `config.odometry.method` names.

        Raises:
            StereoSfmError: an unknown method, or one that this camera cannot serve.
        """
        ...

    def around(self, tracker: AnyTracker, config: Config, rig: Rig) -> AnyTracker:
        """A tracker that asks another one, and adds what it knows itself."""
        ...


class Places(Protocol):
    """Relocalization in recent keyframes after a loss of tracking."""

    def use(self, rig: Rig) -> None:
        """Use a corrected rig."""
        ...

    def add(self, keyframe: Keyframe) -> None:
        """Add the newest keyframe."""
        ...

    def find(self, keyframe: Keyframe, expected: F64) -> Iterator[F64]:
        """Hypotheses odom_T_cam (4, 4) of the keyframe's pose near an `expected` one (4, 4), most likely first."""
        ...
