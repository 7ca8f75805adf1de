"""Corners spread over the image: the best Shi-Tomasi response of each place that has no point yet."""

# pyright: reportUnknownParameterType=false, reportMissingParameterType=false, reportMissingTypeArgument=false

from __future__ import annotations

import math

import cv2
import numpy as np

from stereo_sfm.geometry.cameras import Camera
from stereo_sfm.geometry.kernels import inner, njit
from stereo_sfm.types import F64, U8, Bool

BORDER = 12  # px of the half image, without corners
MIN_SHARE = 0.1  # of the smaller eigenvalue in the larger one: below, the corner lies somewhere along an edge


@njit
def _block(blocked, u, v, radius):
    h, w = blocked.shape
    for y in range(max(v - radius, 0), min(v + radius + 1, h)):
        for x in range(max(u - radius, 0), min(u + radius + 1, w)):
            if (x - u) ** 2 + (y - v) ** 2 <= radius * radius:
                blocked[y, x] = True


@inner
def _lies_on_edge(image, u, v):
    """Whether the structure tensor of the 5x5 pixels has one small eigenvalue (Lowe, IJCV 2004, section 4.1)."""
    a, b, c = 0.0, 0.0, 0.0
    for y in range(v - 2, v + 3):
        for x in range(u - 2, u + 3):
            gx, gy = float(image[y, x + 1]) - float(image[y, x - 1]), float(image[y + 1, x]) - float(image[y - 1, x])
            a += gx * gx
            b += gx * gy
            c += gy * gy
    return (a * c - b * b) * (1 + MIN_SHARE) ** 2 < MIN_SHARE * (a + c) ** 2


@inner
def _cell_best(image, score, blocked, top, left, cell, floor, off_edges):
    """Best unblocked pixel of a cell, with `off_edges` the best that is not on an edge: u, v; -1, -1 if none."""
    h, w = score.shape
    s, bu, bv = floor, -1, -1
    for y in range(top, min(top + cell, h)):
        for x in range(left, min(left + cell, w)):
            if score[y, x] > s and not blocked[y, x] and not (off_edges and _lies_on_edge(image, x, y)):
                s, bu, bv = score[y, x], x, y
    return bu, bv


@njit
def _cell_maxima(image, score, blocked, cell, floor, edges):
    """Best unblocked pixel of every cell, on an edge only with `edges`: (M, 2) integer u v and (M,) score, by rows."""
    h, w = score.shape
    found = np.empty((((h + cell - 1) // cell) * ((w + cell - 1) // cell), 2), np.int64)
    best = np.empty(len(found))
    n = 0
    for top in range(0, h, cell):
        for left in range(0, w, cell):
            u, v = _cell_best(image, score, blocked, top, left, cell, floor, False)
            if u >= 0 and not edges and _lies_on_edge(image, u, v):
                u, v = _cell_best(image, score, blocked, top, left, cell, floor, True)
            if u >= 0:
                found[n, 0], found[n, 1], best[n] = u, v, score[v, u]
                n += 1
    return found[:n], best[:n]


@njit
def _pick(found, order, blocked, radius, count):
    """Indices of `found`, best first, that keep `radius` pixels apart."""
    picked = np.empty(min(count, len(order)), np.int64)
    n = 0
    for k in order:
        if n == len(picked):
            break
        u, v = found[k, 0], found[k, 1]
        if not blocked[v, u]:
            picked[n] = k
            n += 1
            _block(blocked, u, v, radius)
    return picked[:n]


@njit
def _block_all(blocked, points, radius):
    for k in range(len(points)):
        _block(blocked, points[k, 0], points[k, 1], radius)


def corner_mask(camera: Camera, max_angle_deg: float) -> Bool:
    """(H/2, W/2) where corners may lie: valid pixels, neither too far from the axis nor too near to the border."""
    half = camera.valid_mask(math.radians(max_angle_deg), step=2)
    half[:BORDER] = half[-BORDER:] = False
    half[:, :BORDER] = half[:, -BORDER:] = False
    return half


def detect_corners(
    half_image: U8, mask: Bool, taken: F64, count: int, spacing: float, quality: float, edges: bool = False
) -> F64:
    """New corners in areas without points.

    Args:
        half_image: (H/2, W/2) level 1 of the pyramid: corners of the finest pixels would be noise.
        mask: (H/2, W/2) where corners may lie. taken: (N, 2) px of the full image, existing points.
        count: maximum number. spacing: minimum distance in px of the full image.
        quality: minimum response, as a fraction of the 95th percentile of the cells' best.
        edges: also places along edges, which are no use for stereo matching: along the epipolar curve they look alike.

    Returns:
        (M, 2) float64 px of the full image, strongest first.
    """
    score = cv2.cornerMinEigenVal(half_image, 5, ksize=3)
    blocked = ~mask
    radius = max(int(spacing / 2), 1)
    inside = (np.rint(taken / 2)).astype(np.int64)
    _block_all(blocked, inside, radius)
    found, best = _cell_maxima(half_image, score, blocked, max(radius, 4), 1e-7, edges)
    if len(found) == 0:
        return np.zeros((0, 2))
    strong = best > quality * np.percentile(best, 95)
    found, best = found[strong], best[strong]
    order = np.argsort(-best, kind="stable")
    return found[_pick(found, order, blocked, radius, count)] * 2.0
