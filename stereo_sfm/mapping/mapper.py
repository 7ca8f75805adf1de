"""The mapper: one keyframe (and perhaps a loop) in, exactly one `MapUpdate` out. It alone owns the map.

Frames of reference. Keyframes and points are in the map frame, the tracker's frames in the odometry frame; map_T_odom
relates them. It is the identity until a loop is corrected or the whole map is adjusted, and then changes by the motion
of the newest keyframe, so that the newest points stay in the odometry frame and the odometry pose does not jump.

Drift. Local bundle adjustment moves keyframes and points in the map frame. The update contains the moved points; the
tracker transforms them by the inverse of map_T_odom and solves the next frames against them. A point re-observed by its
descriptor is fused with the older one: its track then belongs to the older point, and with it to the older, less
drifted part of the map. In a place that the robot does not leave, the same old points bound the drift.

Gravity. Keyframes that measured it are held level by it, in local windows, in the whole map and where a loop is closed;
`down` of an update is its direction in the map.

A loop that the map agrees with, within the loop's noise, only fuses the points that it pairs, so that a robot that
passes the same places all day does not repeat the correction.

Time. A window contains the keyframes nearest to the newest and, as fixed ones, those that share most points with them:
a limited number of each, and with them of points and observations. Of views that are seen again and again a few are
kept (`culling`), and of all views together a limited number; more are removed when the robot has passed. What was
removed leaves nothing behind once the loop closer names it no more. So a keyframe costs the same after hours in the
same aisles.

Local windows propagate a small error of scale from one to the next that only all keyframes together correct. So a full
bundle adjustment runs concurrently with mapping after a loop, and whenever the map has grown by a share. It is a job of
arrays (`pending_job`) whose result (`finish_job`) is applied a fixed number of keyframes later, wherever it was
computed; without a result by then, the mapper computes it. Keyframes added in between move with the nearest in it.

The retail paper's mapping (section IV-B) is configuration: association = "previous" (a point is known if the previous
keyframe saw it, else it is new), window_keyframes = 0 (all connected keyframes move), redundant_share = 2 (no keyframe
is culled).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.choice import with_terms
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calibration.row_errors import RowMonitor
from stereo_sfm.calibration.self_calibration import Revision, SelfCalibration
from stereo_sfm.calibration.sensor_calibration import SensorCalibration
from stereo_sfm.config import LoopConfig, MapperConfig
from stereo_sfm.geometry import se3
from stereo_sfm.mapping import culling, window
from stereo_sfm.mapping.bundle import BundleConfig, BundleResult, bundle_adjust
from stereo_sfm.mapping.correction import apply_loop, fuse_sides, loop_is_known, sides_share_points
from stereo_sfm.mapping.insertion import insert_keyframe
from stereo_sfm.mapping.level import mean_down
from stereo_sfm.mapping.map import Map
from stereo_sfm.mapping.protocol import AnyMapper
from stereo_sfm.mapping.recalibration import recalibrate
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.mapping.triangulate import triangulate
from stereo_sfm.timing import NoSpans
from stereo_sfm.types import (
    F64,
    I64,
    RIG_TERMS,
    CalibrationUpdate,
    Keyframe,
    LoopResult,
    MapUpdate,
    RowErrors,
    SensorUpdate,
)

MAX_TRIANGULATED = 4  # observations up to which a point is triangulated anew before each adjustment: more hold it
FIRST_FULL_BUNDLE = 8  # keyframes of the first full bundle adjustment: fewer are within one window
GROWTH_AT_KNOWN_LOOP = 1.1  # factor by which the map has grown when a known loop starts a full bundle adjustment
LAG_SHARE = 0.1  # of the living keyframes, until a result is due: the time of a full adjustment grows with the map
RECENT = 3  # newest keyframes, whose points are checked and which are never redundant: their points are still tracked


@dataclass(frozen=True, eq=False)
class Job:
    """A full bundle adjustment for `run_job`, possibly in another process."""

    rig: Rig
    config: BundleConfig
    window: window.Window
    newest: int  # row of the newest keyframe when the job was created


def run_job(job: Job) -> BundleResult:
    """The full bundle adjustment of a job."""
    return bundle_adjust(job.rig, job.window.bundle, job.config)


class Mapper(AnyMapper):
    """Owner of the map."""

    def __init__(
        self,
        config: MapperConfig,
        rig: Rig,
        spans: NoSpans | None = None,
        loop_config: LoopConfig | None = None,
        calibration: SelfCalibration | None = None,
        sensors: SensorCalibration | None = None,
    ) -> None:
        """Empty map.

        Args:
            loop_config: how an accepted loop is distributed over the keyframes.
            calibration: estimates corrections of the rig; None: the rig stays.
            sensors: estimates those of IMU and wheels; None: they stay.
        """
        super().__init__(rig)
        self._config, self._spans, self._calibration = config, spans or NoSpans(), calibration
        self._revised: CalibrationUpdate | None = None  # for the next update
        self._sensors = sensors
        self._sensor_update: SensorUpdate | None = None  # of this step
        self._rows = RowMonitor(rig) if rig.stereo and not rig.depth else None
        self._row_errors: RowErrors | None = None  # for the next update
        self._loop_config = loop_config or LoopConfig()
        self.map = Map()
        self._map_T_odom: F64 = np.eye(4)
        self._rig_terms: F64 = np.zeros(RIG_TERMS)  # with which the newest keyframe was tracked
        self._version = 0
        self._culled: list[I64] = []
        self._fused: list[tuple[int, int]] = []  # rows (removed, kept)
        self._adjusted: I64 = np.zeros(0, np.int64)  # point rows of the last window
        self._thin: I64 = np.zeros(0, np.int64)  # point rows with too few observations that may still get more
        self._repeated: list[int] = []  # rows of keyframes added to views that had some from earlier visits
        self._loops: list[LoopResult] = []
        self._refused: list[int] = []  # kf_ids whose loops contradict the rest of the map
        self._job: Job | None = None
        self._job_due = -1
        self._size_at_full_bundle = FIRST_FULL_BUNDLE  # living keyframes at the last full bundle adjustment
        self._job_taken = False
        self._result: BundleResult | None = None

    # -- messages ----------------------------------------------------------------------------------------------------

    def step(self, keyframe: Keyframe, loop: LoopResult | None = None) -> MapUpdate:
        """Insert a keyframe and adjust the map around it.

        Args:
            keyframe: the newest. loop: the loop closer's result for an earlier keyframe, or none.
        """
        self._version += 1
        if self._sensors is not None:
            with self._spans.span("calibrate_sensors"):
                self._sensor_update = self._sensors.add(keyframe, self._version)
        if not self._config.enabled:
            ids, poses = np.array([keyframe.kf_id]), np.array([keyframe.odom_T_cam])
            return MapUpdate(self._version, keyframe.kf_id, ids, poses, sensors=self._sensor_update)
        if self._job is None and self.map.many_forgotten:
            now = self.map.free_keyframes()
            self._repeated = [row for row in now[self._repeated].tolist() if row >= 0]
        if self.job_due:
            with self._spans.span("full_ba"):
                self._apply_job()
        if loop is not None and loop.candidate_kf_id >= 0:
            with self._spans.span("close_loop"):
                self._close(loop)
        if loop is not None:
            self.map.forget(loop.forgotten_kf_ids)
        with self._spans.span("associate"):
            row = self._insert(keyframe)
        if self._calibration is not None:
            with self._spans.span("calibrate"):
                self._revise(self._calibration.add(keyframe))
        if self._rows is not None:
            self._row_errors = self._rows.add(keyframe)
        with self._spans.span("local_ba"):
            self._adjust(row)
        with self._spans.span("cull"):
            self._cull(row)
        self._bundle_when_grown(self._config.full_ba_growth)
        update = self._update(keyframe.kf_id)
        if self._job is None and self.map.much_removed:
            self._thin = np.unique(self.map.compact(keyframe.point_ids)[self._thin])
        return update

    def finish(self, loops: Sequence[LoopResult]) -> MapUpdate | None:
        """After the last keyframe: remaining loops and the work in the background.

        Returns:
            The last update, or None without a map.
        """
        if not self._config.enabled or not len(self.map.keyframes):
            return None
        for loop in [*loops, None]:
            if self._job is not None:
                self._apply_job()
            if loop is not None and loop.candidate_kf_id >= 0:
                self._close(loop)
        self._version += 1
        self._sensor_update = None
        if self._calibration is not None:
            self._revise(self._calibration.finish())
            if self._job is not None:
                self._apply_job()
        if self._config.final_iterations:
            self._start_full_bundle(window.final_bundle_config(self._config))
            self._apply_job()
        return self._update(int(self.map.keyframes.kf_id[-1]))

    def _update(self, kf_id: int) -> MapUpdate:
        (kf, gone, pt), table = self.map.take_delta(), self.map.keyframes
        felt = np.flatnonzero(table.alive & (table.down_sigma > 0))
        level = felt[table.submap_id[felt] == table.submap_id[0]]  # whose frame is the map's
        level = level if len(level) else felt[table.submap_id[felt] == table.submap_id[felt[-1:]]]
        culled = self.map.points.pt_id[np.unique(np.concatenate([np.zeros(0, np.int64), *self._culled]))]
        fused = self.map.points.pt_id[np.array(self._fused, np.int64).reshape(-1, 2)]
        refused = np.array(self._refused, np.int64)
        self._culled, self._fused, self._refused = [], [], []
        revised, self._revised = self._revised, None
        row_errors, self._row_errors = self._row_errors, None
        return MapUpdate(
            version=self._version,
            kf_id=kf_id,
            kf_ids=table.kf_id[kf],
            map_T_kf=table.map_T_kf[kf],
            point_ids=self.map.points.pt_id[pt],
            points_map=self.map.points.xyz[pt],
            culled_point_ids=culled[culled >= 0],
            fused_point_ids=fused[(fused >= 0).all(axis=1)],
            map_T_odom=self._map_T_odom.copy(),
            culled_kf_ids=table.kf_id[gone],
            carrier_kf_ids=table.kf_id[table.reference[gone]],
            carrier_T_kf=table.reference_T_kf[gone],
            refused_kf_ids=refused,
            calibration=revised,
            row_errors=row_errors,
            sensors=self._sensor_update,
            down=mean_down(table.map_T_kf[level], table.down[level], table.down_sigma[level]),
        )

    # -- calibration -------------------------------------------------------------------------------------------------

    def _revise(self, revision: Revision | None) -> None:
        """Correct the rig: points move to their positions with the new rig, and a full bundle adjustment follows."""
        if revision is None:
            return
        assert self._calibration is not None
        row, applied = len(self.map.keyframes) - 1, self._calibration.applies
        kf_id, stamp_ns = int(self.map.keyframes.kf_id[row]), int(self.map.keyframes.stamp_ns[row])
        self._revised = revision.message(self._version, kf_id, stamp_ns, applied)
        if applied:
            self._terms = revision.terms
            changes = [*revision.on_the_way, (revision.since_kf_id, revision.terms)]
            rigs = [(self.map.row_since(since), with_terms(self._source_rig, terms)) for since, terms in changes]
            recalibrate(self.map, [(0, self.rig), *rigs])
            self.rig = rigs[-1][1]
            self._adjust_since(rigs[0][0])
            self._start_full_bundle()
            if self._rows is not None:
                self._rows.use(self.rig)

    def _adjust_since(self, first: int) -> None:
        """Adjust the keyframes from a row on at once: the tracker's next poses are solved with their points.

        As many as a window has, fixed ones included; a full bundle adjustment follows.
        """
        before, config = self.map.keyframes.map_T_kf[-1].copy(), self._config
        most = config.window_keyframes + config.fixed_keyframes
        part = window.newest(self.map, first, most, config, self.rig.imu)
        window.write_back(self.map, part, bundle_adjust(self.rig, part.bundle, window.bundle_config(self._config)))
        self._follow_newest(before)

    # -- loops -------------------------------------------------------------------------------------------------------

    def _close(self, loop: LoopResult) -> None:
        """Correct the map for a loop that the pose graph accepts; a full bundle adjustment follows if that bends it."""
        received, loop = loop, self._between_living(loop)
        same = loop.candidate_kf_id == loop.kf_id
        if same or loop_is_known(self.map, loop):
            if not (same or sides_share_points(self.map, loop, self._config.connected_points)):
                self._loops.append(loop)
            self._fused += fuse_sides(self.map, loop, self._config.match_sigma_px)
            self._bundle_when_grown(GROWTH_AT_KNOWN_LOOP)
            return
        before = self.map.keyframes.map_T_kf[-1].copy()
        correction = apply_loop(self.map, loop, self._loops, self._loop_config, self._config.match_sigma_px)
        if not correction.applied:
            self._refused.append(received.kf_id)
            return
        self._loops.append(loop)
        self._fused += correction.fused
        self._follow_newest(before)
        if correction.bent:
            self._start_full_bundle()
        else:
            self._bundle_when_grown(GROWTH_AT_KNOWN_LOOP)

    def _bundle_when_grown(self, factor: float) -> None:
        """Start a full bundle adjustment if the map has grown by a factor since the last."""
        if self._job is None and len(self.map.living_keyframes()) >= factor * self._size_at_full_bundle:
            self._start_full_bundle()

    def _start_full_bundle(self, config: BundleConfig | None = None) -> None:
        self._cull_loose()
        part = window.whole_map(self.map)
        config = config or window.bundle_config(self._config)
        self._job = Job(self.rig, config, part, len(self.map.keyframes) - 1)
        self._job_taken, self._result = False, None
        lag = max(self._config.full_ba_lag_keyframes, round(LAG_SHARE * len(self.map.living_keyframes())))
        self._job_due = len(self.map.keyframes) + lag
        self._size_at_full_bundle = len(self.map.living_keyframes())

    def _between_living(self, loop: LoopResult) -> LoopResult:
        """The loop between the living keyframes that carry its two ends, if one of them was culled."""
        keyframes = self.map.keyframes
        rows = [self.map.kf_row(loop.candidate_kf_id), self.map.kf_row(loop.kf_id)]
        ends = [row if keyframes.alive[row] else int(keyframes.reference[row]) for row in rows]
        if ends == rows:
            return loop
        offset = [np.eye(4) if e == r else keyframes.reference_T_kf[r] for e, r in zip(ends, rows, strict=True)]
        ids, candidate_T_kf = keyframes.kf_id[ends].tolist(), offset[0] @ loop.candidate_T_kf @ se3.inverse(offset[1])
        matches = loop.matches
        if ids[0] > ids[1]:  # the candidate's reference is newer: swap, the candidate is the older keyframe
            ids, candidate_T_kf, matches = ids[::-1], se3.inverse(candidate_T_kf), matches[:, ::-1]
        return dataclasses.replace(
            loop, candidate_kf_id=ids[0], kf_id=ids[1], candidate_T_kf=candidate_T_kf, matches=matches
        )

    def _carry_loops(self, culled_kf_id: int) -> None:
        """Loops that end at a culled keyframe now end at its reference: one a pair, none where both ends coincide.

        If they kept their ends alive, a robot that goes round and round would have ever more keyframes.
        """
        ends = {_ends(x) for x in self._loops}
        for loop in [x for x in self._loops if culled_kf_id in _ends(x)]:
            self._loops.remove(loop)
            carried = self._between_living(loop)
            pair = _ends(carried)
            if pair[0] != pair[1] and pair not in ends:
                ends.add(pair)
                self._loops.append(carried)

    def _follow_newest(self, before: F64) -> None:
        """Move the odometry frame with the newest keyframe, whose map_T_kf was `before`."""
        moved = self.map.keyframes.map_T_kf[-1] @ se3.inverse(before)
        self._map_T_odom = se3.orthonormalize(moved @ self._map_T_odom)

    @property
    def job_due(self) -> bool:
        return self._job is not None and len(self.map.keyframes) >= self._job_due

    def pending_job(self) -> Job | None:
        if self._job is None or self._job_taken:
            return None
        self._job_taken = True
        return self._job

    def finish_job(self, result: BundleResult) -> None:
        self._result = result

    def snapshot(self) -> MapSnapshot:
        """The living map."""
        return self.map.snapshot()

    def _apply_job(self) -> None:
        assert self._job is not None
        job, result = self._job, self._result or run_job(self._job)
        self._job, self._result = None, None
        rows, poses = job.window.kf_rows, self.map.keyframe_poses()  # some of the job may have been culled since
        later = np.arange(job.newest + 1, len(poses))
        apart = poses[later, :3, 3][:, None] - poses[rows, :3, 3]
        nearest, after = np.argmin(np.linalg.norm(apart, axis=2), axis=1), poses.copy()
        after[rows] = result.world_T_kf
        after[later] = after[rows[nearest]] @ se3.inverse(poses[rows[nearest]]) @ poses[later]
        before = self.map.keyframes.map_T_kf.copy()
        self.map.move_keyframes(np.arange(len(after)), after)
        self.map.carry_points(before, self.map.keyframes.map_T_kf)
        window.write_back(self.map, job.window, result)
        self._follow_newest(before[-1])

    # -- stages ------------------------------------------------------------------------------------------------------

    def _insert(self, keyframe: Keyframe) -> int:
        guess = self._map_T_odom @ keyframe.odom_T_cam
        row, fused = insert_keyframe(self.map, self.rig, keyframe, guess, self._config)
        self._fused += fused
        if not np.array_equal(keyframe.rig_terms, self._rig_terms):
            self._follow_newest(guess)  # what the rig before it measured since the last keyframe is wrong
            self._rig_terms = keyframe.rig_terms
        return row

    def _adjust(self, row: int) -> None:
        if row == 0:
            return
        seen = self.map.seen_by(row)
        count = self.map.points.obs_count[seen]
        recent = seen[(count > 1) & (count <= MAX_TRIANGULATED)]
        self.map.move_points(recent, triangulate(self.map, self.rig, recent))
        part = window.covisible_window(self.map, row, self._config, self.rig.imu)
        self._adjusted = part.pt_rows
        result = bundle_adjust(self.rig, part.bundle, window.bundle_config(self._config))
        window.write_back(self.map, part, result)

    def _cull(self, row: int) -> None:
        recent = range(max(0, row - RECENT), row + 1)
        seen = [self.map.seen_by(k) for k in recent]
        protected = np.zeros(len(self.map.keyframes), bool)
        protected[0] = protected[-RECENT:] = True
        earlier = culling.earlier_visits(self.map, row, protected)
        redundant = culling.redundant_keyframe(self.map, row, protected, earlier, self._config)
        if len(earlier):
            self._repeated.append(row)
        passed = self._one_too_many() if redundant < 0 and self._config.redundant_share <= 1 else -1
        if (gone := max(redundant, passed)) >= 0:
            seen.append(self.map.seen_by(gone))
            self.map.cull_keyframe(gone)
            if redundant >= 0:
                self._carry_loops(int(self.map.keyframes.kf_id[gone]))
            else:
                self._loops = [x for x in self._loops if int(self.map.keyframes.kf_id[gone]) not in _ends(x)]
        rows = np.unique(np.concatenate([self._adjusted, self._thin, *seen]))
        weak = culling.weak_points(self.map, self.rig, rows, row, self._config)
        self.map.cull_points(weak)
        self._culled.append(weak)
        points = self.map.points
        self._thin = rows[points.alive[rows] & (points.obs_count[rows] < 2)]

    def _cull_loose(self) -> None:
        """Cull the keyframes of earlier times that hardly anything holds."""
        if self._config.redundant_share > 1:
            return
        settled = np.arange(len(self.map.keyframes)) < len(self.map.keyframes) - culling.PASSED
        self._repeated = [row for row in self._repeated if self.map.keyframes.alive[row]]
        for row in culling.loose_keyframes(self.map, settled, np.array(self._repeated, int), self._config).tolist():
            self._thin = np.union1d(self._thin, self.map.seen_by(row))
            self.map.cull_keyframe(row)
            self._carry_loops(int(self.map.keyframes.kf_id[row]))

    def _one_too_many(self) -> int:
        """A keyframe of a view of earlier visits that has been passed, if there are too many such; else -1.

        The newest goes, not the earlier ones: they are connected with the whole map, and hold it together. Its loops go
        with it: they have joined points, and carried on from keyframe to keyframe they would follow the robot.
        """
        self._repeated = [row for row in self._repeated if self.map.keyframes.alive[row]]
        passed = self._repeated[culling.OF_EARLIER_VISITS : -culling.PASSED]
        return next((row for row in passed if not self._joins_submaps(row)), -1)

    def _joins_submaps(self, row: int) -> bool:
        """Whether a keyframe has the only loop between two submaps."""
        table, kf_id = self.map.keyframes, int(self.map.keyframes.kf_id[row])
        submaps = [frozenset(int(table.submap_id[self.map.kf_row(k)]) for k in _ends(x)) for x in self._loops]
        own = [s for s, x in zip(submaps, self._loops, strict=True) if len(s) == 2 and kf_id in _ends(x)]
        return any(submaps.count(s) == 1 for s in own)


def _ends(loop: LoopResult) -> tuple[int, int]:
    """Ids of the two keyframes of a loop."""
    return loop.candidate_kf_id, loop.kf_id
