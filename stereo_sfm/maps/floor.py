"""The floor of a map: which way is up, and along which axes the aisles lie."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.dominant_direction import dominant_direction
from stereo_sfm.mapping.snapshot import MapSnapshot
from stereo_sfm.types import F64, Bool

if TYPE_CHECKING:
    from stereo_sfm.maps.saved_map import SavedMap

LOW, HIGH = 0.15, 1.9  # height range in metres of obstacles for the robot
BELOW_M = 0.2  # metres below the camera at which a floor can be
FEW = 20  # points, fewer show no plane
THICK_M = 0.05  # metres, of a level: stereo points of a floor a metre or two away scatter by a few centimetres


def floor_of(saved: SavedMap) -> F64:
    """map_T_floor (4, 4) of a saved map, as `find_floor`, by the axes of its newest session's robot."""
    return find_floor(saved.snapshot, saved.rig.base_T_left[2, :3])


def find_floor(s: MapSnapshot, up: F64 | None = None) -> F64:
    """map_T_floor (4, 4): z up from the floor plane, x along the dominant direction of the structure above it.

    `up`: (3,) unit vector in the left camera, of the robot's axes (`Rig.base_T_left`), where gravity is not measured.
    """
    felt = s.down_sigma > 0  # gravity, where an IMU measured it
    if felt.any():
        down = (s.map_T_kf[felt, :3, :3] @ s.down[felt, :, None])[..., 0].mean(0)
    else:
        # Cameras stand upright, though they may look up or down while driving around: a body whose z axis is not
        # upright then is an IMU's.
        axis = -up if up is not None and up[1] < -0.5 else np.array([0.0, 1.0, 0.0])
        down = (s.map_T_kf[:, :3, :3] @ axis).mean(0)
    if np.linalg.norm(down) < 0.3:
        raise StereoSfmError(
            "no floor plan: the vertical direction is unknown, since the cameras look in all directions"
        )
    down /= np.linalg.norm(down)
    centre = s.map_T_kf[:, :3, 3].mean(0)
    below = (s.points - centre) @ down
    down, depth = _floor_plane(s.points - centre, below > BELOW_M, down)
    across = np.cross(down, [1.0, 0, 0]) if abs(down[0]) < 0.5 else np.cross(down, [0, 0, 1.0])
    x = across / np.linalg.norm(across)
    axes = np.stack([x, np.cross(-down, x), -down], axis=1)
    flat = (s.points - centre) @ axes[:, :2]
    height = depth - (s.points - centre) @ down
    yaw = dominant_direction(flat[(height > LOW) & (height < HIGH)])
    c, n = math.cos(yaw), math.sin(yaw)
    turned = axes @ np.array([[c, -n, 0], [n, c, 0], [0, 0, 1.0]])
    return se3.from_rotation_translation(turned, centre + depth * down)


def _floor_plane(points: F64, candidates: Bool, down: F64) -> tuple[F64, float]:
    """Normal (pointing down) and depth below the origin of the lowest well-filled plane."""
    depth = points[candidates] @ down
    if len(depth) < FEW:
        return down, float(np.percentile(points @ down, 99)) if len(points) else 1.5
    level = floor_level(depth)
    near, normal = points[candidates][np.abs(depth - level) < THICK_M], down
    for _ in range(5):
        if len(near) < FEW:
            return down, level
        mean = near.mean(0)
        normal = np.linalg.svd(near - mean, full_matrices=False)[2][2]
        normal *= np.sign(normal @ down)
        if normal @ down < math.cos(math.radians(10)):
            return down, level
        distance = (points[candidates] - mean) @ normal
        near = points[candidates][np.abs(distance) < THICK_M]
    return (normal, float(near.mean(0) @ normal)) if len(near) >= FEW else (down, level)


def floor_level(depth: F64) -> float:
    """Metres to the lowest well-filled level. Args: depth, (N,) metres of points below the camera."""
    counts, edges = np.histogram(depth, np.arange(depth.min(), depth.max() + 2 * THICK_M, THICK_M))
    smooth = np.convolve(counts, [1, 2, 1], "same")
    full = np.flatnonzero(smooth > 0.4 * smooth.max())
    return float(edges[full[-1]] + THICK_M / 2)
