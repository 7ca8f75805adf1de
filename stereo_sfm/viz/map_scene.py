"""The 3D part of the viewer: camera, trajectories, keyframes, points, edges."""

from __future__ import annotations

import numpy as np
import rerun as rr

from stereo_sfm.calib.rig import Rig
from stereo_sfm.log.map_view import MapView
from stereo_sfm.types import F64, Frame, Keyframe, LoopResult, MapUpdate
from stereo_sfm.viz.shapes import spread_colors, strips, wire_cameras

ODOMETRY, MAPPED, LOOP = (255, 160, 40), (70, 150, 255), (255, 60, 60)
COVISIBLE, CAMERA = (70, 84, 110), (240, 240, 240)
MAP_SHARE = 40  # the whole map is redrawn when it has grown by 1 / MAP_SHARE
LINE_EVERY = 10  # frames between two updates of the odometry's line, more as it grows
USUAL_FRAMES = 2000
CAMERA_SIZE = 0.06  # of the trajectory's extent


class MapScene:
    """Follows the messages of a run and draws them under `map`."""

    def __init__(self, recording: rr.RecordingStream, rig: Rig) -> None:
        self._rec, self._rig, self._map = recording, rig, MapView()
        self._map_T_odom: F64 = np.eye(4)
        self._odometry: list[F64] = []  # positions
        self._next_update = self._next_line = 1
        self._updates = 0
        self._size = 0.0  # of the drawn camera, metres
        self._rec.log("map", rr.ViewCoordinates.RDF, static=True)

    def frame(self, frame: Frame) -> None:
        """The current pose of the camera."""
        pose = self._map_T_odom @ frame.odom_T_cam
        self._odometry.append(frame.odom_T_cam[:3, 3])
        self._rec.log("map/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        if len(self._odometry) < self._next_line:
            return
        self._next_line = len(self._odometry) + LINE_EVERY * max(len(self._odometry), USUAL_FRAMES) // USUAL_FRAMES
        line = np.array(self._odometry)
        self.show_camera(float(np.linalg.norm(np.ptp(line, axis=0))))
        self._rec.log("map/odometry", _lines(line[None], ODOMETRY, 1.0))

    def show_camera(self, extent: float) -> None:
        """The pyramid of the camera, scaled with the trajectory."""
        size = max(0.15, CAMERA_SIZE * extent)
        if 0.8 < size / max(self._size, 1e-9) < 1.25:
            return
        self._size = size
        left = self._rig.left
        focal = min(left.fx, 0.5 * left.width)  # a fisheye's pyramid shows its direction, not its field of view
        pinhole = rr.Pinhole(
            focal_length=focal, width=left.width, height=left.height, camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=1.2 * size, color=CAMERA,
        )  # fmt: skip
        self._rec.log("map/camera/left", pinhole)

    def keyframe(self, keyframe: Keyframe) -> None:
        """A frame that enters the map."""
        self._map.keyframe(keyframe, self._map_T_odom)

    def loop(self, result: LoopResult) -> None:
        """An accepted loop."""
        self._map.loop(result)

    def update(self, update: MapUpdate) -> None:
        """The mapper's result; the whole map is redrawn as it grows and after each correction."""
        jumped = float(np.abs(update.map_T_odom - self._map_T_odom).max()) > 1e-3 and len(update.kf_ids) > 20
        self._map.update(update)
        self._map_T_odom = update.map_T_odom
        self._updates += 1
        if jumped or self._updates >= self._next_update:
            self._next_update = self._updates + max(1, self._map.keyframes // MAP_SHARE)
            self.show()

    def show(self) -> None:
        """The whole map."""
        points, (_, poses) = self._map.points, self._map.trajectory
        # Colour is height: y points down where the first camera was upright.
        cloud = rr.Points3D(points, radii=rr.Radius.ui_points(1.3), colors=spread_colors(-points[:, 1]))
        self._rec.log("map/points", cloud)
        if not len(poses):
            return
        self._rec.log("map/trajectory", _lines(poses[None, :, :3, 3], MAPPED, 1.6))
        self._rec.log("map/keyframes", _lines(wire_cameras(poses, 0.3 * self._size), MAPPED, 0.7))
        self._rec.log("map/covisibility", _lines(self._map.covisibility_lines.reshape(-1, 2, 3), COVISIBLE, 0.5))
        self._rec.log("map/loops", _lines(self._map.loop_lines.reshape(-1, 2, 3), LOOP, 3.0))


def _lines(points: F64, color: tuple[int, int, int], width: float) -> rr.LineStrips3D:
    """(N, L, 3) vertices of lines that are 2 * `width` screen points wide at any distance."""
    return rr.LineStrips3D(strips(points), colors=[color], radii=rr.Radius.ui_points(width))
