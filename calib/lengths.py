"""What a calibration's lengths mean for the first images: no pair of images can check them.

All of a map scales with the baseline, and the images fit each scale alike. A person who knows the place sees at once
whether the distances can be true.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import islice

import numpy as np

from stereo_sfm.calib.rectification import rectify
from stereo_sfm.calib.rig import Rig
from stereo_sfm.calib.start import CORNERS, LOOKED_AT, MIN_MATCHES, SEARCH_ROWS
from stereo_sfm.calib.tracks import still_window
from stereo_sfm.calib.wrong_rig import LIMIT_PX, MIN_DISPARITY_PX
from stereo_sfm.errors import StereoSfmError
from stereo_sfm.geometry.stereo import triangulate
from stereo_sfm.types import F64, StereoImage


def unchecked_lengths(rig: Rig, images: Iterable[StereoImage]) -> str:
    """One line about the length that scales everything, "" with one camera.

    Args:
        rig: the calibration. images: successive ones; few are read.
    """
    if rig.depth:
        return "the images cannot check the unit of the depths: compare a distance that you know"
    if rig.second_camera is None:
        return ""
    text = f"the images cannot check the baseline of {1e3 * rig.baseline:.4g} mm"
    metres = _distances(rig, images)
    if len(metres) < MIN_MATCHES:
        return f"{text}: measure it"
    near, middle, far = np.percentile(metres, (10, 50, 90)).tolist()
    return f"{text}; by it the points of the first pair are {near:.2g} to {far:.2g} m away, half within {middle:.2g} m"


def _distances(rig: Rig, images: Iterable[StereoImage]) -> F64:
    """(N,) metres from the left camera to the stereo matches of the first pair that has enough of them."""
    second = rig.second_camera
    assert second is not None
    with suppress(StereoSfmError):  # no epipolar geometry, or the source fails: the start check says so
        rectification = rectify(rig, "epipolar")
        for image in islice(images, LOOKED_AT):
            if image.right is None:
                continue
            window = still_window(rectification, image, CORNERS, SEARCH_ROWS)
            rows = window.rows
            good = (np.abs(rows.row_error) < LIMIT_PX) & (rows.left[:, 0] - rows.right[:, 0] > MIN_DISPARITY_PX)
            if int(good.sum()) < MIN_MATCHES:
                continue
            left, right = rig.left.unproject(window.left[0][good]), second.unproject(window.right[0][good])
            metres = np.linalg.norm(triangulate(left, right, rig.left_T_right), axis=-1)
            return metres[np.isfinite(metres)]
    return np.zeros(0)
