"""The papers' trackers as a plug-in (`tracking.protocol.TrackerPlugin`)."""

from __future__ import annotations

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.papers.motion_estimator import estimator
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.protocol import AnyTracker
from stereo_sfm.types import Trajectory


def make_tracker(
    config: Config, rig: Rig, spans: NoSpans | None = None, ground_truth: Trajectory | None = None
) -> AnyTracker:
    """Descriptors around the estimator that `config.odometry.method` names.

    Raises:
        StereoSfmError: an unknown method, or one that this camera cannot serve.
    """
    method = config.odometry.method
    if not rig.stereo and estimator(method).needs_depth:
        raise StereoSfmError(
            f"odometry {method} needs two cameras or depth, this source has one camera: use eight-point or pnp"
        )
    if not rig.stereo and method == "eight-point" and config.odometry.scale == "stereo":
        raise StereoSfmError(
            "one camera has no scale: choose --set odometry.scale=unit (steps of one metre) or ground-truth"
        )
    if method == "eight-point" and config.odometry.scale == "unit" and config.odometry.reference == "keyframe":
        raise StereoSfmError("steps of one metre are from image to image: choose --set odometry.reference=frame")
    if method == "pnp" and (config.odometry.monocular or not rig.stereo):
        from stereo_sfm.papers.monocular import MonocularTracker

        return MonocularTracker(config, rig, spans)
    from stereo_sfm.papers.feature_tracker import FeatureTracker

    return FeatureTracker(config, rig, spans, ground_truth)


def around(tracker: AnyTracker, config: Config, rig: Rig) -> AnyTracker:
    """Any tracker, with headings from the lines of walls and shelves (`config.manhattan`)."""
    from stereo_sfm.papers.manhattan_prior import ManhattanTracker

    return ManhattanTracker(tracker, config.manhattan, rig)
