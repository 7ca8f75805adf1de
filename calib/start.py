"""The start check: whether a few of the first images fit the calibration, and what would make them fit.

A pair fits if half of its stereo matches lie within a pixel of their rows, as the trackers need it. The first pair that
fits ends the check. If none does, the calibration is corrected (`calib.wrong_rig`) or a mistake is named
(`calib.mistakes`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from stereo_sfm.calib.matches import match_pair
from stereo_sfm.calib.mistakes import MIN_DISPARITY_PX, mistake
from stereo_sfm.calib.rectification import Rectification, rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.wrong_rig import correction
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import U8, StereoImage

MAX_PAIRS = 3  # of a recording that are examined
SPACING = 5  # frames from one to the next
LOOKED_AT = SPACING * (MAX_PAIRS - 1) + 1  # frames
CORNERS = 100  # of the left image
MIN_CORNERS = 25  # with fewer an image shows too little to judge a calibration
MIN_MATCHES = 12  # with fewer a pair does not fit; as in a window of `check-calib`
FITTING_SHARE = 0.5  # of the matches
LIMIT_PX = 1.0  # of a row error: what the tracker accepts (tracker.max_epipolar_px)
DARK_MEDIAN, BRIGHT_MEDIAN = 12.0, 243.0  # grey levels
MIN_CONTRAST = 4.0  # grey levels between the 10th and the 90th percentile


@dataclass(frozen=True, eq=False)
class StartFinding:
    """What the first images say about the calibration."""

    text: str = ""  # one line; "" if they fit
    rig: Rig | None = None  # the calibration that they fit; None: none is known but the given one
    shown: bool = False  # by the images; False: only a guess, for a tracker that does not start


def check_start(rig: Rig, images: Iterable[StereoImage]) -> StartFinding:
    """Check a calibration by some of the first images; of one camera only the exposure is checked.

    Args:
        rig: the calibration.
        images: `SPACING` frames from one to the next, at most `MAX_PAIRS`; read as far as needed.
    """
    seen: list[StereoImage] = []
    rectification: Rectification | None = None
    for image in images:
        seen.append(image)
        if image.right is None or rig.second_camera is None:
            if not _exposure([image.left]):
                return StartFinding()
            continue
        try:
            rectification = rectification or rectify(rig, "epipolar")
        except StereoSfmError:
            continue
        if _fits(rectification, image.left, image.right):
            return StartFinding()
    light = _exposure([image.left for image in seen])
    if light:
        return StartFinding(light)
    pairs = [image for image in seen if image.right is not None]
    return _what_is_wrong(rig, pairs, rectification is not None) if pairs and rig.second_camera else StartFinding()


def _fits(rectification: Rectification, left: U8, right: U8) -> bool:
    found = match_pair(rectification, *rectification.apply(left, right), CORNERS)
    ahead = found.left[:, 0] - found.right[:, 0] > MIN_DISPARITY_PX
    return len(found) >= MIN_MATCHES and float((ahead & (np.abs(found.row_error) < LIMIT_PX)).mean()) >= FITTING_SHARE


def _what_is_wrong(rig: Rig, pairs: Sequence[StereoImage], valid: bool) -> StartFinding:
    better = correction(rig, pairs) if valid else None
    if better is not None:
        return StartFinding(better.text, better.rig, True)
    text, shown = mistake(rig, [(image.left, image.right) for image in pairs if image.right is not None])
    return StartFinding(text, None, shown)


def _exposure(images: Sequence[U8]) -> str:
    if not images:
        return ""
    middle = float(np.median([np.median(image) for image in images]))
    spread = float(np.median([np.subtract(*np.percentile(image, (90, 10))) for image in images]))
    if middle < DARK_MEDIAN:
        return f"the images are nearly black (median grey level {middle:.0f} of 255): increase light or exposure"
    if middle > BRIGHT_MEDIAN:
        return f"the images are nearly white (median grey level {middle:.0f} of 255): reduce the exposure"
    if spread < MIN_CONTRAST:
        return f"the images have no contrast (grey levels within {spread:.0f}): a covered lens, or a blank wall"
    return ""
