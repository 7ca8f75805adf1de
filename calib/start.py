"""The start check: whether a few of the first images fit the calibration, and what would make them fit.

A pair fits if half of its stereo matches lie within a pixel of their rows, as the trackers need it, and no other lens
model fits it much better (`calib.other_lens`). The first pair that fits ends the check. If none does, the lens model or
the calibration is corrected (`calib.wrong_rig`) or a mistake is named (`calib.mistakes`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice

import cv2
import numpy as np

from stereo_sfm.calib.mistakes import mistake
from stereo_sfm.calib.other_lens import OtherLens, other_lens
from stereo_sfm.calib.rectification import Rectification, rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.tracks import Window, still_window
from stereo_sfm.calib.wrong_rig import LIMIT_PX, MAX_SHIFT, MIN_DISPARITY_PX, Fit, better_fit
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.types import U8, StereoImage

CHOSEN = (0, 5, 10)  # the pairs that are examined, if the first one does not fit
LOOKED_AT = CHOSEN[-1] + 1 + MAX_SHIFT  # images: some on either side of these, where pairs may be frames apart
CORNERS = 100  # of the left image
SEARCH_ROWS = 14  # above and below, px
MIN_CORNERS = 25  # with fewer, and fewer matches, an image shows too little to judge a calibration
MIN_MATCHES = 12  # with fewer a pair does not fit; as in a window of `check-calib`
FITTING_SHARE = 0.5  # of the matches
DOUBTFUL = 0.1  # of the corrected matches, behind the cameras: a mistake may explain more
CALIBRATE = "'stereo-sfm calibrate' measures lenses; 'stereo-sfm convert-calib --lens' says what a file's numbers are"
ADVICE = "'stereo-sfm check-calib SOURCE --correct rig.yaml' measures it with all images; then use '--rig rig.yaml'"
PAIR = "pair the images by the cameras' own stamps, or give both of a pair the same number"
READ_OTHERWISE = "name their topics so ('image_rect' or 'image_raw'), or give their calibration with '--rig FILE'"
DARK_MEDIAN, BRIGHT_MEDIAN = 12.0, 243.0  # grey levels
MIN_CONTRAST = 4.0  # grey levels between the 10th and the 90th percentile
EDGE = 8  # grey levels between neighbours in a row, where two cameras' images are compared
MIN_EDGES = 100  # pixels, with which the images tell one camera from two
SAME = 0.9  # of them: two sensors' noise leaves fewer equal even without disparity, as their noise would have to be
# below a tenth of a grey level (shot noise of 4 million electrons); real pairs have less than 0.07
ONE_CAMERA = "left and right show the images of one camera: give each side its own folder, file or topic"


@dataclass(frozen=True, eq=False)
class StartFinding:
    """What the first images say about the calibration."""

    text: str = ""  # one line; "" if they fit
    rig: Rig | None = None  # the calibration that they fit; None: none is known but the given one
    shift: int = 0  # left image k belongs to right image k + shift
    shown: bool = False  # by the images; False: only a guess, for a tracker that does not start
    advice: str = ADVICE  # what a user can do besides
    masked: Rig | None = None  # the given calibration with masks of what sticks to the images; None: nothing does


def check_start(
    rig: Rig, images: Iterable[StereoImage], other_reading: Callable[[], tuple[str, Rig] | None] = lambda: None
) -> StartFinding:
    """Check a calibration by the first images; of one camera only the exposure is checked.

    Args:
        rig: the calibration.
        images: successive ones; `LOOKED_AT` of them are read, but only one if it fits.
        other_reading: of the source, asked if they do not fit.
    """
    seen: list[StereoImage] = []
    cameras, alike = _Cameras(rig), 0
    for number, image in enumerate(islice(images, LOOKED_AT)):
        seen.append(image)
        if number in CHOSEN and of_one_camera(image):
            alike += 1
        elif number in CHOSEN and cameras.fit(image):
            return StartFinding()
    chosen = [k for k in CHOSEN if k < len(seen)]
    if alike and alike == len(chosen):
        return StartFinding(ONE_CAMERA, shown=True)
    light = exposure([seen[k].left for k in chosen])
    if light or not cameras.judged:
        return StartFinding(light)
    other = other_reading()
    if other is not None and _confirmed(Fit(*other, np.zeros(0)), seen, chosen) is not None:
        return StartFinding(*other, shown=True, advice=READ_OTHERWISE)
    lens = other_lens(rig, cameras.windows)
    if lens is not None and lens.fits:
        return _of_lens(lens)
    pairs = [(seen[k].left, right) for k in chosen if (right := seen[k].right) is not None]
    better = None if cameras.rows_fit or cameras.rectification is None else better_fit(rig, seen, chosen)
    tried = None if better is None else _confirmed(better, seen, chosen)
    if better is not None and tried is not None:
        text, shown = mistake(rig, pairs, better.rig) if tried.behind > DOUBTFUL and not better.shift else ("", False)
        if shown:
            return StartFinding(text, shown=True)
        return StartFinding(better.text, better.rig, better.shift, True, PAIR if better.shift else ADVICE)
    if lens is not None:
        return _of_lens(lens)
    if cameras.rows_fit:
        return StartFinding()
    text, shown = mistake(rig, pairs)
    return StartFinding(text, shown=shown)


def _of_lens(lens: OtherLens) -> StartFinding:
    text = lens.text if lens.known else f"{lens.text}: {CALIBRATE}"
    return StartFinding(text, lens.rig if lens.known else None, shown=True, advice=CALIBRATE)


def _confirmed(better: Fit, images: Sequence[StereoImage], chosen: Sequence[int]) -> _Cameras | None:
    """The cameras by which most pairs fit, once they are rectified and searched anew; None if they do not."""
    cameras, at = _Cameras(better.rig), [k for k in chosen if 0 <= k + better.shift < len(images)]
    fits = [cameras.fit(replace(images[k], right=images[k + better.shift].right)) for k in at]
    return cameras if 2 * sum(fits) > len(fits) else None


class _Cameras:
    """Whether pairs fit the calibration."""

    def __init__(self, rig: Rig) -> None:
        self.rectification: Rectification | None = None
        self.judged = False  # a pair that shows something was seen
        self.rows_fit = False  # of one of the pairs
        self.behind = 0.0  # largest share of a pair's matches near their rows that lie behind the cameras
        self.windows: list[Window] = []  # the matches of the pairs
        self._rig, self._stereo = rig, rig.second_camera is not None
        if self._stereo:
            with suppress(StereoSfmError):  # no epipolar geometry: nothing fits
                self.rectification = rectify(rig, "epipolar")

    def fit(self, image: StereoImage) -> bool:
        """Whether half of the matches are near their rows, and no other lens fits better. An image of one camera fits
        if it shows something."""
        if image.right is None or not self._stereo:
            return not exposure([image.left])
        if self.rectification is None:
            self.judged = True
            return False
        window = still_window(self.rectification, image, CORNERS, SEARCH_ROWS)
        found = window.rows
        self.windows.append(window)
        self.judged |= found.corners >= MIN_CORNERS or len(found) >= MIN_MATCHES
        ahead = found.left[:, 0] - found.right[:, 0] > MIN_DISPARITY_PX
        in_rows = np.abs(found.row_error) < LIMIT_PX
        near = ahead & in_rows
        self.behind = max(self.behind, float((in_rows & ~ahead).sum()) / max(int(in_rows.sum()), 1))
        rows_fit = len(found) >= MIN_MATCHES and float(near.mean()) >= FITTING_SHARE
        self.rows_fit |= rows_fit
        return rows_fit and other_lens(self._rig, [window]) is None


def of_one_camera(image: StereoImage) -> bool:
    """Whether both sides are the same image, by the pixels at edges; False where they show nothing."""
    if image.right is None or image.left.shape != image.right.shape:
        return False
    left, right = image.left[::4], image.right[::4]  # enough rows
    edges = cv2.absdiff(left[:, 1:], left[:, :-1]) >= EDGE
    same = (left[:, 1:] == right[:, 1:])[edges]
    return len(same) >= MIN_EDGES and float(same.mean()) >= SAME and not exposure([image.left])


def exposure(images: Sequence[U8]) -> str:
    """Why images show nothing, "" if they do."""
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
