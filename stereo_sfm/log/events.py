"""The events of a run as readable lines: on the screen (`run -v`) and in the viewer."""

from __future__ import annotations

import logging
from functools import singledispatchmethod

import numpy as np

from stereo_sfm.geometry import se3
from stereo_sfm.messages import LogLine
from stereo_sfm.types import F64, Dropped, Frame, LoopResult, MapUpdate, TrackState

log = logging.getLogger("stereo_sfm")

JUMP = (0.01, np.radians(0.1))  # metres, radians: smaller corrections of the map are not reported
STATES = {
    TrackState.INITIALIZING: "no pose yet",
    TrackState.LOST: "lost",
    TrackState.INERTIAL: "pose from IMU or wheels alone",
    TrackState.RECOVERED: "tracking recovered",
    TrackState.OCCLUDED: "view covered",
    TrackState.RESTARTED: "tracking restarted in a new submap",
}


class Events:
    """Describes the messages of one run; only changes are reported."""

    def __init__(self) -> None:
        self._first_ns: int | None = None
        self._last = (TrackState.OK, "")
        self._map_T_odom: F64 = np.eye(4)
        self._rows_warned = False

    @singledispatchmethod
    def of(self, message: object) -> LogLine | None:
        """The line for one message of the run, or None."""
        return None

    @of.register
    def _dropped(self, dropped: Dropped) -> LogLine | None:
        frames = "1 frame" if dropped.count == 1 else f"{dropped.count} frames"
        return LogLine(dropped.where, "WARNING", f"{frames} dropped at {dropped.frame_id}: {_words(dropped.why)}")

    @of.register
    def _frame(self, frame: Frame) -> LogLine | None:
        self._first_ns = frame.stamp_ns if self._first_ns is None else self._first_ns
        now = (frame.state, frame.reason)
        if now == self._last:
            return None
        self._last = now
        if frame.state == TrackState.OK and not frame.reason:
            return None
        text = STATES.get(frame.state, "")
        why = f" ({_words(frame.reason)})" if text and frame.reason else _words(frame.reason)
        level = "INFO" if frame.state in (TrackState.OK, TrackState.RECOVERED) else "WARNING"
        seconds = (frame.stamp_ns - self._first_ns) * 1e-9
        return LogLine("tracker", level, f"frame {frame.frame_id} at {seconds:.1f} s: {text}{why}")

    @of.register
    def _loop(self, result: LoopResult) -> LogLine | None:
        if result.candidate_kf_id >= 0:
            seen = f"keyframe {result.kf_id} sees keyframe {result.candidate_kf_id} again"
            return LogLine("loop", "INFO", f"{seen}, {result.inliers} inliers")
        if result.failed:
            what = f"the loop closer failed at keyframe {result.kf_id} ({result.reason}) and started again"
            return LogLine("loop", "WARNING", what)
        if not result.rejected:
            return None
        refused = f"{len(result.rejected)} rejected: {_words(result.reason)}"
        return LogLine("loop", "DEBUG", f"no loop at keyframe {result.kf_id}, {refused}")

    @of.register
    def _map_update(self, update: MapUpdate) -> LogLine | None:
        if len(update.refused_kf_ids):
            ids = ", ".join(str(k) for k in update.refused_kf_ids.tolist())
            return LogLine("mapper", "WARNING", f"the loop of keyframe {ids} contradicts the rest of the map: rejected")
        if update.calibration is not None:
            verdict = "corrected" if update.calibration.applied else "seems wrong"
            where = f"at keyframe {update.kf_id} ({update.calibration.why})"
            return LogLine("mapper", "WARNING", f"calibration {verdict} {where}: {update.calibration.text}")
        if update.sensors is not None:
            return LogLine("mapper", "INFO", f"calibration at keyframe {update.kf_id}: {update.sensors.text}")
        if update.row_errors is not None and update.row_errors.warning != self._rows_warned:
            self._rows_warned = update.row_errors.warning
            rows = f"{update.row_errors.systematic_px:.2f} px off the epipolar curves at keyframe {update.kf_id}"
            if self._rows_warned:
                return LogLine("mapper", "WARNING", f"matches are {rows}: the calibration no longer fits")
            return LogLine("mapper", "INFO", f"matches are {rows}: the calibration fits again")
        moved = se3.log(se3.inverse(self._map_T_odom) @ update.map_T_odom)
        metres, radians = float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:]))
        if metres < JUMP[0] and radians < JUMP[1]:
            return None
        self._map_T_odom = update.map_T_odom
        text = f"map corrected by {metres:.3f} m, {np.degrees(radians):.2f} deg at keyframe {update.kf_id}"
        return LogLine("mapper", "INFO", text)


class EventLines:
    """A sink that prints the events of a run."""

    def __init__(self) -> None:
        self._events = Events()

    def put(self, message: object) -> None:
        """Take any message of a run."""
        line = self._events.of(message)
        if line is not None:
            log.info("%s: %s", line.stage, line.text)


def _words(reason: str) -> str:
    return reason.replace("_", " ")
