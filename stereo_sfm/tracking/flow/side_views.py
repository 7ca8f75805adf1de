"""Virtual views towards the shelves beside the camera, which look alike when the aisle is driven in both directions.

Fronto-parallel views of a plane differ by a shift and a scale only. The shelf front on the right of a robot will be on
its left when it comes back. Corners are therefore detected and described in two virtual pinhole views whose optical
axes are perpendicular to the shelf fronts, and are stored with their pixels in the camera's image, as other corners
(`Corners`). Fisheye cameras see the shelves almost fronto-parallel; narrower cameras contribute the oblique part of the
view that they have.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.dominant_direction import dominant_direction
from stereo_sfm.geometry.kernels import njit
from stereo_sfm.tracking.descriptors import RADIUS
from stereo_sfm.tracking.flow.klt import Pyramid
from stereo_sfm.tracking.flow.place_corners import StereoOrb
from stereo_sfm.types import F32, F64, U8, Corners

FOCAL = 0.7  # focal length of a view over the camera's: about the resolution of the image
HALF_ANGLES = 2.14, 1.0  # tangents of half the field of view, horizontal and vertical: 65 and 45 degrees
MAX_FOCAL_PX = 320.0  # finer views take longer and find no more
NODE_SPACING = 16  # px of a view between exactly projected pixels; the map is interpolated between them
# Metres: height over the camera and uncertainty of points that determine the shelves' direction.
HEIGHT_BAND, MAX_SIGMA = 1.1, 0.3
CELL, MIN_SIGMA = 0.08, 0.05  # metres, of the histogram and of a point's uncertainty
SPACING = 0.3, 0.35  # between successive views: share of the distance to the shelves, radians
MIN_SPACING_M = 0.25  # between successive views


@dataclass(frozen=True, eq=False)
class _View:
    """A virtual pinhole camera: pixel (u, v) has the ray ((u, v) + first) / focal, 1) in its axes."""

    camera_R_view: F64  # (3, 3)
    first: F64  # (2,) px from the principal point to the upper left corner
    maps: tuple[F32, F32]  # (H, W) pixels of the image, for cv2.remap
    mask: U8  # (H, W) where corners may lie


class SideViews:
    """Corners of the two views."""

    def __init__(self, config: Config, rig: Rig) -> None:
        self._rig, self._orb = rig, StereoOrb(config.tracker, rig, config.loop.side_corners // 2)
        self._disparity_sigma = config.loop.disparity_sigma_px
        self._min_z = np.cos(np.deg2rad(config.tracker.max_angle_deg))
        self._focal = min(FOCAL * rig.left.fx, MAX_FOCAL_PX)
        self._left_mask = None if rig.left_mask is None else rig.left_mask.astype(np.uint8)
        self._last: tuple[int, F64, float] | None = None  # newest: submap, odom_T_cam, metres to the shelves

    @staticmethod
    def from_config(config: Config, rig: Rig) -> SideViews | None:
        """The views of a run; None without place recognition or without depth."""
        needed = config.mapper.enabled or config.loop.enabled
        return SideViews(config, rig) if rig.stereo and needed and config.loop.side_corners else None

    def use(self, rig: Rig) -> None:
        """Use a corrected rig."""
        self._rig = rig
        self._orb.use(rig)

    def find(self, left: Pyramid, right: Pyramid | F32, corners: Corners, odom_T_cam: F64, submap_id: int) -> Corners:
        """The corners of both views that both cameras see; none if the camera has hardly moved since the last ones.

        Args:
            left: the image's pyramid. right: the result of `StereoMatcher.prepare` for the second camera.
            corners: of the image; the direction of the shelves is estimated from their points.
            odom_T_cam, submap_id: pose (4, 4) of the image.
        """
        if not self._due(odom_T_cam, submap_id):
            return Corners.none()
        points = corners.points_cam.astype(np.float64)
        camera_R_shelves = self._shelf_axes(points)
        across = np.abs((points @ camera_R_shelves)[:, 0])
        self._last = submap_id, odom_T_cam, float(np.median(across)) if len(points) else 0.0
        views = [self._view(camera_R_shelves, side) for side in (1.0, -1.0)]
        parts = [self._corners(left, right, view) for view in views if view is not None]
        return Corners.joined(parts)

    def _due(self, odom_T_cam: F64, submap_id: int) -> bool:
        if self._last is None or self._last[0] != submap_id:
            return True
        metres, radians = se3.extent(se3.inverse(self._last[1]) @ odom_T_cam)
        return bool(metres >= max(SPACING[0] * self._last[2], MIN_SPACING_M) or radians >= SPACING[1])

    def _shelf_axes(self, points: F64) -> F64:
        """(3, 3) camera_R_shelves: x perpendicular to the shelf fronts, y down, z along them.

        The camera is assumed to be upright; a tilt of some degrees rotates the views in both directions alike.
        """
        sigmas = self._rig.range_sigmas(points, self._disparity_sigma)
        near = (sigmas < MAX_SIGMA) & (np.abs(points[:, 1]) < HEIGHT_BAND)
        yaw = dominant_direction(points[near][:, [0, 2]], 1.0 / (sigmas[near] + MIN_SIGMA), CELL)
        return se3.so3_exp(np.array([0.0, -yaw, 0.0]))

    def _view(self, camera_R_shelves: F64, side: float) -> _View | None:
        """The view to the right (side 1) or left (-1), cropped to the camera's view; None if that is too small."""
        axis, down = side * camera_R_shelves[:, 0], camera_R_shelves[:, 1]
        camera_R_view = np.stack([np.cross(down, axis), down, axis], axis=1)
        x, y = (
            np.arange(-tangent * self._focal, tangent * self._focal + NODE_SPACING, NODE_SPACING)
            for tangent in HALF_ANGLES
        )
        u, v = np.meshgrid(x, y)
        rays = np.stack([u / self._focal, v / self._focal, np.ones_like(u)], -1) @ camera_R_view.T
        uv = self._rig.left.project(rays)
        seen = self._rig.left.inside(uv, 1.0) & (rays[..., 2] > self._min_z * np.linalg.norm(rays, axis=-1))
        rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
        if (min(len(rows), len(columns)) - 1) * NODE_SPACING <= 2 * RADIUS:  # no corner so far from the border
            return None
        cut = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        nodes = np.where(seen[..., None], uv, np.nan)[cut].astype(np.float32)
        *maps, mask = _interpolated(nodes)
        if self._left_mask is not None:
            mask &= np.asarray(cv2.remap(self._left_mask, maps[0], maps[1], cv2.INTER_NEAREST), np.uint8)
        mask = np.asarray(cv2.erode(mask, np.ones((2 * RADIUS + 1, 2 * RADIUS + 1), np.uint8)), np.uint8)
        return _View(camera_R_view, np.array([x[columns[0]], y[rows[0]]]), (maps[0], maps[1]), mask)

    def _corners(self, left: Pyramid, right: Pyramid | F32, view: _View) -> Corners:
        image = np.asarray(cv2.remap(left[0], view.maps[0], view.maps[1], cv2.INTER_LINEAR), np.uint8)

        def pixels(xy: F64) -> F64:
            slopes = (xy + view.first) / self._focal
            return self._rig.left.project(np.column_stack([slopes, np.ones(len(xy))]) @ view.camera_R_view.T)

        return self._orb.find(image, view.mask, pixels, left, right)


