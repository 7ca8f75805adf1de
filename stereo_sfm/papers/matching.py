"""Brute-force descriptor matching with Lowe's ratio, and the epipolar check by RANSAC (retail paper, IV-A2)."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from stereo_sfm.geometry.essential import essential_ransac
from stereo_sfm.geometry.robust import Degenerate
from stereo_sfm.papers.extraction import Features
from stereo_sfm.types import F64, I64, U8, Bool

# Cosine of 70 degrees: bearings further from the axis are not put on an image plane, which stretches nine times there.
PLANE_LIMIT = np.cos(np.radians(70.0))


def match_features(first: Features, second: Features, norm: int, ratio: float) -> I64:
    """Two nearest neighbours, Lowe's ratio, then one match per feature of the second image (the closest).

    Returns:
        (M, 2) rows of `first` and `second`, ascending in the first column.
    """
    if len(first) == 0 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    kind = cv2.CV_32S if norm == cv2.NORM_HAMMING else cv2.CV_32F
    found: Any = cv2.batchDistance(first.descriptors, second.descriptors, kind, normType=norm, K=2)
    (best, second_best), target = found[0].astype(float).T, found[1][:, 0]
    passed = np.flatnonzero(best < ratio * second_best)
    passed = passed[np.lexsort((passed, best[passed], target[passed]))]  # by target, then distance, then source
    chosen = np.sort(passed[np.unique(target[passed], return_index=True)[1]])
    return np.stack([chosen, target[chosen]], 1).astype(np.int64)


def epipolar_inliers(bearings0: F64, bearings1: F64, threshold: float, rng: np.random.Generator) -> Bool:
    """(N,) matches that agree with one epipolar geometry, estimated by RANSAC.

    Fundamental matrix (OpenCV's seven-point RANSAC on the undistorted image plane) where every bearing lies within
    70 degrees of the axis, else the essential matrix on the bearings themselves. `threshold` in radians. With fewer
    than eight matches, or no consensus, nothing is an inlier.
    """
    count = len(bearings0)
    if count < 8:  # five determine an essential matrix, three say whether it is right
        return np.zeros(count, bool)
    if min(bearings0[:, 2].min(), bearings1[:, 2].min()) < PLANE_LIMIT:
        try:
            return essential_ransac(bearings0, bearings1, threshold, rng, min_ratio=0.0).inliers
        except Degenerate:
            return np.zeros(count, bool)
    scale = 1.0 / threshold  # image plane on which the threshold is one pixel
    flat0, flat1 = scale * bearings0[:, :2] / bearings0[:, 2:], scale * bearings1[:, :2] / bearings1[:, 2:]
    cv2.setRNGSeed(int(rng.integers(1 << 31)))
    found: Any = cv2.findFundamentalMat(flat0, flat1, cv2.FM_RANSAC, 1.0, 0.999)
    mask: U8 | None = found[1]
    return np.zeros(count, bool) if mask is None else mask.ravel().astype(bool)
