"""Frames and map updates of a run as pose updates: the body's pose in both frames, its velocity, and when that was."""

from __future__ import annotations

import time
from collections import deque

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.messages import Localized
from stereo_sfm.service.messages import PoseUpdate
from stereo_sfm.types import F64, Frame, MapUpdate, TrackState

TRACKED = (TrackState.OK, TrackState.RECOVERED, TrackState.RESTARTED)
KEPT_VERSIONS = 256  # of the map, which frames may still refer to
WINDOW = 300  # images over which the delay from exposure to this computer is estimated
BUFFERED_NS = 500_000_000  # most that a camera and its driver hold back: older, and the stamps do not run with time
STALLED_NS = 3_000_000_000  # most that a busy computer holds them up: later, and the stamps were set


class HostClock:
    """The sensor's clock against this computer's clocks, from when images arrived.

    The offset is that of the image with the shortest delay among the newest ones. A step of the wall clock changes only
    the wall clock times computed after it. Where an image would be older than a camera can hold it back, its source
    does not keep the rate of its stamps, and the estimate begins anew. Not so after a stall: the images that have
    waited come later all at once, and none of them much later than the first. A source that is not live has no clock
    that runs with this computer's: where it is slower than its stamps say, each image is as old as its arrival.
    """

    def __init__(self) -> None:
        self.live = True
        self._offsets: deque[int] = deque(maxlen=WINDOW)  # monotonic clock minus stamp
        self._captured: dict[int, float] = {}
        self._late, self._oldest = False, BUFFERED_NS  # the newest image was held up; most that a delay may grow

    def image(self, frame_id: int, stamp_ns: int, captured_s: float) -> None:
        """An image was handed over by its driver at a time of the monotonic clock."""
        if not self.live:
            self._offsets.clear()
        offset = int(captured_s * 1e9) - stamp_ns
        if self._offsets and self._too_old(offset):
            self._offsets.clear()
            self._oldest = BUFFERED_NS
        self._offsets.append(offset)
        self._captured[frame_id] = captured_s
        if len(self._captured) > WINDOW:
            del self._captured[next(iter(self._captured))]

    def _too_old(self, offset: int) -> bool:
        age, late = offset - min(self._offsets), BUFFERED_NS // 2 < offset - self._offsets[-1] < STALLED_NS
        if age <= BUFFERED_NS:
            self._oldest = BUFFERED_NS
        elif late and not self._late:  # twice in a row, and the source is slow
            self._oldest = age + BUFFERED_NS // 2
        self._late = late
        return age > self._oldest

    def captured_s(self, frame_id: int) -> float:
        """When an image arrived; now where that is not known."""
        return self._captured.get(frame_id, time.monotonic())

    def unix_ns(self, stamp_ns: int) -> int:
        """A stamp as Unix time."""
        offset = min(self._offsets, default=time.monotonic_ns() - stamp_ns)
        return stamp_ns + offset + time.time_ns() - time.monotonic_ns()


class PoseConverter:
    """The poses of one session."""

    def __init__(self, rig: Rig, session: int, clock: HostClock) -> None:
        self._left_T_body, self._adjoint = np.eye(4), np.eye(6)
        self._session, self._clock = session, clock
        self._map_frames: dict[int, tuple[F64, F64]] = {0: (np.eye(4), np.zeros(3))}  # map_T_odom, gravity in the map
        self._localized_from: int | None = None
        self._before: tuple[int, F64, F64] | None = None  # stamp, odom_T_body, covariance in body axes
        self.mount(rig)

    def mount(self, rig: Rig) -> None:
        """Where the camera is on the body, from the next frame on."""
        self._left_T_body = se3.inverse(rig.body_T_left)
        self._adjoint = se3.adjoint(rig.body_T_left)
        self._before = None

    def localized(self, message: Localized) -> None:
        """The saved map was found."""
        self._localized_from = message.version

    def update(self, update: MapUpdate) -> None:
        """A version of the map."""
        self._map_frames[update.version] = update.map_T_odom, update.down
        if len(self._map_frames) > KEPT_VERSIONS:
            del self._map_frames[next(iter(self._map_frames))]

    def frame(self, frame: Frame) -> PoseUpdate:
        """The pose at a frame, in the map as the frame knew it."""
        version = self._known(frame.map_version)
        map_T_odom, down = self._map_frames[version]
        odom_T_body = frame.odom_T_cam @ self._left_T_body
        in_body = self._adjoint @ frame.covariance @ self._adjoint.T
        tracked = frame.state in TRACKED
        twist, twist_covariance = self._twist(frame.stamp_ns, odom_T_body, in_body, tracked)
        turn = np.kron(np.eye(2), odom_T_body[:3, :3])
        return PoseUpdate(
            frame_id=frame.frame_id,
            stamp_ns=frame.stamp_ns,
            unix_ns=self._clock.unix_ns(frame.stamp_ns),
            captured_s=self._clock.captured_s(frame.frame_id),
            state=frame.state.name,
            reason=frame.reason,
            map_T_odom=map_T_odom.copy(),
            odom_T_body=odom_T_body,
            covariance=turn @ in_body @ turn.T,
            twist=twist,
            twist_covariance=twist_covariance,
            map_version=version,
            session=self._session,
            localized=self._localized_from is not None and version >= self._localized_from,
            tracked=tracked,
            down=down.copy(),
        )

    def _known(self, version: int) -> int:
        """The newest known version that is not newer than this one."""
        if version in self._map_frames:
            return version
        return max((v for v in self._map_frames if v <= version), default=next(iter(self._map_frames)))

    def _twist(self, stamp_ns: int, odom_T_body: F64, covariance: F64, tracked: bool) -> tuple[F64, F64]:
        """Mean velocity since the frame before, body axes, with its covariance; NaN where either has no pose."""
        before, self._before = self._before, (stamp_ns, odom_T_body, covariance) if tracked else None
        if before is None or not tracked or stamp_ns <= before[0]:
            return np.full(6, np.nan), np.full((6, 6), np.nan)
        seconds = (stamp_ns - before[0]) * 1e-9
        return se3.log(se3.inverse(before[1]) @ odom_T_body) / seconds, (before[2] + covariance) / seconds**2