@njit
def _interpolated(nodes):
    """Pixels (H, W, 2) at nodes NODE_SPACING px apart, bilinear for all pixels of the view.

    Returns:
        Two (H', W') float32, columns and rows of the image, and (H', W') uint8, 0 beside a node that is NaN.
    """
    step = NODE_SPACING
    h, w = (nodes.shape[0] - 1) * step, (nodes.shape[1] - 1) * step
    columns, rows = np.full((h, w), -1, np.float32), np.full((h, w), -1, np.float32)  # no pixel of the image
    seen = np.zeros((h, w), np.uint8)
    for i in range(nodes.shape[0] - 1):
        for j in range(nodes.shape[1] - 1):
            if math.isnan(nodes[i, j, 0] + nodes[i, j + 1, 0] + nodes[i + 1, j, 0] + nodes[i + 1, j + 1, 0]):
                continue
            for y in range(step):
                down = np.float32(y / step)
                u0 = nodes[i, j, 0] + down * (nodes[i + 1, j, 0] - nodes[i, j, 0])
                u1 = nodes[i, j + 1, 0] + down * (nodes[i + 1, j + 1, 0] - nodes[i, j + 1, 0])
                v0 = nodes[i, j, 1] + down * (nodes[i + 1, j, 1] - nodes[i, j, 1])
                v1 = nodes[i, j + 1, 1] + down * (nodes[i + 1, j + 1, 1] - nodes[i, j + 1, 1])
                for x in range(step):
                    across = np.float32(x / step)
                    columns[i * step + y, j * step + x] = u0 + across * (u1 - u0)
                    rows[i * step + y, j * step + x] = v0 + across * (v1 - v0)
                    seen[i * step + y, j * step + x] = 1
    return columns, rows, seen
