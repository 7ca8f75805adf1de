"""Which tracker a configuration asks for: the default one by flow, or descriptors around a named estimator."""

from __future__ import annotations

from typing import Protocol

from calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.timing import NoSpans
from stereo_sfm.types import Frame, Keyframe, MapUpdate, StereoImage, Trajectory

# methods that turn 3D points of the current frame into motion: they need a second eye or depth
NEEDS_DEPTH = ("em-r", "vp-r", "r-um", "um")


class AnyTracker(Protocol):
    """What every tracker is: one image in, one frame and perhaps a keyframe out."""

    def step(self, image: StereoImage) -> tuple[Frame, Keyframe | None]: ...

    def apply(self, update: MapUpdate) -> None: ...


def make_tracker(
    config: Config, rig: Rig, spans: NoSpans | None = None, ground_truth: Trajectory | None = None
) -> AnyTracker:
    """The tracker that `config.odometry.method` names.

    Args:
        ground_truth: only for `odometry.scale = "ground-truth"`, where the true length of each step is taken from it.

    Raises:
        StereoSfmError: an unknown method, or one that this camera cannot serve.
    """
    method = config.odometry.method
    if method == "flow":
        from stereo_sfm.tracking.tracker import Tracker

        return Tracker(config.tracker, rig, spans or NoSpans())
    if not rig.stereo and method in NEEDS_DEPTH:
        raise StereoSfmError(
            f"odometry {method} needs two eyes or depth, this camera has one eye: use eight-point or pnp"
        )
    if method == "pnp" and (config.odometry.monocular or not rig.stereo):
        from stereo_sfm.tracking.monocular import MonocularTracker

        return MonocularTracker(config, rig, spans)
    from stereo_sfm.tracking.feature_tracker import FeatureTracker

    return FeatureTracker(config, rig, spans, ground_truth)
