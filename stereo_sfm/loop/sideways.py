"""Loops across directions of travel: keyframes that see one shelf front from opposite sides.

What is compared are the corners of the views that face the shelves (`Keyframe.sides`). They go the same way as other
corners: words, candidates, verification with stereo points in both directions, agreement of successive keyframes.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from stereo_sfm.config import LoopConfig
from stereo_sfm.geometry import se3
from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.mapping.columns import Columns, column
from stereo_sfm.types import F64, I64, Keyframe

# Of a keyframe with which a search is worth it: a loop across directions needs twice as many. So many stand for what
# its views show: the overlap with another one's is a mean of them.
MIN_CORNERS = 20
MIN_OVERLAP = 0.2  # of two keyframes' views, of at most 1
SIDE_FACTOR = 1.5  # times `side_inliers` where no odometry speaks for it
TURNED = np.cos(np.deg2rad(60.0))  # of the optical axes of keyframes that only views to the side can compare


def of_a_part(config: LoopConfig, min_inliers: int) -> LoopConfig:
    """What the verification asks for where but a part of a view is seen: so many corners, whatever their share."""
    return dataclasses.replace(
        config, min_match_fraction=0.0, min_inliers=min_inliers, min_inlier_share=0.0, min_cells=config.fewer_cells
    )


def with_neighbours(scores: F64) -> F64:
    """(K,) scores of successive keyframes, each with those beside it: together they tell more.

    Keyframes without a score, as those without views to the side, are passed over.
    """
    scored = scores > 0
    padded = np.pad(scores[scored], 1)
    together = np.zeros_like(scores)
    together[scored] = padded[1:-1] + padded[:-2] + padded[2:]
    return together


def front_of(keyframe: Keyframe) -> F64:
    """(MIN_CORNERS, 3) corners of a keyframe's views, in its camera; NaN without views."""
    points = keyframe.sides.points_cam
    if len(points) < MIN_CORNERS:
        return np.full((MIN_CORNERS, 3), np.nan)
    return points[np.linspace(0, len(points) - 1, MIN_CORNERS).astype(int)].astype(np.float64)


class Fronts(Columns):
    """What the views of keyframes show, one row each."""

    points: F64 = column(np.float64, np.nan, (MIN_CORNERS, 3))  # in the keyframe's camera; NaN without views

    def __init__(self, camera: Camera) -> None:
        super().__init__()
        self._camera = camera

    def add(self, keyframe: Keyframe) -> None:
        """Remember the newest keyframe."""
        self.append(1, points=front_of(keyframe))

    def turned(self, front: F64, cam_T_kf: F64) -> I64:
        """Rows whose views overlap with a camera's from another direction, those that should look most alike first.

        Args:
            front: what the camera's views show, see `front_of`. cam_T_kf: (K, 4, 4) poses of all keyframes in that
                camera, NaN where unknown.
        """
        apart = np.linalg.norm(cam_T_kf[:, :3, 3], axis=1)
        reach = 2 * float(np.median(np.linalg.norm(front, axis=1)))  # of views that may show the same fronts
        rows = np.flatnonzero((cam_T_kf[:, 2, 2] < TURNED) & (apart < reach))
        there, here = self.points[rows], np.broadcast_to(front, (len(rows), MIN_CORNERS, 3))
        back = se3.inverse(cam_T_kf[rows])
        overlap = (self._alike(cam_T_kf[rows], there) + self._alike(back, here)) / 2
        order = np.lexsort((rows, -overlap))
        return rows[order[overlap[order] > MIN_OVERLAP]].astype(np.int64)

    def _alike(self, b_T_a: F64, points: F64) -> F64:
        """(R,) mean over points (R, N, 3) in a: the ratio of their distances from a and b, 0 where b is blind."""
        moved = np.einsum("rij,rsj->rsi", b_T_a[:, :3, :3], points) + b_T_a[:, None, :3, 3]
        seen = self._camera.inside(self._camera.project(moved), 1.0)
        ratio = np.linalg.norm(moved, axis=2) / np.linalg.norm(points, axis=2)
        return np.where(seen, np.minimum(ratio, 1 / ratio), 0.0).mean(axis=1)
