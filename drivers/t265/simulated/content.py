"""The scene of the simulated camera: images, poses, inertial truth, by the time since it first streamed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.drivers.t265 import messages as m
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import F64, U8

GRAVITY_WORLD = np.array([0.0, 9.80665, 0.0])  # y points down in the scenes used here
_STEP_S = 2e-3


@dataclass(frozen=True, eq=False)
class Content:
    """Pre-rendered images that are played forwards and backwards endlessly."""

    rig: Rig
    images: list[tuple[U8, U8]]  # (800, 848) each
    poses: Callable[[F64], F64]  # (N,) seconds within the images -> (N, 4, 4) world_T_cam

    @property
    def _duration_s(self) -> float:
        return (len(self.images) - 1) / m.FRAME_RATE

    def image(self, index: int) -> tuple[U8, U8]:
        """Left and right of the frame with this index, counted since the camera first streamed."""
        count = len(self.images)
        period = max(2 * (count - 1), 1)
        k = index % period
        return self.images[k if k < count else period - k]

    def pose(self, seconds: F64) -> F64:
        """(N, 4, 4) world_T_cam at (N,) seconds since the camera first streamed."""
        d = self._duration_s
        folded = d - np.abs(np.mod(np.asarray(seconds, float), 2 * d) - d) if d > 0 else np.zeros_like(seconds)
        return self.poses(folded)

    def inertial(self, seconds: F64, left_T_imu: F64) -> tuple[F64, F64]:
        """Gyroscope (N, 3) rad/s and accelerometer (N, 3) m/s^2 in the IMU's axes, by differences of the poses."""
        t = np.asarray(seconds, float)
        before, now, after = (self.pose(t + k * _STEP_S) @ left_T_imu for k in (-1, 0, 1))
        gyro = se3.so3_log(np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]) / (2 * _STEP_S)
        acceleration = (after[:, :3, 3] - 2 * now[:, :3, 3] + before[:, :3, 3]) / _STEP_S**2
        force = np.einsum("nji,nj->ni", now[:, :3, :3], np.clip(acceleration, -50, 50) - GRAVITY_WORLD)
        return gyro, force


def room_content(frames: int, seed: int = 0) -> Content:
    """The default scene."""
    from stereo_sfm.drivers.sim.rigs import fisheye
    from stereo_sfm.drivers.t265.simulated.room import Room, camera_path

    rig = fisheye()
    room = Room(rig, seed)
    images = [room.render(pose) for pose in camera_path(np.arange(frames) / m.FRAME_RATE)]
    return Content(rig, images, camera_path)


def source_content(spec: str, frames: int) -> Content:
    """Images of any source with a fisheye pair of 848x800: the simulated store, a recording of a real T265.

    Raises:
        StereoSfmError: unsuitable camera, or no images.
    """
    from stereo_sfm.drivers.source import open_source
    from stereo_sfm.geometry.cameras import KannalaBrandt

    with open_source(spec) as source:
        rig = source.rig
        if not isinstance(rig.left, KannalaBrandt) or rig.left.size != (m.WIDTH, m.HEIGHT) or rig.right is None:
            raise StereoSfmError(f"{spec} is not a fisheye pair of 848x800: a simulated T265 cannot show it")
        images: list[tuple[U8, U8]] = []
        stamps: list[int] = []
        for image in source:
            if image.right is not None:
                images.append((image.left, image.right))
                stamps.append(image.stamp_ns)
            if len(images) == frames:
                break
        truth = source.ground_truth
    if not images:
        raise StereoSfmError(f"{spec} has no image pairs to show")
    if truth is None:
        still = np.eye(4)
        return Content(rig, images, lambda t: np.broadcast_to(still, (len(t), 4, 4)))
    known_s = (truth.stamp_ns - stamps[0]) * 1e-9
    poses = truth.poses

    def interpolated(seconds: F64) -> F64:
        right = np.clip(np.searchsorted(known_s, seconds, side="right"), 1, len(known_s) - 1)
        span = known_s[right] - known_s[right - 1]
        fraction = np.clip((seconds - known_s[right - 1]) / span, 0, 1)
        return se3.interpolate(poses[right - 1], poses[right], fraction)

    return Content(rig, images, interpolated)
