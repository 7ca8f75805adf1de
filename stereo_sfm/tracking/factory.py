"""The tracker of a configuration: the default one by optical flow, or one of a plug-in."""

from __future__ import annotations

import importlib

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.timing import NoSpans
from stereo_sfm.tracking.protocol import AnyTracker, Places, TrackerPlugin
from stereo_sfm.types import Trajectory

__all__ = ["AnyTracker", "make_tracker"]

PAPERS = "stereo_sfm.papers.trackers"  # a `TrackerPlugin`: the core knows its name only


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
    if config.odometry.method != "flow":
        tracker = _papers().make_tracker(config, rig, spans, ground_truth)
    else:
        from stereo_sfm.tracking.flow.place_corners import PlaceCorners
        from stereo_sfm.tracking.flow.readout import ReadoutSearch
        from stereo_sfm.tracking.flow.side_views import SideViews
        from stereo_sfm.tracking.flow.sudden_turn import SuddenTurns
        from stereo_sfm.tracking.flow.tracker import Tracker

        corners, sides = PlaceCorners.from_config(config, rig), SideViews.from_config(config, rig)
        sudden, readout = SuddenTurns.from_config(config, rig), ReadoutSearch.from_config(config, rig)
        tracker = Tracker(config.tracker, rig, spans, corners, places, sides, sudden, readout)
    return _papers().around(tracker, config, rig) if config.manhattan.enabled else tracker


def _papers() -> TrackerPlugin:
    found: TrackerPlugin = importlib.import_module(PAPERS)  # pyright: ignore[reportAssignmentType]
    return found
