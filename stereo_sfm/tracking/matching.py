"""Brute-force descriptor matching with Lowe's ratio, and the epipolar check by RANSAC (retail paper, IV-A2)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from stereo_sfm.geometry.essential import essential_ransac
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.tracking.features import Features
from stereo_sfm.types import F64, I64, U8, Bool

_PINHOLE_LIMIT = np.cos(np.radians(70.0))  # bearings further from the axis are not put on an image plane
_MIN_FOR_RANSAC = 8


def match_features(first: Features, second: Features, norm: int, ratio: float) -> I64:
    """Two nearest neighbours, Lowe's ratio, then one match per feature of the second image (the closest).

    Returns:
        (M, 2) rows of `first` and `second`, ascending in the first column.
    """
    if len(first) == 0 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    pairs = cv2.BFMatcher(norm).knnMatch(first.descriptors, second.descriptors, k=2)
    rows = np.array([(a.queryIdx, a.trainIdx, a.distance) for a, b in pairs if a.distance < ratio * b.distance])
    if len(rows) == 0:
        return np.zeros((0, 2), np.int64)
    order = np.lexsort((rows[:, 0], rows[:, 2], rows[:, 1]))  # by target, then distance, then source
    rows = rows[order]
    first_of_target = np.ones(len(rows), bool)
    first_of_target[1:] = rows[1:, 1] != rows[:-1, 1]
    chosen = rows[first_of_target, :2].astype(np.int64)
    return chosen[np.argsort(chosen[:, 0])]


def epipolar_inliers(bearings0: F64, bearings1: F64, threshold: float, rng: np.random.Generator) -> Bool:
    """(N,) matches that agree with one epipolar geometry, estimated by RANSAC.

    Fundamental matrix (OpenCV's seven-point RANSAC on the undistorted image plane) where every bearing lies within
    70 degrees of the axis, else the essential matrix on the bearings themselves. `threshold` in radians. With fewer
    than eight matches, or no consensus, nothing is an inlier.
    """
    count = len(bearings0)
    if count < _MIN_FOR_RANSAC:
        return np.zeros(count, bool)
    if min(bearings0[:, 2].min(), bearings1[:, 2].min()) < _PINHOLE_LIMIT:
        try:
            return essential_ransac(bearings0, bearings1, threshold, rng, min_ratio=0.0).inliers
        except Degenerate:
            return np.zeros(count, bool)
    scale = 1.0 / threshold  # image plane on which the threshold is one pixel
    flat0, flat1 = scale * bearings0[:, :2] / bearings0[:, 2:], scale * bearings1[:, :2] / bearings1[:, 2:]
    cv2.setRNGSeed(int(rng.integers(1 << 31)))
    answer: Any = cv2.findFundamentalMat(flat0, flat1, cv2.FM_RANSAC, 1.0, 0.999)
    mask: U8 | None = answer[1]
    return np.zeros(count, bool) if mask is None else mask.ravel().astype(bool)
