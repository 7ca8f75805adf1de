"""What stands in a robot's way in one depth image: the floor is removed by gravity and the mounted height."""

from __future__ import annotations

import math

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import DenseConfig
from stereo_sfm.geometry.preintegration import GRAVITY
from stereo_sfm.maps.floor import BELOW_M, floor_level
from stereo_sfm.types import F32, F64, ImuSamples

CELL_M = 0.05  # side of the cells that get one point each: that of Nav2's costmaps
SUPPORT = 3  # pixels in a cell: fewer are gross errors of the matcher
TILT_SIGMA = math.radians(3.0)  # of gravity's direction, while a robot brakes or its body sways
HEIGHT_SIGMA_M = 0.03  # of the mounted height: tyres, suspension, a measuring tape
UNEVEN_M = 0.01  # of a floor
FLOOR_SAMPLES = 8000  # points that the floor's plane is fitted to: more cost time and tell nothing
ROUNDS = 4  # of the robust plane: its weights settle in three
FEW = 100  # points from which a height of the floor is known
CLEAR_SIGMAS = 2.0  # by which a point must be above the least height: noise of the floor is no obstacle
G_SHARE = 0.1  # an accelerometer that shows more or less than g by this does not show gravity alone


def upwards(rig: Rig, imu: ImuSamples | None) -> F64:
    """(3,) unit vector in the left camera against gravity: by the accelerometer at rest, else by the robot's axes."""
    accel = imu.accel[np.isfinite(imu.accel).all(axis=1)] if imu is not None else np.zeros((0, 3))
    if rig.imu is not None and len(accel):
        felt = rig.imu.accel_matrix @ accel.mean(axis=0) - rig.imu.accel_bias
        size = float(np.linalg.norm(felt))
        if abs(size - GRAVITY) < G_SHARE * GRAVITY:
            return rig.imu.left_T_imu[:3, :3] @ felt / size
    return rig.base_T_left[2, :3].copy()


def mounted_height(rig: Rig, config: DenseConfig) -> float:
    """Metres of the left camera above the floor, 0 where unknown: a body beside the camera is its IMU or itself."""
    above_body = float(rig.body_T_left[2, 3])
    return config.camera_height_m or (above_body if above_body > BELOW_M else 0.0)


def obstacles(ranges: F32, sigmas: F32, rays: F32, up: F64, height: float, config: DenseConfig) -> F32:
    """(N, 3) metres in the left camera, one point a cell of `CELL_M`.

    Args:
        ranges, sigmas: (H, W) metres, NaN where unknown. rays: (H, W, 3) unit vectors in the left camera.
        up: (3,) against gravity. height: of the camera above the floor; 0: as seen.
        config: limits of range and height.
    """
    used = ranges <= config.range_m  # NaN is not
    ranges, sigmas, rays = ranges[used], sigmas[used], rays[used]
    points = rays * ranges[:, None]
    rises = rays @ up.astype(np.float32)
    if height <= 0:
        below = -(rises * ranges)[rises < 0]
        height = floor_level(below.astype(float)) if len(below) >= FEW else 0.0
    sides = np.stack([*(points @ _across(up)).T, np.ones(len(points), np.float32)], axis=1)
    h, spread = rises * ranges + np.float32(height), np.abs(rises) * sigmas
    some = np.s_[:: max(1, len(h) // FLOOR_SAMPLES)]
    plane = _floor(*(a[some].astype(float) for a in (h, spread, sides)))
    above = h - sides @ plane.astype(np.float32)
    clear = (above - CLEAR_SIGMAS * spread > config.min_height_m) & (above < config.max_height_m)
    return _thinned(points[clear], config.range_m)


def _across(up: F64) -> F32:
    """(3, 2) two unit vectors across gravity."""
    x = np.cross(up, [0.0, 0.0, 1.0]) if abs(up[2]) < 0.9 else np.cross(up, [1.0, 0.0, 0.0])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x)], axis=1).astype(np.float32)


def _floor(h: F64, spread: F64, sides: F64) -> F64:
    """(3,) slopes and lift of the floor. Args: heights (N,), their standard deviations (N,), places (N, 3) across.

    The points may tilt and lift the floor within the standard deviations of gravity's direction and of the mounted
    height: where no floor is in view it stays where those say.
    """
    prior = np.diag([TILT_SIGMA**-2, TILT_SIGMA**-2, HEIGHT_SIGMA_M**-2])
    noise = spread * spread + UNEVEN_M**2
    unsure = noise + (TILT_SIGMA * np.linalg.norm(sides[:, :2], axis=1)) ** 2 + HEIGHT_SIGMA_M**2
    plane = np.zeros(3)
    for k in range(ROUNDS):
        scale = unsure if k == 0 else noise  # the first plane may be off by all that is unknown
        weight = 1 / (1 + np.square(h - sides @ plane) / scale) ** 2 / noise
        plane = np.linalg.solve(sides.T @ (sides * weight[:, None]) + prior, sides.T @ (weight * h))
    return np.asarray(plane, float)


def _thinned(points: F32, reach: float) -> F32:
    """The mean of the points in each cell with `SUPPORT`, cells in order. Args: (N, 3) metres; none beyond `reach`."""
    side = 2 * int(reach / CELL_M) + 3
    at = np.floor(points / np.float32(CELL_M)).astype(np.int64) + side // 2
    _, cell, count = np.unique((at[:, 0] * side + at[:, 1]) * side + at[:, 2], return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(cell, points[:, k], len(count)) for k in range(3)], axis=1)
    full = count >= SUPPORT
    return (sums[full] / count[full, None]).astype(np.float32)
