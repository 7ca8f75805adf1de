"""The part of an image inside the lens's image circle, which the calibration does not describe.

The image circle of a fisheye ends in a dark rim that moves with the camera: a window on it has a static edge and would
measure no motion. The rim is found from the images: beyond its angle from the axis no pixel is ever bright.
"""

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.calib.mask import half_size, uncovered
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.tracking.flow.corners import corner_mask
from stereo_sfm.types import F64, U8, Bool

STEP = 2  # px of the half image between the sampled ones
CENTRE_DEG = 45.0  # angle from the axis within which the brightness is that of the scene
MIN_RIM_DEG = 60.0  # smaller angles are dark surroundings, not the rim
LIT = 0.3  # of the median brightness in the centre, above which a pixel is bright
LIT_SHARE = 0.1  # of bright pixels at one angle, above which it is inside the image circle
WINDOW = 7  # px of the half image: margin to the rim for the windows of points


class VisibleArea:
    """The part of one camera's image in which points may lie."""

    def __init__(self, camera: Camera, max_angle_deg: float, mask: Bool | None = None) -> None:
        """`mask`: (H, W) of the camera's image, True where it is used (`Rig.left_mask`); None: everywhere."""
        grid = camera.bearing_grid(2 * STEP)
        with np.errstate(invalid="ignore"):
            angle = np.nan_to_num(np.degrees(np.arccos(np.clip(grid[..., 2], -1, 1))), nan=180.0)
        self._camera = camera
        self._degree = angle.astype(np.int64)  # (H / 4, W / 4)
        self._lit = np.zeros(181)  # largest share of bright pixels so far at each degree
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
        sparse, degree = half_image[::STEP, ::STEP], self._degree
        lit = sparse > LIT * np.median(sparse[degree < CENTRE_DEG])
        share = np.bincount(degree[lit], minlength=181) / np.maximum(np.bincount(degree.ravel(), minlength=181), 1)
        self._lit = np.maximum(self._lit, share)
        rim = int(np.flatnonzero(self._lit >= LIT_SHARE).max(initial=0)) + 1
        if rim >= MIN_RIM_DEG and rim != self._rim_deg:
            self._rim_deg = rim
            shown = self._camera.valid_mask(math.radians(rim), step=2).astype(np.uint8)
            self._shown = (cv2.erode(shown, np.ones((WINDOW, WINDOW), np.uint8)) > 0) & self._used

    def inside(self, uv: F64) -> Bool:
        """Which pixels (N, 2) are in the image and inside the rim; False for NaN."""
        inside = self._camera.inside(uv, 1.0)
        u, v = np.rint(uv[inside] / 2).astype(np.int64).T
        inside[inside] = self._shown[np.minimum(v, self._shown.shape[0] - 1), np.minimum(u, self._shown.shape[1] - 1)]
        return inside
