"""Depth of the newest pair while a run goes on: matched once, without refinement, for a robot that must not wait."""

from __future__ import annotations

from typing import Any

import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import DenseConfig
from stereo_sfm.dense.keyframe_depth import check_rig
from stereo_sfm.dense.matching import match_checked
from stereo_sfm.dense.noise import learned_sigmas
from stereo_sfm.dense.obstacles import mounted_height, obstacles, upwards
from stereo_sfm.dense.views import stereo_view
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.cameras import Pinhole
from stereo_sfm.types import F32, U8, U16, LiveDepth, StereoImage

TEXTURE_PX = 9  # side of the window whose gradients tell how well a disparity is known: the refinement's
STEP = 4  # px between disparities from which standard deviations are learned: neighbours say the same
AHEAD_DEG = 100.0  # field of view of the depth image of a wide lens, whose own view no pinhole camera shows
MOST_MM = 65_535  # of a depth image


class LiveDepthMaker:
    """Makes `LiveDepth` of pairs; each depends on its pair alone."""

    def __init__(self, rig: Rig, config: DenseConfig) -> None:
        """Args: rig, of the pairs. config: scale and limits.

        Raises:
            StereoSfmError: a camera without a pair.
        """
        check_rig(rig)
        if rig.second_camera is None:
            raise StereoSfmError("live depth needs two cameras: leave out dense.live, or use 'stereo-sfm dense' later")
        self._rig, self._config = rig, config
        self._view = stereo_view(rig, config.scale)
        self._camera = ahead(rig, config.scale)
        self._rays = (self._view.camera.bearing_grid() @ self._view.cam_R_view.T).astype(np.float32)
        rays = self._camera.bearing_grid()
        uv = self._view.camera.project(rays @ self._view.cam_R_view)
        self._inside = self._view.camera.inside(uv, -0.49)  # the nearest pixel is in the view
        at = np.rint(np.where(self._inside[..., None], uv, 0)).astype(np.int64)
        self._pick = at[..., 1], at[..., 0]
        self._along = rays[..., 2].astype(np.float32)  # of a range, along the optical axis

    def step(self, image: StereoImage) -> LiveDepth | None:
        """The depth of a pair; None where the right image is missing."""
        if image.right is None:
            return None
        ranges, sigmas = self._measured(image.left, image.right)
        up = upwards(self._rig, image.imu)
        found = obstacles(ranges, sigmas, self._rays, up, mounted_height(self._rig, self._config), self._config)
        c = self._camera
        pinhole = np.array([c.fx, c.fy, c.cx, c.cy])
        return LiveDepth(image.frame_id, image.stamp_ns, self._seen_ahead(ranges), pinhole, found)

    def _measured(self, left: U8, right: U8) -> tuple[F32, F32]:
        """Ranges (H, W) metres in the view, NaN where unknown, and their standard deviations."""
        view = self._view
        a, b = view.images(left, right)
        disparity = match_checked(a, b, view.disparities)
        disparity[~view.first.mask] = np.nan
        sigma = self._sigmas(a, disparity)
        return view.measured(disparity, sigma)

    @staticmethod
    def _sigmas(image: U8, disparity: F32) -> F32:
        """(H, W) px learned from the disparities, by texture (dense/noise.py)."""
        import cv2

        gradient = cv2.Sobel(image, cv2.CV_32F, 1, 0, scale=1 / 8)
        energy: Any = cv2.boxFilter(gradient * gradient, -1, (TEXTURE_PX, TEXTURE_PX))
        predicted = np.where(np.isfinite(disparity), 1 / (TEXTURE_PX * np.sqrt(energy + 1e-3)), np.nan)
        return learned_sigmas(disparity, predicted.astype(np.float32), TEXTURE_PX, STEP)

    def _seen_ahead(self, ranges: F32) -> U16:
        depth = np.where(self._inside, ranges[self._pick], 0) * self._along * 1000
        return np.where(depth <= MOST_MM, np.rint(depth), 0).astype(np.uint16)  # NaN: 0


def ahead(rig: Rig, scale: float) -> Pinhole:
    """The pinhole camera of depth images: the left one's axes, and its focal length unless that is a wide lens's."""
    width, height = (max(16, round(n * scale)) for n in rig.left.size)
    widest = 0.5 * width / np.tan(np.deg2rad(0.5 * AHEAD_DEG))
    focal = max(rig.left.fx * width / rig.left.width, float(widest))
    return Pinhole(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))


class Paced:
    """Which images get a depth: the first one at or after each instant of a rate; the same for the same stamps."""

    def __init__(self, rate_hz: float) -> None:
        self._every_ns = round(1e9 / rate_hz)
        self._next_ns: int | None = None

    def due(self, image: StereoImage) -> bool:
        """Ask for each image, in order; taken only when it was asked for and is made."""
        return self._next_ns is None or image.stamp_ns >= self._next_ns

    def taken(self, image: StereoImage) -> None:
        """The image is used: the next one follows after the interval."""
        late = 0 if self._next_ns is None else (image.stamp_ns - self._next_ns) % self._every_ns
        self._next_ns = image.stamp_ns - late + self._every_ns


class Chosen:
    """The images that an earlier run made depth of."""

    def __init__(self, frame_ids: frozenset[int]) -> None:
        self._frame_ids = frame_ids

    def due(self, image: StereoImage) -> bool:
        """Whether it is one of them."""
        return image.frame_id in self._frame_ids

    def taken(self, image: StereoImage) -> None:
        """Nothing depends on it."""
