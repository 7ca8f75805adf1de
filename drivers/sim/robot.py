"""The robot's own parts in view: the edge of its top below the cameras, and the post of a hand rail to their right.

They are planes fixed to the left camera; each camera sees them from its own position, so their disparity is correct.
"""

from __future__ import annotations

import numpy as np

from stereo_sfm.drivers.sim.render import CameraRays
from stereo_sfm.types import F32, F64, Bool

TOP_BELOW_M = 0.22  # the robot's top, below the left camera
TOP_EDGE = 0.72  # of the angle from the axis down to the last row: the direction of the top's front edge
POST_M = 0.24, 0.27  # the post's left and right side, to the right of the left camera
POST_ANGLE = 0.55  # of the angle from the axis to the last column: the direction of the post
CELL_M = 0.02  # side of the cells of the pattern on both, in place of screws, scratches and labels


class RobotView:
    """The robot in the image of one camera."""

    def __init__(self, camera: CameraRays, left_T_camera: F64, reach: tuple[float, float]) -> None:
        """Args:
        camera: the camera's rays. left_T_camera: (4, 4) its pose in the left camera. reach: radians from the left
            camera's axis down to its last row, and to the side to its last column.
        """
        rays = np.nan_to_num(camera.grid, nan=0.0) @ left_T_camera[:3, :3].T
        centre = left_T_camera[:3, 3]
        top = _hit(rays, centre, 1, TOP_BELOW_M)
        ahead = TOP_BELOW_M / np.tan(TOP_EDGE * reach[0])
        on_top = (top[..., 2] < ahead) & (np.abs(top[..., 0]) < 0.4)
        distance = POST_M[0] / np.tan(POST_ANGLE * reach[1])
        post = _hit(rays, centre, 2, max(distance, 0.02))
        on_post = (post[..., 0] > POST_M[0]) & (post[..., 0] < POST_M[1]) & (post[..., 1] > -0.3)
        self.covered: Bool = np.asarray(on_top | on_post)  # (H, W)
        pattern = np.where(on_post, _pattern(post[..., 0], post[..., 1]), _pattern(top[..., 0], top[..., 2]))
        self.brightness: F32 = pattern.astype(np.float32)  # (H, W) grey levels

    def over(self, image: F32) -> F32:
        """The image (H, W) with the robot in front of it."""
        return np.where(self.covered, self.brightness, image)


def _hit(rays: F64, centre: F64, axis: int, at: float) -> F64:
    """Where rays (H, W, 3) from a centre (3,) meet the plane of the left camera's coordinate `axis`; NaN where not."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (at - centre[axis]) / rays[..., axis]
        return np.where((t > 0)[..., None], centre + t[..., None] * rays, np.nan)


def _pattern(a: F64, b: F64) -> F64:
    """Grey levels of the surface at coordinates in metres: cells of pseudo-random shade, two fifths of them equal."""
    i, j = (np.floor(np.nan_to_num(v) / CELL_M).astype(np.int64) for v in (a, b))
    shade = ((i * 73856093) ^ (j * 19349663)) % 97 / 97.0
    return np.where(shade < 0.4, 70.0, 40.0 + 120.0 * shade)
