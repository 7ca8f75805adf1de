"""Stereo matches for checking a calibration: few, well distributed, sub-pixel, and not restricted to one row.

Corners, distributed by a grid, are searched in a band of rows of the other rectified image by normalised correlation,
accepted if the best match is clearly better than the second best, refined by Lucas-Kanade and checked in reverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stereo_sfm.calib.rectification import Rectification
from stereo_sfm.types import F64, U8, Bool

PATCH = 10  # half size of the correlation patch, px
WINDOW = (17, 17)  # of Lucas-Kanade


@dataclass(frozen=True, eq=False)
class Matches:
    """The matches of one stereo pair in rectified pixels."""

    left: F64  # (N, 2)
    right: F64  # (N, 2)
    corners: int = 0  # of the left image that were searched in the right one

    def __len__(self) -> int:
        return len(self.left)

    @property
    def row_error(self) -> F64:
        """(N,) px: how much lower the right camera sees the point."""
        return self.right[:, 1] - self.left[:, 1]


def match_pair(
    rectification: Rectification,
    left: U8,
    right: U8,
    max_matches: int = 400,
    search_rows: int = 14,
    max_disparity: float = 0.2,
) -> Matches:
    """Match a rectified pair; deterministic.

    Args:
        rectification: of the images; patches near the black border and the outermost rays are avoided.
        left: (H, W) rectified. right: (H, W) rectified.
        max_matches: number of corners to try.
        search_rows: rows to search above and below, the largest row error of the calibration.
        max_disparity: columns to search, as a fraction of the width.
    """
    usable = _shrunk(rectification.left.well_calibrated, PATCH + 2)
    corners = spread_corners(left, usable, max_matches)
    guess = np.full_like(corners, np.nan)
    reach = round(max_disparity * left.shape[1])
    right_usable = _shrunk(rectification.right.well_calibrated, PATCH + 2)
    for i, (u, v) in enumerate(np.round(corners).astype(int)):
        guess[i] = _search(left, right, int(u), int(v), reach, search_rows)
    found = np.isfinite(guess[:, 0])
    start, guess = corners[found].astype(np.float32), guess[found].astype(np.float32)
    if not len(start):
        return Matches(np.zeros((0, 2)), np.zeros((0, 2)), len(corners))
    a, b = flattened(left), flattened(right)
    end, good = lucas_kanade(a, b, start, guess)
    back, good_back = lucas_kanade(b, a, end, start)
    inside = right_usable[
        np.clip(np.round(end[:, 1]).astype(int), 0, left.shape[0] - 1),
        np.clip(np.round(end[:, 0]).astype(int), 0, left.shape[1] - 1),
    ]
    returned = np.linalg.norm(back - start, axis=1) < 0.15
    near = np.linalg.norm(end - guess, axis=1) < 2.5
    kept = good & good_back & inside & returned & near
    return Matches(start[kept].astype(float), end[kept].astype(float), len(corners))


def spread_corners(image: U8, usable: Bool, count: int) -> F64:
    """(N, 2) px of the strongest corner of each grid cell, if it is strong enough."""
    import cv2

    strength: Any = cv2.cornerMinEigenVal(cv2.GaussianBlur(image, (0, 0), 0.8), 7)
    strength = np.where(usable, strength, 0.0)
    height, width = image.shape
    cell = max(8, round(np.sqrt(max(usable.sum(), 1) / count)))
    rows, columns = height // cell, width // cell
    blocks = strength[: rows * cell, : columns * cell].reshape(rows, cell, columns, cell).swapaxes(1, 2)
    flat = blocks.reshape(rows * columns, cell * cell)
    best = flat.argmax(1)
    peak = flat[np.arange(len(flat)), best]
    kept = np.flatnonzero(peak > max(2e-4, 0.02 * float(np.quantile(peak, 0.95))))
    v = (kept // columns) * cell + best[kept] // cell
    u = (kept % columns) * cell + best[kept] % cell
    return np.stack([u, v], -1).astype(float)


def _shrunk(mask: Bool, border: int) -> Bool:
    import cv2

    padded = np.pad(mask, 1).astype(np.uint8)
    distance: Any = cv2.distanceTransform(padded, cv2.DIST_L1, 3)
    return distance[1:-1, 1:-1] > border


def _search(left: U8, right: U8, u: int, v: int, reach: int, rows: int) -> tuple[float, float]:
    """Best match of the patch around (u, v) in the right image, NaN when it is weak or not unique."""
    import cv2

    height, width = right.shape
    u0, u1 = max(u - reach - PATCH, 0), min(u + 8 + PATCH + 1, width)
    v0, v1 = max(v - rows - PATCH, 0), min(v + rows + PATCH + 1, height)
    patch = left[v - PATCH : v + PATCH + 1, u - PATCH : u + PATCH + 1]
    score: Any = cv2.matchTemplate(right[v0:v1, u0:u1], patch, cv2.TM_CCOEFF_NORMED)
    y, x = np.unravel_index(int(score.argmax()), score.shape)
    peak = float(score[y, x])
    if peak < 0.85:
        return np.nan, np.nan
    score[max(y - 3, 0) : y + 4, max(x - 3, 0) : x + 4] = -1.0
    if 1 - peak > 0.6 * (1 - float(score.max())):
        return np.nan, np.nan
    return float(u0 + x + PATCH), float(v0 + y + PATCH)


def flattened(image: U8) -> U8:
    """The image minus its local mean, divided by its local contrast: independent of the cameras' exposures."""
    import cv2

    grey = image.astype(np.float32)
    mean: Any = cv2.blur(grey, (27, 27))
    spread: Any = np.sqrt(np.maximum(cv2.blur(grey * grey, (27, 27)) - mean * mean, 0))
    return np.clip(128 + 48 * (grey - mean) / (spread + 4), 0, 255).astype(np.uint8)


def pyramid_flow(a: U8, b: U8, start: Any) -> tuple[Any, Bool]:
    """Pyramidal Lucas-Kanade from image a to b: (N, 2) float32 px and whether the reverse flow agrees."""
    import cv2

    options: Any = {"winSize": WINDOW, "maxLevel": 4, "minEigThreshold": 1e-3}
    end, status, _ = cv2.calcOpticalFlowPyrLK(a, b, start, start.copy(), **options)
    back, status_back, _ = cv2.calcOpticalFlowPyrLK(b, a, end, end.copy(), **options)
    returned = np.linalg.norm(back - start, axis=1) < 0.5
    return end, (status.ravel() > 0) & (status_back.ravel() > 0) & returned


def lucas_kanade(a: U8, b: U8, start: Any, guess: Any) -> tuple[Any, Bool]:
    """Sub-pixel refinement at full size from `guess` (N, 2) float32 px in image b, and whether it converged."""
    import cv2

    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
    flags = cv2.OPTFLOW_USE_INITIAL_FLOW
    end, status, _ = cv2.calcOpticalFlowPyrLK(
        a, b, start, guess.copy(), winSize=WINDOW, maxLevel=0, criteria=criteria, flags=flags, minEigThreshold=1e-3
    )
    return end, status.ravel() > 0
