"""Loops across directions of travel: keyframes that see one shelf front from opposite sides.

What is compared are the corners of the views that face the shelves (`Keyframe.sides`). They go the same way as other
corners: words, candidates, verification with stereo points in both directions, agreement of successive keyframes.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from stereo_sfm.config import LoopConfig
from stereo_sfm.types import F64, I64, Keyframe

MIN_CORNERS = 20  # corners of a keyframe with which a search is worth it
APART = 1.0  # distance of two keyframes' fronts over the distance at which they see them: nearer ones overlap
SIDE_FACTOR = 1.5  # times `side_inliers` where no odometry speaks for it
TURNED = np.cos(np.deg2rad(60.0))  # of the optical axes of keyframes that only views to the side can compare


def sideways_config(config: LoopConfig) -> LoopConfig:
    """What the verification asks for: fewer corners, since directions share but a part of the views."""
    return dataclasses.replace(
        config,
        min_match_fraction=0.0,
        min_inliers=config.side_inliers,
        min_inlier_share=0.0,
        min_cells=config.side_cells,
    )


def with_neighbours(scores: F64) -> F64:
    """(K,) scores of successive keyframes, each with those beside it: together they tell more."""
    padded = np.pad(scores, 1)
    return scores + padded[:-2] + padded[2:]


def front_of(keyframe: Keyframe) -> F64:
    """(3,) middle of what the views of a keyframe show, in its camera; NaN without views."""
    points = keyframe.sides.points_cam
    return np.median(points, axis=0).astype(np.float64) if len(points) >= MIN_CORNERS else np.full(3, np.nan)


class Fronts:
    """Where keyframes see the fronts beside them, one row each."""

    def __init__(self) -> None:
        self._middles: F64 = np.empty((64, 3))  # in the keyframe's camera; NaN without views
        self._count = 0

    def add(self, keyframe: Keyframe) -> None:
        """Remember the newest keyframe."""
        if self._count == len(self._middles):
            self._middles = np.concatenate([self._middles, np.empty_like(self._middles)])
        self._middles[self._count] = front_of(keyframe)
        self._count += 1

    def turned(self, middle: F64, cam_T_kf: F64) -> I64:
        """Rows that saw the fronts around a middle (3,) from another direction, the nearest first.

        Args:
            middle: of a camera's fronts, see `front_of`. cam_T_kf: (K, 4, 4) poses of all keyframes in that camera, NaN
                where unknown.
        """
        there = (cam_T_kf[:, :3, :3] @ self._middles[: self._count, :, None])[..., 0] + cam_T_kf[:, :3, 3]
        apart = np.linalg.norm(there - middle, axis=1)
        rows = np.flatnonzero((cam_T_kf[:, 2, 2] < TURNED) & (apart < APART * np.linalg.norm(middle)))
        return rows[np.lexsort((rows, apart[rows]))].astype(np.int64)
