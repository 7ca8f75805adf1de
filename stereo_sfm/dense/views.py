"""Two images from different places, resampled so that a point is on the same row of both.

A stereo pair that sees less than 120 degrees becomes a pinhole pair. A wider pair, and two keyframes between which the
camera drove (any direction, also straight ahead), become epipolar-aligned images: rows are half planes through both
centres, columns the angle along the line between them (geometry/cameras.py, `Epipolar`). There the epipolar geometry
holds in the whole view, so that one image shows what is ahead and the shelves on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereo_sfm.calib.rectification import CameraRectification, camera_rectification, rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.geometry.cameras import Camera, Epipolar, Pinhole
from stereo_sfm.types import F32, F64, I64, U8, Bool

WIDE_DEG = 120.0  # a pinhole image of a wider view is mostly stretched border (as geometry/rectify.py)
POLE_DEG = 75.0  # from the plane across the baseline: beyond, the baseline seen from there is below a quarter of itself
NEAREST_BASELINES = 4.0  # nearest range searched in a stereo pair, as `tracker.min_depth_baselines`
COARSE_PX = 8  # between the pixels of a view that tell which part of it two images show
NEAREST_M = 0.5  # the same between keyframes: a robot keeps this distance from shelves


@dataclass(frozen=True, eq=False)
class _Resampling:
    """Tables of cv2.remap from one camera's images to the view."""

    table: NDArray[np.int16]  # (H, W, 2)
    fraction: NDArray[np.uint16]  # (H, W)
    mask: Bool  # (H, W) pixels that have a source

    def apply(self, image: U8) -> U8:
        import cv2

        out: Any = cv2.remap(image, self.table, self.fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return out


@dataclass(frozen=True, eq=False)
class PairView:
    """Virtual equal cameras of two images; the second is at (+baseline, 0, 0) of the first."""

    camera: Camera  # Pinhole or Epipolar
    cam_R_view: F64  # (3, 3) into the first image's camera
    baseline: float  # metres
    nearest: float  # metres, smallest range that is searched
    first: _Resampling
    second: _Resampling

    @property
    def disparities(self) -> int:
        """Largest disparity plus one that is searched, px: a multiple of 16, as the matcher needs."""
        most = self.camera.fx * 2 * np.arctan(0.5 * self.baseline / self.nearest) + 1
        return max(16, -(-int(most) // 16) * 16)

    def every(self, step: int) -> PairView:
        """The view of every `step`-th pixel alone; its disparities are smaller by `step`."""
        c = self.camera
        size = -(-c.width // step), -(-c.height // step)
        return replace(self, camera=type(c)(*size, c.fx / step, c.fy / step, c.cx / step, c.cy / step))

    def images(self, first: U8, second: U8) -> tuple[U8, U8]:
        """Both (H, W) images in the view."""
        return self.first.apply(first), self.second.apply(second)

    def measured(self, disparity: F32, sigma: F32) -> tuple[F32, F32]:
        """As `ranges`, and standard deviations in metres from those (H, W) px of the disparities."""
        ranges, slope = self._geometry(disparity)
        return ranges, slope * sigma

    def ranges(self, disparity: F32) -> F32:
        """Disparities (H, W) px -> metres from the first camera's centre along each pixel's ray."""
        return self._geometry(disparity)[0]

    def _geometry(self, disparity: F32) -> tuple[F32, F32]:
        """Range, and the size of its derivative by the disparity."""
        c = self.camera
        u = np.arange(c.width, dtype=np.float32)[None, :]
        with np.errstate(divide="ignore", invalid="ignore"):
            if isinstance(c, Pinhole):
                x, y = (u - c.cx) / c.fx, (np.arange(c.height, dtype=np.float32)[:, None] - c.cy) / c.fy
                r = np.float32(c.fx * self.baseline) * np.sqrt(1 + x * x + y * y) / disparity
                slope = r / disparity
            else:  # law of sines in the epipolar plane
                along, angle = (u - c.cx) / c.fx, disparity / np.float32(c.fx)
                r = self.baseline * np.cos(along - angle) / np.sin(angle)
                slope = self.baseline * np.cos(along) / (np.square(np.sin(angle)) * np.float32(c.fx))
        good = (disparity > 0) & (r > 0)
        return np.where(good, r, np.nan).astype(np.float32), np.where(good, slope, np.nan).astype(np.float32)


def stereo_view(rig: Rig, scale: float = 1.0) -> PairView:
    """The view of a stereo rig; `scale` of its resolution over the images'.

    Raises:
        StereoSfmError: one camera, or two that cannot be rectified.
    """
    rectified = rectify(rig, "pinhole" if _is_narrow(rig.left) else "epipolar", None if _is_narrow(rig.left) else 150.0)
    camera, nearest = scaled(rectified.rig.left, scale), NEAREST_BASELINES * rig.baseline
    if camera is not rectified.rig.left:
        assert rig.right is not None
        left = _resampling(rig.left, rig.left_mask, camera, rectified.left.target_R_source)
        right = _resampling(rig.right, rig.right_mask, camera, rectified.right.target_R_source)
    else:
        left, right = _tables(rectified.left), _tables(rectified.right)
    return PairView(camera, rectified.cam_T_rect[:3, :3], rig.baseline, nearest, left, right)


def motion_view(first: Rig, second: Rig, first_T_second: F64, focal: float) -> PairView | None:
    """The view of two left images taken from different places: all around the line between them.

    Args:
        first, second: their rigs. first_T_second: (4, 4) metres, of the left cameras. focal: resolution, px per radian.

    Returns:
        None where both see too little in common.
    """
    offset = first_T_second[:3, 3]
    baseline = float(np.linalg.norm(offset))
    x = offset / max(baseline, 1e-12)
    axis = np.eye(3)[int(np.argmin(np.abs(x)))]
    y = np.cross(axis, x)
    y /= np.linalg.norm(y)
    view_R_first = np.stack([x, y, np.cross(x, y)])
    half = np.deg2rad(POLE_DEG)
    width, height = int(2 * half * focal), int(2 * np.pi * focal)
    camera = Epipolar(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))
    sources = (first, view_R_first), (second, view_R_first @ first_T_second[:3, :3])
    some = camera.bearing_grid(COARSE_PX)
    masks = [rig.left.inside(rig.left.project(some @ rotation)) for rig, rotation in sources]
    v = _span(np.flatnonzero((masks[0] & masks[1]).any(axis=1)), height)
    u = _span(np.flatnonzero((masks[0] | masks[1]).any(axis=0)), width)
    cropped = Epipolar(u.stop - u.start, v.stop - v.start, focal, focal, camera.cx - u.start, camera.cy - v.start)
    if min(cropped.size) < 16:
        return None
    parts = [_resampling(rig.left, rig.left_mask, cropped, rotation) for rig, rotation in sources]
    return PairView(cropped, view_R_first.T, baseline, NEAREST_M, parts[0], parts[1])


def _span(seen: I64, size: int) -> slice:
    """Pixels of `size` around those that are seen. Args: seen (N,) numbers among every `COARSE_PX`-th, ascending."""
    at = (COARSE_PX * seen).tolist()
    return slice(max(0, at[0] - COARSE_PX), min(size, at[-1] + COARSE_PX + 1)) if at else slice(0, 0)


def scaled(camera: Camera, scale: float) -> Camera:
    """A camera of another resolution that sees the same; pixel (0, 0) is the centre of the upper left pixel."""
    if scale == 1.0:
        return camera
    size = max(16, round(camera.width * scale)), max(16, round(camera.height * scale))
    sx, sy = size[0] / camera.width, size[1] / camera.height
    centre = (camera.cx + 0.5) * sx - 0.5, (camera.cy + 0.5) * sy - 0.5
    return type(camera)(*size, camera.fx * sx, camera.fy * sy, *centre, camera.distortion)


def _is_narrow(camera: Camera) -> bool:
    """Whether the horizontal field of view is below `WIDE_DEG`."""
    ends = camera.unproject(np.array([[0.0, camera.cy], [camera.width - 1.0, camera.cy]]))
    return bool(np.isfinite(ends).all() and ends[0] @ ends[1] > np.cos(np.deg2rad(WIDE_DEG)))


def _resampling(source: Camera, used: Bool | None, target: Camera, target_R_source: F64) -> _Resampling:
    """`used`: (H, W) of the source; what it does not cover has none."""
    return _tables(camera_rectification(source, used, target, target_R_source))


def _tables(found: CameraRectification) -> _Resampling:
    return _Resampling(found.table, found.fraction, found.mask)
