"""What happens in a run, a line each, for people: on the screen (`run -v`) and in the viewer."""

from __future__ import annotations

import logging
from functools import singledispatchmethod

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.messages import LogLine
from stereo_sfm.types import F64, Dropped, Frame, LoopResult, MapUpdate, TrackState

log = logging.getLogger("stereo_sfm")

JUMP = (0.01, np.radians(0.1))  # metres, radians that the map moves against the odometry: less is not told
STATES = {
    TrackState.INITIALIZING: "no pose yet",
    TrackState.LOST: "lost",
    TrackState.INERTIAL: "going on by the IMU",
    TrackState.RECOVERED: "found again",
    TrackState.OCCLUDED: "view covered",
    TrackState.RESTARTED: "begins anew in another piece of the map",
}


class Events:
    """Puts the messages of one run into words; tells what changed, not what stays as it was."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._told = (TrackState.OK, "")
        self._map_T_odom: F64 = np.eye(4)
        self._rows_warned = False

    @singledispatchmethod
    def of(self, message: object) -> LogLine | None:
        """The line for one message of the run, None when there is nothing to say."""
        return None

    @of.register
    def _dropped(self, dropped: Dropped) -> LogLine | None:
        frames = "1 frame" if dropped.count == 1 else f"{dropped.count} frames"
        return LogLine(dropped.where, "WARNING", f"{frames} dropped at {dropped.frame_id}: {_words(dropped.why)}")

    @of.register
    def _frame(self, frame: Frame) -> LogLine | None:
        self._first_ns = frame.stamp_ns if self._first_ns is None else self._first_ns
        now = (frame.state, frame.reason)
        if now == self._told:
            return None
        self._told = now
        if frame.state == TrackState.OK and not frame.reason:
            return None
        said = STATES.get(frame.state, "")
        why = f" ({_words(frame.reason)})" if said and frame.reason else _words(frame.reason)
        level = "INFO" if frame.state in (TrackState.OK, TrackState.RECOVERED) else "WARNING"
        seconds = (frame.stamp_ns - self._first_ns) * 1e-9
        return LogLine("tracker", level, f"frame {frame.frame_id} at {seconds:.1f} s: {said}{why}")

    @of.register
    def _loop(self, result: LoopResult) -> LogLine | None:
        if result.candidate_kf_id >= 0:
            seen = f"keyframe {result.kf_id} sees keyframe {result.candidate_kf_id} again"
            return LogLine("loop", "INFO", f"{seen}, {result.inliers} inliers")
        if not result.rejected:
            return None
        refused = f"{len(result.rejected)} refused: {_words(result.reason)}"
        return LogLine("loop", "DEBUG", f"no loop at keyframe {result.kf_id}, {refused}")

    @of.register
    def _map_update(self, update: MapUpdate) -> LogLine | None:
        if len(update.refused_kf_ids):
            ids = ", ".join(str(k) for k in update.refused_kf_ids.tolist())
            return LogLine("mapper", "WARNING", f"the loop of keyframe {ids} contradicts the rest of the map: left out")
        if update.calibration is not None:
            said = "corrected" if update.calibration.applied else "seems wrong"
            where = f"at keyframe {update.kf_id} ({update.calibration.why})"
            return LogLine("mapper", "WARNING", f"rig {said} {where}: {update.calibration.text}")
        if update.row_errors is not None and update.row_errors.warning != self._rows_warned:
            self._rows_warned = update.row_errors.warning
            rows = f"{update.row_errors.systematic_px:.2f} px off their rows at keyframe {update.kf_id}"
            if self._rows_warned:
                return LogLine("mapper", "WARNING", f"matches are {rows}: the rig is not what its calibration says")
            return LogLine("mapper", "INFO", f"matches are {rows}: the rig fits again")
        moved = se3.log(se3.inverse(self._map_T_odom) @ update.map_T_odom)
        metres, radians = float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:]))
        if metres < JUMP[0] and radians < JUMP[1]:
            return None
        self._map_T_odom = update.map_T_odom
        said = f"map corrected by {metres:.3f} m, {np.degrees(radians):.2f} deg at keyframe {update.kf_id}"
        return LogLine("mapper", "INFO", said)


class EventLines:
    """A sink: events on the screen, where it is asked to say more."""

    def __init__(self) -> None:
        self._events = Events()

    def put(self, message: object) -> None:
        """Any message of a run."""
        line = self._events.of(message)
        if line is not None:
            log.info("%s: %s", line.stage, line.text)


def _words(reason: str) -> str:
    return reason.replace("_", " ")
