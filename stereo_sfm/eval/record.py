"""The data of a run for its output folder: a few numbers per frame, keyframes, loops, times. A sink."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
from dataclasses import dataclass, field
from functools import singledispatchmethod

import numpy as np
import scipy.sparse
from scipy.sparse.csgraph import connected_components

from stereo_sfm.config import Config
from stereo_sfm.eval.frame_table import FrameTable, TimeTable
from stereo_sfm.eval.smoothing import smooth_bridges
from stereo_sfm.export.trajectories import fill_missing
from stereo_sfm.geometry import se3
from stereo_sfm.mapping.keyframe_poses import KeyframePoses
from stereo_sfm.maps.mounting import MountingEstimate
from stereo_sfm.messages import Health, LogEnded, LogLine, SourceCounters, StageTimes
from stereo_sfm.recording.describe import GAP
from stereo_sfm.types import (
    F64,
    I64,
    Bool,
    CalibrationUpdate,
    Dropped,
    Frame,
    Keyframe,
    LoopResult,
    MapUpdate,
    RowErrors,
    SensorUpdate,
    StartCheck,
    TrackState,
    Trajectory,
)

SLOWEST = 1e-3  # m/s: a way's length grows by that at rest


@dataclass(slots=True)
class KeyframeRow:
    """One keyframe."""

    frame_id: int
    stamp_ns: int
    odom_T_cam: F64
    path_m: float  # odometry path up to here
    submap_id: int  # of the uninterrupted odometry


@dataclass(frozen=True, slots=True)
class Closure:
    """One accepted loop, without the points that it matched."""

    kf_id: int
    candidate_kf_id: int
    candidate_T_kf: F64


@dataclass(frozen=True)
class LostInterval:
    """Frames in a row without a pose of their own."""

    first_frame_id: int
    frames: int
    seconds: float
    reason: str
    begin_s: float  # since the first frame


@dataclass(frozen=True)
class StampGap:
    """Between two successive frames of a run, where images are missing."""

    begin_s: float  # the frame before, since the first one
    seconds: float
    missing: int  # images, estimated from the usual interval


@dataclass
class RunRecord:
    """Collects the messages of one run."""

    localize_only: bool = False  # a saved map gives the pose of every submap
    followed: bool = True  # points are tracked from frame to frame: errors grow slowly from keyframe to keyframe
    frames: FrameTable = field(default_factory=FrameTable)
    keyframes: dict[int, KeyframeRow] = field(default_factory=dict[int, KeyframeRow])
    stage_ms: TimeTable = field(default_factory=TimeTable)
    health: dict[str, Health] = field(
        default_factory=dict[str, Health]
    )  # by stage: the last word, but the worst p99 and queue
    drops: dict[str, int] = field(default_factory=dict[str, int])  # images by where they were dropped
    log_ended: str = ""  # why the log is not complete
    source_counts: dict[str, float] = field(default_factory=dict[str, float])  # of a live camera, at the end
    map_T_kf: KeyframePoses = field(default_factory=KeyframePoses)
    map_points: set[int] = field(default_factory=set[int])
    seen_points: Bool = field(default_factory=lambda: np.zeros(1024, bool))  # by id: whether a keyframe had it
    closed: list[Closure] = field(default_factory=list[Closure])  # accepted by the loop closer
    failed_kf_ids: list[int] = field(default_factory=list[int])  # at which the loop closer failed
    refused_kf_ids: set[int] = field(default_factory=set[int])  # of loops that the mapper rejected
    warnings: dict[str, None] = field(default_factory=dict[str, None])  # lines of all stages, mostly of the source
    start_check: StartCheck | None = None  # what the first images said about the calibration; None: they fit
    row_errors: RowErrors | None = None  # the last
    row_error_px: list[tuple[int, float]] = field(default_factory=list[tuple[int, float]])  # stamp_ns, systematic
    calibrations: list[CalibrationUpdate] = field(default_factory=list[CalibrationUpdate])  # changes of the rig
    calibrates_sensors: bool = False  # asked for
    sensor_updates: list[SensorUpdate] = field(default_factory=list[SensorUpdate])  # of IMU and wheels
    down: F64 = field(default_factory=lambda: np.zeros(3))  # gravity's direction in the map, zero: unknown
    down_information: float = 0.0  # 1/rad^2, summed over the keyframes
    sensor_use: dict[str, int] = field(default_factory=dict[str, int])  # by sensor, the last: a `SensorUse`
    news: list[tuple[int, str]] = field(default_factory=list[tuple[int, str]])  # stamp_ns, what sensors do
    rejections: dict[str, int] = field(default_factory=dict[str, int])
    located_kf_id: int = -1  # first keyframe that was found in the saved map
    mounting: MountingEstimate = field(default_factory=MountingEstimate)  # the camera's tilt, if it is on a robot
    _path_m: float = 0.0

    @staticmethod
    def of(config: Config, localize_only: bool = False) -> RunRecord:
        """For a run with this configuration."""
        flow = config.odometry.method == "flow"
        return RunRecord(localize_only, followed=flow, calibrates_sensors=config.tracker.calibrate_sensors)

    def put(self, message: object) -> None:
        """Take one message of the run."""
        self._take(message)

    @singledispatchmethod
    def _take(self, message: object) -> None:
        """Kinds without a method below are not kept."""

    @_take.register
    def _put_dropped(self, dropped: Dropped) -> None:
        self.drops[dropped.where] = self.drops.get(dropped.where, 0) + dropped.count

    @_take.register
    def _put_line(self, line: LogLine) -> None:
        if line.level == "WARNING":
            self.warnings[line.text] = None

    @_take.register
    def _put_start_check(self, check: StartCheck) -> None:
        self.start_check = check

    @_take.register
    def _put_log_ended(self, ended: LogEnded) -> None:
        self.log_ended = ended.why

    @_take.register
    def _put_keyframe(self, keyframe: Keyframe) -> None:
        self.keyframes[keyframe.kf_id] = KeyframeRow(
            keyframe.frame_id, keyframe.stamp_ns, keyframe.odom_T_cam, self._path_m, keyframe.submap_id
        )
        self.down_information += keyframe.down_sigma**-2 if keyframe.down_sigma > 0 else 0.0
        self._see(keyframe.point_ids)
        self.mounting.add(keyframe)

    @_take.register
    def _put_stage_times(self, times: StageTimes) -> None:
        self.stage_ms.add(times.frame_id, times.ms)

    @_take.register
    def _put_counters(self, counters: SourceCounters) -> None:
        self.source_counts = counters.counts

    @_take.register
    def _put_frame(self, frame: Frame) -> None:
        if len(self.frames):
            step = frame.odom_T_cam[:3, 3] - self.frames.last("odom")[:, 3]
            self._path_m += float(np.linalg.norm(step))
        self.frames.add(frame)
        self.sensor_use |= {name: int(frame.stats[name]) for name in ("imu", "wheels") if name in frame.stats}
        if frame.reason and frame.state in (TrackState.OK, TrackState.RECOVERED):
            self.news.append((frame.stamp_ns, frame.reason))

    def _see(self, point_ids: I64) -> None:
        last = int(point_ids.max(initial=0))
        if last >= len(self.seen_points):
            more = np.zeros(max(last + 1, 2 * len(self.seen_points)) - len(self.seen_points), bool)
            self.seen_points = np.concatenate([self.seen_points, more])
        self.seen_points[point_ids] = True

    @_take.register
    def _put_health(self, health: Health) -> None:
        before = self.health.get(health.stage, health)
        p99, queue = max(before.p99_ms, health.p99_ms), max(before.queue, health.queue)
        self.health[health.stage] = dataclasses.replace(health, p99_ms=p99, queue=queue)

    @_take.register
    def _put_update(self, update: MapUpdate) -> None:
        self.map_T_kf.update(update)
        if self.located_kf_id < 0 and len(update.kf_ids):
            self.located_kf_id = update.kf_id
        if update.calibration is not None:
            self.calibrations.append(update.calibration)
        if update.sensors is not None:
            self.sensor_updates.append(update.sensors)
        if update.row_errors is not None:
            self.row_errors = update.row_errors
            self.row_error_px.append((update.row_errors.stamp_ns, update.row_errors.systematic_px))
        if update.down.any():
            self.down = update.down
        self.refused_kf_ids.update(update.refused_kf_ids.tolist())
        self.map_points.update(update.point_ids.tolist())
        self.map_points.difference_update(update.culled_point_ids.tolist(), update.fused_point_ids[:, 0].tolist())

    @_take.register
    def _put_loop(self, loop: LoopResult) -> None:
        if loop.candidate_kf_id >= 0 and not loop.reason:
            self.closed.append(Closure(loop.kf_id, loop.candidate_kf_id, loop.candidate_T_kf))
        if loop.failed:
            self.failed_kf_ids.append(loop.kf_id)
        for _, _, reason in loop.rejected:
            self.rejections[reason] = self.rejections.get(reason, 0) + 1

    @property
    def loops(self) -> list[Closure]:
        """Accepted loops that the map holds."""
        return [x for x in self.closed if x.kf_id not in self.refused_kf_ids]

    @property
    def rejected(self) -> dict[str, int]:
        """How many candidates were rejected, by reason."""
        refused = {"against_the_map": len(self.refused_kf_ids)} if self.refused_kf_ids else {}
        return self.rejections | refused

    def times(self) -> dict[str, F64]:
        """(frames,) milliseconds by stage, NaN where a stage did not run."""
        return self.stage_ms.of_frames(self.frames.frame_id)

    # -- results ---------------------------------------------------------------------------------------------

    def tracked(self) -> Bool:
        """(frames,) whether the frame has a pose of its own."""
        return self.frames.tracked

    def odometry(self) -> Trajectory:
        """odom_T_cam of the tracked frames."""
        tracked = self.tracked()
        return Trajectory(self.frames.stamp_ns[tracked], self.frames.odom_T_cam[tracked])

    def mapped(self) -> Trajectory | None:
        """map_T_cam after the last map update of the frames that have a place in the map; None without any.

        A frame moves with its reference keyframe. Where points are tracked from frame to frame, the next
        keyframe contributes too, the more the nearer it is: the map has moved both since the frame was tracked, by
        different amounts. Near means a short path by odometry, whose errors grow with the path, not with time.
        """
        if not len(self.map_T_kf):
            return None
        known, following = self.map_T_kf.all(), self._following() if self.followed else dict[int, int]()
        odom_T_cam, kf_T_cam = self._smoothed()
        rows = np.flatnonzero(self.placed())
        reference = self.frames.reference_kf_id[rows].tolist()
        stamps = self.frames.stamp_ns[rows]
        poses = np.array([known[kf_id] for kf_id in reference]).reshape(-1, 4, 4) @ kf_T_cam[rows]
        between = [k for k, kf_id in enumerate(reference) if kf_id in following]
        if between:
            begin = [self.keyframes[reference[k]].stamp_ns for k in between]
            ends = [following[reference[k]] for k in between]
            end = np.array([self.keyframes[kf_id].stamp_ns for kf_id in ends])
            odom_T_end = np.array([self.keyframes[kf_id].odom_T_cam for kf_id in ends])
            end_T_cam = se3.inverse(odom_T_end) @ odom_T_cam[rows[between]]
            behind = _way(kf_T_cam[rows[between]], stamps[between] - begin)
            share = behind / (behind + _way(end_T_cam, end - stamps[between]))
            there = np.array([known[kf_id] for kf_id in ends]) @ end_T_cam
            poses[between] = se3.interpolate(poses[between], there, share)
        return Trajectory(stamps, poses)

    def _smoothed(self) -> tuple[F64, F64]:
        """(frames, 4, 4) odom_T_cam and kf_T_cam, poses from the IMU adjusted to the good ones around."""
        odom_T_cam, kf_T_cam = self.frames.odom_T_cam, self.frames.kf_T_cam
        inertial = self.frames.state == TrackState.INERTIAL
        if not inertial.any():
            return odom_T_cam, kf_T_cam
        rows = np.flatnonzero(self.tracked())
        odom_T_cam = odom_T_cam.copy()
        odom_T_cam[rows] = smooth_bridges(self.frames.stamp_ns[rows], odom_T_cam[rows], inertial[rows])
        return odom_T_cam, kf_T_cam @ se3.inverse(self.frames.odom_T_cam) @ odom_T_cam

    def _following(self) -> dict[int, int]:
        """The next keyframe in the same submap, by id, for those in the map."""
        known = self.map_T_kf.all()
        pairs = itertools.pairwise(k for k in sorted(self.keyframes) if k in known)
        return {a: b for a, b in pairs if self.keyframes[a].submap_id == self.keyframes[b].submap_id}

    def placed(self) -> Bool:
        """(frames,) whether the frame has a pose in the map: all tracked ones, unless not found in a saved map."""
        known = np.array([*self.map_T_kf.all()], np.int64)
        return self.tracked() & np.isin(self.frames.reference_kf_id, known)

    def keyframe_trajectory(self) -> Trajectory:
        """The trajectory of the keyframes, in the map if there is one."""
        rows, known = sorted(self.keyframes.items()), self.map_T_kf.all()
        poses = [known.get(kf_id, row.odom_T_cam) for kf_id, row in rows]
        stamps = np.array([row.stamp_ns for _, row in rows], np.int64)
        return Trajectory(stamps, np.array(poses).reshape(-1, 4, 4))

    def pose_per_frame(self, poses: F64, kept: Bool, step: int = 1) -> F64:
        """One pose for each frame id of the run: lost ones are interpolated.

        Args:
            poses: (M, 4, 4) of the frames that `kept` (frames,) marks.
            step: frame ids that follow each other.

        Returns:
            (M, 4, 4). Frames before the first pose take that one, those after the last take the last.
        """
        ids = self.frames.frame_id
        known = ids[kept]
        if not len(known):
            return poses
        filled = fill_missing(known, poses, step)
        before, after = (known[0] - ids[0]) // step, (ids[-1] - known[-1]) // step
        return np.concatenate([np.repeat(filled[:1], before, 0), filled, np.repeat(filled[-1:], after, 0)])

    def lost_intervals(self) -> list[LostInterval]:
        """Runs of frames without a pose after the first one that had one."""
        tracked = self.tracked()
        if not tracked.any():
            return []
        lost = ~tracked
        lost[: int(np.argmax(tracked))] = False
        edges = np.diff(np.concatenate([[0], lost.astype(np.int8), [0]]))
        return [
            self._interval(begin, end)
            for begin, end in zip(np.flatnonzero(edges > 0).tolist(), np.flatnonzero(edges < 0).tolist(), strict=True)
        ]

    def _interval(self, begin: int, end: int) -> LostInterval:
        stamps = self.frames.stamp_ns
        seconds = float(stamps[min(end, len(stamps) - 1)] - stamps[begin]) / 1e9
        reason = self.frames.reasons_of(np.array([begin]))[0]
        begin_s = float(stamps[begin] - stamps[0]) / 1e9
        return LostInterval(int(self.frames.frame_id[begin]), end - begin, seconds, reason, begin_s)

    def stamp_gaps(self) -> list[StampGap]:
        """Where images are missing: intervals longer than `GAP` usual ones."""
        stamps = self.frames.stamp_ns
        steps = np.diff(stamps)
        usual = max(float(np.median(steps)), 1.0) if len(steps) else 1.0
        return [
            StampGap(float(stamps[k] - stamps[0]) / 1e9, float(steps[k]) / 1e9, max(round(steps[k] / usual) - 1, 1))
            for k in np.flatnonzero(steps > GAP * usual).tolist()
        ]

    def located_after_s(self) -> float | None:
        """Seconds from the first frame to the first keyframe that was found in the saved map; None if none was."""
        keyframe = self.keyframes.get(self.located_kf_id)
        return None if keyframe is None else float(keyframe.stamp_ns - self.frames.stamp_ns[0]) / 1e9

    def unconnected_submaps(self) -> int:
        """Number of parts of the map that no loop connects, because tracking restarted after it was lost. Their
        relative poses are only predicted.
        """
        submaps = sorted({row.submap_id for row in self.keyframes.values()})
        if self.localize_only or len(submaps) < 2:
            return min(len(submaps), 1)
        at = {submap: k for k, submap in enumerate(submaps)}
        joined = [tuple(at[self.keyframes[k].submap_id] for k in (x.candidate_kf_id, x.kf_id)) for x in self.loops]
        i, j = np.array(joined, np.int64).reshape(-1, 2).T
        graph = scipy.sparse.coo_array((np.ones(len(i)), (i, j)), shape=(len(at), len(at)))
        return int(connected_components(graph, directed=False)[0])

    def closure_drifts(self) -> list[float]:
        """For each loop without a loss of tracking: error of the odometry as a share of the path between both ends."""
        drifts: list[float] = []
        for loop in self.loops:
            old, new = self.keyframes[loop.candidate_kf_id], self.keyframes[loop.kf_id]
            if old.submap_id != new.submap_id:
                continue
            odometry = se3.inverse(old.odom_T_cam) @ new.odom_T_cam
            error = se3.inverse(loop.candidate_T_kf) @ odometry
            drifts.append(float(np.linalg.norm(error[:3, 3])) / max(new.path_m - old.path_m, 1e-9))
        return drifts

    def fingerprint(self) -> str:
        """Eight hex digits of a hash of all poses: equal for runs with the same result."""
        digest = hashlib.sha256()
        for stamp_ns, odom_T_cam in zip(self.frames.stamp_ns, self.frames.odom_T_cam, strict=True):
            digest.update(stamp_ns.tobytes())
            digest.update(odom_T_cam.tobytes())
        mapped = self.mapped()
        if mapped is not None:
            digest.update(mapped.poses.tobytes())
        return digest.hexdigest()[:8]


def _way(a_T_b: F64, nanoseconds: I64) -> F64:
    """(N,) metres of paths along transforms (N, 4, 4) that last for so long; a radian counts as a metre."""
    return sum(se3.extent(a_T_b), start=SLOWEST * 1e-9 * np.maximum(nanoseconds, 1))
