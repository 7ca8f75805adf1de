"""A run in rerun: images with features, trajectory, map, loops, time series. A sink of the pipeline."""

from __future__ import annotations

import logging
import sys
from collections.abc import Mapping
from functools import singledispatchmethod
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.log.events import Events
from stereo_sfm.messages import Health, LogLine, StageTimes
from stereo_sfm.types import (
    U8,
    Bool,
    Dropped,
    Frame,
    Keyframe,
    LiveDepth,
    LoopResult,
    MapUpdate,
    StereoImage,
    Trajectory,
)
from stereo_sfm.viz.blueprint import blueprint
from stereo_sfm.viz.map_scene import MapScene
from stereo_sfm.viz.server import LOOPBACK, open_window, serve
from stereo_sfm.viz.shapes import age_colors, spread_colors, strips, turbo

log = logging.getLogger("stereo_sfm")
JPEG_QUALITY = 80
MATCHES_DRAWN = 100  # more lines would hide the image: every k-th is drawn
MATCHES_EVERY = 5  # images between two images of matches
KEPT = 64  # images waiting for their frame, more than the stages can hold
GRACE_S = 5.0  # time for a viewer to take the remaining messages
OBSTACLE = (255, 90, 60)
TRUTH = (95, 200, 110)
MASKED = (230, 60, 90)
MASK_OPACITY = 0.45
MASK_ORDER = 1.0  # over images (-10) and under points (30)
SERIES: Mapping[str, tuple[int, int, int]] = {
    "points/tracked": (90, 170, 255),
    "points/inliers": (120, 220, 130),
    "ms/track": (90, 170, 255),
    "ms/map": (255, 170, 60),
    "ms/loop": (235, 90, 90),
    "ms/latency": (180, 180, 190),
}


def open_recording(mode: str, layout: rrb.Blueprint, path: Path | None, address: str = LOOPBACK) -> rr.RecordingStream:
    """A recording that goes to a viewer. Args: as `RerunSink`."""
    recording = rr.RecordingStream("stereo_sfm", recording_id=None)
    if mode == "serve":
        destination, said = serve(address)
        recording.connect_grpc(destination, default_blueprint=layout)
        print(said, file=sys.stderr, flush=True)
    elif mode == "spawn":
        recording.connect_grpc(open_window(), default_blueprint=layout)
    else:
        assert path is not None
        path.open("ab").close()  # raises OSError if the file cannot be written, unlike rerun
        recording.save(path, default_blueprint=layout)
    return recording


def end_recording(recording: rr.RecordingStream, mode: str) -> None:
    """Send what is left and disconnect."""
    try:
        recording.flush(timeout_sec=1e38 if mode == "save" else GRACE_S)
    except RuntimeError as error:
        log.warning("the viewer does not respond, what it shows is incomplete: %s", str(error).splitlines()[0])
    if mode == "save":
        recording.disconnect()  # writes the end of the file


