"""`RunLog`: all messages of a run as topics. A sink of the pipeline."""

from __future__ import annotations

import functools
from collections import deque
from dataclasses import dataclass
from functools import singledispatchmethod
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.Pose_pb2 import Pose

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.log import foxglove, topics
from stereo_sfm.log.image_log import LEVEL_T_MAP, ImageLog, level_T_map
from stereo_sfm.log.images import LoggedImage
from stereo_sfm.log.map_view import MapView
from stereo_sfm.log.provenance import ENDED_EARLY, METADATA, TOTALS, Opening, write_provenance
from stereo_sfm.log.track_stats import track_stats
from stereo_sfm.log.writer import LogWriter
from stereo_sfm.messages import LogLine, SourceCounters
from stereo_sfm.types import (
    F32,
    F64,
    I32,
    Frame,
    Keyframe,
    LiveDepth,
    LoopResult,
    MapUpdate,
    StereoImage,
    TrackState,
    Trajectory,
)

# Shortest intervals of the whole trajectory with its edges, and of the whole map; longer as they grow, so that a long
# run needs no more space per second.
TRAJECTORY_NS = 1_000_000_000
TRAJECTORY_SIZE = 200  # keyframes
POINTS_NS = 5_000_000_000
POINTS_SIZE = 50_000
PATH_COLOR = (70, 150, 255, 255)
KEPT_STAMPS = 10_000  # of keyframes whose messages may still come
OLD_TRACK = 30  # frames after which a track's colour no longer changes


@dataclass(frozen=True, eq=False)
class LeftOut:
    """An image that was tracked and is not in the log, without its pixels: a camera in real time does not wait."""

    image: StereoImage


