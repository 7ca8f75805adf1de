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
_MIN_FOR_RANSAC = 8  # matches: five determine an essential matrix, three say whether it is right
_CHUNK = 1024  # rows of the distance table at once: some megabytes


def match_features(first: Features, second: Features, norm: int, ratio: float) -> I64:
    """Two nearest neighbours, Lowe's ratio, then one match per feature of the second image (the closest).

    Returns:
        (M, 2) rows of `first` and `second`, ascending in the first column.
    """
    if len(first) == 0 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    target, best, second_best = _two_nearest(first, second, norm)
    passed = np.flatnonzero(best < ratio * second_best)
    if len(passed) == 0:
        return np.zeros((0, 2), np.int64)
    rows = np.stack([passed.astype(float), target[passed].astype(float), best[passed]], axis=1)
    order = np.lexsort((rows[:, 0], rows[:, 2], rows[:, 1]))  # by target, then distance, then source
    rows = rows[order]
    first_of_target = np.ones(len(rows), bool)
    first_of_target[1:] = rows[1:, 1] != rows[:-1, 1]
    chosen = rows[first_of_target, :2].astype(np.int64)
    return chosen[np.argsort(chosen[:, 0])]


def _two_nearest(first: Features, second: Features, norm: int) -> tuple[I64, F64, F64]:
    """Brute force: row of the nearest descriptor for each of `first`, its distance, and the second best distance.

    Squared l2 distances come from one matrix product. OpenCV's SIFT descriptors are whole numbers below 256, so their
    products are exact in single precision and the result does not depend on the order of summation.
    """
    if norm != cv2.NORM_L2:
        pairs: Any = cv2.BFMatcher(norm).knnMatch(first.descriptors, second.descriptors, k=2)
        table = np.array([(a.trainIdx, a.distance, b.distance) for a, b in pairs])
        return table[:, 0].astype(np.int64), table[:, 1], table[:, 2]
    a, b = first.descriptors.astype(np.float32), second.descriptors.astype(np.float32)
    b_squared = (b * b).sum(axis=1)
    target, best, second_best = np.zeros(len(a), np.int64), np.zeros(len(a)), np.zeros(len(a))
    for start in range(0, len(a), _CHUNK):
        rows = slice(start, start + _CHUNK)
        squared = b_squared - 2.0 * (a[rows] @ b.T) + (a[rows] * a[rows]).sum(axis=1)[:, None]
        nearest = squared.argmin(axis=1)
        every = np.arange(len(nearest))
        target[rows], best[rows] = nearest, squared[every, nearest]
        squared[every, nearest] = np.inf
        second_best[rows] = squared.min(axis=1)
    return target, np.sqrt(best.clip(0)), np.sqrt(second_best.clip(0))


def epipolar_inliers(bearings0: F64, bearings1: F64, threshold: float, rng: np.random.Generator) -> Bool:
    """(N,) matches that agree with one epipolar geometry, estimated by RANSAC.

    Fundamental matrix (OpenCV's seven-point RANSAC on the undistorted image plane) where every bearing lies within
    70 degrees of the axis, else the essential matrix on the bearings themselves. `threshold` in radians. With fewer
    than eight matches, or no consensus, nothing is an inlier.
    """
    count = len(bearings0)
    if count < _MIN_FOR_RANSAC:
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
