"""Why does tracking not start? The usual mistakes tried one by one on a few pairs: which one makes the cameras agree?

Stereo matches are searched with the calibration as it is and with each mistake undone (`calib.matches`). Where undoing
one gives many times the matches, it is named. A pair whose cameras are parallel and alike cannot tell left and right
exchanged from both images upside down or a transform the wrong way round: then all that help are named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from stereo_sfm.calib.matches import match_pair
from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry import se3
from stereo_sfm.types import U8, StereoImage

PAIRS = 3  # looked at
CORNERS = 200  # searched in each
BEHIND_PX = -0.5  # disparity below which a point lies behind the cameras
ROW_PX = 2.0  # distance of a match from its row
ENOUGH = 25  # matches a pair with which the cameras agree
BETTER = 3.0  # times the matches as it is, for a mistake to be named
SHARE = 0.7  # of the best one's matches, for another mistake to be named beside it
NEARLY_BLACK, NEARLY_WHITE = 12.0, 243.0  # grey levels of the middle pixel
FLAT = 4.0  # grey levels between the dark and the light tenth of the pixels

Pair = tuple[U8, U8]


@dataclass(frozen=True)
class Mistake:
    """Something that goes wrong between cameras and calibration, and how it is undone."""

    name: str
    rig: Callable[[Rig], Rig]
    pair: Callable[[Pair], Pair]


def _turned(image: U8) -> U8:
    return np.ascontiguousarray(image[::-1, ::-1])


def _inverted(rig: Rig) -> Rig:
    return replace(rig, left_T_right=se3.inverse(rig.left_T_right))


MISTAKES = (
    Mistake("left and right are exchanged", lambda rig: rig, lambda pair: (pair[1], pair[0])),
    Mistake("left_T_right is the wrong way round", _inverted, lambda pair: pair),
    Mistake("both images are upside down", lambda rig: rig, lambda pair: (_turned(pair[0]), _turned(pair[1]))),
    Mistake("the left image is upside down", lambda rig: rig, lambda pair: (_turned(pair[0]), pair[1])),
    Mistake("the right image is upside down", lambda rig: rig, lambda pair: (pair[0], _turned(pair[1]))),
)


def why_no_start(rig: Rig, images: Sequence[StereoImage]) -> str:
    """One line that says why tracking does not start with these images; "" where nothing is found.

    Args:
        rig: that the images were tracked with.
        images: some of the first; those without a right image only say how bright they are.
    """
    light = _exposure([image.left for image in images])
    if light:
        return light
    pairs = [(image.left, image.right) for image in images if image.right is not None][:PAIRS]
    if rig.right is None or not pairs:
        return ""
    return _mistake(rig, pairs)


def _exposure(images: Sequence[U8]) -> str:
    if not images:
        return ""
    middle = float(np.median([np.median(image) for image in images]))
    spread = float(np.median([np.subtract(*np.percentile(image, (90, 10))) for image in images]))
    if middle < NEARLY_BLACK:
        return f"the images are nearly black (half of the pixels are below {middle:.0f} of 255): more light or exposure"
    if middle > NEARLY_WHITE:
        return f"the images are nearly white (half of the pixels are above {middle:.0f} of 255): less exposure"
    if spread < FLAT:
        return f"the images show nothing (their grey levels differ by {spread:.0f}): a covered lens, or a bare wall"
    return ""


def _mistake(rig: Rig, pairs: Sequence[Pair]) -> str:
    now = _matches(rig, pairs)
    if now >= ENOUGH:
        return ""
    undone = [(_matches(mistake.rig(rig), [mistake.pair(pair) for pair in pairs]), mistake) for mistake in MISTAKES]
    best = max(count for count, _ in undone)
    if best < max(ENOUGH, BETTER * now):
        return f"the cameras hardly agree ({now:.0f} stereo matches a pair): is this the calibration of these cameras?"
    names = [mistake.name for count, mistake in undone if count >= SHARE * best]
    return f"{' or '.join(names)}: {now:.0f} stereo matches a pair as it is, {best:.0f} when that is undone"


def _matches(rig: Rig, pairs: Sequence[Pair]) -> float:
    """Stereo matches on their rows, of points in front of the cameras: mean over the pairs."""
    try:
        rectification = rectify(rig, "epipolar")
    except StereoSfmError:
        return 0.0
    counts: list[int] = []
    for left, right in pairs:
        found = match_pair(rectification, *rectification.apply(left, right), CORNERS)
        ahead = found.left[:, 0] - found.right[:, 0] > BEHIND_PX
        counts.append(int((ahead & (np.abs(found.row_error) < ROW_PX)).sum()))
    return float(np.mean(counts))
