"""Disparities of a rectified pair: semi-global matching both ways, and what both agree on.

Hirschmüller, PAMI 30 (2008), as OpenCV computes it over three directions.
"""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false

from __future__ import annotations

import math
from typing import Any

import numpy as np

from stereo_sfm.geometry.kernels import njit
from stereo_sfm.types import F32, U8

BLOCK = 5  # px, side of the matched windows where nothing refines
REFINED_BLOCK = 3  # where sub-pixel refinement averages over windows of its own: less is drawn over depth edges
SMALL_STEP, LARGE_STEP = 8, 32  # penalties of disparity steps over the window's pixels: those of OpenCV's examples
AGREE_PX = 1.0  # between the disparities of both directions


def match_both_ways(left: U8, right: U8, disparities: int) -> tuple[F32, F32]:
    """(H, W) px disparities of left and of right pixels, NaN where both directions do not agree to `AGREE_PX`."""
    a = _match(left, right, disparities, REFINED_BLOCK)
    b = np.ascontiguousarray(_match(_mirrored(right), _mirrored(left), disparities, REFINED_BLOCK)[:, ::-1])
    flipped_a, flipped_b = _mirrored(a), _mirrored(b)
    return agreeing(a, b, AGREE_PX), _mirrored(agreeing(flipped_b, flipped_a, AGREE_PX))


def match_checked(left: U8, right: U8, disparities: int) -> F32:
    """(H, W) px disparities of left pixels from one matching, which OpenCV itself checks against the right image."""
    return _match(left, right, disparities, BLOCK, round(AGREE_PX))


def _mirrored(image: Any) -> Any:
    return np.ascontiguousarray(image[:, ::-1])


def _match(left: U8, right: U8, disparities: int, block: int, agree: int = -1) -> F32:
    """Padded by the search range, so that pixels at the left border have a disparity as well.

    `agree`: px by which the right image's disparity may differ; -1: any.
    """
    import cv2

    area = block * block
    matcher = cv2.StereoSGBM.create(
        0, disparities, block, SMALL_STEP * area, LARGE_STEP * area, agree, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY
    )
    padded = [cv2.copyMakeBorder(i, 0, 0, disparities, 0, cv2.BORDER_REPLICATE) for i in (left, right)]
    found = np.asarray(matcher.compute(padded[0], padded[1]))[:, disparities:].astype(np.float32) / 16
    return np.where(found > 0, found, np.float32(np.nan))


@njit
def agreeing(left, right, most):
    """Left disparities (H, W), NaN where the right image's disparity there (H, W) differs by more than `most` px."""
    h, w = left.shape
    out = np.full((h, w), np.nan, np.float32)
    for v in range(h):
        for u in range(w):
            x = u - left[v, u]
            if not x >= 0:  # NaN or beyond the border
                continue
            i = int(math.floor(x))
            f = x - i
            other = right[v, i] if f < 0.5 or i + 1 >= w else right[v, i + 1]
            if i + 1 < w and abs(right[v, i] - right[v, i + 1]) < 1:  # one surface: between them
                other = right[v, i] * (1 - f) + right[v, i + 1] * f
            if abs(other - left[v, u]) <= most:
                out[v, u] = left[v, u]
    return out
