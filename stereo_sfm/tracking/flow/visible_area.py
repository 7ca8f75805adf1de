"""The part of an image inside the lens's image circle, which the calibration does not describe.

The image circle of a fisheye ends in a dark rim that moves with the camera: a window on it has a static edge and would
measure no motion. The rim is found from the images: beyond its angle from the axis no pixel is ever bright.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.calib.mask import half_size, uncovered
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.tracking.flow.corners import corner_mask
from stereo_sfm.types import F32, F64, I64, U8, Bool

STEP = 2  # px of the half image between the sampled ones
CENTRE_DEG = 45.0  # angle from the axis within which the brightness is that of the scene
MIN_RIM_DEG = 60.0  # smaller angles are dark surroundings, not the rim
LIT = 0.3  # of the median brightness in the centre, above which a pixel is bright
LIT_SHARE = 0.1  # of bright pixels at one angle, at which it is inside the image circle
LEAST = 16  # median brightness in the centre of an image that shows the rim: four times the noise of black
WINDOW = 7  # px of the half image: margin to the rim for the windows of points
GRID = 8, 6  # columns and rows of cells, over which points should be spread


def cells_of(uv: F64 | F32, size: tuple[int, int], grid: tuple[int, int] = GRID) -> I64:
    """(N,) cells, row by row, of a grid over an image of that size that pixels (N, 2) are in."""
    cell = np.clip(uv * grid / size, 0, np.subtract(grid, 1)).astype(np.int64)
    return cell[:, 1] * grid[0] + cell[:, 0]


class VisibleArea:
    """The part of one camera's image in which points may lie."""

    def __init__(self, camera: Camera, max_angle_deg: float, mask: Bool | None = None) -> None:
        """`mask`: (H, W) of the camera's image, True where it is used (`Rig.left_mask`); None: everywhere."""
        grid = camera.bearing_grid(2 * STEP)
        with np.errstate(invalid="ignore"):
            angle = np.nan_to_num(np.degrees(np.arccos(np.clip(grid[..., 2], -1, 1))), nan=180.0)
        self._camera = camera
        self._degree = angle.astype(np.int64)  # (H / 4, W / 4)
        self._lit = np.zeros(
            181
        )  # brightness that LIT_SHARE of pixels at each degree reached, over the centre's median
        self._rim_deg = 181
        self._allowed = corner_mask(camera, max_angle_deg)
        self._used = np.ones_like(self._allowed) if mask is None else uncovered(half_size(mask), WINDOW // 2)
        self._shown = self._used  # (H / 2, W / 2) off the rim and what the mask covers

    @property
    def mask(self) -> Bool:
        """(H / 2, W / 2) where corners may lie."""
        return self._allowed & self._shown

    def learn(self, half_image: U8) -> None:
        """Update the rim with an image, level 1 of its pyramid."""
        if self._degree[0, 0] < MIN_RIM_DEG:
            return
        centre, lit = _brightness(half_image[::STEP, ::STEP], self._degree)
        if centre < LEAST:  # its noise is as bright beyond the rim
            return
        self._lit = np.maximum(self._lit, lit / centre)
        rim = int(np.flatnonzero(self._lit > LIT).max(initial=0)) + 1
        if rim >= MIN_RIM_DEG and rim != self._rim_deg:
            self._rim_deg = rim
            shown = self._camera.valid_mask(math.radians(rim), step=2).astype(np.uint8)
            self._shown = (cv2.erode(shown, np.ones((WINDOW, WINDOW), np.uint8)) > 0) & self._used

    def inside(self, uv: F64) -> Bool:
        """Which pixels (N, 2) are in the image and inside the rim; False for NaN."""
        return _inside(uv, self._camera.width, self._camera.height, self._shown)


@njit
def _brightness(image, degree):
    """Median within CENTRE_DEG, and (181,) what LIT_SHARE of the pixels at each degree from the axis reach.

    Args: image (H, W) uint8, degree (H, W).
    """
    counts = np.zeros((181, 256), np.int64)
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            counts[degree[y, x], image[y, x]] += 1
    lit = np.zeros(181, np.int64)
    for k in range(181):
        total, value = counts[k].sum(), 255
        reached = counts[k, value]
        while value > 0 and reached < LIT_SHARE * total:
            value -= 1
            reached += counts[k, value]
        lit[k] = value if total > 0 else 0
    centre = counts[: int(CENTRE_DEG)].sum(axis=0)
    median, below = 0, 0
    while median < 255 and below + centre[median] < centre.sum() / 2:
        below += centre[median]
        median += 1
    return median, lit


@njit
def _inside(uv, width, height, shown):
    inside = np.zeros(len(uv), np.bool_)
    for k in range(len(uv)):
        u, v = uv[k, 0], uv[k, 1]
        if u >= 1.0 and v >= 1.0 and u <= width - 2.0 and v <= height - 2.0:
            x, y = int(np.rint(u / 2)), int(np.rint(v / 2))
            inside[k] = shown[min(y, shown.shape[0] - 1), min(x, shown.shape[1] - 1)]
    return inside