class RerunSink:
    """Shows the messages of a run as they come."""

    def __init__(
        self,
        rig: Rig,
        name: str,
        mode: str,
        path: Path | None = None,
        ground_truth: Trajectory | None = None,
        address: str = LOOPBACK,
    ) -> None:
        """Open a viewer.

        Args:
            mode: "spawn" a viewer, "serve" it to browsers, or "save" to `path`.
            ground_truth: drawn aligned with the first pose.
            address: to listen on with "serve".
        """
        self._mode = mode
        self._rec = open_recording(mode, blueprint(name), path, address)
        self._scene = MapScene(self._rec, rig)
        self._events = Events()
        self._images: dict[int, StereoImage] = {}  # waiting for their frame
        self._pictures = 0
        self._keyframe: tuple[Keyframe, U8] | None = None
        self._first_ns: int | None = None
        self._last_frame = -1
        self._dropped = 0
        for entity, color in SERIES.items():
            self._rec.log(entity, rr.SeriesLines(colors=[color], names=entity.split("/")[1]), static=True)
        for entity, used in (("map/camera/left/mask", rig.left_mask), ("right/mask", rig.right_mask)):
            if used is not None:
                self._show_mask(entity, used)
        if ground_truth is not None and len(ground_truth):
            world = se3.inverse(ground_truth.poses[0]) @ ground_truth.poses
            line = rr.LineStrips3D([world[:, :3, 3]], colors=[TRUTH], radii=rr.Radius.ui_points(0.8))
            self._rec.log("map/ground_truth", line, static=True)

    def put(self, message: object) -> None:
        """Take any message of a run."""
        self._show(message)
        event = self._events.of(message)
        if event is not None:
            self._text(event)

    @singledispatchmethod
    def _show(self, message: object) -> None:
        """Kinds without a method below are not shown."""

    @_show.register
    def _put_image(self, image: StereoImage) -> None:
        self._images[image.frame_id] = image
        if len(self._images) > KEPT:
            self._show_alone(self._images.pop(min(self._images)))

    @_show.register
    def _put_update(self, update: MapUpdate) -> None:
        self._scene.update(update)

    @_show.register
    def _put_loop(self, result: LoopResult) -> None:
        self._scene.loop(result)

    @_show.register
    def _put_times(self, times: StageTimes) -> None:
        for stage, ms in sorted(times.ms.items()):
            self._rec.log(f"ms/{stage}", rr.Scalars(ms))

    @_show.register
    def _put_health(self, health: Health) -> None:
        self._rec.log(f"rate/{health.stage}", rr.Scalars(health.rate))

    def close(self) -> None:
        """Send what is left and disconnect."""
        for frame_id in sorted(self._images):
            self._show_alone(self._images[frame_id])
        self._scene.show()
        end_recording(self._rec, self._mode)

    @_show.register
    def _text(self, line: LogLine) -> None:
        self._rec.log("log", rr.TextLog(f"{line.stage}: {line.text}", level=line.level.replace("WARNING", "WARN")))

    def _show_mask(self, entity: str, used: Bool) -> None:
        """What is masked of an image, in colour over all images that come."""
        self._rec.log(entity, rr.AnnotationContext([(1, "masked", MASKED)]), static=True)
        masked = rr.SegmentationImage((~used).astype(np.uint8), opacity=MASK_OPACITY, draw_order=MASK_ORDER)
        self._rec.log(entity, masked, static=True)

    # -- frames ------------------------------------------------------------------------------------------------------

    def _at(self, frame_id: int, stamp_ns: int) -> None:
        self._first_ns = stamp_ns if self._first_ns is None else self._first_ns
        self._rec.set_time("frame", sequence=frame_id)
        self._rec.set_time("seconds", duration=np.timedelta64(stamp_ns - self._first_ns, "ns"))

    def _show_alone(self, image: StereoImage) -> None:
        """An image without a frame, as in a recording without a run."""
        if image.frame_id <= self._last_frame:  # a keyframe whose message was dropped, or a late image
            return
        self._at(image.frame_id, image.stamp_ns)
        self._scene.show_camera(0.0)
        self._rec.log("map/camera/left/image", _jpeg(image.left))
        if image.right is not None:
            self._rec.log("right/image", _jpeg(image.right))

    @_show.register
    def _put_frame(self, frame: Frame) -> None:
        self._at(frame.frame_id, frame.stamp_ns)
        self._last_frame = frame.frame_id
        obs = frame.observations
        self._rec.log("points/tracked", rr.Scalars(float(len(obs))))
        self._rec.log("points/inliers", rr.Scalars(float(obs.inlier.sum())))
        self._scene.frame(frame)
        image = self._images.pop(frame.frame_id, None)
        if image is not None:
            self._show_images(frame, image)
            if self._pictures % MATCHES_EVERY == 0:
                self._show_matches(frame, image.left)
            self._pictures += 1
            if frame.is_keyframe:
                self._images[frame.frame_id] = image  # until the keyframe itself comes
        elif not self._pictures:
            self._show_tracks(frame)

    def _show_tracks(self, frame: Frame) -> None:
        obs = frame.observations
        dots = rr.Points2D(obs.uv_left, colors=age_colors(obs.age), radii=rr.Radius.ui_points(2.5))
        self._rec.log("map/camera/left/features", dots)

    def _show_images(self, frame: Frame, image: StereoImage) -> None:
        """Both images, tracks by age in the left one, lines by disparity in the right one."""
        self._rec.log("map/camera/left/image", _jpeg(image.left))
        self._show_tracks(frame)
        obs = frame.observations
        stereo = np.isfinite(obs.uv_right[:, 0])
        if image.right is not None:
            self._rec.log("right/image", _jpeg(image.right))
        elif not stereo.any():
            return
        ends = np.stack([obs.uv_left[stereo], obs.uv_right[stereo]], 1)
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        colors = spread_colors(np.log(np.maximum(length, 0.1)))
        self._rec.log("right/disparity", rr.LineStrips2D(strips(ends), colors=colors, radii=rr.Radius.ui_points(1.0)))
        self._rec.log("right/points", rr.Points2D(ends[:, 1], colors=colors, radii=rr.Radius.ui_points(2.0)))

    def _show_matches(self, frame: Frame, now: U8) -> None:
        """The points that the last keyframe and this frame share, side by side."""
        if self._keyframe is None:
            return
        keyframe, before = self._keyframe
        obs = frame.observations
        _, a, b = np.intersect1d(keyframe.point_ids, obs.point_ids, return_indices=True)
        if not len(a) or before.shape != now.shape:
            return
        some = slice(None, None, -(-len(a) // MATCHES_DRAWN))
        a, b = a[some], b[some]
        shift = np.array([before.shape[1], 0.0])
        ends = np.stack([keyframe.uv_left[a], obs.uv_left[b] + shift], 1)
        colors = turbo(ends[:, 0, 1], 0.0, float(before.shape[0]))  # by height, so that neighbours can be distinguished
        self._rec.log("matches/image", _jpeg(np.hstack([before, now])))
        self._rec.log("matches/lines", rr.LineStrips2D(strips(ends), colors=colors, radii=rr.Radius.ui_points(0.6)))

    # -- other messages----------------------------------------------------------------------------------------------

    @_show.register
    def _put_keyframe(self, keyframe: Keyframe) -> None:
        self._scene.keyframe(keyframe)
        image = self._images.pop(keyframe.frame_id, None)
        if image is not None:
            self._keyframe = (keyframe, image.left)

    @_show.register
    def _put_depth(self, live: LiveDepth) -> None:
        self._at(live.frame_id, live.stamp_ns)
        fx, fy, cx, cy = live.pinhole.tolist()
        height, width = live.depth_mm.shape
        camera = rr.Pinhole(
            focal_length=(fx, fy), principal_point=(cx + 0.5, cy + 0.5), width=width, height=height,
            camera_xyz=rr.ViewCoordinates.RDF,
        )  # fmt: skip
        self._rec.log("depth", camera)
        self._rec.log("depth/image", rr.DepthImage(live.depth_mm, meter=1000.0))
        obstacles = rr.Points3D(live.obstacles, colors=[OBSTACLE], radii=rr.Radius.ui_points(2.0))
        self._rec.log("map/camera/obstacles", obstacles)

    @_show.register
    def _put_dropped(self, dropped: Dropped) -> None:
        self._dropped += dropped.count
        self._rec.log("points/dropped", rr.Scalars(float(self._dropped)))


def _jpeg(image: U8) -> rr.EncodedImage:
    data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()
    return rr.EncodedImage(contents=data, media_type="image/jpeg")
