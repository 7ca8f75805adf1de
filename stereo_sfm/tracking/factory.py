"""The tracker of a configuration: the default one by optical flow, or descriptors around a named estimator."""

from __future__ import annotations

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.protocol import AnyTracker, Places
from stereo_sfm.types import Trajectory

__all__ = ["AnyTracker", "make_tracker"]


def make_tracker(
    config: Config,
    rig: Rig,
    spans: NoSpans | None = None,
    ground_truth: Trajectory | None = None,
    places: Places | None = None,
) -> AnyTracker:
    """The tracker that `config.odometry.method` names.

    Args:
        ground_truth: only for `odometry.scale = "ground-truth"`, where the true length of each step is taken from it.
        places: where the default tracker searches a camera that is lost.

    Raises:
        StereoSfmError: an unknown method, or one that this camera cannot serve.
    """
    tracker = _tracker(config, rig, spans, ground_truth, places)
    if not config.manhattan.enabled:
        return tracker
    from stereo_sfm.tracking.manhattan_prior import ManhattanTracker

    return ManhattanTracker(tracker, config.manhattan, rig)


def _tracker(
    config: Config, rig: Rig, spans: NoSpans | None, ground_truth: Trajectory | None, places: Places | None
) -> AnyTracker:
    method = config.odometry.method
    if method == "flow":
        from stereo_sfm.tracking.flow.place_corners import PlaceCorners
        from stereo_sfm.tracking.flow.side_views import SideViews
        from stereo_sfm.tracking.flow.sudden_turn import SuddenTurns
        from stereo_sfm.tracking.flow.tracker import Tracker

        corners, sides = PlaceCorners.wanted(config, rig), SideViews.wanted(config, rig)
        return Tracker(config.tracker, rig, spans, corners, places, sides, SuddenTurns.wanted(config, rig))
    from stereo_sfm.tracking.features.estimators import estimator

    if not rig.stereo and estimator(method).needs_depth:
        raise StereoSfmError(
            f"odometry {method} needs two cameras or depth, this source has one camera: use eight-point or pnp"
        )
    if not rig.stereo and method == "eight-point" and config.odometry.scale == "stereo":
        raise StereoSfmError(
            "one camera has no scale: choose --set odometry.scale=unit (steps of one metre) or ground-truth"
        )
    if method == "pnp" and (config.odometry.monocular or not rig.stereo):
        from stereo_sfm.tracking.features.monocular import MonocularTracker

        return MonocularTracker(config, rig, spans)
    from stereo_sfm.tracking.features.feature_tracker import FeatureTracker

    return FeatureTracker(config, rig, spans, ground_truth)
