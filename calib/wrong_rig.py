"""Errors of calibration and pairing that are too large for a stereo search, found in a few of the first images.

Corners are searched in so many rows that a right camera turned by two degrees is found. The turn comes from the small
bundle adjustment of `check-calib`; rows that a cropped or shifted image sets apart are the other candidate. Each half
of the matches is corrected by what the other half says: a correction counts only if these rows fit then. The
right images may belong to other left ones, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.choice import significant, with_terms
from stereo_sfm.calib.consistency import estimate
from stereo_sfm.calib.rectification import Rectification, rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.scene_model import inverse_distances
from stereo_sfm.calib.tracks import MIN_POINTS, Window, still_window
from stereo_sfm.geometry.stereo import epipolar_angle
from stereo_sfm.types import F64, RIG_TERMS, StereoImage

MAX_TURN = np.deg2rad(2.2)  # of a right camera that is found: two degrees about x and z, and some rows
CORNERS = 200  # searched in each pair
MIN_MATCHES = 40  # in all pairs, as `check-calib` needs
MIN_GAIN = 2.0  # ratio of the row errors without and with a correction, for it to count
MIN_DISPARITY_PX = -0.5  # points of smaller disparity lie behind the cameras
LIMIT_PX = 1.0  # of a row error: what the tracker accepts (tracker.max_epipolar_px)
MAX_SHIFT = 2  # frames between the images of a pair
SEEN_IN_ROWS = np.array([k in (0, 2) for k in range(RIG_TERMS)])  # of the terms: the turns about x and z


@dataclass(frozen=True, eq=False)
class Fit:
    """A calibration, and how it fits the pairs."""

    text: str  # what was wrong; "" for the given calibration
    rig: Rig
    error_px: F64  # (F,) median row error of each pair, its matches corrected by what the other half says
    shift: int = 0  # left image k belongs to right image k + shift

    @property
    def worst_px(self) -> float:
        """Of the pair that fits least."""
        return float(self.error_px.max())


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


def better_fit(rig: Rig, images: Sequence[StereoImage], chosen: Iterable[int]) -> Fit | None:
    """What makes the rows of the chosen pairs fit; None if the given calibration does, or nothing was found.

    Args:
        rig: two cameras. images: successive pairs. chosen: positions of those to look at.

    Raises:
        StereoSfmError: the rig cannot be rectified.
    """
    rectification, at = rectify(rig, "epipolar"), list(chosen)
    best = _best(rig, _windows(rectification, images, at, 0))
    if best is None:
        return None
    for shift in sorted(range(-MAX_SHIFT, MAX_SHIFT + 1), key=abs)[1:]:
        other = _best(rig, _windows(rectification, images, at, shift))
        if other is not None and len(other.error_px) > 1 and MIN_GAIN * other.worst_px < best.worst_px:
            text = " and ".join(part for part in (_apart(shift), other.text) if part)
            best = replace(other, text=text, shift=shift)
    return best if best.text and best.worst_px < LIMIT_PX else None


def _apart(shift: int) -> str:
    frames = "a frame" if abs(shift) == 1 else f"{abs(shift)} frames"
    return f"each left image fits the right one of {frames} {'before' if shift < 0 else 'later'}"


def _windows(rectification: Rectification, images: Sequence[StereoImage], at: list[int], shift: int) -> list[Window]:
    """The matches of left images `at` with right images `shift` later, where there are enough."""
    rows = search_rows(rectification)
    pairs = [replace(images[k], right=images[k + shift].right) for k in at if 0 <= k + shift < len(images)]
    found = [still_window(rectification, pair, CORNERS, rows) for pair in pairs if pair.right is not None]
    return [window for window in found if len(window.rows) >= MIN_POINTS]


def _best(rig: Rig, windows: list[Window]) -> Fit | None:
    """The given rig, or one that is much better; None without enough matches."""
    if sum(len(window.rows) for window in windows) < MIN_MATCHES:
        return None
    given = Fit("", rig, _medians(windows, rig, rig))
    turned, shifted = _turned(rig, windows), _moved_rows(rig, windows)
    other = shifted if turned is None or MIN_GAIN * shifted.worst_px < turned.worst_px else turned
    return other if MIN_GAIN * other.worst_px < given.worst_px else given


def _turned(rig: Rig, windows: list[Window]) -> Fit | None:
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
    return Fit(text, best, _medians(windows, first, second))


def _moved_rows(rig: Rig, windows: list[Window]) -> Fit:
    first, second = (_with_rows_moved(rig, half) for half in _halves(windows))
    whole = _with_rows_moved(rig, windows)
    assert rig.right is not None and whole.right is not None
    rows = whole.right.cy - rig.right.cy
    text = f"the rows of the right image are {abs(rows):.1f} px {'lower' if rows > 0 else 'higher'} than calibrated"
    return Fit(text, whole, _medians(windows, first, second))


def _with_rows_moved(rig: Rig, windows: list[Window]) -> Rig:
    """The rig with the right principal point moved along y, by Newton's steps of the median row error; the same rig
    where that moves points along their epipolar curves, as of cameras one above the other."""
    for _ in range(3):
        assert rig.right is not None
        lower = replace(rig, right=replace(rig.right, cy=rig.right.cy + 1.0))
        here, there = (np.concatenate([row_errors(one, window) for window in windows]) for one in (rig, lower))
        across = there - here  # px of row error by a row
        if not np.nanmedian(np.abs(across)) > 0.5:
            return rig
        rig = replace(rig, right=replace(rig.right, cy=rig.right.cy - float(np.nanmedian(here / across))))
    return rig


def _halves(windows: list[Window]) -> tuple[list[Window], list[Window]]:
    """Even and odd windows; of a single window, even and odd points: as `estimate` divides them."""
    if len(windows) > 1:
        return windows[0::2], windows[1::2]
    (one,) = windows
    even, odd = (Window(one.left[:, k::2], one.right[:, k::2], one.right_velocity[:, k::2], one.rows) for k in (0, 1))
    return [even], [odd]


def _medians(windows: list[Window], first: Rig, second: Rig) -> F64:
    """(F,) median absolute row errors: of the first half's windows with the rig of the second, and the reverse."""
    even, odd = _halves(windows)
    halves = [(second, window) for window in even] + [(first, window) for window in odd]
    return np.array([np.nanmedian(_misfit(rig, window)) for rig, window in halves])


def _misfit(rig: Rig, window: Window) -> F64:
    """(N,) absolute row errors; infinite for points behind the cameras, which no calibration explains."""
    disparity = rig.left.fx * rig.baseline * inverse_distances(rig, window.left[0], window.right[0])
    return np.where(disparity < MIN_DISPARITY_PX, np.inf, np.abs(row_errors(rig, window)))