class RunLog:
    """Writes a run.

    The messages of the stages may arrive interleaved in any way, as from several processes; each stage's own must come
    in order. What is assembled from several stages (map pose, points, edges) waits until everything it needs has
    come, so that the content of every topic is the same however the stages were scheduled.
    """

    def __init__(
        self,
        writer: LogWriter,
        rig: Rig,
        config: Config,
        *,
        source: str,
        mode: str,
        image_format: str = "png",
        ground_truth: Trajectory | None = None,
        opening: Opening | None = None,
        whole_map: bool = True,
    ) -> None:
        """Begin a log.

        Args:
            writer: the open file; `close` closes it.
            rig: calibration that the run uses.
            config: what decides its results.
            source: the source's name.
            mode: "inline", "lockstep" or "realtime".
            image_format: "png", "raw", "jpeg" (only with images from `encode_pair`), or "none" for no images.
            ground_truth: world_T_cam0 where the source has it.
            opening: how the source was opened.
            whole_map: now and then the whole map and trajectory, for viewers; memory and file grow with it.
        """
        self._left_T_body = se3.inverse(rig.body_T_left)
        self._body_adjoint = se3.adjoint(rig.body_T_left)
        localize_only = opening is not None and opening.localize_only
        self._loops = config.closes_loops(rig.stereo, localize_only)  # whether results will come
        self._whole_map = whole_map
        self._provenance = functools.partial(
            write_provenance, source=source, serial=rig.serial, mode=mode, image_format=image_format, config=config,
            opening=opening,
        )  # fmt: skip
        self._image_log = functools.partial(
            ImageLog, rig=rig, ground_truth=ground_truth, image_format=image_format, mapped=True
        )
        self._begin(writer)
        self._has_images = image_format != "none"  # else there is nothing to draw the tracked points on
        self._map = MapView()
        self._levels = rig.imu is not None  # the map's level may change: it comes with every frame
        self._map_frames: dict[int, tuple[F64, F64]] = {0: (np.eye(4), LEVEL_T_MAP)}  # map_T_odom, level_T_map
        self._version = 0
        self._frames: deque[tuple[Frame, Pose]] = deque()  # wait for the map version they used
        self._waiting: tuple[deque[MapUpdate], deque[LoopResult]] = (deque(), deque())  # wait for their keyframe
        self._updates: deque[MapUpdate] = deque()  # wait for their keyframe and its loop result, to be shown
        self._keyframes: dict[int, Keyframe] = {}
        self._stamps: dict[int, tuple[int, int]] = {}  # kf_id -> stamp and frame id
        self._results: dict[int, LoopResult] = {}
        self._next_trajectory_ns: int | None = None
        self._next_points_ns: int | None = None
        self._last: tuple[int, int] = (0, 0)  # stamp and frame id of the newest keyframe shown
        self._now_ns = 0
        self._closed = False
        self._counts: dict[str, float] = {}  # of a live source

    def _begin(self, writer: LogWriter) -> None:
        """Begin a file."""
        self._writer = writer
        self._provenance(writer)
        self._images = self._image_log(writer)
        self._totals = dict.fromkeys(("frames", "lost", "keyframes", "loops accepted", "loop candidates rejected"), 0)

    def next_file(self, writer: LogWriter) -> None:
        """Close the file and go on in another one, where what is still awaited will be written."""
        if not self._writer.closed:
            self._end()
        self._begin(writer)

    def put(self, message: object) -> None:
        """Any message of a run."""
        self._write(message)

    @singledispatchmethod
    def _write(self, message: object) -> None:
        """Write a message as its row of topics says; those with a method below write more than that."""
        row = topics.OF.get(type(message))
        if row is None:
            raise TypeError(f"no topic for {type(message).__name__}")
        self._writer.write(row.name, message, *row.key(message, self._now_ns))

    @_write.register
    def image(self, image: StereoImage | LoggedImage) -> None:
        """What the tracker sees."""
        pair = image.image if isinstance(image, LoggedImage) else image
        self._now_ns = pair.stamp_ns
        self._images.image(image)

    @_write.register
    def left_out(self, left: LeftOut) -> None:
        """An image whose pixels are not kept."""
        self._now_ns = left.image.stamp_ns
        self._images.without_pixels(left.image)

    @_write.register
    def frame(self, frame: Frame) -> None:
        """A frame of the tracker."""
        self._totals["frames"] += 1
        self._totals["lost"] += frame.state in (TrackState.LOST, TrackState.OCCLUDED)
        write, stamp, sequence = self._writer.write, frame.stamp_ns, frame.frame_id
        write(topics.FRAME, frame, stamp, sequence)
        write(topics.STATS, track_stats(frame), stamp, sequence)
        obs = frame.observations
        if self._has_images:
            dots = foxglove.point_annotations(stamp, obs.uv_left, age_colors(obs.age, obs.inlier))
            write(topics.FEATURES, dots, stamp, sequence)
        odom_T_body = frame.odom_T_cam @ self._left_T_body
        pose = foxglove.pose(odom_T_body)
        write(topics.ODOM_POSE, foxglove.pose_in_frame("odom", stamp, pose), stamp, sequence)
        covariance = self._odometry_covariance(frame.covariance, odom_T_body)
        write(topics.ODOMETRY, foxglove.odometry(stamp, pose, covariance), stamp, sequence)
        self._frames.append((frame, pose))
        self._release_frames()

    @_write.register
    def keyframe(self, keyframe: Keyframe) -> None:
        """A frame that enters the map."""
        self._totals["keyframes"] += 1
        self._writer.write(topics.KEYFRAME, keyframe, keyframe.stamp_ns, keyframe.frame_id)
        self._keyframes[keyframe.kf_id] = keyframe
        self._stamps[keyframe.kf_id] = (keyframe.stamp_ns, keyframe.frame_id)
        if len(self._stamps) > KEPT_STAMPS:
            del self._stamps[next(iter(self._stamps))]
        self._release_waiting()
        self._release_updates()

    @_write.register
    def map_update(self, update: MapUpdate) -> None:
        """The mapper's result."""
        self._waiting[0].append(update)
        self._release_waiting()
        self._totals["loops accepted"] -= len(update.refused_kf_ids)
        self._totals["loop candidates rejected"] += len(update.refused_kf_ids)
        self._updates.append(update)
        self._map_frames[update.version] = update.map_T_odom, level_T_map(update.down)
        self._version = update.version
        self._release_updates()
        self._release_frames()

    @_write.register
    def loop(self, result: LoopResult) -> None:
        """The loop closer's result."""
        self._totals["loops accepted"] += result.candidate_kf_id >= 0
        self._totals["loop candidates rejected"] += len(result.rejected)
        self._waiting[1].append(result)
        self._release_waiting()
        self._results[result.kf_id] = result
        self._release_updates()

    @_write.register
    def depth(self, live: LiveDepth) -> None:
        """Depth of a pair while the run goes on."""
        stamp, sequence = live.stamp_ns, live.frame_id
        image, camera, cloud = foxglove.live_depth(live)
        self._writer.write(topics.LIVE_DEPTH, image, stamp, sequence)
        self._writer.write(topics.LIVE_CALIBRATION, camera, stamp, sequence)
        self._writer.write(topics.OBSTACLES, cloud, stamp, sequence)

    @_write.register
    def counters(self, counters: SourceCounters) -> None:
        """Counters of a live camera."""
        self._counts = counters.counts
        self._writer.write(topics.COUNTERS, counters, self._now_ns, counters.frame_id)

    @_write.register
    def line(self, line: LogLine) -> None:
        """A human-readable line."""
        if not self._writer.closed:  # a full disk is reported with the next message of a stage
            text = foxglove.text(self._now_ns, line.level, line.text, line.stage)
            self._writer.write(topics.LOG, text, self._now_ns)

    @property
    def refused(self) -> bool:
        """Whether the disk was full and the file was closed early."""
        return self._writer.refused

    def close(self, *, early: bool = False) -> None:
        """Write what is left and close the file. `early`: a stage was killed, its last messages are missing."""
        if self._closed or self._writer.closed:  # closed by itself when the disk was full
            return
        self._closed = True
        try:
            self._release_waiting(everything=True)
            self._release_updates(everything=True)
            self._release_frames(everything=True)
            if self._whole_map:
                self._show_trajectory()
                self._show_points()
        finally:
            self._end(early=early)

    def _end(self, *, early: bool = False) -> None:
        """Write the totals and close the file."""
        try:
            totals = {name: str(int(value)) for name, value in self._totals.items()}
            counted = {name: f"{value:g}" for name, value in self._counts.items() if value}
            self._writer.metadata(TOTALS, counted | self._images.totals | totals)
            if early:
                self._writer.metadata(METADATA, ENDED_EARLY)
        finally:
            self._writer.close()

    def _release_frames(self, everything: bool = False) -> None:
        while self._frames and (everything or self._frames[0][0].map_version <= self._version):
            self._show_frame(*self._frames.popleft())

    def _show_frame(self, frame: Frame, odom_pose: Pose) -> None:
        """The pose of the body in the version of the map that the frame used."""
        frames = self._map_frames
        older = sorted(v for v in frames if v <= frame.map_version)
        for version in older[:-1]:
            del frames[version]
        map_T_odom, level = frames[older[-1] if older else min(frames)]  # none: a frame written again
        map_T_body = map_T_odom @ frame.odom_T_cam @ self._left_T_body
        stamp, sequence = frame.stamp_ns, frame.frame_id
        map_pose, correction = foxglove.poses(np.stack([map_T_body, map_T_odom]))
        self._writer.write(topics.MAP_POSE, foxglove.pose_in_frame("map", stamp, map_pose), stamp, sequence)
        rows = [("map", "odom", correction), ("odom", "body", odom_pose)]
        rows += [("level", "map", foxglove.pose(level))] if self._levels else []
        self._writer.write(topics.TF, foxglove.transforms(stamp, rows), stamp, sequence)

    def _release_waiting(self, everything: bool = False) -> None:
        """Write the messages of the mapper and the loop closer with the stamp of their keyframe."""
        for topic, queue in zip((topics.MAP_UPDATE, topics.LOOP), self._waiting, strict=True):
            while queue and (everything or queue[0].kf_id in self._stamps):
                message = queue.popleft()
                stamps = self._stamps.get(message.kf_id, self._last)
                self._writer.write(topic, message, *stamps)
                if isinstance(message, MapUpdate) and message.calibration is not None:
                    self._writer.write(topics.CALIBRATION, message.calibration, *stamps)
                if isinstance(message, MapUpdate) and message.row_errors is not None:
                    self._writer.write(topics.ROW_ERRORS, message.row_errors, *stamps)
                if isinstance(message, MapUpdate) and message.sensors is not None:
                    self._writer.write(topics.SENSORS, message.sensors, *stamps)

    def _release_updates(self, everything: bool = False) -> None:
        while self._updates:
            kf_id = self._updates[0].kf_id
            ready = kf_id in self._keyframes and (not self._loops or kf_id in self._results)
            if not ready and not everything:
                return
            self._show_update(self._updates.popleft())

    def _show_update(self, update: MapUpdate) -> None:
        keyframe, result = self._keyframes.pop(update.kf_id, None), self._results.pop(update.kf_id, None)
        if keyframe is not None:
            self._last = (keyframe.stamp_ns, keyframe.frame_id)
        if not self._whole_map:
            return
        if keyframe is not None:
            self._map.keyframe(keyframe, update.map_T_odom)
        if result is not None:
            self._map.loop(result)
        self._map.update(update)
        stamp = self._last[0]
        if self._next_trajectory_ns is None or stamp >= self._next_trajectory_ns:
            self._next_trajectory_ns = stamp + _interval(TRAJECTORY_NS, self._map.keyframes, TRAJECTORY_SIZE)
            self._show_trajectory()
        if self._next_points_ns is None or stamp >= self._next_points_ns:
            self._next_points_ns = stamp + _interval(POINTS_NS, len(self._map.points), POINTS_SIZE)
            self._show_points()

    def _show_trajectory(self) -> None:
        kf_ids, poses = self._map.trajectory
        if not len(poses):
            return
        stamp, sequence = self._last
        self._writer.write(topics.TRAJECTORY, foxglove.poses_in_frame("map", stamp, poses), stamp, sequence)
        path = foxglove.point_cloud("map", stamp, poses[:, :3, 3], kf_ids, PATH_COLOR)
        self._writer.write(topics.PATH, path, stamp, sequence)
        lines = [
            ("covisibility", foxglove.line_list(self._map.covisibility_lines, (0.4, 0.6, 1.0, 0.4), 1.0)),
            ("loops", foxglove.line_list(self._map.loop_lines, (1.0, 0.3, 0.2, 1.0), 3.0)),
        ]
        self._writer.write(topics.SCENE, foxglove.scene("map", stamp, lines), stamp, sequence)

    def _show_points(self) -> None:
        if not len(self._map.points):
            return
        stamp, sequence = self._last
        cloud = foxglove.point_cloud("map", stamp, self._map.points, self._map.point_ids)
        self._writer.write(topics.POINTS, cloud, stamp, sequence)

    def _odometry_covariance(self, covariance: F64, odom_T_body: F64) -> F64:
        """From xi in camera axes to the body's position and rotation in the axes of `odom`, as Odometry has it."""
        turn = np.zeros((6, 6))
        turn[:3, :3] = turn[3:, 3:] = odom_T_body[:3, :3]
        turn = turn @ self._body_adjoint
        return turn @ covariance @ turn.T


def _interval(shortest_ns: int, size: int, usual: int) -> int:
    """Nanoseconds until the whole trajectory or map is written again."""
    return shortest_ns * max(size, usual) // usual


def age_colors(age: I32, inlier: Any) -> F32:
    """(N, 4) from blue (new) over green to red (old); grey where the pose does not use the point."""
    t = np.clip(age / OLD_TRACK, 0.0, 1.0)
    colors = np.stack([t, 1.0 - np.abs(2.0 * t - 1.0), 1.0 - t, np.ones_like(t)], 1).astype(np.float32)
    colors[~inlier] = (0.6, 0.6, 0.6, 0.6)
    return colors
