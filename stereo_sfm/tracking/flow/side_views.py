"""Views that face the shelves beside the camera: what looks alike on the way there and on the way back.

A plane that a virtual pinhole camera faces looks the same from every place, up to a shift and a scale. Where the robot
goes along a shelf front, the front that it has on its right it will have on its left when it comes back. So corners are
detected and described in two views whose axes are perpendicular to the fronts, and stand for pixels of the image as
other corners do (`Corners`). Wide cameras see the fronts almost from straight ahead. Narrow ones see them obliquely:
their views hold what there is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from stereo_sfm.calib.rig import Rig
from stereo_sfm.config import Config
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.dominant_direction import dominant_direction
from stereo_sfm.tracking.flow.klt import Pyramid
from stereo_sfm.tracking.flow.place_corners import BORDER, FAST_THRESHOLD, LEVELS, SCALE, seen_by_both
from stereo_sfm.tracking.flow.stereo import StereoMatcher
from stereo_sfm.types import F32, F64, U8, Corners

FOCAL = 0.7  # of a view, as a share of the camera's: its middle is as sharp as the image
REACH = 2.14, 1.0  # tangents of the half angles of a view, horizontal and vertical: 65 and 45 degrees
STEP = 16  # px of a view between points that are projected; in between the map is linear
LEAST_NODES = 3  # of these in both directions, for a view
BAND, MOST_SIGMA = 1.1, 0.3  # metres above and below the camera, and of uncertainty, of points that show directions
CELL, LEAST_SIGMA = 0.08, 0.05  # metres
SPACING = 0.3, 0.35  # between views: share of the fronts' distance, radians
LEAST_METRES = 0.25


@dataclass(frozen=True, eq=False)
class _View:
    """A virtual camera: rays (x, y, 1) @ camera_R_view.T with x, y from pixels + `first`, over the focal length."""

    camera_R_view: F64  # (3, 3)
    first: F64  # (2,) px of its left upper corner from the principal point
    maps: tuple[F32, F32]  # (H, W) where its pixels lie in the image, for cv2.remap
    mask: U8  # (H, W) where corners may lie


class SideViews:
    """Oriented FAST with rotated BRIEF (Rublee et al., ORB, ICCV 2011) in the two views."""

    def __init__(self, config: Config, rig: Rig) -> None:
        self._rig, self._stereo = rig, StereoMatcher(config.tracker, rig)
        self._disparity_sigma = config.loop.disparity_sigma_px
        self._least_z = np.cos(np.deg2rad(config.tracker.max_angle_deg))
        self._focal = FOCAL * rig.left.fx
        self._left_mask = None if rig.left_mask is None else rig.left_mask.astype(np.uint8)
        half = config.loop.side_corners // 2
        self._orb = cv2.ORB.create(half, SCALE, LEVELS, edgeThreshold=BORDER, fastThreshold=FAST_THRESHOLD)
        self._last: tuple[int, F64, float] | None = None  # the last: submap, odom_T_cam, fronts' distance

    @staticmethod
    def wanted(config: Config, rig: Rig) -> SideViews | None:
        """None for a run that does not look sideways, or a camera without depth."""
        recognised = config.mapper.enabled or config.loop.enabled
        return SideViews(config, rig) if rig.stereo and recognised and config.loop.side_corners else None

    def use(self, rig: Rig) -> None:
        """From now on with this rig."""
        self._rig = rig
        self._stereo.use(rig)

    def find(self, left: Pyramid, right: Pyramid | F32, corners: Corners, odom_T_cam: F64, submap_id: int) -> Corners:
        """Corners in the views of an image, those of each view that both cameras see; none too near to the last.

        Args:
            left: the image's pyramid. right: what `StereoMatcher.prepare` makes of the second camera.
            corners: of the image: their points show where the fronts are.
            odom_T_cam, submap_id: where the image was taken, since views near to the last ones say nothing new.
        """
        if not self._due(odom_T_cam, submap_id):
            return Corners.none()
        points = corners.points_cam.astype(np.float64)
        camera_R_fronts = self._fronts(points)
        self._last = submap_id, odom_T_cam, _distance(points @ camera_R_fronts)
        views = [self._view(camera_R_fronts, side) for side in (1.0, -1.0)]
        parts = [self._corners(left, right, view) for view in views if view is not None]
        return Corners.joined(parts)

    def _due(self, odom_T_cam: F64, submap_id: int) -> bool:
        if self._last is None or self._last[0] != submap_id:
            return True
        metres, radians = se3.extent(se3.inverse(self._last[1]) @ odom_T_cam)
        return bool(metres >= max(SPACING[0] * self._last[2], LEAST_METRES) or radians >= SPACING[1])

    def _fronts(self, points: F64) -> F64:
        """(3, 3) camera_R_fronts: x across the fronts beside the camera, y down, z along them.

        The camera is taken to be upright. Where it is not, by some degrees, views are turned alike in both directions.
        """
        sigmas = self._rig.range_sigmas(points, self._disparity_sigma)
        near = (sigmas < MOST_SIGMA) & (np.abs(points[:, 1]) < BAND)
        yaw = dominant_direction(points[near][:, [0, 2]], 1.0 / (sigmas[near] + LEAST_SIGMA), CELL)
        return se3.so3_exp(np.array([0.0, -yaw, 0.0]))

    def _view(self, camera_R_fronts: F64, side: float) -> _View | None:
        """The view to the right (side 1) or left (-1), cut to what the camera sees; None where that is too little."""
        axis, down = side * camera_R_fronts[:, 0], camera_R_fronts[:, 1]
        camera_R_view = np.stack([np.cross(down, axis), down, axis], axis=1)
        x, y = (np.arange(-reach * self._focal, reach * self._focal + STEP, STEP) for reach in REACH)
        u, v = np.meshgrid(x, y)
        rays = np.stack([u / self._focal, v / self._focal, np.ones_like(u)], -1) @ camera_R_view.T
        uv = self._rig.left.project(rays)
        seen = self._rig.left.inside(uv, 1.0) & (rays[..., 2] > self._least_z * np.linalg.norm(rays, axis=-1))
        rows, columns = np.flatnonzero(seen.any(1)), np.flatnonzero(seen.any(0))
        if len(rows) < LEAST_NODES or len(columns) < LEAST_NODES:
            return None
        cut = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        nodes = np.where(seen[..., None], uv, np.nan)[cut].astype(np.float32)
        maps = _magnified(nodes[..., 0]), _magnified(nodes[..., 1])
        mask = np.isfinite(maps[0] + maps[1]).astype(np.uint8)
        maps = np.nan_to_num(maps[0], nan=-1e3), np.nan_to_num(maps[1], nan=-1e3)
        if self._left_mask is not None:
            mask &= np.asarray(cv2.remap(self._left_mask, maps[0], maps[1], cv2.INTER_NEAREST), np.uint8)
        mask = np.asarray(cv2.erode(mask, np.ones((2 * BORDER + 1, 2 * BORDER + 1), np.uint8)), np.uint8)
        return _View(camera_R_view, np.array([x[columns[0]], y[rows[0]]]), maps, mask)

    def _corners(self, left: Pyramid, right: Pyramid | F32, view: _View) -> Corners:
        image = cv2.remap(left[0], view.maps[0], view.maps[1], cv2.INTER_LINEAR)
        keypoints, descriptors = self._orb.detectAndCompute(image, view.mask)
        if not len(keypoints):
            return Corners.none()
        xy = (np.asarray(cv2.KeyPoint.convert(keypoints), np.float64) + view.first) / self._focal
        uv = self._rig.left.project(np.column_stack([xy, np.ones(len(xy))]) @ view.camera_R_view.T)
        return seen_by_both(self._stereo, left, right, uv, np.asarray(descriptors, np.uint8))


def _magnified(nodes: F32) -> F32:
    """Nodes (H, W) STEP px apart, with all pixels between them; NaN beside a node that is NaN."""
    size = (nodes.shape[1] - 1) * STEP, (nodes.shape[0] - 1) * STEP
    scale = np.array([[STEP, 0, 0], [0, STEP, 0]], np.float64)
    return np.asarray(
        cv2.warpAffine(nodes, scale, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.float32
    )


def _distance(points: F64) -> float:
    """Metres across to what is beside: the median of points (N, 3), x across; 0 for none."""
    return float(np.median(np.abs(points[:, 0]))) if len(points) else 0.0
