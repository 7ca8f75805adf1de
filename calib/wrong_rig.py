"""Errors of a calibration that are too large for a stereo search, found in a few pairs of images.

Corners are searched in so many rows that a right camera turned by two degrees is found. The turn comes from the small
bundle adjustment of `check-calib`; rows that a cropped or shifted image sets apart are the other candidate. Each half
of the matches is corrected by what the other half says: a correction counts only if these rows fit then.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.choice import significant, with_terms
from stereo_sfm.calib.consistency import estimate
from stereo_sfm.calib.rectification import Rectification, rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.tracks import Window, still_window
from stereo_sfm.geometry.stereo import epipolar_angle
from stereo_sfm.types import F64, RIG_TERMS, StereoImage

MAX_TURN = np.deg2rad(2.2)  # of a right camera that is found: two degrees about x and z, and some rows
CORNERS = 200  # searched in each pair
MIN_MATCHES = 40  # in all pairs, as `check-calib` needs
MIN_GAIN = 2.0  # the median row error of points that a correction was not estimated from is smaller by this factor
SEEN_IN_ROWS = np.array([k in (0, 2) for k in range(RIG_TERMS)])  # of the terms: the turns about x and z


@dataclass(frozen=True, eq=False)
class Correction:
    """A calibration that fits the images better."""

    text: str  # what was wrong
    rig: Rig
    error_px: F64  # (N,) of the matches, distances from their rows, each corrected by what the other half says


def row_errors(rig: Rig, window: Window) -> F64:
    """(N,) distances of the first moment's matches from their epipolar curves, px at the left image's centre; NaN where
    a lens does not see them."""
    assert rig.right is not None
    bearings = rig.left.unproject(window.left[0]), rig.right.unproject(window.right[0])
    return rig.left.fx * epipolar_angle(*bearings, rig.left_T_right)


def search_rows(rectification: Rectification) -> int:
    """Rows above and below, in which a point is seen by a right camera that is turned by `MAX_TURN` about x or z."""
    camera = rectification.rig.left
    return int(np.ceil(np.tan(MAX_TURN) * np.hypot(camera.fy, 0.5 * camera.width)))


def correction(rig: Rig, images: Sequence[StereoImage]) -> Correction | None:
    """What makes the rows of these pairs fit; None if the given calibration does, or nothing was found.

    Args:
        rig: two cameras. images: one pair or more.

    Raises:
        StereoSfmError: the rig cannot be rectified.
    """
    rectification = rectify(rig, "epipolar")
    windows = [still_window(rectification, image, CORNERS, search_rows(rectification)) for image in images]
    windows = [window for window in windows if len(window.rows)]
    if sum(len(window.rows) for window in windows) < MIN_MATCHES:
        return None
    turned, shifted = _turned(rig, windows), _shifted(rig, windows)
    best = shifted if turned is None or _median(shifted) * MIN_GAIN < _median(turned) else turned
    before = np.abs(np.concatenate([row_errors(rig, window) for window in windows]))
    return best if _median(best) * MIN_GAIN < float(np.nanmedian(before)) else None


def _median(found: Correction) -> float:
    return float(np.nanmedian(found.error_px))


def _turned(rig: Rig, windows: list[Window]) -> Correction | None:
    found = estimate(rig, windows)
    kept = significant(found.whole, found.halves, among=SEEN_IN_ROWS)
    if not kept.any():
        return None
    whole, *halves = (one.without(kept) for one in (found.whole, *found.halves))
    turns = [
        f"{np.rad2deg(whole.value[k]):+.2f} +- {np.rad2deg(whole.sigma[k]):.2f} deg about {'xyz'[k]}"
        for k in np.flatnonzero(kept)
    ]
    text = f"the right camera is turned by {' and '.join(turns)}"
    best, first, second = (with_terms(rig, one.value) for one in (whole, *halves))
    return Correction(text, best, _other_half(windows, first, second))


def _shifted(rig: Rig, windows: list[Window]) -> Correction:
    """The rows of the right image further down or up."""
    halves = _halves(windows)
    first, second = (_moved(rig, half) for half in halves)
    whole = _moved(rig, windows)
    assert rig.right is not None and whole.right is not None
    text = f"the rows of the right image are {whole.right.cy - rig.right.cy:+.1f} px lower"
    return Correction(text, whole, _other_half(windows, first, second))


def _moved(rig: Rig, windows: list[Window]) -> Rig:
    """The rig with the right principal point moved along y, by Newton's steps of the median row error."""
    for _ in range(3):
        assert rig.right is not None
        lower = replace(rig, right=replace(rig.right, cy=rig.right.cy + 1.0))
        here, there = (np.concatenate([row_errors(one, window) for window in windows]) for one in (rig, lower))
        rig = replace(rig, right=replace(rig.right, cy=rig.right.cy - float(np.nanmedian(here / (there - here)))))
    return rig


def _halves(windows: list[Window]) -> tuple[list[Window], list[Window]]:
    """Even and odd windows; of a single window, even and odd points: as `estimate` divides them."""
    if len(windows) > 1:
        return windows[0::2], windows[1::2]
    (one,) = windows
    parts = [
        Window(one.left[:, k::2], one.right[:, k::2], one.right_velocity[:, k::2], one.rows) for k in (0, 1)
    ]
    return [parts[0]], [parts[1]]


def _other_half(windows: list[Window], first: Rig, second: Rig) -> F64:
    """(N,) row errors of each half with the rig of the other."""
    parts: Callable[[Rig, list[Window]], list[F64]] = lambda rig, half: [row_errors(rig, window) for window in half]
    even, odd = _halves(windows)
    return np.abs(np.concatenate([*parts(second, even), *parts(first, odd)]))
