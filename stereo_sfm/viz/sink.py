"""A run in rerun: images with features, trajectory, map, loops, time series. A sink of the pipeline."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from calib.rig import Rig
from stereo_sfm.geometry import se3
from stereo_sfm.log.map_view import MapView
from stereo_sfm.pipeline.sinks import StageTimes
from stereo_sfm.types import F64, I32, U8, Frame, Keyframe, LoopResult, MapUpdate, StereoImage, Trajectory

MEMORY_LIMIT = "1GB"  # of the viewer, which keeps its history
JPEG_QUALITY = 80
MAP_EVERY = 5  # updates between two pictures of the whole map
OLD = 60  # frames after which a track's colour no longer changes
ODOMETRY, MAPPED, TRUTH, LOOP = (255, 170, 0), (60, 160, 255), (120, 220, 120), (255, 60, 60)


def blueprint(name: str) -> rrb.Blueprint:
    """What a user sees first: the map, both eyes, and the numbers over time."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/map", name=name),
            rrb.Vertical(
                rrb.Spatial2DView(origin="/cam0", name="left: features by age (new blue, old red)"),
                rrb.Spatial2DView(origin="/matches", name="last keyframe (left) and this frame (right)"),
                rrb.TimeSeriesView(origin="/points", name="tracked points"),
                rrb.TimeSeriesView(origin="/ms", name="milliseconds a stage"),
                rrb.TextLogView(origin="/log", name="log"),
                row_shares=[4, 3, 2, 2, 1],
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def age_colors(age: I32) -> U8:
    """(N,) frames -> (N, 3) RGB: blue for new tracks, over green, to red for old ones."""
    scaled = np.clip(age.astype(float) / OLD, 0, 1) * 255
    bgr = cv2.applyColorMap(scaled.astype(np.uint8)[:, None], cv2.COLORMAP_JET)[:, 0]
    return bgr[:, ::-1].astype(np.uint8, copy=False)


class RerunSink:
    """Shows the messages of a run as they come."""

    def __init__(
        self, rig: Rig, name: str, mode: str, path: Path | None = None, ground_truth: Trajectory | None = None
    ) -> None:
        """Open a viewer.

        Args:
            mode: "spawn" a viewer, "serve" it to browsers, or "save" to `path`.
            ground_truth: drawn aligned with the first pose.
        """
        self._rec = rr.RecordingStream("stereo_sfm", recording_id=None)
        if mode == "spawn":
            self._rec.spawn(memory_limit=MEMORY_LIMIT, default_blueprint=blueprint(name))
        elif mode == "serve":
            uri = self._rec.serve_grpc(default_blueprint=blueprint(name), server_memory_limit=MEMORY_LIMIT)
            rr.serve_web_viewer(open_browser=False, connect_to=uri)
        else:
            assert path is not None
            self._rec.save(path, default_blueprint=blueprint(name))
        self._rig, self._map = rig, MapView()
        self._image: StereoImage | None = None
        self._keyframe: tuple[Keyframe, U8] | None = None
        self._map_T_odom: F64 = np.eye(4)
        self._odometry: list[F64] = []
        self._updates = 0
        self._rec.log("map", rr.ViewCoordinates.RDF, static=True)
        if ground_truth is not None and len(ground_truth):
            world = se3.inverse(ground_truth.poses[0]) @ ground_truth.poses
            self._rec.log("map/ground_truth", rr.LineStrips3D([world[:, :3, 3]], colors=[TRUTH]), static=True)

    def put(self, message: object) -> None:
        """Any message of a run; kinds that are not shown are passed over."""
        if isinstance(message, StereoImage):
            self._put_image(message)
        elif isinstance(message, Frame):
            self._put_frame(message)
        elif isinstance(message, Keyframe):
            self._put_keyframe(message)
        elif isinstance(message, MapUpdate):
            self._put_update(message)
        elif isinstance(message, LoopResult):
            self._put_loop(message)
        elif isinstance(message, StageTimes):
            for stage, ms in sorted(message.ms.items()):
                self._rec.log(f"ms/{stage}", rr.Scalars(ms))

    def close(self) -> None:
        """Everything is sent."""
        self._show_map()
        self._rec.flush()

    def _at(self, frame_id: int, stamp_ns: int) -> None:
        self._rec.set_time("frame", sequence=frame_id)
        self._rec.set_time("stamp", timestamp=np.datetime64(stamp_ns, "ns"))

    def _put_image(self, image: StereoImage) -> None:
        self._image = image
        self._at(image.frame_id, image.stamp_ns)
        self._rec.log("cam0/image", _jpeg(image.left))
        if image.right is not None:
            self._rec.log("cam1/image", _jpeg(image.right))

    def _put_frame(self, frame: Frame) -> None:
        self._at(frame.frame_id, frame.stamp_ns)
        obs = frame.observations
        self._rec.log("cam0/features", rr.Points2D(obs.uv_left, colors=age_colors(obs.age), radii=2.5))
        if len(obs):
            stereo = np.isfinite(obs.uv_right[:, 0])
            ends = np.stack([obs.uv_left[stereo], obs.uv_right[stereo]], 1)
            self._rec.log("cam0/disparity", rr.LineStrips2D(list(ends), colors=[(255, 255, 255, 60)], radii=0.5))
        self._rec.log("points/tracked", rr.Scalars(float(len(obs))))
        self._rec.log("points/inliers", rr.Scalars(float(obs.inlier.sum())))
        if frame.reason:
            self._rec.log(
                "log", rr.TextLog(f"frame {frame.frame_id}: {frame.state.name} ({frame.reason})", level="WARN")
            )
        pose = self._map_T_odom @ frame.odom_T_cam
        self._odometry.append(frame.odom_T_cam[:3, 3])
        self._rec.log("map/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        focal = min(self._rig.left.fx, 0.5 * self._rig.left.width)
        self._rec.log(
            "map/camera/left",
            rr.Pinhole(focal_length=focal, width=self._rig.left.width, height=self._rig.left.height,
                       camera_xyz=rr.ViewCoordinates.RDF, image_plane_distance=0.4),
        )  # fmt: skip
        if frame.frame_id % 10 == 0:
            self._rec.log("map/odometry", rr.LineStrips3D([np.array(self._odometry)], colors=[ODOMETRY], radii=0.01))
            self._show_matches(frame)

    def _put_keyframe(self, keyframe: Keyframe) -> None:
        self._map.keyframe(keyframe, self._map_T_odom)
        if self._image is not None:
            self._keyframe = (keyframe, self._image.left)

    def _show_matches(self, frame: Frame) -> None:
        """The points that the last keyframe and this frame share, side by side."""
        if self._keyframe is None or self._image is None:
            return
        keyframe, before = self._keyframe
        obs = frame.observations
        _, a, b = np.intersect1d(keyframe.point_ids, obs.point_ids, return_indices=True)
        if not len(a):
            return
        shift = np.array([before.shape[1], 0.0])
        self._rec.log("matches/image", _jpeg(np.hstack([before, self._image.left])))
        lines = np.stack([keyframe.uv_left[a], obs.uv_left[b] + shift], 1)
        self._rec.log("matches/points", rr.LineStrips2D(list(lines), colors=age_colors(obs.age[b]), radii=0.7))

    def _put_update(self, update: MapUpdate) -> None:
        self._map.update(update)
        self._map_T_odom = update.map_T_odom
        self._updates += 1
        if self._updates % MAP_EVERY == 0:
            self._show_map()

    def _show_map(self) -> None:
        self._rec.log("map/points", rr.Points3D(self._map.points, radii=0.012, colors=[(200, 200, 210)]))
        self._rec.log("map/trajectory", rr.LineStrips3D([self._map.trajectory[:, :3, 3]], colors=[MAPPED], radii=0.015))
        covisible = self._map.covisibility_lines.reshape(-1, 2, 3)
        self._rec.log("map/covisibility", rr.LineStrips3D(list(covisible), colors=[(90, 120, 160, 80)], radii=0.003))
        loops = self._map.loop_lines.reshape(-1, 2, 3)
        self._rec.log("map/loops", rr.LineStrips3D(list(loops), colors=[LOOP], radii=0.02))

    def _put_loop(self, result: LoopResult) -> None:
        if result.candidate_kf_id >= 0:
            self._map.loop(result)
            text = f"loop: keyframe {result.kf_id} is at keyframe {result.candidate_kf_id}, {result.inliers} inliers"
            self._rec.log("log", rr.TextLog(text, level="INFO"))
        elif result.rejected:
            text = f"no loop at keyframe {result.kf_id}: {result.reason}"
            self._rec.log("log", rr.TextLog(text, level="DEBUG"))


def _jpeg(image: U8) -> rr.EncodedImage:
    data = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()
    return rr.EncodedImage(contents=data, media_type="image/jpeg")
