"""Common mistakes between images and calibration, undone one by one on a few pairs.

Stereo matches are searched with the given calibration and with each mistake undone (`calib.matches`); a mistake is
reported if undoing it gives many times the matches. For identical parallel cameras, swapped images, upside-down images
and an inverted transform are indistinguishable: then all that help are reported.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.matches import match_pair
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.wrong_rig import MIN_DISPARITY_PX
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import U8

CORNERS = 200  # searched in each pair
MAX_ROW_ERROR_PX = 2.0
MIN_MATCHES = 25  # in a pair, with which a calibration is plausible
MIN_GAIN = 3.0  # ratio of matches with and without a mistake undone, for it to be reported
MIN_SHARE_OF_BEST = 0.7  # of the best mistake's matches, for another one to be reported too

Pair = tuple[U8, U8]


@dataclass(frozen=True)
class Mistake:
    """A common mistake between images and calibration, and how to undo it."""

    name: str
    rig: Callable[[Rig], Rig]
    pair: Callable[[Pair], Pair]


def _turned(image: U8) -> U8:
    return np.ascontiguousarray(image[::-1, ::-1])


def _inverted(rig: Rig) -> Rig:
    return replace(rig, left_T_right=se3.inverse(rig.left_T_right))


def _of_optical_axes(rig: Rig) -> Rig:
    """A transform in axes with x forwards, y left and z up, as robots have them (REP 103), in those of cameras."""
    body_R_optical = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    body_T_optical = se3.from_rotation_translation(body_R_optical, np.zeros(3))
    return replace(rig, left_T_right=se3.inverse(body_T_optical) @ rig.left_T_right @ body_T_optical)


IN_BODY_AXES = "left_T_right is in a body's axes (x forwards), not in the camera's (z forwards)"
MISTAKES = (
    Mistake("left and right are swapped", lambda rig: rig, lambda pair: (pair[1], pair[0])),
    Mistake("left_T_right is inverted", _inverted, lambda pair: pair),
    Mistake(IN_BODY_AXES, _of_optical_axes, lambda pair: pair),
    Mistake("both images are upside down", lambda rig: rig, lambda pair: (_turned(pair[0]), _turned(pair[1]))),
    Mistake("the left image is upside down", lambda rig: rig, lambda pair: (_turned(pair[0]), pair[1])),
    Mistake("the right image is upside down", lambda rig: rig, lambda pair: (pair[0], _turned(pair[1]))),
)


def mistake(rig: Rig, pairs: Sequence[Pair], corrected: Rig | None = None) -> tuple[str, bool]:
    """What is wrong between these pairs and the calibration, "" if nothing is found, and whether the images show it.

    Args:
        rig: two cameras. pairs: left and right images, one pair or more.
        corrected: another explanation, which a mistake must exceed in matches.
    """
    now = _matches(rig, pairs)
    undone = [(_matches(mistake.rig(rig), [mistake.pair(pair) for pair in pairs]), mistake) for mistake in MISTAKES]
    best = max(count for count, _ in undone)
    if corrected is not None and best <= _matches(corrected, pairs):
        return "", False
    if best < max(MIN_MATCHES, MIN_GAIN * now):
        if now >= MIN_MATCHES:
            return "", False
        return f"few stereo matches ({now:.0f} per pair): is this the calibration of these cameras?", False
    names = [mistake.name for count, mistake in undone if count >= MIN_SHARE_OF_BEST * best]
    return f"{' or '.join(names)}: {now:.0f} stereo matches per pair, {best:.0f} with that undone", True


def _matches(rig: Rig, pairs: Sequence[Pair]) -> float:
    """Mean number per pair of stereo matches with small row error and points in front of the cameras."""
    try:
        rectification = rectify(rig, "epipolar")
    except StereoSfmError:
        return 0.0
    counts: list[int] = []
    for left, right in pairs:
        found = match_pair(rectification, *rectification.apply(left, right), CORNERS)
        ahead = found.left[:, 0] - found.right[:, 0] > MIN_DISPARITY_PX
        counts.append(int((ahead & (np.abs(found.row_error) < MAX_ROW_ERROR_PX)).sum()))
    return float(np.mean(counts))
